"""Choice of the topics of a bag that make a capture.

Topics are found by type; `BAG.json` beside the bag, or the user, names others.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
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
    decode,
    decode_message,
    frame_name,
    is_colour,
    read_size,
)
from placegraph_io.ros.poses import PoseReader, Samples

IMAGES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
_STAMP_END = 12  # bytes of a message up to its header's stamp
_RECTIFIED = re.compile(r"(^|[/_])rect([/_]|$)")


class ImageTopic(NamedTuple):
    """An image topic, described by its first message."""

    topic: Topic
    kind: str  # `colour`, `grey`, `depth`, or empty: not read
    problem: str = ""  # Why it cannot be read
    frame: str = ""
    size: tuple[int, int] = (0, 0)  # Width and height [px]
    encoding: str = ""

    @property
    def base(self) -> str:
        """Name of the topic without its image transport."""
        return re.sub(r"/(compressed|compressedDepth)$", "", self.topic.name)

    @property
    def summary(self) -> str:
        """Name, type, encoding, size and number of messages."""
        return (
            f"{self.topic.name} ({self.topic.short}, {self.encoding}, "
            f"{self.size[0]} x {self.size[1]}, {len(self.topic):,} messages)"
        )


def inspect_images(bag: Bag) -> list[ImageTopic]:
    """Inspect every image topic; problems are noted, not raised."""
    return [_inspect(topic) for topic in bag.of_type(*IMAGES)]


def _inspect(topic: Topic) -> ImageTopic:
    name = f"{topic[0].place.path}, {topic.name}"
    try:
        image = decode_message(topic[0], topic.name, topic.type, topic.encoding)
        width, height, encoding = read_size(image, name)
    except InputError as error:
        return ImageTopic(topic, "", str(error))
    frame = frame_name(image.header.frame_id)
    if encoding in DEPTHS and (encoding != "mono16" or "depth" in topic.name):
        kind = "depth"
    elif is_colour(encoding):
        kind = "grey" if encoding in GREYS else "colour"
    else:
        problem = f"{name}: the encoding {encoding[:40]!r} is unknown."
        return ImageTopic(topic, "", problem, frame, (width, height), encoding)
    return ImageTopic(topic, kind, "", frame, (width, height), encoding)


def choose_images(
    bag: Bag,
    views: Sequence[ImageTopic],
    colour: str | None,
    depth: str | None,
    *,
    with_depth: bool,
) -> tuple[ImageTopic, ImageTopic | None]:
    """Return the best matching colour and depth topics, or those named.

    Raises `InputError` where a named topic is missing or of another kind, or there is no colour topic.
    """
    colours = [v for v in views if v.kind in {"colour", "grey"}]
    depths: list[ImageTopic | None] = [v for v in views if v.kind == "depth"] if with_depth else []
    if colour is not None:
        colours = [_named(bag, views, colour, ("colour", "grey"))]
    if depth is not None:
        depths = [_named(bag, views, depth, ("depth",))]
    if not colours:
        why = next((f" {v.problem}" for v in views if v.problem), "")
        raise InputError(
            f"{bag.path} contains no colour images (sensor_msgs/Image or CompressedImage).{why} "
            "Record the camera's image topic."
        )
    infos = {t.name for t in bag.of_type("sensor_msgs/CameraInfo")}

    def rank(pair: tuple[ImageTopic, ImageTopic | None]) -> tuple[float, ...]:
        seen, measured = pair
        joint = 0.0
        if measured is not None:
            alike = seen.frame == measured.frame and bool(seen.frame)
            joint = 1.0 + 2.0 * alike + _common_namespace(seen.base, measured.base)
        plain = seen.topic.short == IMAGES[0]
        named = bool(re.search(r"colou?r|rgb", seen.topic.name))
        known = camera_info_names(seen)[0] in infos
        return (seen.kind == "colour", joint, known, named, len(seen.topic), plain)

    pairs = [(c, d) for c in colours for d in depths or [None]]
    return max(pairs, key=rank)


def _named(bag: Bag, views: Sequence[ImageTopic], name: str, kinds: tuple[str, ...]) -> ImageTopic:
    view = next((v for v in views if v.topic.name == name), None)
    if view is None:
        there = ", ".join(v.topic.name for v in views) or "none"
        other = bag.topics.get(name)
        what = f"is {other.short} with {len(other)} messages" if other else "is not in the bag"
        raise InputError(f"{bag.path}: {name} {what}; image topics are {there}.")
    if view.kind not in kinds:
        raise InputError(
            view.problem
            or f"{bag.path}, {name}: shows {view.kind} ({view.encoding}), not {kinds[0]}."
        )
    return view


def _common_namespace(a: str, b: str) -> float:
    """Return the common share of two topics' namespaces, 0 to 1."""
    x, y = a.strip("/").split("/"), b.strip("/").split("/")
    same = takewhile(lambda pair: pair[0] == pair[1], zip(x, y, strict=False))
    return sum(1 for _ in same) / max(len(x), len(y))


