"""Recordings of ios_logger in its AR mode: a video with ARKit's poses, without depth.

`Frames.m4v`; `Frames.txt`, a row a frame of it: `time, number, fx, fy, cx, cy` [s, px]; `ARposes.txt`,
rows `time, x, y, z, qw, qx, qy, qz` in ARKit's axes, of the image as it is stored. Rows have no header.
(ViewController.mm of Varvrar/ios_logger.)
"""

from __future__ import annotations

from collections import Counter
from functools import partial
from pathlib import Path

from placegraph.errors import InputError
from placegraph.io.capture.frame_files import LazyImages
from placegraph.io.capture.frames import Capture
from placegraph.io.capture.posed import (
    ARKIT_FROM_OPENCV,
    MAP_FROM_Y_UP,
    Shot,
    camera_of,
    capture_of,
    nearest_stamps,
    pose_of,
    read_rows,
)
from placegraph.io.capture.video import Video

_SAME = 0.002  # seconds: both files have the frame's own stamp, rounded to a microsecond


def is_ios_logger(path: Path) -> bool:
    """Whether a folder has `Frames.txt` and `ARposes.txt`."""
    return (path / "Frames.txt").is_file() and (path / "ARposes.txt").is_file()


def read_ios_logger(path: Path) -> Capture:
    """Read a recording; frames without a pose are left out.

    Raises `InputError` where files are missing or broken, or the frames have no intrinsics (recorded
    outside of the AR mode), `MissingExtraError` where no decoder of videos is installed.
    """
    video = Video(path / "Frames.m4v")
    frames = read_rows(path / "Frames.txt", (6,), "time, number, fx, fy, cx, cy")
    poses = read_rows(path / "ARposes.txt", (8,), "time, x, y, z, qw, qx, qy, qz")
    found = nearest_stamps([row[0] for _, row in poses], [row[0] for _, row in frames], _SAME)
    left_out: Counter[str] = Counter()
    shots = []
    for (line, (stamp, index, *intrinsics)), at in zip(frames, found.tolist(), strict=True):
        number = int(index)
        if number != index or number < 0:
            raise InputError(f"{line}: number is {index:g}; it is the frame's in Frames.m4v.")
        if at < 0 or number >= len(video):
            left_out[f"no {'pose' if at < 0 else 'colour image'}"] += 1
            continue
        where, (_, x, y, z, qw, *q) = poses[at]
        camera = camera_of(line, video.size, intrinsics)
        pose = MAP_FROM_Y_UP @ pose_of((x, y, z), (*q, qw), where) @ ARKIT_FROM_OPENCV
        images = LazyImages(partial(video.picture, number, camera))
        shots.append(Shot(where, stamp, pose, camera, images))
    return capture_of(path, shots, left_out=left_out)
