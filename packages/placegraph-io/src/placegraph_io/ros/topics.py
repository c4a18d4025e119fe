"""Topics of a bag: what each image topic shows, and which topics a capture is made of.

Topics are found by type; `BAG.json` beside the bag, or the user, names others.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.json_files import read_json
from placegraph.io.capture.posed import make_camera
from placegraph_io.ros.containers import Bag, Topic
from placegraph_io.ros.decode import (
    DEPTHS,
    GREYS,
    Registration,
    decoded,
    frame_of,
    is_colour,
    size_of,
)
from placegraph_io.ros.poses import PoseReader, Samples

IMAGES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
_RECTIFIED = re.compile(r"(^|[/_])rect([/_]|$)")


class View(NamedTuple):
    """An image topic, by its first message."""

    topic: Topic
    kind: str
    """`colour`, `grey`, `depth`, or empty: not read."""
    problem: str = ""
    """Why it is not read."""
    frame: str = ""
    size: tuple[int, int] = (0, 0)
    """Width and height [px]."""
    encoding: str = ""

    @property
    def base(self) -> str:
        """Name of the topic without its transport."""
        return re.sub(r"/(compressed|compressedDepth)$", "", self.topic.name)

    @property
    def said(self) -> str:
        """What it is, for the user."""
        return (
            f"{self.topic.name} ({self.topic.short}, {self.encoding}, "
            f"{self.size[0]} x {self.size[1]}, {len(self.topic):,} messages)"
        )


def views_of(bag: Bag) -> list[View]:
    """Return what every image topic shows; nothing is raised."""
    return [_view(topic) for topic in bag.of_type(*IMAGES)]


def _view(topic: Topic) -> View:
    name = f"{topic[0].place.path}, {topic.name}"
    try:
        image = decoded(topic[0], topic.name, topic.type, topic.encoding)
        width, height, encoding = size_of(image, name)
    except InputError as error:
        return View(topic, "", str(error))
    frame = frame_of(image.header.frame_id)
    if encoding in DEPTHS and (encoding != "mono16" or "depth" in topic.name):
        kind = "depth"
    elif is_colour(encoding):
        kind = "grey" if encoding in GREYS else "colour"
    else:
        problem = (
            f"{name}: encoding {encoding[:40]!r} is neither a colour nor a depth that is read."
        )
        return View(topic, "", problem, frame, (width, height), encoding)
    return View(topic, kind, "", frame, (width, height), encoding)


def chosen_views(
    bag: Bag, views: Sequence[View], colour: str | None, depth: str | None, *, with_depth: bool
) -> tuple[View, View | None]:
    """Return the colour and the depth that belong together best, or those named.

    Raises `InputError` where a named topic is not there or of another kind, or there is no colour.
    """
    colours = [v for v in views if v.kind in {"colour", "grey"}]
    depths: list[View | None] = [v for v in views if v.kind == "depth"] if with_depth else []
    if colour is not None:
        colours = [_named(bag, views, colour, ("colour", "grey"))]
    if depth is not None:
        depths = [_named(bag, views, depth, ("depth",))]
    if not colours:
        why = next((f" {v.problem}" for v in views if v.problem), "")
        raise InputError(
            f"{bag.path} holds no colour images: no sensor_msgs/Image or CompressedImage in colour "
            f"has messages.{why} Record the camera's image topic."
        )
    infos = {t.name for t in bag.of_type("sensor_msgs/CameraInfo")}

    def worth(pair: tuple[View, View | None]) -> tuple[float, ...]:
        seen, measured = pair
        joint = 0.0
        if measured is not None:
            alike = seen.frame == measured.frame and bool(seen.frame)
            joint = 1.0 + 2.0 * alike + _shared(seen.base, measured.base)
        plain = seen.topic.short == IMAGES[0]
        named = bool(re.search(r"colou?r|rgb", seen.topic.name))
        known = info_names(seen)[0] in infos
        return (seen.kind == "colour", joint, known, named, len(seen.topic), plain)

    pairs = [(c, d) for c in colours for d in depths or [None]]
    return max(pairs, key=worth)


def _named(bag: Bag, views: Sequence[View], name: str, kinds: tuple[str, ...]) -> View:
    view = next((v for v in views if v.topic.name == name), None)
    if view is None:
        there = ", ".join(v.topic.name for v in views) or "none"
        other = bag.topics.get(name)
        what = f"is {other.short} with {len(other)} messages" if other else "is not there"
        raise InputError(f"{bag.path}: {name} {what}; image topics are {there}.")
    if view.kind not in kinds:
        raise InputError(
            view.problem
            or f"{bag.path}, {name}: shows {view.kind} ({view.encoding}), not {kinds[0]}."
        )
    return view


def _shared(a: str, b: str) -> float:
    """Return the share of the names of two topics that is one namespace, 0 to 1."""
    x, y = a.strip("/").split("/"), b.strip("/").split("/")
    same = 0
    while same < min(len(x), len(y)) and x[same] == y[same]:
        same += 1
    return same / max(len(x), len(y))


def info_names(view: View) -> tuple[str, str]:
    """Return the names that the topic of a view's CameraInfo has by custom."""
    return f"{view.base.rpartition('/')[0]}/camera_info", f"{view.base}/camera_info"