def camera_info_names(view: ImageTopic) -> tuple[str, str]:
    """Return the customary names of the CameraInfo topic of an image topic."""
    return f"{view.base.rpartition('/')[0]}/camera_info", f"{view.base}/camera_info"


@dataclass(eq=False)
class CameraReader:
    """Cameras of an image topic, as its CameraInfo messages have them: a lens may refocus."""

    path: Path
    view: ImageTopic
    topic: Topic
    _last: tuple[bytes, Camera] | None = None

    def read(self, data: bytes) -> Camera:
        """Return the camera of a message; decode it only if it differs from the last one."""
        content = data[_STAMP_END:]
        if self._last is None or self._last[0] != content:
            name = f"{self.path}, {self.topic.name}"
            info = decode(data, name, self.topic.type, self.topic.encoding)
            rectified = _RECTIFIED.search(self.view.base.rpartition("/")[2]) is not None
            camera = camera_from_info(info, self.view.size, name, rectified=rectified)
            self._last = content, camera
        return self._last[1]


def find_camera(
    bag: Bag, view: ImageTopic, given: str | dict[str, Any] | None, role: str
) -> tuple[Camera, CameraReader | None]:
    """Return the first camera of an image topic, and the reader of its CameraInfo topic.

    `given` is a topic or intrinsics, `role` their key in the file beside the bag. Raises `InputError`
    where there is no camera.
    """
    if isinstance(given, dict):
        return camera_from_dict(given, view.size, f'{bag.path}.json, "{role}"'), None
    infos = {t.name: t for t in bag.of_type("sensor_msgs/CameraInfo")}
    names = (given,) if given is not None else camera_info_names(view)
    topic = next((infos[n] for n in names if n in infos), None)
    if topic is None and given is not None:
        raise InputError(
            f"{bag.path}: {given} has no sensor_msgs/CameraInfo messages; CameraInfo topics: "
            f"{', '.join(infos) or 'none'}."
        )
    if topic is None:
        topic = next((t for t in infos.values() if _is_of(t, view)), None)
    if topic is None:
        raise InputError(
            f"{bag.path} contains no CameraInfo of {view.topic.name} ({' or '.join(names)}); "
            f'record it, or write {bag.path}.json with {{"{role}": {{"fx": ..., "fy": ..., '
            '"cx": ..., "cy": ...}}.'
        )
    reader = CameraReader(bag.path, view, topic)
    return reader.read(topic[0].read()), reader


def _is_of(topic: Topic, view: ImageTopic) -> bool:
    """Return whether a CameraInfo topic has the frame and size of an image topic."""
    info = decode_message(topic[0], topic.name, topic.type, topic.encoding)
    return frame_name(info.header.frame_id) == view.frame and (info.width, info.height) == view.size


_MODELS = {"": "opencv", "none": "opencv", "plumb_bob": "opencv", "rational_polynomial": "opencv",
           "radtan": "opencv", "equidistant": "fisheye", "fisheye": "fisheye"}  # fmt: skip


def camera_from_info(info: Any, size: tuple[int, int], name: str, *, rectified: bool) -> Camera:  # noqa: ANN401
    """Return the camera of images of a width and height [px]; `rectified`: without distortion.

    ROS counts pixels from their centres, placegraph from their corners: half a pixel is added.
    Raises `InputError`, beginning with `name`, where the message does not fit the images.
    """
    get = {field: _field(info, field) for field in ("k", "p", "d")}
    matrix = np.asarray(get["p"] if rectified else get["k"], np.float64)
    if not matrix.any():
        raise InputError(
            f"{name}: {'P' if rectified else 'K'} is all zeros, so the camera was not calibrated; "
            'give intrinsics as "camera" in the JSON file beside the bag.'
        )
    matrix = matrix.reshape(3, -1)
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5
    lens = str(info.distortion_model).lower()
    if lens not in _MODELS:
        raise InputError(
            f"{name}: distortion_model is {lens[:40]!r}, but only plumb_bob, rational_polynomial "
            'and equidistant are supported. Rectify the images, or give "camera" in the JSON file '
            "beside the bag."
        )
    distortion = () if rectified else _distortion(get["d"], _MODELS[lens], name)
    full_size = int(info.width), int(info.height)
    roi = info.roi
    if roi.width and roi.height and (roi.width, roi.height) != full_size:
        cx, cy, full_size = cx - roi.x_offset, cy - roi.y_offset, (int(roi.width), int(roi.height))
    if full_size == (0, 0):  # drivers that leave it out
        full_size = size
    model = "opencv" if rectified else _MODELS[lens]
    camera = make_camera(name, full_size, (fx, fy, cx, cy), distortion, model)
    if abs(size[0] * full_size[1] - size[1] * full_size[0]) > max(*size, *full_size):
        raise InputError(
            f"{name} has {full_size[0]} x {full_size[1]} pixels, but the images have {size[0]} x "
            f'{size[1]}, with another aspect ratio; give their intrinsics as "camera" in the JSON '
            "file beside the bag."
        )
    return camera if size == full_size else camera.resize(*size)


