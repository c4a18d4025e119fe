"""Recordings of Stray Scanner.

`rgb.mp4`; `odometry.csv` with a header and rows `timestamp, frame, x, y, z, qx, qy, qz, qw` and, in
newer versions, `fx, fy, cx, cy`; `camera_matrix.csv` (3 x 3 [px of the video]); `depth/` (PNG of 16
bits [mm]) and `confidence/` (0 to 2), named by the frame. The world has ARKit's y up, but the
cameras have OpenCV's axes already (OdometryEncoder.swift of strayrobots/scanner). The video is
stored as the sensor lies, whatever way the telephone was held.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np

from placegraph.errors import InputError
from placegraph.io.capture.frame_files import DepthUnit, LazyImages, depth_file
from placegraph.io.capture.frames import Capture
from placegraph.io.capture.images import image_size, images_of
from placegraph.io.capture.posed import (
    MAP_FROM_Y_UP,
    Shot,
    camera_of,
    capture_of,
    pose_of,
    read_text,
    smaller_view,
)
from placegraph.io.capture.video import Video

_POSE = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_UNIT = 1000.0


def is_stray(path: Path) -> bool:
    """Whether a folder has `odometry.csv` and `camera_matrix.csv`."""
    return (path / "odometry.csv").is_file() and (path / "camera_matrix.csv").is_file()


def read_stray(path: Path) -> Capture:
    """Read a recording; frames without depth are left out.

    Raises `InputError` where files are missing or broken, `MissingExtraError` where no decoder of
    videos is installed.
    """
    video = Video(path / "rgb.mp4")
    matrix = _matrix(path / "camera_matrix.csv")
    depths, sure = images_of(path / "depth"), images_of(path / "confidence")
    if not depths:
        raise InputError(f"{path / 'depth'} holds no image; copy the whole recording.")
    first = next(iter(depths.values()))
    size, unit = image_size(first), DepthUnit(str(path / "depth"), _UNIT)
    left_out: Counter[str] = Counter()
    shots = []
    for line, row in _rows(path / "odometry.csv"):
        number = int(row["frame"])
        stem = f"{number:06d}"
        if number >= len(video) or stem not in depths:
            left_out[f"no {'colour image' if number >= len(video) else 'depth'}"] += 1
            continue
        intrinsics = [row.get(name, matrix[name]) for name in _INTRINSICS]
        camera = camera_of(f"{path / 'camera_matrix.csv'}", video.size, intrinsics)
        depth_camera = smaller_view(camera, size, first)
        position, xyzw = ([row[name] for name in _POSE[a:b]] for a, b in ((2, 5), (5, 9)))
        depth = depth_file(depths[stem], depth_camera, _UNIT, confidence=sure.get(stem))
        shots.append(
            Shot(
                name=line,
                stamp=row["timestamp"],
                pose=MAP_FROM_Y_UP @ pose_of(position, xyzw, line),
                camera=camera,
                images=LazyImages(partial(video.picture, number, camera), depth, unit=unit),
                depth_camera=depth_camera,
            )
        )
    return capture_of(path, shots, left_out=left_out)


def _matrix(path: Path) -> dict[str, float]:
    """fx, fy, cx, cy of a matrix by rows."""
    try:
        values = [float(word) for word in read_text(path).replace(",", " ").split()]
    except ValueError as error:
        raise InputError(f"{path}: {error}; it must be a matrix of 3 x 3 numbers.") from error
    if len(values) != 9:
        raise InputError(f"{path} holds {len(values)} numbers; it must be a matrix of 3 x 3.")
    return dict(zip(_INTRINSICS, (values[0], values[4], values[2], values[5]), strict=True))


def _rows(path: Path) -> list[tuple[str, dict[str, float]]]:
    """Rows of a table with a header, by column, and where they stand; empty cells have no entry."""
    try:
        lines = list(csv.reader(io.StringIO(read_text(path)), skipinitialspace=True))
    except csv.Error as error:
        raise InputError(f"{path} is no table ({error}).") from error
    names = [name.strip() for name in lines[0]] if lines else []
    if not set(_POSE) <= set(names):
        raise InputError(f"{path}, line 1: the columns are not `{', '.join(_POSE)}`.")
    rows = []
    for number, cells in enumerate(lines[1:], 2):
        where = f"{path}, line {number}"
        try:
            row = {n: float(c) for n, c in zip(names, cells, strict=False) if c.strip()}
        except ValueError as error:
            raise InputError(f"{where}: {error}.") from error
        if not row:
            continue
        lost = [n for n in _POSE if not np.isfinite(row.get(n, np.nan))]
        if lost or row["frame"] < 0:
            raise InputError(f"{where}: {lost[0] if lost else 'frame'} is no finite number.")
        rows.append((where, row))
    return rows
