"""Elastic distortion of point clouds: space pulled to and fro, smoothly (Simard et al. 2003)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

SCALES = ((0.05, 0.2), (0.2, 0.4), (0.4, 0.4))
"""Granularity, the distance [m] over which the pull changes, and magnitude [m]."""
SHARE = 0.95
"""Of all clouds; the others stay as they are."""
_MOST = 48
"""Cells along an axis: clouds too large for a granularity are pulled more coarsely."""


def distorted(points: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.float32]:
    """Points (..., 3) [m], with the probability `SHARE` pulled at all `SCALES`."""
    out = np.asarray(points, np.float64).reshape(-1, 3)
    if rng.random() < SHARE:
        for granularity, magnitude in SCALES:
            out = out + magnitude * _pull(out, granularity, rng)
    return out.reshape(points.shape).astype(np.float32)


def _pull(
    points: NDArray[np.float64], granularity: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Smooth noise (n, 3) at points (n, 3)."""
    low = points.min(axis=0)
    step = np.maximum(np.ptp(points, axis=0) / (_MOST - 3), granularity)
    shape = (np.ptp(points, axis=0) / step).astype(np.int64) + 3
    noise = rng.standard_normal((*shape, 3), np.float32)
    for axis in (0, 1, 2) * 2:
        noise = _blurred(noise, axis)
    at = (points - low) / step + 1.0
    base = np.minimum(at.astype(np.int64), shape - 2)
    part = at - base
    out = np.zeros_like(points)
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (base + corner).T
        weight = np.where(corner, part, 1.0 - part).prod(axis=1)
        out += weight[:, None] * noise[x, y, z]
    return out


def _blurred(noise: NDArray[np.float32], axis: int) -> NDArray[np.float32]:
    """Mean of each node and its two neighbours along an axis; beyond the edge is nothing."""
    lines = np.moveaxis(noise, axis, 0)
    total = lines.copy()
    total[1:] += lines[:-1]
    total[:-1] += lines[1:]
    total *= np.float32(1.0 / 3.0)
    return np.moveaxis(total, 0, axis)
