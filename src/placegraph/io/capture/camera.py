"""`camera.json` of a capture folder: intrinsics of the colour, depth and label images."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from placegraph.core.camera_models import MODELS
from placegraph.core.files import regular
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError

_INTRINSICS = ("fx", "fy", "cx", "cy")
_MAX_SIDE = 1 << 16


@dataclass(frozen=True, slots=True)
class CameraFile:
    """What stands in a `camera.json`."""

    path: Path
    camera: Camera
    """Of the colour images."""
    depth: Camera
    """Of the depth images; the colour images' where the file says nothing else."""
    depth_scale: float
    """Units of a depth image in a metre."""
    labels: dict[str, Camera | None]
    """Of the images in `labels/` and `instances/`, where the file has such an entry."""
    offsets: dict[str, int]
    """What to subtract from the values in `labels/` and `instances/`; below it is nothing."""

    def label_camera(self, kind: str, size: tuple[int, int]) -> Camera:
        """Camera of the images in the folder `kind`, which have this width and height [px].

        Without an entry of their own they share the depth's or the colour images' intrinsics,
        whichever has their size. Raises `InputError` where neither has.
        """
        own = self.labels[kind]
        if own is not None:
            return own
        for camera in (self.depth, self.camera):
            if (camera.width, camera.height) == size:
                return camera
        raise InputError(
            f"{self.path} has no entry {kind!r}, and the images in {kind}/ are {size[0]} x {size[1]} "
            f"like neither depth nor colour; add their intrinsics as {kind!r}."
        )


def read_camera(path: Path, *, depth_scale: float = 1000.0) -> CameraFile:
    """Read `camera.json`; `depth_scale` is what its depth has, if it does not say so.

    Raises
    ------
    InputError
        The file is missing or not JSON, or a field is missing, no number, or out of range.

    """
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f"{path} must be a JSON object with width, height, fx, fy, cx, cy.")
    camera = _camera(path, content, "")
    entries = {kind: _entry(path, content, kind) for kind in ("depth", "labels", "instances")}
    scale = _number(path, entries["depth"].get("scale", depth_scale), "depth.scale")
    if not scale >= 1:
        raise InputError(
            f"{path}: depth.scale is {scale:g}; it says how many units of the depth images make a "
            "metre, such as 1000."
        )
    return CameraFile(
        path=path,
        camera=camera,
        depth=_sub(path, entries["depth"], "depth", camera) or camera,
        depth_scale=scale,
        labels={kind: _sub(path, entries[kind], kind, camera) for kind in ("labels", "instances")},
        offsets={
            kind: _whole(path, content.get(f"{kind}_offset", 0), f"{kind}_offset")
            for kind in ("labels", "instances")
        },
    )


def read_json(path: Path) -> Any:  # noqa: ANN401  # whatever the file holds
    """Content of a JSON file; `InputError` where it is missing or not JSON."""
    try:
        return json.loads(regular(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path} is not JSON ({error}).") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error


def _entry(path: Path, content: dict[str, Any], kind: str) -> dict[str, Any]:
    entry = content.get(kind, {})
    if not isinstance(entry, dict):
        raise InputError(f"{path}: {kind} must be an object with the intrinsics of {kind}/.")
    return entry


def _sub(path: Path, entry: dict[str, Any], kind: str, camera: Camera) -> Camera | None:
    """Camera of an entry: its own, or the colour camera brought to the entry's size; else none."""
    if any(name in entry for name in _INTRINSICS):
        return _camera(path, entry, f"{kind}.")
    if "width" in entry or "height" in entry:
        return camera.resized(*_size(path, entry, f"{kind}."))
    return None


def _camera(path: Path, content: dict[str, Any], prefix: str) -> Camera:
    width, height = _size(path, content, prefix)
    fx, fy, cx, cy = (_number(path, content.get(n), prefix + n) for n in _INTRINSICS)
    distortion = content.get("distortion") or []
    if not isinstance(distortion, list):
        raise InputError(f"{path}: {prefix}distortion must be a list of numbers.")
    numbers = tuple(_number(path, d, f"{prefix}distortion") for d in distortion)
    model = content.get("model", "opencv")
    if model not in MODELS:
        raise InputError(
            f"{path}: {prefix}model is {str(model)[:40]!r}; it is one of {', '.join(MODELS)}."
        )
    try:
        return Camera(width, height, fx, fy, cx, cy, numbers, model)
    except OptionError as error:
        raise InputError(f"{path}: {prefix}{error}") from error


def _size(path: Path, content: dict[str, Any], prefix: str) -> tuple[int, int]:
    width, height = (_whole(path, content.get(name), prefix + name) for name in ("width", "height"))
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE):
        raise InputError(f"{path}: {prefix}width and height are {width} and {height} pixels.")
    return width, height


def _number(path: Path, value: object, field: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e300:
        what = "is missing" if value is None else f"is {str(value)[:40]!r}"
        raise InputError(f"{path}: {field} {what}; it must be a number.")
    return float(value)


def _whole(path: Path, value: object, field: str) -> int:
    number = _number(path, value, field)
    if number != int(number if abs(number) < 1e15 else 0):
        raise InputError(f"{path}: {field} is {number:g}; it must be a whole number.")
    return int(number)
