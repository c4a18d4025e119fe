"""Sequences of ARKitScenes, raw or of its 3D object detection.

`lowres_wide/`, `lowres_depth/` (16 bits [mm]) and `confidence/` (0 to 2) hold files VIDEO_STAMP.png;
`lowres_wide_intrinsics/VIDEO_STAMP.pincam`: `width height fx fy cx cy`; `lowres_wide.traj`: rows
`stamp rx ry rz tx ty tz`, camera_from_world as axis times angle and metres. The world has z up,
cameras have OpenCV's axes. (DATA.md and tenFpsDataLoader.py of apple/ARKitScenes.)
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, rotation_from_vector
from placegraph.errors import InputError
from placegraph.io.capture.frame import Capture, DepthUnit, LazyImages, colour_file, depth_file
from placegraph.io.capture.images import image_size, list_images
from placegraph.io.capture.posed import (
    StoredFrame,
    make_camera,
    make_capture,
    match_stamps,
    read_text,
    resize_camera,
)
from placegraph.io.capture.tum import read_table

_TOLERANCE = 0.005  # of Apple's own loader [s]; images come every 17 ms or more
_UNIT = 1000.0


def is_arkit_scenes(path: Path) -> bool:
    """Return whether a folder, or its only subfolder `*_frames`, holds `lowres_wide.traj`."""
    return (_frames(path) / "lowres_wide.traj").is_file()


def read_arkit_scenes(path: Path) -> Capture:
    """Read a sequence; images without depth, intrinsics or a pose within 5 ms are left out.

    Raises `InputError` where files are missing or broken.
    """
    folder = _frames(path)
    kinds = ("lowres_wide", "lowres_depth", "confidence", "lowres_wide_intrinsics")
    files = [_list_stamped(folder / k, (".pincam",) if "intr" in k else (".png",)) for k in kinds]
    for kind, found in zip(kinds, files, strict=True):
        if not found and kind != "confidence":
            raise InputError(
                f"{folder / kind} contains no file; download this part of the data set too."
            )
    stamps, poses = _read_trajectory(folder / "lowres_wide.traj")
    asked = [stamp for stamp, _ in files[0]]
    depth_of, confidence_of, camera_file_of = (
        match_stamps([stamp for stamp, _ in found], asked, _TOLERANCE) for found in files[1:]
    )
    pose_of = match_stamps(stamps, asked, _TOLERANCE)
    first = files[1][0][1]
    size, unit = image_size(first), DepthUnit(str(folder / "lowres_depth"), _UNIT)
    left_out: Counter[str] = Counter()
    found_frames = []
    for i, (stamp, file) in enumerate(files[0]):
        rows = {"depth": depth_of[i], "intrinsics": camera_file_of[i], "pose": pose_of[i]}
        lacking = next((name for name, row in rows.items() if row < 0), None)
        if lacking:
            left_out[f"no {lacking} within 5 ms"] += 1
            continue
        camera = _read_camera(files[3][camera_file_of[i]][1])
        depth = files[1][depth_of[i]][1]
        depth_camera = resize_camera(camera, size, first)
        confidence = files[2][confidence_of[i]][1] if confidence_of[i] >= 0 else None
        images = LazyImages(
            colour_file(file, camera),
            depth_file(depth, depth_camera, _UNIT, confidence=confidence),
            unit=unit,
        )
        found_frames.append(
            StoredFrame(str(file), stamp, poses[pose_of[i]], camera, images, depth_camera)
        )
    return make_capture(path, found_frames, left_out=left_out)


def _frames(path: Path) -> Path:
    """Return the folder of the sequence itself."""
    if not path.is_dir() or (path / "lowres_wide.traj").is_file():
        return path
    below = list(path.glob("*_frames"))
    return below[0] if len(below) == 1 else path


def _list_stamped(folder: Path, endings: tuple[str, ...]) -> list[tuple[float, Path]]:
    """Return the stamps and files VIDEO_STAMP of a folder."""
    found = []
    for stem, file in list_images(folder, endings).items():
        try:
            stamp = float(stem.rpartition("_")[2])
        except ValueError:
            stamp = np.nan
        if not np.isfinite(stamp):
            raise InputError(f"{file}: the file name has no stamp; name files VIDEO_STAMP.")
        found.append((stamp, file))
    return sorted(found)


def _read_trajectory(path: Path) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the stamps (T,) [s] and world_from_camera (T, 4, 4) [m]."""
    table = read_table(path, ("stamp", "rx", "ry", "rz", "tx", "ty", "tz"))
    rotation = rotation_from_vector(table.values[:, 1:4])
    poses = np.tile(np.eye(4), (len(rotation), 1, 1))
    poses[:, :3, :3] = rotation.swapaxes(1, 2)
    poses[:, :3, 3] = -np.einsum("nji,nj->ni", rotation, table.values[:, 4:])
    return table.values[:, 0], poses


def _read_camera(path: Path) -> Camera:
    try:
        width, height, *intrinsics = (float(word) for word in read_text(path).split())
        size = int(width), int(height)
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path} must be one row `width height fx fy cx cy`.") from error
    if len(intrinsics) != 4:
        raise InputError(f"{path} must be one row `width height fx fy cx cy`.")
    return make_camera(str(path), size, intrinsics)
