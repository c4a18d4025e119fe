"""Sensors that lag behind the odometry's clock: when an image was taken is unknown, to some hundredths.

A camera that turns by a radian a second is two degrees elsewhere after 35 ms, which is what the depth
of a Kinect is late by. How late depth and images are, each for itself, is one unknown of the whole
sequence: what they see is seen from where odometry leads that much later.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, rotation_from_vector, vector_from_rotation

USUAL = (0.03, 0.3)
"""Standard deviation of a lag: in the unit of the stamps [s], or this share of the time between two
frames where that is more (of frames that are numbered, not timed)."""
MOST = 4.0
"""No lag is found that is more of these deviations."""
CLEAR = 4.0
"""A lag is told that is so many of its standard deviations ..."""
TOLD = 0.2
"""... and no less than this share of `usual_lag`."""


DEPTH, IMAGES = range(2)
"""Rows of what lags."""


@dataclass(frozen=True, slots=True, eq=False)
class Lags:
    """How much later than their stamps depth and images were taken."""

    values: Floats
    """(2,) in the stamps' unit"""
    deviations: Floats
    """(2,)"""
    twist: Floats
    """(T, 6) as of `twists`"""
    usual: float
    """As of `usual_lag`."""

    def of_depth(self, poses: Floats) -> Floats:
        """Where depth was measured from (T, 4, 4), by poses at the stamps."""
        return later(poses, self.twist, float(self.values[DEPTH]))

    def of_images(self, poses: Floats) -> Floats:
        """Where images were taken from (T, 4, 4), by poses at the stamps."""
        return later(poses, self.twist, float(self.values[IMAGES]))

    def clear(self) -> dict[str, float]:
        """Lags that the data leave no doubt of: `depth`, `images`, in the stamps' unit."""
        rows = np.flatnonzero(clear(self))
        return {("depth", "images")[row]: float(self.values[row]) for row in rows}


def clear(lags: Lags | None) -> NDArray[np.bool_]:
    """Which of depth and images (2,) are late without doubt."""
    if lags is None:
        return np.zeros(2, bool)
    least = np.maximum(CLEAR * lags.deviations, TOLD * lags.usual)
    return np.asarray(np.abs(lags.values) > least)


def usual_lag(stamps: Floats) -> float:
    """Standard deviation of lags of frames with these stamps (T,), in their unit."""
    between = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    return max(USUAL[0], USUAL[1] * between)


def twists(odometry: Floats, stamps: Floats) -> Floats:
    """Way and turn (T, 6) of a camera a unit of its stamps (T,), in its own axes, at each frame.

    Between the frames before and after; `odometry`: (T, 4, 4). Zero of a single frame.
    """
    count = len(odometry)
    if count < 2:
        return np.zeros((count, 6))
    before, after = np.maximum(np.arange(count) - 1, 0), np.minimum(np.arange(count) + 1, count - 1)
    rotation = np.swapaxes(odometry[:, :3, :3], 1, 2)
    way = np.einsum("tij,tj->ti", rotation, odometry[after, :3, 3] - odometry[before, :3, 3])
    turned = np.swapaxes(odometry[before, :3, :3], 1, 2) @ odometry[after, :3, :3]
    both = np.concatenate([way, vector_from_rotation(turned)], axis=1)
    return np.asarray(both / (stamps[after] - stamps[before])[:, None])


def later(poses: Floats, twist: Floats, lag: float) -> Floats:
    """Poses (T, 4, 4) a `lag` later on ways (T, 6) as of `twists`."""
    out = poses.copy()
    out[:, :3, 3] += lag * np.einsum("tij,tj->ti", poses[:, :3, :3], twist[:, :3])
    out[:, :3, :3] = poses[:, :3, :3] @ rotation_from_vector(lag * twist[:, 3:])
    return out


def in_map_axes(poses: Floats, twist: Floats) -> NDArray[np.float64]:
    """Ways and turns (T, 6) of poses (T, 4, 4) in map axes."""
    rotation = poses[:, :3, :3]
    parts = [np.einsum("tij,tj->ti", rotation, part) for part in (twist[:, :3], twist[:, 3:])]
    return np.concatenate(parts, axis=1)
