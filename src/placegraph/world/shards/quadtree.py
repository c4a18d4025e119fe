"""Squares of the Earth: the quadtree of map tiles, whose paths are the keys of shards.

A key such as "0313" is a path from the whole Earth down, a digit 0 to 3 a level: 1 is east, 2 south
(Bing's quadkeys). Next to S2 and H3 it needs no library, neighbours share no more than an edge, two
comparisons say whether a place is inside, and a key begins with the key of what holds it. Squares are
squares on the ground too, the smaller the nearer to a pole; those of the outermost rows reach it.
"""

from __future__ import annotations

from math import atan, degrees, pi, sinh
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.errors import OptionError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

DEEPEST = 16
"""Levels at most: squares of 600 m at the equator."""
_EDGE = 85.0511287798066
"""Latitude at which the map of all tiles is a square [deg]."""


class Core(NamedTuple):
    """Ground of a square [deg]: from its west edge on to before its east edge, and so southwards."""

    west: float
    south: float
    east: float
    north: float


def checked_zoom(zoom: int) -> int:
    """The zoom; `OptionError` where there are no squares of it."""
    if isinstance(zoom, bool) or not isinstance(zoom, int) or not 1 <= zoom <= DEEPEST:
        raise OptionError(f"zoom is {zoom!r}; choose a whole number from 1 to {DEEPEST}.")
    return zoom


def tiles(lonlat: ArrayLike, zoom: int) -> NDArray[np.int64]:
    """Column and row (..., 2), from north-west, of the squares that hold places (..., 2) [deg]."""
    lon, lat = np.moveaxis(np.asarray(lonlat, np.float64), -1, 0)
    sine = np.sin(np.radians(np.clip(lat, -_EDGE, _EDGE)))
    down = 0.5 - np.log((1.0 + sine) / (1.0 - sine)) / (4.0 * np.pi)
    n = 1 << zoom
    column = np.floor((lon + 180.0) / 360.0 * n).astype(np.int64) % n
    row = np.clip(np.floor(down * n), 0, n - 1).astype(np.int64)
    return np.stack([column, row], axis=-1)


def key_of(tile: ArrayLike, zoom: int) -> str:
    """Key of the square in a column and a row (2,)."""
    column, row = (int(x) for x in np.asarray(tile))
    bits = range(zoom - 1, -1, -1)
    return "".join(str((column >> k & 1) + 2 * (row >> k & 1)) for k in bits)


def tile_of(key: str) -> tuple[int, int]:
    """Column and row of a key; `ValueError` where it is none."""
    if not key or set(key) - set("0123") or len(key) > DEEPEST:
        raise ValueError(f"{key!r} is no key of a square")
    column = row = 0
    for digit in map(int, key):
        column, row = 2 * column + (digit & 1), 2 * row + (digit >> 1)
    return column, row


def core_of(key: str) -> Core:
    """Ground of the square of a key; `ValueError` where it is none."""
    column, row = tile_of(key)
    n = 1 << len(key)

    def latitude(line: int) -> float:
        if line in (0, n):
            return 90.0 if line == 0 else -90.0
        return degrees(atan(sinh(pi * (1.0 - 2.0 * line / n))))

    west, east = (360.0 * c / n - 180.0 for c in (column, column + 1))
    return Core(west, latitude(row + 1), east, latitude(row))


def held(lonlat: ArrayLike, key: str) -> NDArray[np.bool_]:
    """Which places (..., 2) [deg] lie in the square of a key: each place in one square of a zoom."""
    found: NDArray[np.bool_] = (tiles(lonlat, len(key)) == tile_of(key)).all(axis=-1)
    return found
