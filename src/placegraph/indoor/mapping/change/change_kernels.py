# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled: colours of hits, and cells that touch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.indoor.map.map_kernels import sample_colour

BITS = 20  # Of a cell's number along one axis


@kernel
def label_connected(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Label each of ascending cells by its root: those that touch share one."""
    parent = np.arange(len(cells))
    for i in range(len(cells)):
        for dx in range(-1, 1):
            for dy in range(-1, 2):
                first = cells[i] + (dx << 2 * BITS) + (dy << BITS) - 1
                row = np.searchsorted(cells, first)
                while row < len(cells) and cells[row] <= first + 2:
                    a, b = i, row
                    while parent[a] != a:
                        parent[a] = parent[parent[a]]
                        a = parent[a]
                    while parent[b] != b:
                        parent[b] = parent[parent[b]]
                        b = parent[b]
                    parent[max(a, b)] = min(a, b)
                    row += 1
    for i in range(len(cells)):
        parent[i] = parent[parent[i]]  # ascending: what it points to points to its root already
    return parent


@kernel
def paint(surface, triangle, u, v, footprint, out):
    """Write colours of hits (N, 3)."""
    for i in range(len(triangle)):
        if triangle[i] >= 0:
            out[i, 0], out[i, 1], out[i, 2] = sample_colour(
                surface, triangle[i], u[i], v[i], footprint[i]
            )
