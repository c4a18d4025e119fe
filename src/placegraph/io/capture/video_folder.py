"""A video and a trajectory beside it, whoever made them.

A folder with one video, `camera.json`, and the camera's trajectory `odometry.tum`, or `odometry.csv` in
EuRoC's columns: `timestamp [ns], x, y, z, qw, qx, qy, qz`, axes as everywhere (z up, OpenCV's camera).
Rows belong to frames in order, where there are as many, else to those within 20 ms; the first
frame has the stamp `start` of `camera.json`, 0 if it says none. `body_from_camera` there (4 x 4 by
rows) leads from the camera to what the trajectory tells of, as EuRoC's `T_BS` does.
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.io.capture.camera import read_camera, read_json
from placegraph.io.capture.frame_files import LazyImages
from placegraph.io.capture.frames import Capture
from placegraph.io.capture.posed import (
    SAME_MOMENT,
    Shot,
    capture_of,
    exact_pose,
    nearest_stamps,
    number,
    pose_of,
    read_rows,
)
from placegraph.io.capture.tum import read_tum
from placegraph.io.capture.video import ENDINGS, Video

Poses = tuple[NDArray[np.float64], NDArray[np.float64]]


_EUROC = "timestamp [ns], x, y, z, qw, qx, qy, qz"
_WIDTHS = (8, 17)  # EuRoC's truth goes on with velocities and biases


def is_video_folder(path: Path) -> bool:
    """Whether a folder has a video and `camera.json`, and no images in `rgb/`, as capture folders have."""
    alone = (path / "camera.json").is_file() and not (path / "rgb").exists()
    return alone and bool(_videos(path))


def read_video_folder(path: Path) -> Capture:
    """Read a video; frames without a pose are left out, and none has depth.

    Raises `InputError` where files are missing or broken, or no frame has a pose, `MissingExtraError`
    where no decoder of videos is installed.
    """
    videos = _videos(path)
    if len(videos) != 1:
        listed = ", ".join(v.name for v in videos) or "no video"
        raise InputError(f"{path} holds {listed}; leave one there.")
    video = Video(videos[0])
    cameras = read_camera(path / "camera.json")
    said = read_json(cameras.path)
    stamps, poses = _trajectory(path)
    start = number(cameras.path, said, "start") if "start" in said else 0.0
    body_from_camera = _matrix(cameras.path, said)
    moments = start + np.arange(len(video)) / video.rate
    rows = np.arange(len(video))
    if len(stamps) != len(video):
        rows = nearest_stamps(stamps, moments, SAME_MOMENT)
        if (rows < 0).all():
            raise InputError(
                f"{path}: the video lasts from {moments[0]:.6g} to {moments[-1]:.6g} s, and no row of the "
                f"trajectory, which begins at {stamps[0]:.6g}, is near a frame; give the stamp of the "
                'first frame as "start" in camera.json.'
            )
    else:
        moments = stamps
    shots = [
        Shot(
            f"{path}, trajectory row {row + 1}",
            float(moments[i]),
            poses[row] @ body_from_camera,
            cameras.camera,
            LazyImages(partial(video.picture, i, cameras.camera)),
        )
        for i, row in enumerate(rows.tolist())
        if row >= 0
    ]
    left_out = Counter({"no pose": len(video) - len(shots)})
    return capture_of(path, shots, left_out=+left_out)


def _videos(path: Path) -> list[Path]:
    if not path.is_dir():
        return []
    return sorted(p for p in path.iterdir() if p.suffix.lower() in ENDINGS and p.is_file())


def _trajectory(path: Path) -> Poses:
    """Stamps (T,) [s] and poses (T, 4, 4)."""
    if (path / "odometry.tum").is_file() or not (path / "odometry.csv").is_file():
        held = read_tum(path / "odometry.tum")
        return held.stamps, held.poses
    file = path / "odometry.csv"
    rows = read_rows(file, _WIDTHS, _EUROC)
    stamps = np.array([row[0] for _, row in rows]) * 1e-9
    if (np.diff(stamps) <= 0).any():
        raise InputError(f"{file}: the stamps do not ascend; sort the rows.")
    poses = [pose_of(row[1:4], (*row[5:8], row[4]), where) for where, row in rows]
    return stamps, np.stack(poses)


def _matrix(path: Path, said: dict[str, Any]) -> NDArray[np.float64]:
    if "body_from_camera" not in said:
        return np.eye(4)
    name = f"{path}: body_from_camera"
    try:
        rows = np.array(said["body_from_camera"], np.float64).ravel()
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} is not 16 numbers by rows.") from error
    if rows.size != 16:
        raise InputError(f"{name} has {rows.size} numbers; 16 by rows belong.")
    return exact_pose(rows, name)
