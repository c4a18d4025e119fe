"""The GeoPose protocol of the Open AR Cloud (OSCP): requests, and answers by localization."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from datetime import datetime
from math import cos, hypot, isfinite, radians, sin
from typing import TYPE_CHECKING, Any

import numpy as np
import orjson
from numpy.typing import NDArray

from placegraph.core.estimate import Status
from placegraph.core.geo import EarthPose
from placegraph.core.geojson import earth_poses
from placegraph.core.geometry import Camera
from placegraph.errors import GeoPoseError, InputError, OptionError, RequestError
from placegraph.io.capture.frame import Frame
from placegraph_io.dataset.colmap import model_camera
from placegraph_serve.localize import find_best, notes
from placegraph_serve.options import ServeOptions
from placegraph_serve.requests import (
    LEVEL,
    SMALLEST,
    Hints,
    Images,
    Photo,
    check_size,
    image_bytes,
    read_photo,
)

if TYPE_CHECKING:
    from placegraph_serve.places import Dispatcher

KINDS = {
    "camera": "cameraReadings",
    "geolocation": "geolocationReadings",
    "accelerometer": "accelerometerReadings",
}
VERSIONS = (1, 2)
_VERSION = re.compile(
    r"application/vnd\.oscp\+json[^,]*?;\s*version\s*=\s*\"?\s*v?(\d+)", re.IGNORECASE
)


@dataclass(frozen=True, slots=True)
class ProtocolRequest:
    """Request of the GeoPose protocol."""

    id: str
    timestamp: Any
    """Timestamp as sent: milliseconds, or text."""
    version: int
    camera: list[dict[str, Any]] = field(default_factory=list)
    """Readings, oldest first; `params`, `imageOrientation`, `image` (bytes) and `when` are added."""
    geolocation: list[dict[str, Any]] = field(default_factory=list)
    accelerometer: list[dict[str, Any]] = field(default_factory=list)
    poses: list[dict[str, Any]] = field(default_factory=list)
    """Poses of before, oldest first: `position`, `quaternion` and `accuracy` [m]."""


def version_of(accept: str) -> int | None:
    """Version that an Accept header asks for, however it is spaced; None: it does not say.

    Raises `RequestError` (406) for one that is not spoken here.
    """
    match = _VERSION.search(accept)
    if match is None:
        return None
    version = int(match[1])
    if version not in VERSIONS:
        raise RequestError(
            f"Accept: version {version} of the GeoPose protocol is not supported; ask for 1.0 or "
            "2.0.",
            status=406,
            code="version",
        )
    return version


def read_request(body: bytes, version: int | None) -> ProtocolRequest:
    """Read a request; `InputError` names the field that is not what it should be."""
    try:
        document = orjson.loads(body)  # takes no number or text that could not be sent back
    except ValueError as error:
        raise InputError(f"body: not JSON ({error}); send a GeoPose request.") from None
    if not isinstance(document, dict):
        raise InputError("body: not a JSON object; send a GeoPose request.")
    readings = document.get("sensorReadings")
    if not isinstance(readings, dict | list):
        raise InputError("sensorReadings: missing, or not a list or object; send the readings.")
    version = version or (1 if isinstance(readings, list) else 2)
    sensors = {str(s.get("id")): s for s in _objects(document.get("sensors") or [], "sensors")}
    kinds = _flat(readings, sensors) if isinstance(readings, list) else _by_kind(readings)
    for reading in kinds["camera"]:
        sensor = sensors.get(str(reading.get("sensorId")), {})
        reading["params"] = part(reading, "params") or part(sensor, "params")
        reading["imageOrientation"] = part(reading, "imageOrientation")
        reading["image"] = image_bytes(reading.get("imageBytes") or "")
    camera, geolocation, accelerometer = (
        sorted(kinds[kind], key=lambda r: float(r["when"])) for kind in KINDS
    )
    name, stamp = str(document.get("id") or ""), document.get("timestamp")
    return ProtocolRequest(
        name, stamp, version, camera, geolocation, accelerometer, _poses(document)
    )


def part(holder: dict[str, Any], name: str) -> dict[str, Any]:
    """An object of an object, empty where there is none; `InputError` where it is something else."""
    value = holder.get(name) or {}
    if not isinstance(value, dict):
        raise InputError(f"{name}: {str(value)[:40]!r} is not an object; send one, or omit it.")
    return value


def number(holder: dict[str, Any], name: str, default: float | None = None) -> float:
    """A finite number of an object; `InputError` where it is none."""
    value = holder.get(name)
    if value is None and default is not None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise InputError(f"{name}: {str(value)[:40]!r} is not a number; send one.")
    return float(value)


def _flat(readings: list[Any], sensors: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Readings of version 1 by kind, which their sensors tell, or else what they hold."""
    kinds: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    for outer in _objects(readings, "sensorReadings"):
        inner = outer.get("reading", outer)
        inner = inner[0] if isinstance(inner, list) and inner else inner
        if not isinstance(inner, dict):
            raise InputError(
                "sensorReadings: a reading is not an object; send the readings as objects."
            )
        kind = sensors.get(str(outer.get("sensorId")), {}).get("type") or _guess_kind(inner)
        if kind in kinds:
            kinds[kind].append({**outer, **inner, "when": _seconds(outer.get("timestamp"))})
    return kinds


