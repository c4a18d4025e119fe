"""Landmarks of a capture: features followed from frame to frame, and where their rays meet.

Each frame's features lie where its depth says. Of those that fall on one spot and look alike the
rays are brought together (the poses stand), so that a landmark is known to millimetres where the
surface of a voxel is known to centimetres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.threads import count_processors
from placegraph.indoor.likelihood.observe import spread
from placegraph.indoor.map.scene import DESCRIPTOR_SIZE, MAX_LANDMARKS, Landmarks
from placegraph.indoor.refine.correspondences import LARGEST, detect_features, make_detector
from placegraph.io.capture.frame import Frame

FRAMES = 300  # Most frames that are looked at, spread over the capture
FEATURES = 1500  # Most features of a frame, the strongest first
_REACH = 4.0  # a landmark falls so near to where it is seen [px of an image `LARGEST` wide]
_ALIKE = 0.8  # least cosine of two sights of one landmark
_MISSED = 2.0  # a landmark whose rays miss each other by more is none [px, likewise]
_LATCH = (0.05, 0.02)  # depth by which sights of one spot differ [m], and its share
_NOISE = (0.01, 0.004)  # standard deviation of depth [m] at 0 m, and what it gains a square metre
_STEPS = 6


@dataclass(frozen=True, slots=True, eq=False)
class _FrameFeatures:
    """Features of one frame that have a depth."""

    rays: Floats  # (N, 3) in the camera, z = 1
    depth: Floats  # (N,) [m]
    vectors: NDArray[np.float32]  # (N, WIDTH)


@dataclass(frozen=True, slots=True, eq=False)
class _Tracks:
    """Sights of landmarks: M of them, of L landmarks."""

    landmark: NDArray[np.int64]  # (M,) row of the landmark
    frame: NDArray[np.int64]  # (M,) row of the pose
    rays: Floats  # (M, 3) in the camera, z = 1
    depth: Floats  # (M,) [m]


def map_landmarks(
    frames: Sequence[Frame], poses: Floats, progress: Callable[[int, int], None] | None = None
) -> Landmarks:
    """Map at most `MAX_LANDMARKS` landmarks of RGB-D frames with poses (T, 4, 4), map_from_camera.

    Those are kept that each frame shows best: seen often, by frames all over the capture. Raises
    `MissingExtraError` where OpenCV is not installed.
    """
    chosen = spread(len(frames), FRAMES)
    make_detector(FEATURES)  # what is missing is told before the work
    points, vectors = np.zeros((0, 3)), np.zeros((0, DESCRIPTOR_SIZE), np.float32)
    counts = np.zeros(0, np.int64)
    tracks = []
    with ThreadPoolExecutor(count_processors()) as pool:
        looks = pool.map(_find_features, (frames[row] for row in chosen))
        for done, (row, features) in enumerate(zip(chosen.tolist(), looks, strict=True)):
            if progress is not None:
                progress(done, len(chosen))
            pose, focal = poses[row], LARGEST * _focal_length(frames[row])
            rows = _match_landmarks(points, vectors, features, pose, focal)
            new = rows < 0
            rows[new] = len(points) + np.arange(new.sum())
            points = np.concatenate([points, np.zeros((new.sum(), 3))])
            vectors = np.concatenate([vectors, np.zeros((new.sum(), DESCRIPTOR_SIZE), np.float32)])
            counts = np.concatenate([counts, np.zeros(new.sum(), np.int64)])
            share = 1.0 / (counts[rows] + 1.0)[:, None]
            here = (features.rays * features.depth[:, None]) @ pose[:3, :3].T + pose[:3, 3]
            points[rows] += share * (here - points[rows])
            vectors[rows] += (share * (features.vectors - vectors[rows])).astype(np.float32)
            counts[rows] += 1
            tracks.append(_Tracks(rows, np.full(len(rows), row), features.rays, features.depth))
    track = _Tracks(
        np.concatenate([t.landmark for t in tracks]),
        np.concatenate([t.frame for t in tracks]),
        np.concatenate([t.rays for t in tracks]),
        np.concatenate([t.depth for t in tracks]),
    )
    points, missed = _triangulate(points, track, poses, LARGEST * _focal_length(frames[0]))
    kept = _choose_landmarks(track, counts, missed)
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return Landmarks.of(points[kept], (vectors / np.maximum(lengths, 1e-9))[kept])


def _focal_length(frame: Frame) -> float:
    camera = frame.camera
    return 0.5 * (camera.fx + camera.fy) / max(camera.width, camera.height)


def _find_features(frame: Frame) -> _FrameFeatures:
    found = detect_features(make_detector(FEATURES), frame, frame.rgb())
    rays = frame.camera.directions(found.points)
    depth = read_depth(frame, rays)
    known = np.isfinite(depth)
    return _FrameFeatures(rays[known], depth[known], found.vectors[known])


def read_depth(frame: Frame, rays: Floats) -> Floats:
    """Read depth (N,) [m] along rays (N, 3), between pixels interpolated; NaN at jumps and holes."""
    depth, camera = frame.depth(), frame.depth_camera
    if depth is None or camera is None or not len(rays):
        return np.full(len(rays), np.nan)
    # beyond a fisheye's rim there is no ray
    at = np.nan_to_num(camera.project(rays) - 0.5, nan=-9.0, posinf=-9.0, neginf=-9.0)
    h, w = depth.shape
    x = np.clip(np.floor(at[:, 0]), 0, w - 2).astype(np.int64)
    y = np.clip(np.floor(at[:, 1]), 0, h - 2).astype(np.int64)
    right, down = at[:, 0] - x, at[:, 1] - y
    corners = np.stack([depth[y, x], depth[y, x + 1], depth[y + 1, x], depth[y + 1, x + 1]])
    inside = (np.abs(right - 0.5) <= 1.0) & (np.abs(down - 0.5) <= 1.0)
    right, down = np.clip(right, 0, 1), np.clip(down, 0, 1)
    shares = [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
    z = (corners * np.stack(shares)).sum(axis=0)
    with np.errstate(invalid="ignore"):
        sound = inside & (np.ptp(corners, axis=0) < 0.03 + 0.03 * z)
    return np.where(sound, z, np.nan)


def _match_landmarks(
    points: Floats,
    vectors: NDArray[np.float32],
    features: _FrameFeatures,
    pose: Floats,
    focal: float,
) -> NDArray[np.int64]:
    """Match landmark (N,) that each feature of a frame shows again, -1: none so far."""
    out = np.full(len(features.depth), -1, np.int64)
    at = (points - pose[:3, 3]) @ pose[:3, :3]
    ahead = np.flatnonzero(at[:, 2] > 0.1)
    if not len(ahead) or not len(out):
        return out
    spots = focal * at[ahead, :2] / at[ahead, 2:]
    order = np.argsort(spots[:, 0])
    spots, ahead = spots[order], ahead[order]
    own = focal * features.rays[:, :2]
    first = np.searchsorted(spots[:, 0], own[:, 0] - _REACH)
    count = np.searchsorted(spots[:, 0], own[:, 0] + _REACH) - first
    feature = np.repeat(np.arange(len(own)), count)
    near = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + first[feature]
    z = features.depth[feature]
    pairs = np.abs(spots[near, 1] - own[feature, 1]) < _REACH
    pairs &= np.abs(at[ahead[near], 2] - z) < _LATCH[0] + _LATCH[1] * z
    feature, landmark = feature[pairs], ahead[near[pairs]]
    cosine = np.einsum("pd,pd->p", features.vectors[feature], vectors[landmark])
    cosine /= np.maximum(np.linalg.norm(vectors[landmark], axis=1), 1e-9)
    best = np.argsort(-cosine, kind="stable")
    best = best[cosine[best] > _ALIKE]
    # each other's likeliest: the first pair of both
    own_first = np.zeros(len(best), bool)
    own_first[np.unique(feature[best], return_index=True)[1]] = True
    its_first = np.zeros(len(best), bool)
    its_first[np.unique(landmark[best], return_index=True)[1]] = True
    mutual = best[own_first & its_first]
    out[feature[mutual]] = landmark[mutual]
    return out


def _triangulate(
    points: Floats, track: _Tracks, poses: Floats, focal: float
) -> tuple[Floats, Floats]:
    """Return points (L, 3) nearest to their rays and depths, and what the rays miss by (L,) [px].

    Gauss-Newton on reprojection, 1 px, and on depth, with Geman and McClure's weights.
    """
    order = np.argsort(track.landmark, kind="stable")
    row, frame = track.landmark[order], track.frame[order]
    rays, depth = track.rays[order], track.depth[order]
    first = np.flatnonzero(np.diff(row, prepend=-1))
    turn, centre = poses[frame, :3, :3], poses[frame, :3, 3]
    # readings of one sensor err together: those of a landmark are worth one
    count = np.diff(np.append(first, len(row)))
    deviation = (_NOISE[0] + _NOISE[1] * depth**2) * np.repeat(np.sqrt(count), count)
    points = points.copy()
    missed = np.zeros(len(points))
    for _ in range(_STEPS):
        at = np.einsum("nij,ni->nj", turn, points[row] - centre)
        z = np.maximum(at[:, 2], 0.05)
        off = focal * (at[:, :2] / z[:, None] - rays[:, :2])
        weight = 1.0 / np.square(1.0 + np.square(off).sum(axis=1) / 4.0)
        far = (z - depth) / deviation
        weight_far = 1.0 / np.square((1.0 + np.square(far) / 4.0) * deviation)
        j = np.zeros((len(row), 2, 3))
        j[:, 0, 0] = j[:, 1, 1] = focal / z
        j[:, :, 2] = -focal * at[:, :2] / np.square(z)[:, None]
        j = j @ np.swapaxes(turn, 1, 2)
        along = turn[:, :, 2]
        h = np.swapaxes(j, 1, 2) @ (weight[:, None, None] * j)
        h += weight_far[:, None, None] * along[:, :, None] * along[:, None, :]
        g = np.einsum("nki,nk->ni", j, weight[:, None] * off)
        g += (weight_far * (z - depth))[:, None] * along
        sums = np.add.reduceat(h, first) + 1e-3 * np.eye(3)
        points -= np.linalg.solve(sums, np.add.reduceat(g, first)[..., None])[..., 0]
        squares = np.add.reduceat(weight * np.square(off).sum(axis=1), first)
        missed = np.sqrt(squares / np.maximum(np.add.reduceat(weight, first), 1e-9))
    return points, missed


def _choose_landmarks(
    track: _Tracks, counts: NDArray[np.int64], missed: Floats
) -> NDArray[np.int64]:
    """Choose rows of the landmarks kept: by their place among those of the frame that values them most."""
    worth = np.where(missed < _MISSED, counts, 0)
    order = np.lexsort((-worth[track.landmark], track.frame))
    frame, landmark = track.frame[order], track.landmark[order]
    first = np.searchsorted(frame, frame)
    place = np.full(len(counts), len(track.frame))
    np.minimum.at(place, landmark, np.arange(len(frame)) - first)
    rows = np.lexsort((place, worth == 0))[:MAX_LANDMARKS]
    return rows[worth[rows] > 0]
