"""`transforms.json`, as NeRFCapture, Spectacular AI and nerfstudio write it for radiance fields.

`frames`: `file_path`, `transform_matrix` (4 x 4, world_from_camera, camera axes as OpenGL's), perhaps
`depth_file_path` or `depth_path` (PNG of 16 bits), `timestamp`; `fl_x fl_y cx cy w h` and distortion
`k1 k2 p1 p2` of all frames or of each. Units of depth are millimetres, or `integer_depth_scale` metres.
Worlds of ARKit have y up (NeRFCapture, nerfstudio of Record3D), others z (Spectacular AI, nerfstudio of
Polycam); the file does not say which, but who wrote it does, or how the cameras were held.
(DatasetWriter.swift and nerfcapture_dataset.py of jc211/NeRFCapture, replay_to_nerf.py of
SpectacularAI/sdk-examples, polycam_utils.py and record3d_utils.py of nerfstudio.)
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.errors import InputError, OptionError
from placegraph.io.capture.frame import Capture, DepthUnit, LazyImages, colour_file, depth_file
from placegraph.io.capture.images import ENDINGS, image_size
from placegraph.io.capture.json_files import read_json
from placegraph.io.capture.posed import (
    ARKIT_FROM_OPENCV,
    StoredFrame,
    make_camera,
    make_capture,
    orthonormalize_pose,
    read_number,
    resize_camera,
)
from placegraph.io.capture.up import upright

_FILE = "transforms.json"
_DISTORTION = {"opencv": ("k1", "k2", "p1", "p2"), "fisheye": ("k1", "k2", "k3", "k4")}
_LENSES = {"OPENCV": "opencv", "PINHOLE": "opencv", "OPENCV_FISHEYE": "fisheye"}
_MIN_DIFFERENCE = (
    0.15  # by how much y or z must be more nearly one direction of the images than the other
)
_UNSCALED = {
    "colmap_im_id",
    "sharpness",
}  # Keys of frames whose poses COLMAP found, which knows no metres


def is_transforms(path: Path) -> bool:
    """Return whether a folder has a `transforms.json`."""
    return (path / _FILE).is_file()


def read_transforms(
    path: Path, *, scale: float | None = None, up: ArrayLike | None = None
) -> Capture:
    """Read a folder; frames whose depth image is missing have none.

    `scale` is metres in a unit of the poses, 1 if not given; `up` a direction (3,) in their world, y
    or z if not given, by how the cameras were held. Raises `InputError` where files are missing or
    broken, where poses are COLMAP's and `scale` is not given, or where neither is plainly up.
    """
    file = path / _FILE
    content = read_json(file)
    frames = content.get("frames") if isinstance(content, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise InputError(f"{file}: frames is not a list of objects; export the capture again.")
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise OptionError(f"scale is {scale}; it must be greater than 0.")
    if scale is None and _UNSCALED & set(frames[0]):
        raise InputError(
            f"{file} has poses from COLMAP, which are not in metres; open COLMAP's own model, or "
            "give scale."
        )
    poses = [_read_pose(file, frame, i) for i, frame in enumerate(frames)]
    map_from_world, note = _level(np.stack(poses), up, _up_axis_of_writer(content), file)
    left_out: Counter[str] = Counter()
    frames_ = []
    for i, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
        image = _find_image(path, frame, i)
        if image is None:
            left_out["no colour image"] += 1
            continue
        moved = pose.copy()
        moved[:3, 3] *= scale or 1.0
        frames_.append(
            _read_frame(path, content, i, image, map_from_world @ moved @ ARKIT_FROM_OPENCV)
        )
    return make_capture(path, frames_, left_out=left_out, notes=(note,))


def _read_pose(file: Path, frame: dict[str, Any], i: int) -> NDArray[np.float64]:
    name = f"{file}: frames[{i}].transform_matrix"
    try:
        rows = np.array(frame.get("transform_matrix"), np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} is not 4 x 4 numbers; export the capture again.") from error
    if rows.shape not in {(4, 4), (3, 4)}:
        raise InputError(f"{name} has shape {rows.shape}; it must be 4 x 4 numbers.")
    return orthonormalize_pose(rows, name)


def _up_axis_of_writer(content: dict[str, Any]) -> int | None:
    """Return the axis that is up (1: y, 2: z) for whoever writes such a file; None: it does not tell."""
    if {"depth_integer_scale", "integer_depth_scale"} & set(content):
        return 1  # NeRFCapture
    if "orientation_override" in content or {"aabb_scale", "k1"} <= set(content):
        return 2  # nerfstudio of Polycam; Spectacular AI
    return None


def _level(
    poses: NDArray[np.float64], up: ArrayLike | None, axis: int | None, file: Path
) -> tuple[NDArray[np.float64], str]:
    """Return the transform (4, 4) to z up, and how up was found: as given, as written, or by the cameras.

    Who turns around keeps up in one direction of the images, whatever way a telephone is held, and
    level directions in none.
    """
    how = "as usual in such files"
    y, z = (float(np.linalg.norm(poses[:, i, :2].mean(axis=0))) for i in (1, 2))
    if up is not None:
        direction = np.asarray(up, np.float64)
        if direction.shape != (3,) or not 0 < np.linalg.norm(direction) < np.inf:
            raise OptionError(f"up is {up!r}; give a direction as three numbers.")
        how = "as given"
    elif axis is not None:
        direction = np.eye(3)[axis]
    elif abs(y - z) >= _MIN_DIFFERENCE:
        direction, how = np.eye(3)[1 if y > z else 2], "the common direction in the images"
    else:
        raise InputError(
            f"The up direction of {file} is unknown; give up=(0, 1, 0), as in ARKit, or "
            "up=(0, 0, 1)."
        )
    move = np.eye(4)
    move[:3, :3] = upright(direction / np.linalg.norm(direction), np.eye(3)[0])
    return move, f"Up is {' '.join(f'{v:g}' for v in direction)}, {how}."


def _find_image(path: Path, frame: dict[str, Any], i: int) -> Path | None:
    """Return the colour image of a frame, whose ending need not be said."""
    said = frame.get("file_path")
    if not isinstance(said, str) or not said:
        raise InputError(
            f"{path / _FILE}: frames[{i}].file_path is not the name of an image; export again."
        )
    file = _check_inside(path, said, i)
    tried = [file, *(file.with_name(file.name + ending) for ending in ENDINGS)]
    return next((f for f in tried if f.is_file()), None)


def _check_inside(path: Path, name: str, i: int) -> Path:
    """Return the file by its name, which must not lead out of the folder."""
    file = path / name
    try:
        file.exists()  # a name may be longer than any
        inside = file.resolve().is_relative_to(path.resolve())
    except (OSError, ValueError, RuntimeError):
        inside = False
    if not inside:
        raise InputError(
            f"{path / _FILE}: the file of frames[{i}], {name[:80]!r}, is missing; copy the whole "
            "folder."
        )
    return file


def _read_frame(
    path: Path, content: dict[str, Any], i: int, image: Path, pose: NDArray[np.float64]
) -> StoredFrame:
    file, frame = path / _FILE, content["frames"][i]
    said = content | frame
    lens = _LENSES.get(str(said.get("camera_model", "OPENCV")))
    if lens is None:
        raise InputError(
            f"{file}: camera_model is {str(said['camera_model'])[:40]!r}, but only "
            f"{', '.join(_LENSES)} are supported; undistort the images."
        )
    width, height = (read_number(file, said, field) for field in ("w", "h"))
    if not (1 <= width < 1 << 16 and 1 <= height < 1 << 16):
        raise InputError(
            f"{file}: frames[{i}]: w and h are {width} and {height}; they must be positive. Export "
            "again."
        )
    intrinsics = [read_number(file, said, field) for field in ("fl_x", "fl_y", "cx", "cy")]
    distortion = [
        read_number(file, said, field) if field in said else 0.0 for field in _DISTORTION[lens]
    ]
    distortion = distortion if any(distortion) or lens == "fisheye" else []
    camera = make_camera(
        f"{file}: frames[{i}]", (int(width), int(height)), intrinsics, distortion, lens
    )
    depth_camera = metres = None
    named = frame.get("depth_file_path") or frame.get("depth_path")
    per_metre = 1000.0
    if content.get("integer_depth_scale"):
        step = read_number(file, content, "integer_depth_scale")
        if not 1e-6 <= step <= 1.0:
            raise InputError(
                f"{file}: integer_depth_scale is {step:g}; it must be the metres per depth unit."
            )
        per_metre = 1.0 / step
    if isinstance(named, str) and (depth := _check_inside(path, named, i)).is_file():
        depth_camera = resize_camera(camera, image_size(depth), depth)
        metres = depth_file(depth, depth_camera, per_metre)
    unit = DepthUnit(f"the depth images listed in {file}", per_metre)
    return StoredFrame(
        name=f"{file}: frames[{i}].transform_matrix",
        stamp=read_number(file, frame, "timestamp") if "timestamp" in frame else float(i),
        pose=pose,
        camera=camera,
        images=LazyImages(colour_file(image, camera), metres, unit=unit),
        depth_camera=depth_camera,
    )
