"""JSON files of captures and maps: `camera.json` with intrinsics, and label tables."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

from placegraph.core.files import check_regular
from placegraph.core.geometry import MODELS, Camera
from placegraph.errors import InputError, OptionError

_INTRINSICS = ("fx", "fy", "cx", "cy")
_MAX_SIDE = 1 << 16


@dataclass(frozen=True, slots=True)
class CameraFile:
    """Content of a `camera.json`."""

    path: Path
    camera: Camera
    """Intrinsics of the colour images."""
    depth: Camera
    """Intrinsics of the depth images; by default those of the colour images."""
    depth_scale: float
    """Units of a depth image in a metre."""
    labels: dict[str, Camera | None]
    """Intrinsics of the images in `labels/` and `instances/`; None without an entry."""
    offsets: dict[str, int]
    """Numbers to subtract from the values in `labels/` and `instances/`; smaller values mean none."""

    def label_camera(self, kind: str, size: tuple[int, int]) -> Camera:
        """Return the camera of the images in the folder `kind`, of this width and height [px].

        Without an entry, the depth's or the colour images' intrinsics of the same size apply. Raises
        `InputError` where neither fits.
        """
        own = self.labels[kind]
        if own is not None:
            return own
        for camera in (self.depth, self.camera):
            if (camera.width, camera.height) == size:
                return camera
        raise InputError(
            f"{self.path} has no entry {kind!r}, and the images in {kind}/ have {size[0]} x "
            f"{size[1]} pixels, unlike depth and colour; add their intrinsics as {kind!r}."
        )


def read_camera(path: Path, *, depth_scale: float = 1000.0) -> CameraFile:
    """Read `camera.json`; `depth_scale` is the default of its depth scale.

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
            f"{path}: depth.scale is {scale:g}; give the depth units per metre, such as 1000."
        )
    return CameraFile(
        path=path,
        camera=camera,
        depth=_entry_camera(path, entries["depth"], "depth", camera) or camera,
        depth_scale=scale,
        labels={
            kind: _entry_camera(path, entries[kind], kind, camera)
            for kind in ("labels", "instances")
        },
        offsets={
            kind: _integer(path, content.get(f"{kind}_offset", 0), f"{kind}_offset")
            for kind in ("labels", "instances")
        },
    )


def read_json(path: Path) -> Any:  # noqa: ANN401  # whatever the file holds
    """Return the content of a JSON file; `InputError` where it is missing or not JSON."""
    try:
        return json.loads(check_regular(path).read_text(encoding="utf-8-sig"))
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


def _entry_camera(path: Path, entry: dict[str, Any], kind: str, camera: Camera) -> Camera | None:
    """Return the camera of an entry: its own, or the colour camera resized; None without either."""
    if any(name in entry for name in _INTRINSICS):
        return _camera(path, entry, f"{kind}.")
    if "width" in entry or "height" in entry:
        return camera.resize(*_size(path, entry, f"{kind}."))
    return None


def _camera(path: Path, content: dict[str, Any], prefix: str) -> Camera:
    faults = [
        f"{prefix}{name} is missing"
        for name in ("width", "height", *_INTRINSICS)
        if content.get(name) is None
    ]
    faults += [
        f"{prefix}{name} is {value:g}, so the camera's axes are not OpenCV's: flip that axis of the "
        "poses, too, as `placegraph capture init` does"
        for name in ("fx", "fy")
        if isinstance(value := content.get(name), int | float) and value < 0
    ]
    if faults:
        raise InputError(f"{path}: {'; '.join(faults)}.")
    width, height = _size(path, content, prefix)
    fx, fy, cx, cy = (_number(path, content.get(n), prefix + n) for n in _INTRINSICS)
    distortion = content.get("distortion") or []
    if not isinstance(distortion, list):
        raise InputError(f"{path}: {prefix}distortion must be a list of numbers.")
    numbers = tuple(_number(path, d, f"{prefix}distortion") for d in distortion)
    model = content.get("model", "opencv")
    if model not in MODELS:
        raise InputError(
            f"{path}: {prefix}model is {str(model)[:40]!r}; choose one of {', '.join(MODELS)}."
        )
    try:
        return Camera(width, height, fx, fy, cx, cy, numbers, model)
    except OptionError as error:
        raise InputError(f"{path}: {prefix}{error}") from error


