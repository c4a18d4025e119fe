"""Videos decoded by OpenCV, and folders that hold a video and a trajectory.

A folder has one video, `camera.json`, and the camera's trajectory `odometry.tum`, or `odometry.csv` in
EuRoC's columns: `timestamp [ns], x, y, z, qw, qx, qy, qz`; z is up, camera axes are OpenCV's. Rows
belong to frames in order if there are as many, else to frames within 20 ms. `camera.json` may have
`start`, the stamp of the first frame (default 0), and `body_from_camera` (4 x 4 by rows), EuRoC's
`T_BS`, where the trajectory is not the camera's.
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, MissingExtraError
from placegraph.io.capture.frame import Capture, LazyImages, check_shape
from placegraph.io.capture.json_files import read_camera, read_json
from placegraph.io.capture.posed import (
    SAME_MOMENT,
    StoredFrame,
    interpolate_poses,
    make_capture,
    match_stamps,
    orthonormalize_pose,
    pose_from_quaternion,
    read_number,
    read_rows,
)
from placegraph.io.capture.tum import read_tum

ENDINGS = (".mp4", ".mov", ".m4v", ".mkv", ".avi")
"""Endings of videos, in lower case."""
_NEAR = 60  # frames that are faster to skip than to seek


class Video:
    """Video whose frames are read by number, fastest in order.

    `size` is the width and height [px] of the stored frames, without the rotation of a player; `rate`
    is the number of frames per second. Raises `InputError` where the file is missing or no video,
    `MissingExtraError` without OpenCV.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(f"{path} does not exist; copy the whole recording.")
        self.path = path
        self._lock = Lock()
        self._next = 0
        self._stream = self._open()
        count, width, height = (int(self._stream.get(code)) for code in (7, 3, 4))
        if not (count > 0 and width > 0 and height > 0):
            raise InputError(f"{path} cannot be read as a video; copy it again.")
        self._count = count
        rate = float(self._stream.get(5))
        self.rate = rate if 0 < rate < 1e4 else 30.0
        self.size = width, height

    def __reduce__(self) -> tuple[type[Video], tuple[Path]]:
        return Video, (self.path,)  # opened again where it is sent to

    def __len__(self) -> int:
        return self._count

    def read(self, number: int) -> NDArray[np.uint8]:
        """Return frame (H, W, 3) uint8, sRGB; `InputError` where the video ends before or is damaged."""
        with self._lock:
            if not self._next <= number <= self._next + _NEAR:
                self._stream.set(1, number)  # CAP_PROP_POS_FRAMES
                self._next = number
            while self._next < number and self._stream.grab():
                self._next += 1
            found, image = self._stream.read() if self._next == number else (False, None)
            if image is None or not found:
                self._stream, self._next = self._open(), 0
                raise InputError(
                    f"{self.path}: frame {number} cannot be read; copy the file again."
                )
            self._next += 1
        return np.ascontiguousarray(image[..., ::-1])

    def picture(self, number: int, camera: Camera) -> NDArray[np.uint8]:
        """Return frame (H, W, 3) uint8, sRGB; `InputError` where it has not the camera's size."""
        image = self.read(number)
        check_shape(image, camera, f"{self.path}, frame {number},")
        return image

    def _open(self) -> Any:  # noqa: ANN401  # OpenCV has no types
        try:
            import cv2
        except ImportError as error:
            raise MissingExtraError(
                f"{self.path} is a video, and no decoder is installed: "
                'pip install "placegraph[video]".'
            ) from error
        stream = cv2.VideoCapture(str(self.path))
        stream.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        return stream


Poses = tuple[NDArray[np.float64], NDArray[np.float64]]


_EUROC = "timestamp [ns], x, y, z, qw, qx, qy, qz"
_WIDTHS = (8, 17)  # EuRoC's truth goes on with velocities and biases


def is_video_folder(path: Path) -> bool:
    """Return whether a folder has a video and `camera.json`, but no `rgb/` of a capture folder."""
    alone = (path / "camera.json").is_file() and not (path / "rgb").exists()
    return alone and bool(_videos(path))


def read_video_folder(path: Path) -> Capture:
    """Read a video and its trajectory as a capture without depth; frames without a pose are left out.

    Raises `InputError` where files are missing or broken, or no frame has a pose, `MissingExtraError`
    without OpenCV.
    """
    videos = _videos(path)
    if len(videos) != 1:
        listed = ", ".join(v.name for v in videos) or "no video"
        raise InputError(f"{path} contains {listed}; leave one of them there.")
    video = Video(videos[0])
    cameras = read_camera(path / "camera.json")
    content = read_json(cameras.path)
    stamps, poses = _read_trajectory(path)
    start = read_number(cameras.path, content, "start") if "start" in content else 0.0
    body_from_camera = _read_matrix(cameras.path, content)
    moments = start + np.arange(len(video)) / video.rate
    known = np.ones(len(video), bool)
    if len(stamps) != len(video):
        known = match_stamps(stamps, moments, SAME_MOMENT) >= 0
        poses = interpolate_poses(stamps, poses, moments)
        if not known.any():
            raise InputError(
                f"{path}: the video lasts from {moments[0]:.6g} to {moments[-1]:.6g} s, but "
                f"the trajectory begins at {stamps[0]:.6g} and has no row near a frame; "
                'give the stamp of the first frame as "start" in camera.json.'
            )
    else:
        moments = stamps
    frames = [
        StoredFrame(
            f"{path}, trajectory at {moments[i]:.6g}",
            float(moments[i]),
            poses[i] @ body_from_camera,
            cameras.camera,
            LazyImages(partial(video.picture, i, cameras.camera)),
        )
        for i in np.flatnonzero(known).tolist()
    ]
    left_out = Counter({"no pose": len(video) - len(frames)})
    return make_capture(path, frames, left_out=+left_out)


def _videos(path: Path) -> list[Path]:
    if not path.is_dir():
        return []
    return sorted(p for p in path.iterdir() if p.suffix.lower() in ENDINGS and p.is_file())


def _read_trajectory(path: Path) -> Poses:
    """Return the stamps (T,) [s] and poses (T, 4, 4)."""
    if (path / "odometry.tum").is_file() or not (path / "odometry.csv").is_file():
        trajectory = read_tum(path / "odometry.tum")
        return trajectory.stamps, trajectory.poses
    file = path / "odometry.csv"
    rows = read_rows(file, _WIDTHS, _EUROC)
    stamps = np.array([row[0] for _, row in rows]) * 1e-9
    if (np.diff(stamps) <= 0).any():
        raise InputError(f"{file}: the stamps do not ascend; sort the rows.")
    poses = [pose_from_quaternion(row[1:4], (*row[5:8], row[4]), where) for where, row in rows]
    return stamps, np.stack(poses)


def _read_matrix(path: Path, content: dict[str, Any]) -> NDArray[np.float64]:
    if "body_from_camera" not in content:
        return np.eye(4)
    name = f"{path}: body_from_camera"
    try:
        rows = np.array(content["body_from_camera"], np.float64).ravel()
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} is not 16 numbers by rows.") from error
    if rows.size != 16:
        raise InputError(f"{name} has {rows.size} numbers; give 16, by rows.")
    return orthonormalize_pose(rows, name)
