"""Sessions in the process that holds them: a tracker each, and one step after the other."""

from __future__ import annotations

from math import radians
from typing import TYPE_CHECKING, Any

from placegraph.errors import OptionError, RequestError
from placegraph.io.capture.frame import Frame
from placegraph.outdoor.track.tracker import CityTracker
from placegraph_serve.asked import LEVEL, camera_of
from placegraph_serve.locate import answered, given, on_earth
from placegraph_serve.oscp import image_bytes
from placegraph_serve.photo import Photo, check_focal, fitted, read_depth, read_photo

if TYPE_CHECKING:
    from placegraph_serve.places import Desk


def begin(desk: Desk, asked: dict[str, Any]) -> dict[str, Any]:
    """Make the tracker of a session; `asked`: `session`, and what `schema.Begin` has."""
    name = asked["map"] or desk.places.only
    if name is None:
        raise OptionError("map: several are served; name one.")
    kind = desk.places.entry(name).kind
    if kind == "city":
        heading = asked["heading_deg"]
        tracker: Any = desk.places.city(name).track(
            near=asked["near"], radius=asked["radius"],
            heading=None if heading is None else radians(heading),
        )  # fmt: skip
    else:
        camera = camera_of(asked["camera"], None)
        if camera is None:
            raise OptionError("camera: missing; give fx, width and height of the images to come.")
        check_focal(camera, "camera")
        scene = desk.places.scene(name)
        camera = camera.resized(*fitted((camera.width, camera.height)))
        tracker = scene.tracker(camera, seed=asked["seed"], description=asked["description"])
    desk.trackers[asked["session"]] = name, tracker
    return {"map": name}


def step(desk: Desk, asked: dict[str, Any]) -> dict[str, Any]:
    """One step of a session; `asked`: `session`, and what `schema.Step` has."""
    if asked["session"] not in desk.trackers:
        raise RequestError("The session is over; begin a new one.", status=410, code="session_over")
    name, tracker = desk.trackers[asked["session"]]
    if isinstance(tracker, CityTracker):
        estimate: Any = _walked(tracker, asked)
        return answered(name, estimate, estimate.next_question(tracker.city))
    estimate = tracker.update(_frame(desk, tracker.camera, asked))
    return {
        "map": name,
        "estimate": estimate.to_dict(),
        "geopose": on_earth(estimate.geopose),
        "geojson": on_earth(estimate.geojson),
    }


def end(desk: Desk, asked: dict[str, Any]) -> dict[str, Any]:
    """Forget a session."""
    desk.trackers.pop(asked["session"], None)
    return {}


def _walked(tracker: CityTracker, asked: dict[str, Any]) -> Any:  # noqa: ANN401  # an estimate
    bearing = asked["bearing_deg"]
    estimate: Any = None
    if asked["east"] is not None and asked["north"] is not None:
        estimate = tracker.move(asked["east"], asked["north"], sigma=asked["sigma"])
    if asked["distance"] is not None:
        bearing = None if bearing is None else radians(bearing)
        estimate = tracker.walk(asked["distance"], bearing)
    if asked["text"] is not None:
        estimate = tracker.tell(asked["text"])
    for answer in asked["answers"]:
        estimate = tracker.answer(given(answer))
    if estimate is None:
        raise OptionError(
            "step: nothing is said or moved; give text, answers, east and north, or distance."
        )
    return estimate


def _frame(desk: Desk, camera: Any, asked: dict[str, Any]) -> Frame:  # noqa: ANN401  # Camera
    if asked["image"] is None:
        raise OptionError("image: missing; give one in base64, JPEG or PNG.")
    photo: Photo = read_photo(image_bytes(asked["image"]), "image", desk.options)
    depth = None
    if asked["depth"] is not None:
        data = image_bytes(asked["depth"])
        depth = read_depth(data, "depth", asked["depth_scale"], desk.options)
    gravity = asked["gravity"]
    if gravity is None and asked["odometry"] is None:
        gravity = LEVEL
    return Frame.from_arrays(
        photo.rgb, camera, depth=depth, odometry=asked["odometry"], gravity=gravity,
        stamp=asked["stamp"] or 0.0, index=asked["number"],
    )  # fmt: skip
