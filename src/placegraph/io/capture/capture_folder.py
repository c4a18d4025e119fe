"""Capture folders: placegraph's own layout (`docs/formats.md`).

The ground truth `trajectory.tum` is never read here: nothing that localizes may see it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame import (
    Capture,
    DepthUnit,
    Frame,
    LabelKind,
    LabelTable,
    LazyImages,
    colour_file,
    depth_file,
    label_file,
)
from placegraph.io.capture.images import image_size, list_images
from placegraph.io.capture.json_files import read_camera, read_json
from placegraph.io.capture.posed import make_camera
from placegraph.io.capture.tum import Trajectory, read_table, read_tum

_GRAVITY_COLUMNS = ("stamp", "gx", "gy", "gz")
_GRAVITY_TOLERANCE = 0.02  # a unit vector of two decimals, but not an accelerometer's 9.81


def is_capture_folder(path: Path) -> bool:
    """Return whether a folder has `rgb/`, `camera.json` or `odometry.tum`, as others may, too."""
    return any((path / name).exists() for name in ("rgb", "camera.json", "odometry.tum"))


def read_capture_folder(path: Path, *, labels: str | None = "auto") -> Capture:
    """Read a capture folder; `labels` is "auto", "labels", "instances" or None (`open_capture`)."""
    colours, depths = list_images(path / "rgb"), list_images(path / "depth")
    has = {
        "colour images in rgb/": bool(colours),
        "camera.json": (path / "camera.json").exists(),
        "odometry.tum": (path / "odometry.tum").exists(),
    }
    if not all(has.values()):
        lacking = " and ".join(name for name, exists in has.items() if not exists)
        raise InputError(
            f"{path} is not a complete capture folder: it lacks {lacking}. `placegraph capture init "
            f"{path}` writes one from images, poses and intrinsics in other layouts."
        )
    cameras = read_camera(path / "camera.json")
    kind = _label_kind(path, labels)
    label_images = list_images(path / kind) if kind else {}
    for folder, images in (("depth", depths), (kind, label_images)):
        extra = sorted(set(images) - set(colours))
        if extra:
            raise InputError(
                f"{images[extra[0]]} matches no image in rgb/; name {folder} images like "
                "their colour images."
            )
    odometry, gravity = _read_motion(path, len(colours))
    focused = _read_intrinsics(path / "intrinsics.txt", cameras.camera, len(colours))
    follows = cameras.depth == cameras.camera.resize(cameras.depth.width, cameras.depth.height)
    names = _read_label_names(path / "labels.json")
    label_camera = table = None
    if kind and label_images:
        size = image_size(next(iter(label_images.values())))
        label_camera = cameras.label_camera(kind, size)
    if kind == "labels":
        table = LabelTable(names, path / "labels.json", cameras.offsets[kind])
    shared: Any = {
        "camera": cameras.camera,
        "depth_camera": cameras.depth if depths else None,
        "label_camera": label_camera,
        "label_kind": kind if label_images else None,
        "label_names": {i: name for i, name in names.items() if name},
    }
    unit = DepthUnit(f"`depth.scale` in {cameras.path}", cameras.depth_scale)

    def lazy_images(stem: str) -> LazyImages:
        metres = ids = None
        if stem in depths:
            metres = depth_file(depths[stem], cameras.depth, cameras.depth_scale)
        if kind and label_camera and stem in label_images:
            ids = label_file(label_images[stem], label_camera, cameras.offsets[kind], table)
        return LazyImages(colour_file(colours[stem], cameras.camera), metres, ids, unit)

    def focused_depth(camera: Camera) -> dict[str, Camera]:
        depth = camera.resize(cameras.depth.width, cameras.depth.height)
        return {"camera": camera} | ({"depth_camera": depth} if depths and follows else {})

    frames = tuple(
        Frame(
            i, float(stamp), pose, down, images=lazy_images(stem), **shared | focused_depth(camera)
        )
        for i, (stem, stamp, pose, down, camera) in enumerate(
            zip(colours, odometry.stamps, odometry.poses, gravity, focused, strict=True)
        )
    )
    return Capture(path, frames, **shared)


def _label_kind(path: Path, labels: str | None) -> LabelKind | None:
    kinds: list[LabelKind] = [k for k in ("instances", "labels") if (path / k).is_dir()]
    if labels == "auto":
        return next(iter(kinds), None)
    for kind in ("instances", "labels"):
        if labels == kind and kind not in kinds:
            raise InputError(f"{path / kind} does not exist, but labels={kind!r} asks for it.")
        if labels == kind:
            return kind
    return None


def _read_label_names(path: Path) -> dict[int, str | None]:
    """Return names by id; None where the file says null, for pixels without a label."""
    if not path.exists():
        return {}
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f'{path} must be a JSON object from label ids to names: {{"3": "chair"}}.')
    names: dict[int, str | None] = {}
    for key, name in content.items():
        number = key.strip()
        if not (number.isascii() and number.isdigit() and len(number) < 6 and int(number) < 65536):
            raise InputError(
                f"{path}: {key[:40]!r} is not a label id; ids are integers from 0 to 65535."
            )
        if not (name is None or isinstance(name, str)):
            raise InputError(f"{path}: the name of label {key} is {str(name)[:40]!r}, not text.")
        names[int(number)] = name or None
    return names


def _read_motion(path: Path, count: int) -> tuple[Trajectory, NDArray[np.float64]]:
    """Return the odometry, and unit gravity (T, 3) in the camera's axes, of as many frames as images.

    Without `gravity.txt` it is the odometry's -z.
    """
    file = path / "odometry.tum"
    odometry = read_tum(file)
    _check_count(file, len(odometry), count)
    if not (path / "gravity.txt").exists():
        return odometry, _read_only(-odometry.poses[:, 2, :3])
    table = read_table(path / "gravity.txt", _GRAVITY_COLUMNS)
    _check_count(path / "gravity.txt", len(table.values), count)
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
    return odometry, _read_only(vectors / lengths[:, None])


def _read_intrinsics(path: Path, camera: Camera, count: int) -> list[Camera]:
    """Return the camera of each image: with a row of `intrinsics.txt`, if it exists, else as it is."""
    if not path.exists():
        return [camera] * count
    table = read_table(path, ("stamp", "fx", "fy", "cx", "cy"))
    _check_count(path, len(table.values), count)
    size = camera.width, camera.height
    return [
        make_camera(table.locations[i], size, row[1:], camera.distortion, camera.model)
        for i, row in enumerate(table.values.tolist())
    ]


def _check_count(path: Path, rows: int, images: int) -> None:
    if rows != images:
        raise InputError(
            f"{path} has {rows} rows, but rgb/ has {images} images; row i belongs to image i."
        )


def _read_only(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.flags.writeable = False
    return array
