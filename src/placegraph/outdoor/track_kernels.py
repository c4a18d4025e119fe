"""Compiled loops of the tracker: a belief on a grid, moved."""

from __future__ import annotations

from typing import TYPE_CHECKING

from numba import njit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@njit(cache=True, nogil=True, fastmath=True)
def scatter(
    mass: NDArray[np.float32],
    weights: NDArray[np.float32],
    bounds: NDArray[np.int64],
    row: int,
    column: int,
    light: float,
    shift: tuple[int, int],
    out: NDArray[np.float32],
) -> None:
    """Move every cell of `mass` (R, C) by a kernel; what falls off the grid is lost.

    Cell (i, j) of the kernel `weights` (K, L) stands for a displacement of (row + i, column + j)
    cells; in its row i only columns from `bounds[i, 0]` to `bounds[i, 1]` matter. Cells that hold no
    more than `light` are shifted whole, by `shift` rows and columns. Adds to `out` (R, C).
    """
    rows, columns = mass.shape
    for r in range(rows):
        for c in range(columns):
            here = mass[r, c]
            if here <= light:
                if here > 0.0 and 0 <= r + shift[0] < rows and 0 <= c + shift[1] < columns:
                    out[r + shift[0], c + shift[1]] += here
                continue
            for i in range(max(0, -r - row), min(weights.shape[0], rows - r - row)):
                first = max(bounds[i, 0], -c - column)
                last = min(bounds[i, 1], columns - c - column)
                for j in range(first, last):
                    out[r + row + i, c + column + j] += here * weights[i, j]
