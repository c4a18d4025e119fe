"""What the user says of a bag, in Python or in the file `BAG.json` beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import InputError, OptionError
from placegraph.formats.capture.camera import read_json

if TYPE_CHECKING:
    from placegraph.formats.ros.transforms import Samples

_NAMES = ("colour", "depth", "odometry", "imu", "frame")
_CAMERAS = ("camera", "depth_camera")
_KEYS = (*_NAMES, *_CAMERAS, "depth_scale", "transforms")


@dataclass(frozen=True, slots=True)
class Wishes:
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


def wishes_of(path: Path, given: Mapping[str, Any] | None) -> Wishes:
    """What `BAG.json` says, and over it what is given.

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
    return Wishes(**out)


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
