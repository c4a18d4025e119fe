"""Landmarks of a map found again in a frame: one more witness for search and refinement.

A frame's features are compared with all landmarks of the map at once, so that nothing need be known
of the pose: what agrees on one pose of all frames (`match.solve_rig`) is a place to search at, and
points that the joint solution fits. Descriptors are RootSIFT turned by gravity, so that a camera may
lie on its side, in their lowest frequencies: a cosine transform over the 4 x 4 cells and a Fourier
transform over the 8 directions of each keep with 32 of 128 numbers most of what tells two apart, and
are the same for every map.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, split_pose, vector_from_rotation
from placegraph.errors import MissingExtraError
from placegraph.indoor.likelihood.observe import spread
from placegraph.indoor.map.scene import DESCRIPTOR_SIZE, Landmarks
from placegraph.indoor.pose.window import Window, timed
from placegraph.indoor.refine.correspondences import (
    Consensus,
    PointMatches,
    held_back,
    shrink_camera,
    solve_rig,
)
from placegraph.indoor.refine.matching.guided import resized
from placegraph.indoor.refine.matching.sift import SiftMatcher
from placegraph.indoor.refine.options import RefineOptions
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.refine.matching.matches import Features

LARGEST = 640
"""Longer side [px] to which larger images are brought."""
RATIO = 0.9
"""Largest ratio of the distances to the nearest landmark and to the nearest one elsewhere."""
SIGMA = 0.7
"""Standard deviation of a feature [px of an image `REFERENCE` wide]."""
LOOKS = 5
"""Frames of a window that are compared with the landmarks."""
FEATURES = 1000
"""Most features of a query's image, the strongest first."""
SHARE = 0.05
"""Least share of the matches that must agree on a pose: fewer do so by chance."""
PLENTY = 20
"""Landmarks a frame beside which renderings have nothing to add."""
FARTHEST = (1.0, 0.6)
"""Landmarks whose pose lies farther than this [m], [rad] from the one at hand mean another place."""
_APART = 0.1  # landmarks nearer to each other show the same spot [m]
_RIVALS = 4  # landmarks of one spot that are passed over in search of a rival
_BLOCK = 8192  # landmarks that are compared at once
_SIDES = 4
_DIRECTIONS = 8


def make_detector(features: int) -> SiftMatcher:
    """Make a detector of features; raises `MissingExtraError` where OpenCV is not installed."""
    return SiftMatcher(features=features)


def detect_features(sift: SiftMatcher, frame: Frame, rgb: NDArray[np.uint8]) -> Features:
    """Detect features of a frame's image (H, W, 3): points [px], vectors (N, `DESCRIPTOR_SIZE`)."""
    camera = shrink_camera(frame.camera, LARGEST)
    x, y, _ = frame.gravity
    down = float(np.degrees(np.arctan2(y, x)) - 90.0) % 360.0
    found = sift.described(resized(rgb, camera.width, camera.height), down)
    scale = np.array([rgb.shape[1] / camera.width, rgb.shape[0] / camera.height])
    return type(found)(found.points * scale, compact(found.vectors))


