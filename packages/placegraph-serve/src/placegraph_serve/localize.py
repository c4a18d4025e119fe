"""Localizing images, at once and step by step in a session."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from math import radians
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.estimate import CityEstimate, PoseEstimate, PoseMode, Status
from placegraph.core.geometry import Camera
from placegraph.core.options import in_radians
from placegraph.errors import OptionError, PlacegraphError, RequestError
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.pose.prior import Prior
from placegraph.indoor.status import SURE_SCENE, decide_joined, diagnostics_of
from placegraph.io.capture.frame import Frame
from placegraph.outdoor.language.languages import translate
from placegraph.outdoor.search.status import describe_doubt
from placegraph.outdoor.track.tracker import CityTracker
from placegraph_serve.locate import describe_answer, on_earth, options_in, read_answer
from placegraph_serve.options import ServeOptions
from placegraph_serve.photon import name_places
from placegraph_serve.requests import (
    LEVEL,
    TILTS,
    Hints,
    Images,
    Photo,
    camera_of,
    capture_in,
    check_focal,
    fit_size,
    image_bytes,
    images_of,
    read_depth,
    read_photo,
    tilt_camera,
)

if TYPE_CHECKING:
    from placegraph.outdoor.search.ask import Question
    from placegraph_serve.places import Dispatcher, Places

MOST_ALONE = 8
"""Images at most that no odometry joins."""
LENS = (
    "The image does not tell its focal length, so a usual one was assumed; use the camera's "
    "original image, or give its intrinsics."
)
ROOM, TOGETHER = 6.0, 0.95
"""Distance [m] within which images without odometry were taken, and the probability that they were."""


def warm(_dispatcher: Dispatcher, _request: None) -> dict[str, Any]:
    """Load what every image needs; a scene is opened when it is asked for."""
    import_module("placegraph.indoor.localize")
    return {}


def plan(dispatcher: Dispatcher, request: dict[str, Any]) -> bytes:
    """Plan of a scene as PNG."""
    from placegraph.view import draw_scene

    scene = dispatcher.places.scene(request["map"])
    with TemporaryDirectory(prefix="placegraph-") as folder:
        return Path(draw_scene(scene, Path(folder) / "plan.png")).read_bytes()


def localize(dispatcher: Dispatcher, request: dict[str, Any]) -> dict[str, Any]:
    """Localize images; `request`: `folder` of the files, their names, and `request`."""
    places, folder = dispatcher.places, Path(request["folder"])
    try:
        images, hints = read(folder, request, dispatcher.options)
        record = "animation" in request["request"]["pictures"]
        estimate, frames = find_best(places, images, hints, record=record)
        pose, where = pose_estimate(estimate), scene_name(places, hints, estimate)
        pictures = {
            name: picture(places, pose, where, frames, folder / f"{name}.png")
            for name in request["request"]["pictures"]
        }
    except PlacegraphError as error:
        if str(folder) not in str(error):
            raise
        raise type(error)(str(error).replace(f"{folder}/", "")) from error  # nobody's business
    return {
        "map": where,
        "estimate": estimate.to_dict(),
        "geopose": on_earth(estimate.geopose),
        "geojson": on_earth(estimate.geojson),
        "pictures": pictures,
        "notes": notes(places, hints, estimate, frames),
    }


def read(folder: Path, request: dict[str, Any], options: ServeOptions) -> tuple[Images, Hints]:
    """Frames and hints of what was sent."""
    parameters = request["request"]
    near = parameters["near"]
    if request["capture"]:
        (folder / "capture").mkdir()
        capture = capture_in(folder / request["capture"], folder / "capture", options)
        images = Images(tuple(capture), moved=True, leveled=True)
    else:
        photos = [
            read_photo((folder / name).read_bytes(), f"images[{i}]", options)
            for i, name in enumerate(request["images"])
        ]
        depths = [
            read_depth(
                (folder / name).read_bytes(), f"depth[{i}]", parameters["depth_scale"], options
            )
            for i, name in enumerate(request["depth"])
        ]
        images = images_of(photos, depths, parameters)
        near = near or next((photo.fix[:2] for photo in photos if photo.fix), None)
    if not images.moved and len(images.frames) > MOST_ALONE:
        raise OptionError(
            f"odometry: {len(images.frames)} images need it, because the limit without it is "
            f"{MOST_ALONE}; send the camera's motion, or fewer images."
        )
    heading, prior = parameters["heading_deg"], parameters["prior"]
    return images, Hints(
        map=parameters["map"], description=parameters["description"] or None, near=near,
        radius=parameters["radius"], seed=parameters["seed"],
        heading=None if heading is None else radians(heading),
        prior=None if prior is None else Prior(**in_radians(prior)),
    )  # fmt: skip


def find_best(
    places: Places, images: Images, hints: Hints, *, record: bool = False
) -> tuple[Any, list[Frame]]:
    """Return the estimate of images, and the frames that it is of.

    Images without odometry are localized one by one; as images of one room they confirm each other. Cameras
    of unknown tilt are tried as tilted while no image is certain.
    """
    groups = [list(images.frames)] if images.moved else [[frame] for frame in images.frames]
    found: dict[int, tuple[Any, list[Frame]]] = {}
    problem: OptionError | None = None
    for tilt in (None,) if images.leveled else (None, *TILTS):
        for i, group in enumerate(groups):
            if i in found and rank_answer(found[i][0]) >= (False, True):
                continue
            frames = group if tilt is None else [tilt_camera(frame, tilt) for frame in group]
            try:
                estimate = answer(places, frames, hints, record=record)
            except OptionError as error:
                problem = error
                continue
            if i not in found or rank_answer(estimate) > rank_answer(found[i][0]):
                found[i] = estimate, frames
        if any(estimate.status is Status.OK for estimate, _ in found.values()):
            break
    if not found:
        assert problem is not None  # noqa: S101  # nothing was localized
        raise problem
    joined = join_images([estimate for estimate, _ in found.values()])
    best = max(range(len(joined)), key=lambda i: rank_image(joined[i]))
    estimate, frames = joined[best], list(found.values())[best][1]
    apart = [e for e in joined if e.status is Status.OK and not are_near(e.best, estimate.best)]
    if apart and estimate.best is not None:
        reason = f"{estimate.reason} {len(apart)} of {len(joined)} images fit another place."
        estimate = replace(estimate, reason=reason)
    return estimate, frames


def join_images(estimates: Sequence[Any]) -> list[Any]:
    """Return estimates of images of one room, the modes of each weighed by the other images.

    Under a mode, another image was taken within `ROOM` with probability `TOGETHER`, or else anywhere:
    p(mode) is multiplied by 1 - TOGETHER p(modes of the other that are not near).
    """
    told = [e for e in estimates if e.status is not Status.LOST and e.modes]
    joined = []
    for estimate in estimates:
        others = [other for other in told if other is not estimate]
        if not others or estimate not in told:
            joined.append(estimate)
            continue
        weights = np.array([*(mode.probability for mode in estimate.modes), estimate.remainder])
        for other in others:
            far = [
                sum(m.probability for m in other.modes if not are_near(m, mode))
                for mode in estimate.modes
            ]
            weights *= 1.0 - TOGETHER * np.array([*far, 1.0 - other.remainder])
        joined.append(decide_joined(estimate, (weights / weights.sum())[:-1].tolist()))
    return joined


def are_near(one: Any, other: Any) -> bool:  # noqa: ANN401  # modes of a scene or of a world
    """Return whether two modes may be of one room."""
    one, other = (m if isinstance(m, PoseMode) else m.pose for m in (one, other))
    if not isinstance(one, PoseMode) or not isinstance(other, PoseMode) or one.scene != other.scene:
        return False
    off = one.scene_from_camera[:3, 3] - other.scene_from_camera[:3, 3]
    return float(np.linalg.norm(off)) < ROOM


def answer(places: Places, frames: list[Frame], hints: Hints, *, record: bool) -> Any:  # noqa: ANN401
    """Estimate of frames that belong together, in the map asked or in all of them."""
    name = hints.map or places.only
    kind = "world" if name is None else places.entry(name).kind
    if kind == "scene" and name is not None:
        scene = places.scene(name)
        prior = hints.prior_in(scene.anchors)
        if hints.prior is None and len(frames) > 30:  # those are tracked, from no prior
            prior = None
        asked: Any = {"prior": prior, "description": hints.description, "seed": hints.seed}
        estimate = scene.localize(frames, **asked)
        if record:  # a second run, so that a picture changes no answer
            recorded = FilterOptions(record=True)
            run = scene.localize(frames, options=recorded, refine=False, **asked)
            estimate = replace(estimate, history=run.history)
        return estimate
    if kind == "library" and name is not None:
        found_in: Any = places.open(name)
        return found_in.localize(frames, description=hints.description, seed=hints.seed)
    if kind == "city":
        raise RequestError(
            f"Map {name!r} is a city, but images are localized in scenes; name a scene or library, "
            "or no map.",
            status=422, code="map_kind",
        )  # fmt: skip
    return places.world(name).locate(
        hints.description, frames, near=hints.near, radius=hints.radius, heading=hints.heading,
        seed=hints.seed,
    )  # fmt: skip


def rank_answer(estimate: Any) -> tuple[bool, bool, float]:  # noqa: ANN401
    """Rank an answer among those to other tilts of a camera: its certainty, and how well it fits."""
    pose, certain = pose_estimate(estimate), estimate.status is Status.OK
    refined = pose is not None and pose.refinement is not None and pose.refinement.accepted
    return certain, certain or refined, 0.0 if pose is None else diagnostics_of(pose).ratio


def rank_image(estimate: Any) -> tuple[bool, bool, float]:  # noqa: ANN401
    """Rank the answer of an image among those of other images of a room: how sure it is."""
    share = estimate.best.probability if estimate.best else 0.0
    return estimate.status is Status.OK, estimate.status is not Status.LOST, share


def pose_estimate(estimate: Any) -> PoseEstimate | None:  # noqa: ANN401
    """Return the estimate in the scene of the best mode."""
    if isinstance(estimate, PoseEstimate):
        return estimate
    if estimate.best is None:
        return None
    found_in: PoseEstimate | None = estimate.poses.get(estimate.best.scene)
    return found_in


def scene_name(places: Places, hints: Hints, estimate: Any) -> str | None:  # noqa: ANN401
    """Name of the map that the answer is in."""
    if isinstance(estimate, PoseEstimate) or estimate.best is None:
        return hints.map or places.only
    return estimate.best.scene or None


def notes(places: Places, hints: Hints, estimate: Any, frames: list[Frame]) -> list[str]:  # noqa: ANN401
    """Return which parts of a request could not be used or are missing, and why."""
    name = hints.map or places.only
    guessed = [LENS] * any(frame.camera.focal_error > 0.0 for frame in frames)
    if name is None or places.entry(name).kind != "scene":
        return [*getattr(estimate, "notes", ()), *guessed]
    return [*hints.notes(name, places.scene(name).anchors), *guessed]


def picture(
    places: Places,
    estimate: PoseEstimate | None,
    where: str | None,
    frames: list[Frame],
    path: Path,
) -> str | None:
    """A picture, named by the stem of the path, as a data URL; None where there is nothing to draw."""
    from placegraph import view

    scenes = {entry.name for entry in places.entries() if entry.kind == "scene"}
    if estimate is None or not estimate.modes or where not in scenes:
        return None
    scene, camera = places.scene(where), frames[-1].camera
    if path.stem == "plan":
        view.write_plan(scene, estimate, path, camera=camera, capture=frames)
    elif path.stem == "overlay":
        view.write_overlay(scene, estimate, frames, path)
    elif any(record.steps for record in estimate.history):
        path = path.with_suffix(".gif")
        view.write_plan_animation(scene, estimate, path, camera=camera)
    else:
        return None
    return f"data:image/{path.suffix[1:]};base64,{b64encode(path.read_bytes()).decode()}"


def begin_session(dispatcher: Dispatcher, request: dict[str, Any]) -> dict[str, Any]:
    """Make the tracker of a session; `request`: `session`, and what `schema.Begin` has."""
    name = request["map"] or dispatcher.places.only
    cities = [e.name for e in dispatcher.places.entries() if e.kind == "city"]
    if name is None and (request["camera"] or not cities):
        raise OptionError("map: the server has several maps; name one.")
    if name is None:
        places, options = dispatcher.places, options_in(request)
        tracker: Any = {n: places.city(n).track(**options) for n in cities}
    elif dispatcher.places.entry(name).kind == "city":
        tracker = dispatcher.places.city(name).track(**options_in(request))
    else:
        camera = _session_camera(request)
        if camera is None:
            raise OptionError("camera: missing; give fx, width and height of the following images.")
        scene = dispatcher.places.scene(name)
        tracker = scene.tracker(camera, seed=request["seed"], description=request["description"])
    dispatcher.trackers[request["session"]] = name, tracker
    return {"map": name}


def _session_camera(request: dict[str, Any]) -> Camera | None:
    """Return the camera of a request in the size of read images; None: it has none."""
    camera = camera_of(request["camera"], None)
    if camera is None:
        return None
    check_focal(camera, "camera")
    return camera.resize(*fit_size((camera.width, camera.height)))


def step(dispatcher: Dispatcher, request: dict[str, Any]) -> dict[str, Any]:
    """One step of a session; `request`: `session`, and what `schema.Step` has."""
    if request["session"] not in dispatcher.trackers:
        raise RequestError(
            "The session has ended; start a new one.", status=410, code="session_over"
        )
    name, tracker = dispatcher.trackers[request["session"]]
    estimate: Any
    if isinstance(tracker, CityTracker | dict):
        trackers = tracker if isinstance(tracker, dict) else {name: tracker}
        estimate, question = _walk_anywhere(trackers, request)
        answer = describe_answer(name, estimate, question)
        answer["geojson"] = on_earth(estimate.geojson)
        return name_places(dispatcher, answer)
    estimate = tracker.update(
        _frame(dispatcher, _session_camera(request) or tracker.camera, request)
    )
    return {
        "map": name,
        "estimate": estimate.to_dict(),
        "geopose": on_earth(estimate.geopose),
        "geojson": on_earth(estimate.geojson),
    }


def end(dispatcher: Dispatcher, request: dict[str, Any]) -> dict[str, Any]:
    """Forget a session."""
    dispatcher.trackers.pop(request["session"], None)
    return {}


def _walk_anywhere(
    trackers: dict[str, CityTracker], request: dict[str, Any]
) -> tuple[CityEstimate, Question | None]:
    """Take a step in all cities, and join their posteriors; return estimate and question.

    A city's share is its odds against elsewhere, over the number of cities.
    """
    found = [(t, _walked(t, request)) for t in trackers.values()]
    if len(found) == 1:
        return found[0][1], found[0][1].next_question(found[0][0].city)
    off = np.clip([t.elsewhere for t, _ in found], 1e-9, 1.0 - 1e-9)
    odds = (1.0 - off) / off / len(found)
    shares = odds / (1.0 + odds.sum())
    scales = (shares / (1.0 - off)).tolist()
    modes = [
        replace(m, probability=m.probability * scale, explain=m.explain)
        for (_, e), scale in zip(found, scales, strict=True) for m in e.modes
    ]  # fmt: skip
    modes.sort(key=lambda m: -m.probability)
    support = [e.support * (1.0, 1.0, s) for (_, e), s in zip(found, scales, strict=True)]
    tracker, best = found[int(shares.argmax())]
    status, reason = best.status, best.reason
    if status is not Status.LOST and shares.max() < SURE_SCENE:  # the reason speaks of one town
        code = best.understood.language if best.understood else "en"
        status, reason = Status.AMBIGUOUS, translate(describe_doubt(modes[0].probability), code)
    joint = replace(
        best, status=status, reason=reason, modes=tuple(modes[:5]), support=np.concatenate(support)
    )
    return joint, best.next_question(tracker.city)


def _walked(tracker: CityTracker, request: dict[str, Any]) -> Any:  # noqa: ANN401  # an estimate
    bearing = request["bearing_deg"]
    estimate: Any = None
    if request["east"] is not None and request["north"] is not None:
        estimate = tracker.move(request["east"], request["north"], sigma=request["sigma"])
    if request["distance"] is not None:
        bearing = None if bearing is None else radians(bearing)
        estimate = tracker.walk(request["distance"], bearing)
    if request["text"] is not None:
        estimate = tracker.tell(request["text"])
    for answer in request["answers"]:
        estimate = tracker.answer(read_answer(answer))
    if estimate is None:
        raise OptionError(
            "step: the request is empty; give text, answers, east and north, or distance."
        )
    return estimate


def _frame(dispatcher: Dispatcher, camera: Camera, request: dict[str, Any]) -> Frame:
    if request["image"] is None:
        raise OptionError("image: missing; give one in base64, JPEG or PNG.")
    photo: Photo = read_photo(image_bytes(request["image"]), "image", dispatcher.options)
    depth = None
    if request["depth"] is not None:
        data = image_bytes(request["depth"])
        depth = read_depth(data, "depth", request["depth_scale"], dispatcher.options)
    gravity = request["gravity"]
    if gravity is None and request["odometry"] is None:
        gravity = LEVEL
    return Frame.from_arrays(
        photo.rgb, camera, depth=depth, odometry=request["odometry"], gravity=gravity,
        stamp=request["stamp"] or 0.0, index=request["number"],
    )  # fmt: skip
