"""Square tiles of the Earth: the quadtree of web maps, by which extracts are split and shards are named.

Tile (column, row) of zoom z is one of 2^z x 2^z squares of the Mercator projection, row 0 in the
north. Its key is its path from the root, one digit of 0 to 3 a level (1: the eastern, 2: the
southern half), so that the key of a parent is the beginning of those of its children.

Why not S2 or H3: a tile is a rectangle of longitudes and latitudes, so a road or a park is clipped to
it by comparing numbers, a part of the world is a prefix of keys, and four children make up their
parent exactly, which hexagons do not. It takes twenty lines and no library. What S2 and H3 do
better, equal areas, is of no use here: what a tile costs depends on what stands in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import LocalPlane
from placegraph.errors import OptionError

DEEPEST = 16
"""Levels at most: tiles of 600 m at the equator."""
NORTHMOST = 85.0511287
"""The projection ends here [deg]; the last rows reach to the poles."""
EQUATOR = 40_075_016.7
"""Once around the Earth [m]."""


class Box(NamedTuple):
    """Longitudes and latitudes [deg], or metres, from edge to edge."""

    west: float
    south: float
    east: float
    north: float

    @property
    def center(self) -> tuple[float, float]:
        """Its middle."""
        return (self.west + self.east) / 2.0, (self.south + self.north) / 2.0

    def widened(self, metres: float) -> Box:
        """Box of longitudes and latitudes with a margin; its west may lie beyond the date line."""
        middle, latitude = self.center
        across, along = metres / np.array(LocalPlane(middle, latitude).metres_per_degree)
        return Box(self.west - across, self.south - along, self.east + across, self.north + along)


def columns_rows(lonlat: NDArray[np.float64], zoom: int) -> NDArray[np.float64]:
    """Where positions (N, 2) [deg] lie, in columns and rows (N, 2) with fractions."""
    sine = np.sin(np.radians(np.clip(lonlat[:, 1], -NORTHMOST, NORTHMOST)))
    rows = 0.5 - np.arctanh(sine) / (2.0 * np.pi)
    found: NDArray[np.float64] = np.stack([lonlat[:, 0] / 360.0 + 0.5, rows], 1) * 2.0**zoom
    return found


def reached(
    low: NDArray[np.float64], high: NDArray[np.float64], zoom: int, margin: float
) -> NDArray[np.int64]:
    """First column, first row, last column and last row (N, 4) that boxes and a margin [m] touch.

    `low` and `high` are their south-western and north-eastern corners (N, 2) [deg]. Columns go
    beyond the grid at the date line: take them modulo 2^zoom.
    """
    farthest = np.minimum(np.maximum(np.abs(low[:, 1]), np.abs(high[:, 1])), NORTHMOST)
    wide = margin * 1.01 * 2.0**zoom / (EQUATOR * np.cos(np.radians(farthest)))
    west, east = columns_rows(low, zoom), columns_rows(high, zoom)
    ends = np.stack([west[:, 0] - wide, east[:, 1] - wide, east[:, 0] + wide, west[:, 1] + wide], 1)
    found = np.floor(ends).astype(np.int64)
    found[:, 1::2] = np.clip(found[:, 1::2], 0, 2**zoom - 1)
    return found


def tiles(lonlat: NDArray[np.float64], zoom: int) -> NDArray[np.int64]:
    """Column and row (N, 2) of the tiles that hold positions (N, 2) [deg]."""
    found = np.floor(columns_rows(lonlat, zoom)).astype(np.int64)
    found[:, 0] %= 1 << zoom
    found[:, 1] = np.clip(found[:, 1], 0, (1 << zoom) - 1)
    return found


def held(lonlat: NDArray[np.float64], key: str) -> NDArray[np.bool_]:
    """Which positions (N, 2) [deg] lie in a tile: each in one tile of a zoom."""
    column, row, zoom = tile_of(key)
    found: NDArray[np.bool_] = (tiles(lonlat, zoom) == (column, row)).all(axis=1)
    return found


def key_of(column: int, row: int, zoom: int) -> str:
    """Key of a tile; the column may lie around the Earth."""
    column %= 1 << zoom
    bits = range(zoom - 1, -1, -1)
    return "".join(str((column >> bit & 1) + 2 * (row >> bit & 1)) for bit in bits)


def key_at(longitude: float, latitude: float, zoom: int) -> str:
    """Key of the tile at a position [deg]."""
    column, row = tiles(np.array([[longitude, latitude]]), zoom)[0].tolist()
    return key_of(column, row, zoom)


def tile_of(key: str) -> tuple[int, int, int]:
    """Column, row and zoom of a key; raises `OptionError` where it is none."""
    if not set(key) <= set("0123") or len(key) > DEEPEST:
        raise OptionError(f"{key!r} is no tile; its key has up to {DEEPEST} digits of 0 to 3.")
    digits = [int(digit) for digit in key]
    column = sum((digit & 1) << bit for bit, digit in enumerate(reversed(digits)))
    row = sum((digit >> 1) << bit for bit, digit in enumerate(reversed(digits)))
    return column, row, len(key)


def bounds(key: str) -> Box:
    """Longitudes and latitudes of a tile [deg]: the core of a shard of this key."""
    column, row, zoom = tile_of(key)
    n = 1 << zoom
    edges = np.array([row + 1, row]) / n
    south, north = np.degrees(np.arctan(np.sinh(np.pi * (1.0 - 2.0 * edges)))).tolist()
    south = -90.0 if row == n - 1 else south
    north = 90.0 if row == 0 else north
    return Box(column / n * 360.0 - 180.0, south, (column + 1) / n * 360.0 - 180.0, north)


def check_zoom(zoom: int) -> None:
    """Raise `OptionError` where tiles of a zoom are none."""
    if isinstance(zoom, bool) or not isinstance(zoom, int) or not 1 <= zoom <= DEEPEST:
        raise OptionError(f"zoom is {zoom!r}; choose a whole number from 1 to {DEEPEST}.")
