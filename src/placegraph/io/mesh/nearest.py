"""Nearest points within a reach, by a grid: what carries labels from one mesh to another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.io.mesh.nearest_kernels import _key, _search

_FARTHEST = 1e9
"""Coordinates beyond this many reaches are damage, and near to nothing."""


def nearest(
    points: NDArray[np.float64], among: NDArray[np.float64], reach: float
) -> NDArray[np.int64]:
    """Row of the nearest of `among` (N, 3) to each of `points` (Q, 3); -1 where none is in reach.

    Of those in one place the first. What is not finite is near to nothing.
    """
    rows = np.full(len(points), -1, np.int64)
    there = np.flatnonzero((np.abs(among) < _FARTHEST * reach).all(axis=1))
    asking = np.flatnonzero((np.abs(points) < _FARTHEST * reach).all(axis=1))
    if not (there.size and asking.size):
        return rows
    cells = np.floor(among[there] / reach).astype(np.int64)
    keys = _key(cells[:, 0], cells[:, 1], cells[:, 2])
    order = np.argsort(keys, kind="stable")
    unique, starts = np.unique(keys[order], return_index=True)
    starts = np.append(starts, len(order))
    found = _search(points[asking], among[there[order]], unique, starts, reach)
    rows[asking] = np.where(found < 0, -1, there[order[found]])
    return rows
