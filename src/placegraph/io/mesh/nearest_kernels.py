# mypy: allow-untyped-defs, allow-incomplete-defs
"""Nearest points within a reach, by a grid: carries labels from one mesh to another."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel


@kernel
def _hash_cell(
    x: NDArray[np.int64], y: NDArray[np.int64], z: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Hash a cell; collisions only cost time."""
    return (x * 73856093) ^ (y * 19349663) ^ (z * 83492791)


@kernel
def _search(
    points: NDArray[np.float64],
    targets: NDArray[np.float64],
    keys: NDArray[np.int64],
    starts: NDArray[np.int64],
    reach: float,
) -> NDArray[np.int64]:
    """Row of `targets`, sorted by cell, that is nearest to each point, -1 beyond reach."""
    rows = np.full(len(points), -1, np.int64)
    for i in range(len(points)):
        best = reach * reach
        cell = np.floor(points[i] / reach).astype(np.int64)
        for neighbour in range(27):
            x = cell[0] + neighbour // 9 - 1
            y = cell[1] + neighbour // 3 % 3 - 1
            z = cell[2] + neighbour % 3 - 1
            key = _hash_cell(x, y, z)
            k = np.searchsorted(keys, key)
            if k == len(keys) or keys[k] != key:
                continue
            for j in range(starts[k], starts[k + 1]):
                dx = targets[j, 0] - points[i, 0]
                dy = targets[j, 1] - points[i, 1]
                dz = targets[j, 2] - points[i, 2]
                d2 = dx * dx + dy * dy + dz * dz
                if d2 < best or (d2 == best and rows[i] < 0):
                    best, rows[i] = d2, j
    return rows


_FARTHEST = 1e9  # Coordinates beyond this many reaches are damage, and near to nothing


def find_nearest(
    points: NDArray[np.float64], targets: NDArray[np.float64], reach: float
) -> NDArray[np.int64]:
    """Row of the nearest of `targets` (N, 3) to each of `points` (Q, 3); -1 where none is in reach.

    Of those in one place the first. What is not finite is near to nothing.
    """
    rows = np.full(len(points), -1, np.int64)
    there = np.flatnonzero((np.abs(targets) < _FARTHEST * reach).all(axis=1))
    asking = np.flatnonzero((np.abs(points) < _FARTHEST * reach).all(axis=1))
    if not (there.size and asking.size):
        return rows
    cells = np.floor(targets[there] / reach).astype(np.int64)
    keys = _hash_cell(cells[:, 0], cells[:, 1], cells[:, 2])
    order = np.argsort(keys, kind="stable")
    unique, starts = np.unique(keys[order], return_index=True)
    starts = np.append(starts, len(order))
    found = _search(points[asking], targets[there[order]], unique, starts, reach)
    rows[asking] = np.where(found < 0, -1, there[order[found]])
    return rows