def _size(path: Path, content: dict[str, Any], prefix: str) -> tuple[int, int]:
    width, height = (
        _integer(path, content.get(name), prefix + name) for name in ("width", "height")
    )
    if not (0 < width <= _MAX_SIDE and 0 < height <= _MAX_SIDE):
        raise InputError(f"{path}: {prefix}width and height are {width} and {height} pixels.")
    return width, height


def _number(path: Path, value: object, field: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > 1e300:
        what = "is missing" if value is None else f"is {str(value)[:40]!r}"
        raise InputError(f"{path}: {field} {what}; it must be a number.")
    return float(value)


def _integer(path: Path, value: object, field: str) -> int:
    number = _number(path, value, field)
    if number != int(number if abs(number) < 1e15 else 0):
        raise InputError(f"{path}: {field} is {number:g}; it must be a whole number.")
    return int(number)


_IDS = ("id", "objectId", "object_id", "instance_id")
_LABELS = ("label", "class", "category", "class_name")


@dataclass(frozen=True, slots=True)
class LabelEntry:
    """Label, name and attributes of one object."""

    label: str
    name: str = ""
    attributes: dict[str, str] = field(default_factory=dict)


def read_label_table(
    labels: Mapping[str, str] | Mapping[int, str] | str | PathLike[str], scan: str = ""
) -> dict[str, LabelEntry]:
    """Return labels by object id, from a mapping of ids (or names) to labels, or from a JSON file.

    The file holds an object `{"3": "chair"}`; or a list `[{"id": 3, "label": "chair", "name": ...}]`;
    or this list under `objects` (3RScan's `objects.json`, in the entry of `scans` named `scan`) or
    `segGroups` (3RScan's and ScanNet's aggregation). Raises `InputError` for anything else.
    """
    if not isinstance(labels, str) and hasattr(labels, "items"):
        return {str(key): LabelEntry(str(label)) for key, label in labels.items()}
    path = Path(labels)
    content = read_json(path)
    if isinstance(content, dict) and "scans" in content:
        content = _scan(path, content["scans"], scan)
    if isinstance(content, dict):
        listed = next((content[k] for k in ("objects", "segGroups") if k in content), None)
        if listed is None:
            return {str(key): _label_entry(path, key, label) for key, label in content.items()}
        content = listed
    if not isinstance(content, list):
        raise InputError(
            f'{path} is not a label table; write {{"3": "chair"}} or [{{"id": 3, "label": '
            '"chair"}].'
        )
    return dict(_table_entry(path, row, entry) for row, entry in enumerate(content))


def _scan(path: Path, scans: object, scan: str) -> object:
    if isinstance(scans, list):
        found = [s for s in scans if isinstance(s, dict) and scan in {s.get("scan"), s.get("id")}]
        if len(scans) == 1 or found:
            return (found or scans)[0]
    raise InputError(f"{path} contains several scans, but not {scan!r}; give only the right one.")


def _label_entry(path: Path, key: str, label: object) -> LabelEntry:
    if not isinstance(label, str) or not label:
        raise InputError(f"{path}: the label of {key!r} is {str(label)[:40]!r}, not text.")
    return LabelEntry(label)


def _table_entry(path: Path, row: int, entry: Any) -> tuple[str, LabelEntry]:  # noqa: ANN401  # of a JSON list
    if not isinstance(entry, dict):
        raise InputError(f"{path}: entry {row} is not an object with id and label.")
    id_ = next((entry[k] for k in _IDS if k in entry), None)
    label = next((entry[k] for k in _LABELS if k in entry), None)
    if isinstance(id_, bool) or not isinstance(id_, int | str) or not isinstance(label, str):
        raise InputError(f"{path}: entry {row} lacks an id (number or text) or a label (text).")
    name = entry.get("name")
    attributes = entry.get("attributes")
    return str(id_), LabelEntry(
        label,
        name if isinstance(name, str) else "",
        {
            str(k): (", ".join(map(str, v)) if isinstance(v, list) else str(v))
            for k, v in attributes.items()
        }
        if isinstance(attributes, dict)
        else {},
    )
