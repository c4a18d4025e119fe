"""Compiled parts of `maps_surface`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel

# mypy: allow-untyped-defs, allow-incomplete-defs


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
_CELL = 0.1  # [m]


class Grid(NamedTuple):
    """Triangles by the cells that they may touch."""

    corners: Floats  # (T, 3, 3) [m]
    low: Floats  # (3,) lowest corner of cell 0 [m]
    shape: Ints  # (3,) cells an axis
    cells: Ints  # (C,) numbers of those that hold a triangle, ascending
    starts: Ints  # (C + 1,) first row of each in `rows`
    rows: Ints  # triangles


@kernel
def _distances(points: Floats, grid: Grid, rings: int, out: Floats) -> None:
    """Fill distances (N,): cells are looked at from the point's own outwards, ring by ring."""
    for i in range(len(points)):
        own = np.floor((points[i] - grid.low) / _CELL).astype(np.int64)
        best = np.inf
        for ring in range(rings + 1):
            for x in range(own[0] - ring, own[0] + ring + 1):
                for y in range(own[1] - ring, own[1] + ring + 1):
                    side = abs(x - own[0]) == ring or abs(y - own[1]) == ring
                    for z in range(own[2] - ring, own[2] + ring + 1, 1 if side else 2 * ring):
                        best = min(best, _squared_in(points[i], grid, x, y, z))
            if best <= (ring * _CELL) ** 2:  # all else is farther
                break
        out[i] = np.sqrt(best)


@kernel
def _squared_in(point: Floats, grid: Grid, x: int, y: int, z: int) -> float:
    """Squared distance of a point from what a cell holds; infinite if nothing."""
    best = np.inf
    shape = grid.shape
    if 0 <= x < shape[0] and 0 <= y < shape[1] and 0 <= z < shape[2]:
        number = (x * shape[1] + y) * shape[2] + z
        k = np.searchsorted(grid.cells, number)
        if k < len(grid.cells) and grid.cells[k] == number:
            for row in grid.rows[grid.starts[k] : grid.starts[k + 1]]:
                best = min(best, _squared(point, grid.corners[row]))
    return best


@kernel
def _squared(point: Floats, corners: Floats) -> float:
    ax, ay, az = corners[1] - corners[0]
    bx, by, bz = corners[2] - corners[0]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    inside = nx * nx + ny * ny + nz * nz > 0.0
    best = np.inf
    for k in range(3):
        a, b = corners[k], corners[(k + 1) % 3]
        ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        px, py, pz = point[0] - a[0], point[1] - a[1], point[2] - a[2]
        length = ex * ex + ey * ey + ez * ez
        along = (ex * px + ey * py + ez * pz) / length if length > 0.0 else 0.0
        along = min(max(along, 0.0), 1.0)
        dx, dy, dz = px - along * ex, py - along * ey, pz - along * ez
        best = min(best, dx * dx + dy * dy + dz * dz)
        turn = nx * (ey * pz - ez * py) + ny * (ez * px - ex * pz) + nz * (ex * py - ey * px)
        inside = inside and turn >= 0.0
    if inside:
        px, py, pz = point[0] - corners[0, 0], point[1] - corners[0, 1], point[2] - corners[0, 2]
        return (nx * px + ny * py + nz * pz) ** 2 / (nx * nx + ny * ny + nz * nz)
    return best
