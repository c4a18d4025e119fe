"""What `POST /geopose` answers: the Open AR Cloud's GeoPose protocol, versions 1 and 2."""

from __future__ import annotations

from math import cos, hypot, radians, sin
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Status
from placegraph.core.geo import EarthPose
from placegraph.core.geojson import poses_of
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, RequestError
from placegraph.io.capture.frame import Frame
from placegraph_io.dataset.colmap import model_camera
from placegraph_serve.asked import LEVEL, Hints, Images
from placegraph_serve.localize import found, notes
from placegraph_serve.options import ServeOptions
from placegraph_serve.oscp import Asked, number, read_request
from placegraph_serve.photo import SMALLEST, Photo, check_size, read_photo

if TYPE_CHECKING:
    from placegraph_serve.places import Desk

GUESS = 20.0
"""Accuracy of a position that does not say how good it is [m]."""
FAR = 200.0
"""Radius of maps that are looked into about a geolocation: it may be far off indoors [m]."""
_IMAGE_HEADS = (b"\xff\xd8\xff", b"\x89PNG", b"RIFF")
_CHANNELS = {1: "GRAY8", 3: "RGB24", 4: "RGBA32"}


def geopose(desk: Desk, asked: dict[str, Any]) -> dict[str, Any]:
    """Answer a request; `asked`: `body` and `version`, None where the client does not say.

    Where no image can be used, the pose is that of the geolocation reading, with its accuracy and the
    status `LOST`.
    """
    request = read_request(asked["body"], asked["version"])
    hints = hints_of(request)
    colour = [r for r in request.camera if not _is_depth(r) and r["image"]]
    depth = [r for r in request.camera if _is_depth(r) and r["image"]]
    if not colour:
        why = "No image was sent that could be compared with a map (imageBytes is empty)."
        return _answer(request, [], Status.LOST.name, why)
    frame, leveled = frame_of(colour[-1], depth, request.accelerometer, desk.options)
    images = Images((frame,), moved=True, leveled=leveled)
    estimate, _ = found(desk.places, images, hints)
    poses = [pose for mode in estimate.modes for pose in poses_of(mode)]
    if estimate.modes and not poses:
        estimate.geopose()  # raises: nobody has placed that map on Earth
    told = _answer(request, poses, estimate.status.name, estimate.reason)
    return told | {"notes": notes(desk.places, hints, estimate)}


def hints_of(request: Asked) -> Hints:
    """Where the device roughly is: by the newest pose of before, or else by geolocation."""
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
    from placegraph.io.capture.frame import turned_camera

    gravity = gravity_of(moved[-1]) if moved else None
    metres = depth_of(depth[-1], options) if depth else None
    frame = Frame.from_arrays(
        np.ascontiguousarray(rgb), turned_camera(camera, turns),
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
            f"imageBytes: {len(data):,} bytes are neither JPEG nor PNG, nor pixels of {width} x "
            f"{height}; send a JPEG."
        )
    pixels = np.frombuffer(data, np.uint8).reshape(height, width, channels)
    rgb = np.repeat(pixels, 3, axis=2) if channels == 1 else pixels[..., :3]
    return Photo(np.ascontiguousarray(rgb), (width, height), None, None)


def depth_of(reading: dict[str, Any], options: ServeOptions) -> NDArray[np.float32]:
    """Depth (h, w) [m] of a reading: float32 metres, or 16 bits between `minMaxDepth`, or of mm."""
    from placegraph_serve.photo import read_depth

    data, bounds = reading["image"], reading["params"].get("minMaxDepth")
    if data.startswith(_IMAGE_HEADS):
        units = np.nan_to_num(read_depth(data, "imageBytes (DEPTH)", 1.0, options))
    else:
        width, height = _size(reading, options)
        if len(data) == 4 * width * height:
            return np.frombuffer(data, "<f4").reshape(height, width)
        if len(data) != 2 * width * height:
            raise InputError(
                f"imageBytes: {len(data):,} bytes are no depth of {width} x {height}; send 16 or 32 "
                "bits a pixel."
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
        raise InputError("modelParams: no list of numbers; send those of the model.")
    numbers = [number({"modelParams": v}, "modelParams") for v in values]
    return model_camera("modelParams", model, photo.size, numbers)


def _answer(request: Asked, poses: list[EarthPose], status: str, reason: str) -> dict[str, Any]:
    """The response: the protocol's keys, and beside them status, reason and all modes."""
    modes = [
        pose.geopose() | {"building": pose.building, "level": pose.level, "room": pose.room}
        for pose in poses
    ]
    source = "images"
    if not modes:
        modes, source = [_fallback(request, reason)], "geolocation"
    best = modes[0]
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
        "modes": modes,
    }  # fmt: skip


def _fallback(request: Asked, reason: str) -> dict[str, Any]:
    """Pose of the geolocation reading alone; `RequestError` where there is none."""
    if not request.geolocation:
        raise RequestError(
            f"There is no pose: {reason} Send an image of a place that a map shows, or a geolocation "
            "reading.",
            status=422,
            code="no_pose",
        )
    fix = request.geolocation[-1]
    lon, lat = _lonlat(number(fix, "longitude"), number(fix, "latitude"))
    half = radians(number(fix, "heading", 0.0)) / 2.0
    told = {"x": 0.0, "y": 0.0, "z": -sin(half), "w": cos(half)}
    return {
        "position": {"lat": lat, "lon": lon, "h": number(fix, "altitude", 0.0)},
        "quaternion": told,
        "accuracy": {"position": number(fix, "accuracy", 0.0) or GUESS, "orientation": None},
        "probability": 0.0,
        "unknown": ["orientation"],
    }


def _degrees(orientation: float | None) -> float:
    return 180.0 if orientation is None else min(orientation, 180.0)


def _quaternion(told: Any) -> NDArray[np.float64]:  # noqa: ANN401  # JSON
    if not isinstance(told, dict):
        return np.full(4, np.nan)
    xyzw = np.array([number(told, axis, 0.0) for axis in "xyzw"])
    length = float(np.linalg.norm(xyzw))
    return xyzw / length if length > 1e-6 else np.full(4, np.nan)


def _lonlat(lon: float, lat: float) -> tuple[float, float]:
    if abs(lat) > 90.0 or abs(lon) > 360.0:
        raise InputError(
            f"latitude, longitude: {lat:g}, {lon:g} are nowhere on Earth; send degrees."
        )
    return (lon + 180.0) % 360.0 - 180.0, lat


def _size(reading: dict[str, Any], options: ServeOptions) -> tuple[int, int]:
    size = reading.get("size")
    if not isinstance(size, list) or len(size) != 2:
        raise InputError("size: width and height are missing; send [width, height].")
    width, height = (int(number({"size": v}, "size")) for v in size)
    if min(width, height) < SMALLEST:
        raise InputError(f"size: {width} x {height}; send an image of {SMALLEST} or more a side.")
    check_size((width, height), "imageBytes", options)
    return width, height


def _is_depth(reading: dict[str, Any]) -> bool:
    return str(reading.get("imageFormat") or "").upper().startswith("DEPTH")