def compact(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return unit vectors (N, `DESCRIPTOR_SIZE`) of RootSIFT descriptors (N, 128)."""
    if vectors.shape[1] != len(_basis()):
        return np.zeros((0, DESCRIPTOR_SIZE), np.float32)
    short = vectors @ _basis()
    return np.asarray(short / np.maximum(np.linalg.norm(short, axis=1, keepdims=True), 1e-9))


@cache
def _basis() -> NDArray[np.float32]:
    """Return (128, `DESCRIPTOR_SIZE`) orthonormal: frequencies of least product, without the mean."""
    across = np.arange(_SIDES)
    waves = np.cos(np.pi * np.outer(across + 0.5, across) / _SIDES) * np.sqrt(2.0 / _SIDES)
    waves[:, 0] /= np.sqrt(2.0)
    turn = np.arange(_DIRECTIONS)
    order = (turn + 1) // 2
    phase = 2.0 * np.pi * np.outer(turn, order) / _DIRECTIONS
    circles = np.where(turn % 2 == 1, np.cos(phase), np.sin(phase))
    circles[:, 0] = 1.0
    circles /= np.linalg.norm(circles, axis=0)
    whole = np.einsum("ai,bj,ck->abcijk", waves, waves, circles).reshape(128, 128)
    steep = np.multiply.outer(np.multiply.outer(across + 1, across + 1), order + 1).ravel()
    return whole[:, np.argsort(steep, kind="stable")[1 : DESCRIPTOR_SIZE + 1]].astype(np.float32)


def match_features(landmarks: Landmarks, found: Features, frame: Frame) -> PointMatches:
    """Return landmarks that features of a frame are likeliest to be, and clearly so (Lowe's ratio)."""
    if not len(found) or not len(landmarks):
        return PointMatches.none()
    cosine, ranked = _likeliest(found.vectors, landmarks.unit_vectors)
    sure, best = cosine[:, 0], ranked[:, 0]
    back = found.vectors @ landmarks.unit_vectors[best].T
    mutual = back.argmax(axis=0) == np.arange(len(found))
    apart = np.linalg.norm(landmarks.points[ranked] - landmarks.points[best][:, None], axis=2)
    elsewhere = apart[:, 1:] >= _APART
    # where all of them show one spot, the last stands for a rival
    rank = np.where(elsewhere.any(axis=1), elsewhere.argmax(axis=1), _RIVALS - 1) + 1
    rival = np.take_along_axis(cosine, rank[:, None], axis=1)[:, 0]
    clear = mutual & (1.0 - sure < RATIO**2 * (1.0 - rival))
    points = landmarks.points[best[clear]].astype(np.float64)
    return PointMatches.of(points, found.points[clear], frame.camera, SIGMA)


def _likeliest(
    vectors: NDArray[np.float32], known: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return cosines (N, 1 + _RIVALS) and rows of the likeliest of L landmarks, likeliest first.

    Landmarks are gone through in blocks, so that memory does not grow with the map; where they are
    too few, the cosine is -1.
    """
    count = 1 + _RIVALS
    best = np.full((len(vectors), count), -1.0, np.float32)
    rows, every = np.zeros((len(vectors), count), np.int64), np.arange(len(vectors))
    for first in range(0, len(known), _BLOCK):
        cosine = vectors @ known[first : first + _BLOCK].T
        for _ in range(min(count, cosine.shape[1])):
            column = cosine.argmax(axis=1)
            # the last of those kept so far gives way, and moves up to its place
            better = cosine[every, column] > best[:, -1]
            if not better.any():
                break
            best[:, -1] = np.where(better, cosine[every, column], best[:, -1])
            rows[:, -1] = np.where(better, first + column, rows[:, -1])
            cosine[every, column] = -2.0
            order = np.argsort(-best, axis=1, kind="stable")
            best = np.take_along_axis(best, order, axis=1)
            rows = np.take_along_axis(rows, order, axis=1)
    return best, rows


def match_window(window: Window) -> list[PointMatches]:
    """Return landmarks (T,) that the frames of a window show: up to `LOOKS` of them, spread over it.

    None of a map without landmarks, and where OpenCV is not installed or images are switched off.
    Found once for each frame.
    """
    landmarks, out = window.scene.landmarks, [PointMatches.none()] * len(window)
    if landmarks is None:
        return out
    try:
        sift = make_detector(FEATURES)
    except MissingExtraError:
        return out
    for t in spread(len(window), LOOKS):
        frame, rgb = window.sightings[t].frame, window.sightings[t].rgb
        if rgb is not None:
            look = partial(_seen, landmarks, sift, frame, rgb)
            out[t] = window.derived(("landmarks", frame.index), look)
    return out


def _seen(
    landmarks: Landmarks, sift: SiftMatcher, frame: Frame, rgb: NDArray[np.uint8]
) -> PointMatches:
    return match_features(landmarks, detect_features(sift, frame, rgb), frame)


def agree_on_pose(
    sights: Sequence[PointMatches], mounts: Floats, options: RefineOptions
) -> Consensus | None:
    """Return pose of the last of T frames that landmarks agree on; None where they do so by chance.

    `mounts`: (T, 4, 4) last_from_camera.
    """
    consensus = solve_rig(sights, list(mounts), options)
    by_chance = consensus is None or consensus.count < SHARE * sum(map(len, sights))
    return None if by_chance else consensus


def drop_held_back(
    landmarks: Sequence[PointMatches], frames: Sequence[Frame], options: RefineOptions
) -> list[PointMatches]:
    """Return landmarks (T,) without those that are kept for the check."""
    pairs = zip(landmarks, frames, strict=True)
    return [s[~held_back(s.pixels, f.camera)] if options.check else s for s, f in pairs]


def is_near(one: Floats, other: Floats) -> bool:
    """Return whether a pose (4, 4) may be another once it is refined."""
    turn = vector_from_rotation(one[:3, :3] @ other[:3, :3].T)
    way = np.linalg.norm(one[:3, 3] - other[:3, 3])
    return bool(way < FARTHEST[0] and np.linalg.norm(turn) < FARTHEST[1])


def has_plenty(sights: Sequence[PointMatches]) -> bool:
    """Return whether frames show so many landmarks that renderings have nothing to add."""
    return sum(map(len, sights)) >= PLENTY * sum(len(s) > 0 for s in sights)


def has_plenty_everywhere(sights: Sequence[PointMatches]) -> bool:
    """Return whether each frame that was looked at, and not some alone, shows so many."""
    return all(len(sights[t]) >= PLENTY for t in spread(len(sights), LOOKS))


def locate_by_landmarks(window: Window) -> Floats:
    """Return pose (K, 4) of the last frame that landmarks tell: one, or none."""
    with timed(window.seconds, "landmarks"):
        odometry = np.stack([s.frame.odometry for s in window.sightings])
        mounts = np.linalg.inv(odometry[-1]) @ odometry
        sights = match_window(window)
        try:
            consensus = agree_on_pose(sights, mounts, RefineOptions())
        except MissingExtraError:
            consensus = None
    return np.zeros((0, 4)) if consensus is None else split_pose(consensus.pose)[0][None]
