"""Patches of label images: a grid, and the most frequent value of each cell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import OptionError

GRID = (9, 16)
"""144 patches, as in the paper's Sec. 3.3."""
_DIRECT = 1 << 16  # values below this are looked up in a table


def checked(grid: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of a grid; `OptionError` where it has no patches."""
    if min(grid) < 1:
        raise OptionError(f"grid is {grid}; it needs at least one row and one column.")
    return grid


def cells(shape: tuple[int, int], grid: tuple[int, int]) -> NDArray[np.int64]:
    """Cell (h, w) of a grid that each pixel of an image lies in, row by row."""
    h, w = shape
    return np.add.outer(np.arange(h) * grid[0] // h * grid[1], np.arange(w) * grid[1] // w)


def looked_up(image: NDArray[np.int32], row_of: dict[int, int]) -> NDArray[np.int32]:
    """Row (h, w) of each pixel's value, -1 for those that have none."""
    top = max(row_of, default=0) + 1
    if top < _DIRECT:  # a table is ten times as fast as sorting the pixels
        table = np.full(top + 1, -1, np.int32)
        for value, row in row_of.items():
            if value >= 0:
                table[value] = row
        return table[np.where((image >= 0) & (image < top), image, top)]
    values = np.unique(image)
    rows = np.array([row_of.get(value, -1) for value in values.tolist()], np.int32)
    out: NDArray[np.int32] = rows[np.searchsorted(values, image)]
    return out


def majority(rows: NDArray[np.int32], grid: tuple[int, int], count: int) -> NDArray[np.int32]:
    """Most frequent row (rows * columns,) of each patch, of `count` rows that there are.

    -1 where fewer than half of a patch's pixels have one.
    """
    number = grid[0] * grid[1]
    flat = np.where(rows >= 0, rows, count) + cells(rows.shape, grid) * (count + 1)
    votes = np.bincount(flat.ravel(), minlength=number * (count + 1)).reshape(number, count + 1)
    best = votes[:, :count].argmax(axis=1) if count else np.zeros(number, np.int64)
    pixels = votes.sum(axis=1)  # none, where the grid is finer than the image
    unknown = (votes[:, count] * 2 > pixels) | (pixels == 0)
    out: NDArray[np.int32] = np.where(unknown, -1, best).astype(np.int32)
    return out
