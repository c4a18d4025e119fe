"""Points in clumps: cells of a grid that touch belong together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from placegraph.errors import OptionError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_BITS = 20  # of a cell's number along one axis
_MARGIN = 2  # empty cells around all, so that a neighbour's number never wraps around


def clumps(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number (N,) of the clump of each cell (N, 3): cells that touch, also by a corner, share one.

    Raises `OptionError` where cells are a million apart.
    """
    if not len(cells):
        return np.zeros(0, np.int64)
    at = cells - cells.min(axis=0) + _MARGIN
    if int(at.max()) >= (1 << _BITS) - _MARGIN:
        raise OptionError(f"Points are {int(at.max()):,} cells apart; make the cells larger.")
    keys = (at[:, 0] << 2 * _BITS) + (at[:, 1] << _BITS) + at[:, 2]
    unique, rows = np.unique(keys, return_inverse=True)
    return np.unique(_connected(unique), return_inverse=True)[1][rows]


@njit(cache=True, nogil=True)
def _connected(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Root of each of ascending cells: those that touch share one."""
    parent = np.arange(len(cells))
    for i in range(len(cells)):
        for dx in range(-1, 1):
            for dy in range(-1, 2):
                first = cells[i] + (dx << 2 * _BITS) + (dy << _BITS) - 1
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