def camera_for(
    bag: Bag, view: View, given: str | dict[str, Any] | None, role: str
) -> tuple[Camera, Topic | None]:
    """Camera of a view, and the topic that says so: one that is given, else the CameraInfo beside it.

    `role` is what the file beside the bag calls it, where `given` may be intrinsics. Raises
    `InputError` where there is none.
    """
    if isinstance(given, dict):
        return camera_of_dict(given, view.size, f'{bag.path}.json, "{role}"'), None
    infos = {t.name: t for t in bag.of_type("sensor_msgs/CameraInfo")}
    names = (given,) if given is not None else info_names(view)
    topic = next((infos[n] for n in names if n in infos), None)
    if topic is None and given is not None:
        raise InputError(
            f"{bag.path}: {given} is no sensor_msgs/CameraInfo with messages; there are "
            f"{', '.join(infos) or 'none'}."
        )
    if topic is None:
        topic = next((t for t in infos.values() if _is_of(t, view)), None)
    if topic is None:
        raise InputError(
            f"{bag.path} holds no CameraInfo of {view.topic.name} ({' or '.join(names)}); record it, or "
            f'write {bag.path}.json with {{"{role}": {{"fx": ..., "fy": ..., "cx": ..., "cy": ...}}}}.'
        )
    info = decoded(topic[0], topic.name, topic.type, topic.encoding)
    rectified = _RECTIFIED.search(view.base.rpartition("/")[2]) is not None
    name = f"{bag.path}, {topic.name}"
    return camera_of_info(info, view.size, name, rectified=rectified), topic


def _is_of(topic: Topic, view: View) -> bool:
    """Return whether a CameraInfo by another name is of a view's frame and size."""
    info = decoded(topic[0], topic.name, topic.type, topic.encoding)
    return frame_of(info.header.frame_id) == view.frame and (info.width, info.height) == view.size


_MODELS = {"": "opencv", "none": "opencv", "plumb_bob": "opencv", "rational_polynomial": "opencv",
           "radtan": "opencv", "equidistant": "fisheye", "fisheye": "fisheye"}  # fmt: skip


def camera_of_info(info: Any, size: tuple[int, int], name: str, *, rectified: bool) -> Camera:  # noqa: ANN401
    """Return the camera of images of this width and height [px]; `rectified`: they were freed of the lens.

    ROS counts pixels from their centres, placegraph from their corners: half a pixel is added.
    Raises `InputError`, which begins with `name`, where the message is none of such images.
    """
    get = {field: _field(info, field) for field in ("k", "p", "d")}
    matrix = np.asarray(get["p"] if rectified else get["k"], np.float64)
    if not matrix.any():
        raise InputError(
            f"{name}: {'P' if rectified else 'K'} is all zeros: the camera was not calibrated; give its "
            'intrinsics as "camera" in the file beside the bag.'
        )
    matrix = matrix.reshape(3, -1)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
    said = str(info.distortion_model).lower()
    if said not in _MODELS:
        raise InputError(
            f"{name}: distortion_model is {said[:40]!r}; plumb_bob, rational_polynomial and equidistant "
            'are known. Rectify the images, or give "camera" in the file beside the bag.'
        )
    bent = () if rectified else _distortion(get["d"], _MODELS[said], name)
    whole = int(info.width), int(info.height)
    roi = info.roi
    if roi.width and roi.height and (roi.width, roi.height) != whole:
        cx, cy, whole = cx - roi.x_offset, cy - roi.y_offset, (int(roi.width), int(roi.height))
    if whole == (0, 0):  # drivers that leave it out
        whole = size
    model = "opencv" if rectified else _MODELS[said]
    camera = make_camera(name, whole, (fx, fy, cx, cy), bent, model)
    if abs(size[0] * whole[1] - size[1] * whole[0]) > max(*size, *whole):
        raise InputError(
            f"{name} is of {whole[0]} x {whole[1]} pixels, but the images have {size[0]} x {size[1]}, "
            'which is not the same view; give their intrinsics as "camera" in the file beside the bag.'
        )
    return camera if size == whole else camera.resized(*size)


