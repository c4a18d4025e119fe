# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops that look colours up on another mesh."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.indoor.map.surface_kernels import colour_at


@kernel(error_model="numpy")
def colours_of(surface, triangle, u, v, footprint, out, first, last):
    """Fill colours (N, 3) uint8 at barycentrics of triangles (N,), where that is not -1.

    `footprint`: width over which textures are averaged [m].
    """
    for i in range(first, last):
        if triangle[i] >= 0:
            red, green, blue = colour_at(surface, triangle[i], u[i], v[i], footprint)
            out[i, 0] = np.uint8(min(max(255.0 * red + 0.5, 0.0), 255.0))
            out[i, 1] = np.uint8(min(max(255.0 * green + 0.5, 0.0), 255.0))
            out[i, 2] = np.uint8(min(max(255.0 * blue + 0.5, 0.0), 255.0))


@kernel(error_model="numpy")
def _cell(x, y, z):
    """Number of a cell of a grid without bounds; two cells in 2^21 apart an axis may share one."""
    return ((x & 0x1FFFFF) << 42) | ((y & 0x1FFFFF) << 21) | (z & 0x1FFFFF)


@kernel(error_model="numpy")
def _cells_of(points, low, size):
    cells = np.empty(len(points), np.int64)
    for i in range(len(points)):
        x = np.int64(np.floor((points[i, 0] - low[0]) / size))
        y = np.int64(np.floor((points[i, 1] - low[1]) / size))
        z = np.int64(np.floor((points[i, 2] - low[2]) / size))
        cells[i] = _cell(x, y, z)
    return cells


def sorted_cells(points, low, size):
    """Points (V, 3) by cells `size` [m] wide: their order, the cells (C,), and their starts (C + 1,)."""
    cell = _cells_of(points, low, size)
    order = np.argsort(cell, kind="stable")
    cells, starts = np.unique(cell[order], return_index=True)
    return order, cells, np.append(starts, len(points)).astype(np.int64)


@kernel(error_model="numpy")
def nearest(asked, points, grid, low, reach, out, first, last):
    """Fill rows (N,) of the points nearest to those asked for (N, 3), -1: none within `reach` [m].

    `grid` as from `sorted_cells`, of cells as wide as `reach`.
    """
    order, cells, starts = grid
    for i in range(first, last):
        out[i] = -1
        best = reach * reach
        x = np.int64(np.floor((asked[i, 0] - low[0]) / reach))
        y = np.int64(np.floor((asked[i, 1] - low[1]) / reach))
        z = np.int64(np.floor((asked[i, 2] - low[2]) / reach))
        for k in range(27):
            cell = _cell(x + k // 9 - 1, y + k // 3 % 3 - 1, z + k % 3 - 1)
            at = np.searchsorted(cells, cell)
            if at == len(cells) or cells[at] != cell:
                continue
            for row in order[starts[at] : starts[at + 1]]:
                d = (
                    (points[row, 0] - asked[i, 0]) ** 2
                    + (points[row, 1] - asked[i, 1]) ** 2
                    + (points[row, 2] - asked[i, 2]) ** 2
                )
                if d < best:
                    best, out[i] = d, row
