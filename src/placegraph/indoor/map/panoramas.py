"""Panoramas: what rays from one position hit in all directions, and their comparison with views."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.panoramas_kernels import (
    _SCALE,
    _SHIFT,
    AZIMUTHS,
    ELEVATIONS,
    FARTHEST,
    NEAREST,
    NOTHING,
    STEP,
)

HIGHEST = np.deg2rad(50.0)
"""Elevations of the table end here, above and below the horizon."""


def _directions() -> NDArray[np.float32]:
    """Unit rays (E * A, 3) in tiles of 4 x 4 bins; azimuth bins are centred on multiples of STEP."""
    azimuth = np.arange(AZIMUTHS) * STEP
    elevation = ((np.arange(ELEVATIONS) + 0.5) / ELEVATIONS * 2.0 - 1.0) * HIGHEST
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    rays = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    tiles = rays.reshape(ELEVATIONS // 4, 4, AZIMUTHS // 4, 4, 3).swapaxes(1, 2)
    return np.ascontiguousarray(tiles.reshape(-1, 3), np.float32)


DIRECTIONS = _directions()


def range_of(steps: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Distances [m] of stored ranges."""
    table = NEAREST * np.exp(np.arange(256) / 254.0 * np.log(FARTHEST / NEAREST))
    table[NOTHING] = np.inf
    return table.astype(np.float32)[steps]


def as_bytes(opponents: NDArray[np.float32]) -> NDArray[np.float32]:
    """Colours on the scale of the table's."""
    return np.asarray(opponents * _SCALE + _SHIFT, np.float32)