def _by_kind(readings: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """Readings of version 2."""
    return {
        kind: [
            {**r, "when": _seconds(r.get("timestamp"))}
            for r in _objects(readings.get(name) or [], name)
        ]
        for kind, name in KINDS.items()
    }


def _guess_kind(reading: dict[str, Any]) -> str:
    return (
        "camera" if "imageBytes" in reading
        else "geolocation" if "latitude" in reading
        else ""
    )  # fmt: skip


def _poses(document: dict[str, Any]) -> list[dict[str, Any]]:
    poses = []
    for prior in _objects(document.get("priorPoses") or [], "priorPoses"):
        pose, accuracy = prior.get("geopose") or prior.get("pose"), prior.get("accuracy")
        if not isinstance(pose, dict) or not isinstance(pose.get("position"), dict):
            raise InputError("priorPoses: a pose has no position; send a GeoPose.")
        metres = accuracy.get("position") if isinstance(accuracy, dict) else accuracy
        poses.append(
            {
                "position": {n: number(pose["position"], n) for n in ("lon", "lat", "h")},
                "quaternion": pose.get("quaternion"),
                "accuracy": number({"accuracy": metres}, "accuracy", 0.0),
                "when": _seconds(prior.get("timestamp")),
            }
        )
    return sorted(poses, key=lambda p: p["when"])


def _objects(value: object, name: str) -> list[dict[str, Any]]:
    if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
        raise InputError(f"{name}: not a list of objects; send one.")
    return value


def _seconds(stamp: object) -> float:
    """Seconds since 1970 of milliseconds or ISO 8601; 0 where there is none."""
    if isinstance(stamp, bool) or stamp is None:
        return 0.0
    if isinstance(stamp, int | float) and isfinite(stamp):
        return stamp / 1000.0
    try:
        return datetime.fromisoformat(str(stamp)).timestamp()
    except ValueError as error:
        raise InputError(
            f"timestamp: {str(stamp)[:40]!r} is not a time; send milliseconds since 1970."
        ) from error


GUESS = 20.0
"""Accuracy of a position that does not say how good it is [m]."""
FAR = 200.0
"""Radius of maps that are looked into about a geolocation: it may be far off indoors [m]."""
_IMAGE_HEADS = (b"\xff\xd8\xff", b"\x89PNG", b"RIFF")
_CHANNELS = {1: "GRAY8", 3: "RGB24", 4: "RGBA32"}


def geopose(dispatcher: Dispatcher, arguments: dict[str, Any]) -> dict[str, Any]:
    """Answer a request; `arguments`: `body` and `version`, None where the client does not say.

    Standard clients read the accuracy and nothing else. The pose is therefore that of the images only if
    the estimate is `OK`, and that of the geolocation reading, with its accuracy, otherwise.
    """
    request = read_request(arguments["body"], arguments["version"])
    hints = hints_of(request)
    colour = [r for r in request.camera if not _is_depth(r) and r["image"]]
    depth = [r for r in request.camera if _is_depth(r) and r["image"]]
    if not colour:
        why = "imageBytes is empty, so nothing can be compared with a map; send an image."
        return _answer(request, Status.LOST.name, why)
    frame, leveled = frame_of(colour[-1], depth, request.accelerometer, dispatcher.options)
    images = Images((frame,), moved=True, leveled=leveled)
    try:
        estimate, frames = find_best(dispatcher.places, images, hints)
    except OptionError as error:  # the image shows nothing
        return _answer(request, Status.LOST.name, str(error))
    modes = [
        pose.geopose() | {"building": pose.building, "level": pose.level, "room": pose.room}
        for mode in estimate.modes
        for pose in earth_poses(mode)
    ]
    said, found = notes(dispatcher.places, hints, estimate, frames), None
    if estimate.status is Status.OK:
        try:
            found = estimate.geopose()
        except GeoPoseError as error:  # its map has no anchor
            if not request.geolocation:
                raise
            said.append(str(error))
    document = _answer(request, estimate.status.name, estimate.reason, found)
    return document | {"modes": modes, "notes": said}


def hints_of(request: ProtocolRequest) -> Hints:
    """Return the rough position of the device: by the newest pose of before, or else by geolocation."""
    if request.poses:
        prior = request.poses[-1]
        at = prior["position"]
        pose = EarthPose(at["lon"], at["lat"], at["h"], _quaternion(prior["quaternion"]), np.eye(6))
        heading = pose.heading if np.isfinite(pose.heading) else None
        return Hints(
            near=_lonlat(at["lon"], at["lat"]), height=at["h"], heading=heading,
            radius=prior["accuracy"] or GUESS,
        )  # fmt: skip
    if request.geolocation:
        fix = request.geolocation[-1]
        near = _lonlat(number(fix, "longitude"), number(fix, "latitude"))
        return Hints(near=near, radius=max(FAR, number(fix, "accuracy", 0.0)))
    return Hints()


def frame_of(
    reading: dict[str, Any], depth: list[dict[str, Any]], moved: list[dict[str, Any]],
    options: ServeOptions,
) -> tuple[Frame, bool]:  # fmt: skip
    """Frame of a camera reading, upright, and whether gravity is known."""
    photo = photo_of(reading, options)
    given = camera_of(reading, photo)
    turns = -round(number(reading["imageOrientation"], "rotation", 0.0) / 90.0) % 4
    rgb, camera = np.rot90(photo.rgb, turns), photo.camera(given, "imageBytes")
    from placegraph.io.capture.frame import rotate_camera

    gravity = gravity_of(moved[-1]) if moved else None
    metres = depth_of(depth[-1], options) if depth else None
    frame = Frame.from_arrays(
        np.ascontiguousarray(rgb), rotate_camera(camera, turns),
        depth=None if metres is None else np.ascontiguousarray(np.rot90(metres, turns)),
        gravity=LEVEL if gravity is None else gravity,
    )  # fmt: skip
    return frame, gravity is not None


def gravity_of(reading: dict[str, Any]) -> NDArray[np.float64] | None:
    """Direction of gravity in the axes of the rear camera, of an accelerometer at rest.

    A device's axes are x right, y up and z out of its screen (W3C), and what is felt points up.
    Some report the opposite: an image is hardly ever taken upside down, so its sign is told.
    """
    x, y, z = (number(reading, axis) for axis in "xyz")
    length = hypot(x, y, z)
    if not length > 0:
        return None
    gravity = np.array([-x, y, z]) / length
    return -gravity if gravity[1] < -0.3 else gravity


def photo_of(reading: dict[str, Any], options: ServeOptions) -> Photo:
    """Picture of a reading: a file of a kind told by its first bytes, or plain rows of pixels."""
    data = reading["image"]
    if data.startswith(_IMAGE_HEADS):
        return read_photo(data, "imageBytes", options)
    width, height = _size(reading, options)
    channels = len(data) // (width * height)
    if channels not in _CHANNELS or channels * width * height != len(data):
        raise InputError(
            f"imageBytes: {len(data):,} bytes are not JPEG, PNG or pixels of {width} x {height}; "
            "send a JPEG."
        )
    pixels = np.frombuffer(data, np.uint8).reshape(height, width, channels)
    rgb = np.repeat(pixels, 3, axis=2) if channels == 1 else pixels[..., :3]
    return Photo(np.ascontiguousarray(rgb), (width, height), None, None)


def depth_of(reading: dict[str, Any], options: ServeOptions) -> NDArray[np.float32]:
    """Depth (h, w) [m] of a reading: float32 metres, or 16 bits between `minMaxDepth`, or of mm."""
    from placegraph_serve.requests import read_depth

    data, bounds = reading["image"], reading["params"].get("minMaxDepth")
    if data.startswith(_IMAGE_HEADS):
        units = np.nan_to_num(read_depth(data, "imageBytes (DEPTH)", 1.0, options))
    else:
        width, height = _size(reading, options)
        if len(data) == 4 * width * height:
            return np.frombuffer(data, "<f4").reshape(height, width)
        if len(data) != 2 * width * height:
            raise InputError(
                f"imageBytes: {len(data):,} bytes are not depth of {width} x {height}; send 16 or "
                "32 bits per pixel."
            )
        units = np.frombuffer(data, "<u2").reshape(height, width).astype(np.float32)
    if isinstance(bounds, list) and len(bounds) == 2:
        low, high = (number({"minMaxDepth": b}, "minMaxDepth") for b in bounds)
        scaled = low + units / np.float32(65535.0) * (high - low)
        return np.where(units > 0, scaled, np.nan).astype(np.float32)
    return np.where(units > 0, units / 1000.0, np.nan).astype(np.float32)


def camera_of(reading: dict[str, Any], photo: Photo) -> Camera | None:
    """Camera by COLMAP's model and parameters; None where the client does not know it."""
    params = reading["params"]
    model, values = str(params.get("model") or "UNKNOWN").upper(), params.get("modelParams") or []
    if model.startswith("UNKNOWN") or not values:
        return None
    if not isinstance(values, list):
        raise InputError(
            "modelParams: not a list of numbers; send the parameters of the camera model."
        )
    numbers = [number({"modelParams": v}, "modelParams") for v in values]
    return model_camera("modelParams", model, photo.size, numbers)


def _answer(
    request: ProtocolRequest, status: str, reason: str, best: dict[str, Any] | None = None
) -> dict[str, Any]:
    """The response: the protocol's keys, and beside them status, reason and source of the pose."""
    source = "images" if best else "geolocation"
    best = best or _fallback(request, reason)
    when = request.camera[-1].get("timestamp") if request.camera else None
    plain = {"position": best["position"], "quaternion": best["quaternion"]}
    return {
        "id": request.id,
        "timestamp": request.timestamp if when is None else when,
        "type": "geopose",
        "accuracy": {"position": best["accuracy"]["position"],
                     "orientation": _degrees(best["accuracy"]["orientation"])},
        "geopose": plain,
        **({"pose": plain} if request.version == 1 else {}),
        "status": status,
        "reason": reason,
        "source": source,
        "modes": [],
        "notes": [],
    }  # fmt: skip


def _fallback(request: ProtocolRequest, reason: str) -> dict[str, Any]:
    """Pose of the geolocation reading alone; `RequestError` where there is none."""
    if not request.geolocation:
        raise RequestError(
            f"There is no certain pose. {reason} Send an image of a mapped place, or a geolocation "
            "reading.",
            status=422,
            code="no_pose",
        )
    fix = request.geolocation[-1]
    lon, lat = _lonlat(number(fix, "longitude"), number(fix, "latitude"))
    half = radians(number(fix, "heading", 0.0)) / 2.0
    document = {"x": 0.0, "y": 0.0, "z": -sin(half), "w": cos(half)}
    return {
        "position": {"lat": lat, "lon": lon, "h": number(fix, "altitude", 0.0)},
        "quaternion": document,
        "accuracy": {"position": number(fix, "accuracy", 0.0) or GUESS, "orientation": None},
        "probability": 0.0,
        "unknown": ["orientation"],
    }


def _degrees(orientation: float | None) -> float:
    return 180.0 if orientation is None else min(orientation, 180.0)


def _quaternion(document: Any) -> NDArray[np.float64]:  # noqa: ANN401  # JSON
    if not isinstance(document, dict):
        return np.full(4, np.nan)
    xyzw = np.array([number(document, axis, 0.0) for axis in "xyzw"])
    length = float(np.linalg.norm(xyzw))
    return xyzw / length if length > 1e-6 else np.full(4, np.nan)


def _lonlat(lon: float, lat: float) -> tuple[float, float]:
    if abs(lat) > 90.0 or abs(lon) > 360.0:
        raise InputError(f"latitude, longitude: {lat:g}, {lon:g} are out of range; send degrees.")
    return (lon + 180.0) % 360.0 - 180.0, lat


def _size(reading: dict[str, Any], options: ServeOptions) -> tuple[int, int]:
    size = reading.get("size")
    if not isinstance(size, list) or len(size) != 2:
        raise InputError("size: width and height are missing; send [width, height].")
    width, height = (int(number({"size": v}, "size")) for v in size)
    if min(width, height) < SMALLEST:
        raise InputError(
            f"size: {width} x {height}; send an image of at least {SMALLEST} pixels per side."
        )
    check_size((width, height), "imageBytes", options)
    return width, height


def _is_depth(reading: dict[str, Any]) -> bool:
    return str(reading.get("imageFormat") or "").upper().startswith("DEPTH")
