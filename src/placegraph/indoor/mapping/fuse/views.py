"""Frames made ready for fusion: read, undistorted, their poses checked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.errors import OptionError
from placegraph.io.capture.frame import Frame

FARTHEST = 1e4
"""Cameras farther from the map's origin than this are damage [m]."""
JUMP = 0.5
"""A pose that leaves its neighbours by more, while they stay together, is a slip [m]."""
AHEAD = 2
"""Frames that are read while one is fused."""
WIDEST = 2.0
"""An undistorted image is at most this much wider and higher than the image."""


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """Images of one frame without distortion, and where they were taken."""

    row: int
    depth: NDArray[np.float32]
    """(h, w) [m], NaN: no reading."""
    image: NDArray[np.uint8]
    """(H, W, 3)"""
    eyes: Floats
    """(2, 4) fx, fy, cx, cy [px] of depth and image."""
    map_from_camera: Floats


def views_of(
    frames: Sequence[Frame], poses: Floats, good: NDArray[np.bool_], left_out: Counter[str]
) -> Iterator[Shot | None]:
    """Views of all frames in order, None for those without depth or whose pose is not `good` (T,).

    The next frames are read while the caller works on the last. Raises `InputError` where an image
    is broken.
    """

    def view(row: int) -> Shot | None:
        return view_of(frames[row], row, poses[row]) if good[row] else None

    with ThreadPoolExecutor(1) as reader:
        ahead = [reader.submit(view, row) for row in range(min(AHEAD, len(frames)))]
        for row in range(len(frames)):
            found = ahead.pop(0).result()
            if row + AHEAD < len(frames):
                ahead.append(reader.submit(view, row + AHEAD))
            if not good[row]:
                left_out["frames with a broken pose"] += 1
            elif found is None:
                left_out["frames without depth"] += 1
            yield found


def view_of(frame: Frame, row: int, map_from_camera: Floats) -> Shot | None:
    """View of a frame, None where it has no depth."""
    depth, depth_camera = frame.depth(), frame.depth_camera
    if depth is None or depth_camera is None or not (depth > 0).any():
        return None
    image, camera = frame.rgb(), frame.camera
    if not depth_camera.straight:
        depth_camera, table = undistorted(depth_camera)
        depth = np.where(table >= 0, depth.ravel()[table], np.nan).astype(np.float32)
    if not camera.straight:
        camera, table = undistorted(camera)
        image = image.reshape(-1, 3)[np.maximum(table, 0)]
    eyes = np.array([[c.fx, c.fy, c.cx, c.cy] for c in (depth_camera, camera)])
    return Shot(
        row, np.ascontiguousarray(depth), np.ascontiguousarray(image), eyes, map_from_camera
    )


@lru_cache(maxsize=8)
def undistorted(camera: Camera) -> tuple[Camera, NDArray[np.int64]]:
    """The same camera without distortion, and where its pixels (h, w) stand in the flat image.

    Its images are as large as it takes to show all that the camera sees, up to `WIDEST` times;
    -1: outside of the image.
    """
    w, h = camera.width, camera.height
    i, j = np.arange(w) + 0.5, np.arange(h) + 0.5
    rim = np.concatenate(
        [np.stack([i, np.full(w, v)], axis=1) for v in (0.0, h)]
        + [np.stack([np.full(h, u), j], axis=1) for u in (0.0, w)]
    )
    limit = 0.5 * WIDEST * np.array([w, h])
    reached = camera.directions(rim)[:, :2] * (camera.fx, camera.fy)
    beyond = np.where(rim < (camera.cx, camera.cy), -limit, limit)
    reached = np.where(np.isfinite(reached), reached, beyond)
    low = np.ceil(np.minimum(np.maximum(-reached.min(axis=0), 1), limit))
    high = np.ceil(np.minimum(np.maximum(reached.max(axis=0), 1), limit))
    width, height = (low + high).astype(int).tolist()
    plain = Camera(width, height, camera.fx, camera.fy, float(low[0]), float(low[1]))
    v, u = np.mgrid[0:height, 0:width] + 0.5
    rays = plain.directions(np.stack([u, v], axis=-1))
    at = camera.project(rays)
    # far outside, the polynomials may fold back into the image: there the way back differs
    back = camera.directions(at)
    same = np.abs(back - rays).max(axis=-1) < 1.0 / min(camera.fx, camera.fy)
    column, line = np.floor(np.moveaxis(at, -1, 0)).astype(np.int64)
    inside = same & (column >= 0) & (line >= 0) & (column < w) & (line < h)
    return plain, np.where(inside, line * w + column, -1)


def checked_poses(frames: Sequence[Frame], poses: ArrayLike | None) -> Floats:
    """Poses (T, 4, 4); `OptionError` where they are of another shape."""
    if poses is None:
        return np.array([frame.odometry for frame in frames], np.float64).reshape(-1, 4, 4)
    array = np.asarray(poses, np.float64)
    if array.shape != (len(frames), 4, 4):
        raise OptionError(
            f"poses: shape {array.shape} for {len(frames)} frames; (T, 4, 4) belong to T frames."
        )
    return array


def good_poses(poses: Floats) -> NDArray[np.bool_]:
    """Which poses (T, 4, 4) can be believed: finite, rigid, near the origin, and no slip.

    A slip is a single pose far off the two around it, that are near to each other.
    """
    with np.errstate(all="ignore"):
        turn = poses[:, :3, :3]
        square = turn @ np.swapaxes(turn, 1, 2)
        good: NDArray[np.bool_] = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
        good &= (np.abs(square - np.eye(3)) < 1e-2).all(axis=(1, 2))
        good &= np.linalg.det(np.where(good[:, None, None], turn, np.eye(3))) > 0
        good &= (np.abs(poses[:, :3, 3]) < FARTHEST).all(axis=1)
    rows = np.flatnonzero(good)
    at = poses[rows, :3, 3]
    if len(rows) > 2:
        step = np.linalg.norm(np.diff(at, axis=0), axis=1)
        around = np.linalg.norm(at[2:] - at[:-2], axis=1)
        off = np.minimum(step[:-1], step[1:])
        good[rows[1:-1][(off > JUMP) & (off > 3 * around)]] = False
    return good