def camera_of_dict(content: Mapping[str, Any], size: tuple[int, int], name: str) -> Camera:
    """Return the camera of intrinsics as `camera.json` has them, but for the size, which is the images'."""
    try:
        numbers = [float(content[field]) for field in ("fx", "fy", "cx", "cy")]
        bent = [float(v) for v in content.get("distortion") or ()]
        whole = int(content.get("width", size[0])), int(content.get("height", size[1]))
        model = str(content.get("model", "opencv"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{name} must have fx, fy, cx, cy as numbers, as camera.json has them ({error!r})."
        ) from error
    if whole != size:
        raise InputError(
            f"{name} is of {whole[0]} x {whole[1]} pixels, but the images have {size[0]} x {size[1]}."
        )
    return make_camera(name, size, numbers, bent, model)


def _field(info: Any, name: str) -> Any:  # noqa: ANN401  # capital letters in ROS 1
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def _distortion(given: Any, model: str, name: str) -> tuple[float, ...]:  # noqa: ANN401
    numbers = [float(v) for v in given]
    if not any(numbers):
        return (0.0,) * 4 if model == "fisheye" else ()
    most = 4 if model == "fisheye" else 8
    if any(numbers[most:]):
        raise InputError(
            f"{name}: D has {len(numbers)} coefficients; the first {most} are known. Rectify the "
            'images, or give "camera" in the file beside the bag.'
        )
    numbers = numbers[:most]
    wanted = next(n for n in ((4,) if model == "fisheye" else (4, 5, 8)) if n >= len(numbers))
    return tuple(numbers + [0.0] * (wanted - len(numbers)))


_NAMES = ("colour", "depth", "odometry", "imu", "frame")
_CAMERAS = ("camera", "depth_camera")
_KEYS = (*_NAMES, *_CAMERAS, "depth_scale", "transforms")


@dataclass(frozen=True, slots=True)
class TopicChoice:
    """Topics and frames by their role; None: found by type."""

    colour: str | None = None
    depth: str | None = None
    odometry: str | None = None
    imu: str | None = None
    frame: str | None = None
    """In which poses are told."""
    camera: str | dict[str, Any] | None = None
    """A CameraInfo's topic, or intrinsics."""
    depth_camera: str | dict[str, Any] | None = None
    depth_scale: float | None = None
    """Units of depth in a metre."""
    transforms: Samples = field(default_factory=dict)
    """That the bag lacks; they never change."""
    with_depth: bool = True
    with_imu: bool = True


def read_topic_choice(path: Path, given: Mapping[str, Any] | None) -> TopicChoice:
    """Return what `BAG.json` says, and over it what is given.

    Raises `InputError` of the file's content, `OptionError` of what is given.
    """
    file = Path(f"{path}.json")
    content = read_json(file) if file.is_file() else {}
    if not isinstance(content, dict):
        raise InputError(f"{file} must be a JSON object with {', '.join(_KEYS)}.")
    _check(content, f"{file}: ", InputError)
    _check(given or {}, "topics: ", OptionError)
    said = {**content, **(given or {})}
    out: dict[str, Any] = {k: said[k] for k in (*_NAMES, *_CAMERAS, "depth_scale") if k in said}
    out["transforms"] = {
        (row["parent"], row["child"]): [np.array([[0.0, *row["xyz"], *row["xyzw"]]])]
        for row in said.get("transforms") or ()
    }
    for role in ("depth", "imu"):
        out[f"with_{role}"] = not (role in said and said[role] is None)
    return TopicChoice(**out)


def _check(said: Mapping[str, Any], name: str, error: type[InputError | OptionError]) -> None:
    for key, value in said.items():
        good = {
            **dict.fromkeys(_NAMES, value is None or isinstance(value, str)),
            **dict.fromkeys(_CAMERAS, isinstance(value, str | dict)),
            "depth_scale": isinstance(value, int | float) and 0 < value < float("inf"),
            "transforms": isinstance(value, list) and all(_is_transform(row) for row in value),
        }
        if key not in good:
            raise error(f"{name}{key!r} is not known; there are {', '.join(_KEYS)}.")
        if not good[key]:
            raise error(f"{name}{key} is {str(value)[:60]!r}; {_WANTED.get(key, 'it is a name')}.")


_WANTED = {
    "camera": "it is a topic or an object with fx, fy, cx, cy",
    "depth_camera": "it is a topic or an object with fx, fy, cx, cy",
    "depth_scale": "it is how many units of depth make a metre, such as 1000",
    "transforms": 'it is a list of {"parent", "child", "xyz": [x, y, z], "xyzw": [x, y, z, w]}',
}


def _is_transform(row: Any) -> bool:  # noqa: ANN401  # whatever the file holds
    if not (isinstance(row, dict) and set(row) == {"parent", "child", "xyz", "xyzw"}):
        return False
    numbers = [row["xyz"], row["xyzw"]]
    return (
        isinstance(row["parent"], str)
        and isinstance(row["child"], str)
        and all(isinstance(n, list) for n in numbers)
        and [len(n) for n in numbers] == [3, 4]
        and all(isinstance(v, int | float) and abs(v) < 1e300 for n in numbers for v in n)
    )


@dataclass(eq=False)
class Plan:
    """What was found in a bag for a capture. Nothing is raised: what is lacking is told."""

    bag: Bag
    choice: TopicChoice
    views: list[View] = field(default_factory=list)
    colour: View | None = None
    camera: Camera | None = None
    camera_topic: Topic | None = None
    depth: View | None = None
    depth_camera: Camera | None = None
    """Of the depth as a capture has it."""
    depth_camera_topic: Topic | None = None
    registration: Registration | None = None
    """Where depth was measured by another camera."""
    pose_reader: PoseReader | None = None
    lacks: dict[str, str] = field(default_factory=dict)
    """By role (colour, camera, poses, depth) the sentence of the error."""
    notes: list[str] = field(default_factory=list)

    def tried(self, role: str, step: Callable[[], None]) -> None:
        """Do a step, and keep what it lacks."""
        try:
            step()
        except InputError as error:
            self.lacks.setdefault(role, str(error))


def plan_of(bag: Bag, choice: TopicChoice) -> Plan:
    """Choose what a capture is made of, and read what is needed to place its frames."""
    plan = Plan(bag, choice, views_of(bag), notes=list(bag.notes))
    plan.tried("colour", lambda: _choose(plan))
    if plan.colour is None:
        return plan
    plan.tried("camera", lambda: _camera(plan))
    plan.pose_reader = PoseReader(bag, choice, plan.colour, plan.depth)
    plan.tried("poses", plan.pose_reader.read)
    plan.notes += plan.pose_reader.notes
    plan.tried("depth", lambda: _depth(plan))
    return plan


def _choose(plan: Plan) -> None:
    choice = plan.choice
    plan.colour, plan.depth = chosen_views(
        plan.bag, plan.views, choice.colour, choice.depth, with_depth=choice.with_depth
    )
    plan.notes.append(f"Colour is {plan.colour.said}.")
    if plan.depth is not None:
        plan.notes.append(f"Depth is {plan.depth.said}.")


def _camera(plan: Plan) -> None:
    assert plan.colour is not None  # noqa: S101  # chosen before
    found = camera_for(plan.bag, plan.colour, plan.choice.camera, "camera")
    plan.camera, plan.camera_topic = found


def _depth(plan: Plan) -> None:
    colour, depth, choice = plan.colour, plan.depth, plan.choice
    if depth is None or colour is None or plan.pose_reader is None:
        return
    same = depth.frame == colour.frame
    try:
        found = camera_for(plan.bag, depth, choice.depth_camera, "depth_camera")
        camera, plan.depth_camera_topic = found
    except InputError:
        if not (same and plan.camera is not None and depth.size == colour.size):
            raise
        camera = plan.camera
    plan.depth_camera = camera
    if same or plan.camera is None:
        return
    if plan.pose_reader.tree.path(colour.frame, depth.frame) is None:
        raise InputError(
            f"{plan.bag.path}: no transform joins {colour.frame!r}, where colours are seen, and "
            f"{depth.frame!r}, where depth is measured; record /tf_static, or write it as "
            f'"transforms" in {plan.bag.path}.json, or do without depth: "depth": null.'
        )
    plan.registration = Registration(plan.camera, camera)
    plan.depth_camera = plan.registration.camera
    plan.notes.append(f"Depth is brought from {depth.frame} to {colour.frame} by the transforms.")
