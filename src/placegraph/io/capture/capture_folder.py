"""Capture folders: placegraph's own layout, as `docs/formats.md` describes it.

`trajectory.tum`, the truth, is never read here: nothing that localizes may see it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame import (
    Capture,
    DepthUnit,
    Frame,
    LabelKind,
    LabelMeanings,
    LazyImages,
    colour_file,
    depth_file,
    label_file,
)
from placegraph.io.capture.images import image_size, images_of
from placegraph.io.capture.json_files import CameraFile, read_camera, read_json
from placegraph.io.capture.tum import read_table, read_tum

_GRAVITY_COLUMNS = ("stamp", "gx", "gy", "gz")
_GRAVITY_TOLERANCE = 0.02  # two decimals are a direction still; an accelerometer's 9.81 is not


def is_capture_folder(path: Path) -> bool:
    """Whether a folder has one of `rgb/`, `camera.json` and `odometry.tum`; other recorders may too."""
    return any((path / name).exists() for name in ("rgb", "camera.json", "odometry.tum"))


def read_capture_folder(path: Path, *, labels: str | None = "auto") -> Capture:
    """Read a capture folder; parameters and errors as of `open_capture`."""
    cameras = read_camera(path / "camera.json")
    colours = images_of(path / "rgb")
    if not colours:
        raise InputError(f"{path / 'rgb'} holds no image; a capture needs colour images there.")
    depths = images_of(path / "depth")
    kind = _label_kind(path, labels)
    marks = images_of(path / kind) if kind else {}
    for folder, found in (("depth", depths), (kind, marks)):
        extra = sorted(set(found) - set(colours))
        if extra:
            raise InputError(
                f"{found[extra[0]]} belongs to no image in rgb/; {folder} images bear the names of "
                "their colour images."
            )
    names = _label_names(path / "labels.json")
    label_camera = None
    if kind and marks:
        label_camera = cameras.label_camera(kind, image_size(next(iter(marks.values()))))
    frames = _frames(path, cameras, colours, depths, marks, kind, label_camera, names)
    shown = {i: name for i, name in names.items() if name}
    depth_camera = cameras.depth if depths else None
    return Capture(
        path, frames, cameras.camera, depth_camera, label_camera, kind if marks else None, shown
    )


def _frames(
    path: Path,
    cameras: CameraFile,
    colours: dict[str, Path],
    depths: dict[str, Path],
    marks: dict[str, Path],
    kind: LabelKind | None,
    label_camera: Camera | None,
    names: dict[int, str | None],
) -> tuple[Frame, ...]:
    """Return one frame an image, with row i of every text file."""
    odometry = read_tum(_needed(path / "odometry.tum", len(colours)))
    _count(path / "odometry.tum", len(odometry), len(colours))
    gravity = _gravity(path / "gravity.txt", odometry.poses)
    known = None
    if kind == "labels":
        known = LabelMeanings(names, path / "labels.json", cameras.offsets[kind])
    shown = {i: name for i, name in names.items() if name}
    unit = DepthUnit(f"`depth.scale` in {cameras.path}", cameras.depth_scale)

    def images(stem: str, colour: Path) -> LazyImages:
        metres = ids = None
        if stem in depths:
            metres = depth_file(depths[stem], cameras.depth, cameras.depth_scale)
        if kind and label_camera and stem in marks:
            ids = label_file(marks[stem], label_camera, cameras.offsets[kind], known)
        return LazyImages(colour_file(colour, cameras.camera), metres, ids, unit)

    return tuple(
        Frame(
            index=i,
            stamp=float(odometry.stamps[i]),
            odometry=odometry.poses[i],
            gravity=gravity[i],
            camera=cameras.camera,
            depth_camera=cameras.depth if depths else None,
            label_camera=label_camera,
            label_kind=kind if marks else None,
            label_names=shown,
            images=images(stem, colour),
        )
        for i, (stem, colour) in enumerate(colours.items())
    )


def _label_kind(path: Path, labels: str | None) -> LabelKind | None:
    there: list[LabelKind] = [k for k in ("instances", "labels") if (path / k).is_dir()]
    if labels == "auto":
        return there[0] if there else None
    for kind in ("instances", "labels"):
        if labels == kind and kind not in there:
            raise InputError(f"{path / kind} does not exist, but labels={kind!r} asks for it.")
        if labels == kind:
            return kind
    return None


def _label_names(path: Path) -> dict[int, str | None]:
    """Return the names by id; None where the file says null: such pixels say nothing."""
    if not path.exists():
        return {}
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f'{path} must be a JSON object from label ids to names: {{"3": "chair"}}.')
    names: dict[int, str | None] = {}
    for key, name in content.items():
        number = key.strip()
        if not (number.isascii() and number.isdigit() and len(number) < 6 and int(number) < 65536):
            raise InputError(f"{path}: {key[:40]!r} is no label id; ids are 0 to 65535.")
        if not (name is None or isinstance(name, str)):
            raise InputError(f"{path}: the name of label {key} is {str(name)[:40]!r}, not text.")
        names[int(number)] = name or None
    return names


def _gravity(path: Path, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit gravity (T, 3) in the camera's axes, from the file or else from the odometry's -z."""
    if not path.exists():
        return _read_only(-poses[:, 2, :3])
    table = read_table(path, _GRAVITY_COLUMNS)
    _count(path, len(table.values), len(poses))
    vectors = table.values[:, 1:]
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(vectors, axis=1)
    wrong = np.flatnonzero(~(np.abs(lengths - 1.0) <= _GRAVITY_TOLERANCE))
    if wrong.size:
        row = int(wrong[0])
        raise table.error(
            row,
            f"gravity has length {lengths[row]:.6g}; give its direction (down, in the camera's axes) "
            "as a unit vector.",
        )
    return _read_only(vectors / lengths[:, None])


def _needed(path: Path, count: int) -> Path:
    if not path.exists():
        raise InputError(
            f"{path} does not exist; it holds one row `stamp tx ty tz qx qy qz qw` for each of the "
            f"{count} images (a single image: `0 0 0 0 0 0 0 1`, and gravity.txt)."
        )
    return path


def _count(path: Path, rows: int, images: int) -> None:
    if rows != images:
        raise InputError(
            f"{path} has {rows} rows, but rgb/ has {images} images; row i belongs to image i."
        )


def _read_only(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.flags.writeable = False
    return array
