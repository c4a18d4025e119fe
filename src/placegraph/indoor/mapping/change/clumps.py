"""Points in clumps: cells of a grid that touch belong together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.mapping.change.clumps_kernels import _BITS, _connected

if TYPE_CHECKING:
    from numpy.typing import NDArray


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