def camera_from_dict(content: Mapping[str, Any], size: tuple[int, int], name: str) -> Camera:
    """Return the camera of intrinsics as in `camera.json`, of images of a width and height [px]."""
    try:
        numbers = [float(content[field]) for field in ("fx", "fy", "cx", "cy")]
        distortion = [float(v) for v in content.get("distortion") or ()]
        full_size = int(content.get("width", size[0])), int(content.get("height", size[1]))
        model = str(content.get("model", "opencv"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{name} must have the numbers fx, fy, cx and cy, as camera.json does ({error!r})."
        ) from error
    if full_size != size:
        raise InputError(
            f"{name} is for {full_size[0]} x {full_size[1]} pixels, but the images have {size[0]} "
            f"x {size[1]}; give their intrinsics."
        )
    return make_camera(name, size, numbers, distortion, model)


def _field(info: Any, name: str) -> Any:  # noqa: ANN401  # capital letters in ROS 1
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def _distortion(given: Any, model: str, name: str) -> tuple[float, ...]:  # noqa: ANN401
    numbers = [float(v) for v in given]
    if not any(numbers):
        return (0.0,) * 4 if model == "fisheye" else ()
    most = 4 if model == "fisheye" else 8
    if any(numbers[most:]):
        raise InputError(
            f"{name}: D has {len(numbers)} coefficients, but only the first {most} are supported. "
            'Rectify the images, or give "camera" in the JSON file beside the bag.'
        )
    numbers = numbers[:most]
    wanted = next(n for n in ((4,) if model == "fisheye" else (4, 5, 8)) if n >= len(numbers))
    return tuple(numbers + [0.0] * (wanted - len(numbers)))


_NAMES = ("colour", "depth", "odometry", "imu", "frame")
_CAMERAS = ("camera", "depth_camera")
_KEYS = (*_NAMES, *_CAMERAS, "depth_scale", "transforms")


@dataclass(frozen=True, slots=True)
class TopicChoice:
    """Topics and frames by role; None: chosen by type."""

    colour: str | None = None
    depth: str | None = None
    odometry: str | None = None
    imu: str | None = None
    frame: str | None = None  # Frame of the poses
    camera: str | dict[str, Any] | None = None  # CameraInfo topic, or intrinsics
    depth_camera: str | dict[str, Any] | None = None
    depth_scale: float | None = None  # Units of depth in a metre
    transforms: Samples = field(default_factory=dict)  # Fixed transforms that the bag lacks
    with_depth: bool = True
    with_imu: bool = True


def read_topic_choice(path: Path, given: Mapping[str, Any] | None) -> TopicChoice:
    """Read `BAG.json`, overridden by `given`; raises `InputError` of the file, `OptionError` of `given`."""
    file = Path(f"{path}.json")
    content = read_json(file) if file.is_file() else {}
    if not isinstance(content, dict):
        raise InputError(f"{file} must be a JSON object with {', '.join(_KEYS)}.")
    _check(content, f"{file}: ", InputError)
    _check(given or {}, "topics: ", OptionError)
    values = {**content, **(given or {})}
    out: dict[str, Any] = {k: values[k] for k in (*_NAMES, *_CAMERAS, "depth_scale") if k in values}
    out["transforms"] = {
        (row["parent"], row["child"]): [np.array([[0.0, *row["xyz"], *row["xyzw"]]])]
        for row in values.get("transforms") or ()
    }
    for role in ("depth", "imu"):
        out[f"with_{role}"] = not (role in values and values[role] is None)
    return TopicChoice(**out)


def _check(values: Mapping[str, Any], name: str, error: type[InputError | OptionError]) -> None:
    for key, value in values.items():
        good = {
            **dict.fromkeys(_NAMES, value is None or isinstance(value, str)),
            **dict.fromkeys(_CAMERAS, isinstance(value, str | dict)),
            "depth_scale": isinstance(value, int | float) and 0 < value < float("inf"),
            "transforms": isinstance(value, list) and all(_is_transform(row) for row in value),
        }
        if key not in good:
            raise error(f"{name}{key!r} is unknown; known keys are {', '.join(_KEYS)}.")
        if not good[key]:
            raise error(f"{name}{key} is {str(value)[:60]!r}; {_WANTED.get(key, 'it is a name')}.")


_WANTED = {
    "camera": "it must be a topic, or an object with fx, fy, cx, cy",
    "depth_camera": "it must be a topic, or an object with fx, fy, cx, cy",
    "depth_scale": "it must be the depth units per metre, such as 1000",
    "transforms": 'it must be a list of {"parent", "child", "xyz": [x, y, z], "xyzw": [x, y, z, w]}',
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
class CapturePlan:
    """Topics, cameras and poses that make a capture of a bag; `missing` says what it lacks."""

    bag: Bag
    choice: TopicChoice
    views: list[ImageTopic] = field(default_factory=list)
    colour: ImageTopic | None = None
    camera: Camera | None = None
    camera_reader: CameraReader | None = None
    depth: ImageTopic | None = None
    depth_camera: Camera | None = None  # Camera of the depth images of the capture
    depth_camera_reader: CameraReader | None = None
    registration: Registration | None = None  # Set where depth was measured by another camera
    pose_reader: PoseReader | None = None
    missing: dict[str, str] = field(default_factory=dict)
    """By role (colour, camera, poses, depth) the sentence of the error."""
    notes: list[str] = field(default_factory=list)

    def attempt(self, role: str, step: Callable[[], None]) -> None:
        """Run a step; note its error in `missing`."""
        try:
            step()
        except InputError as error:
            self.missing.setdefault(role, str(error))


def plan_capture(bag: Bag, choice: TopicChoice) -> CapturePlan:
    """Choose the topics of a capture, and read its cameras, stamps and transforms."""
    plan = CapturePlan(bag, choice, inspect_images(bag), notes=list(bag.notes))
    plan.attempt("colour", lambda: _choose_topics(plan))
    if plan.colour is None:
        return plan
    plan.attempt("camera", lambda: _find_camera(plan))
    plan.pose_reader = PoseReader(bag, choice, plan.colour, plan.depth)
    plan.attempt("poses", plan.pose_reader.read)
    plan.notes += plan.pose_reader.notes
    plan.attempt("depth", lambda: _find_depth(plan))
    return plan


def _choose_topics(plan: CapturePlan) -> None:
    choice = plan.choice
    plan.colour, plan.depth = choose_images(
        plan.bag, plan.views, choice.colour, choice.depth, with_depth=choice.with_depth
    )
    plan.notes.append(f"Colour is {plan.colour.summary}.")
    if plan.depth is not None:
        plan.notes.append(f"Depth is {plan.depth.summary}.")


def _find_camera(plan: CapturePlan) -> None:
    assert plan.colour is not None  # noqa: S101  # chosen before
    found = find_camera(plan.bag, plan.colour, plan.choice.camera, "camera")
    plan.camera, plan.camera_reader = found


def _find_depth(plan: CapturePlan) -> None:
    colour, depth, choice = plan.colour, plan.depth, plan.choice
    if depth is None or colour is None or plan.pose_reader is None:
        return
    same = depth.frame == colour.frame
    try:
        found = find_camera(plan.bag, depth, choice.depth_camera, "depth_camera")
        camera, plan.depth_camera_reader = found
    except InputError:
        if not (same and plan.camera is not None and depth.size == colour.size):
            raise
        camera, plan.depth_camera_reader = plan.camera, plan.camera_reader
    plan.depth_camera = camera
    if same or plan.camera is None:
        return
    if plan.pose_reader.tree.find_path(colour.frame, depth.frame) is None:
        raise InputError(
            f"{plan.bag.path}: no transform connects the colour camera {colour.frame!r} and the "
            f'depth camera {depth.frame!r}; record /tf_static, write it as "transforms" in '
            f'{plan.bag.path}.json, or switch depth off there with "depth": null.'
        )
    plan.registration = Registration(plan.camera, camera)
    plan.depth_camera = plan.registration.camera
    plan.notes.append(f"Depth is registered from {depth.frame} to {colour.frame} by transforms.")
