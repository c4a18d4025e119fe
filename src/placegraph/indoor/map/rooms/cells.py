"""Cells of the floor seen from above: which are walls, closed doors, and ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.floor import label_words
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.rooms.rooms_kernels import cover, cut, nearest, pieces
from placegraph.indoor.map.structure import NAMELESS, structure

CELL = 0.05
"""Side of a cell [m], where the map is no larger than `_MOST_CELLS` of them."""
LINTEL = 2.2
"""Widest door [m] below a wall."""
_WALLS = np.array([0.3, 0.5, 0.7, 0.9, 1.1, 1.3, 1.5, 1.7, 1.9])  # above the floor [m]
_LINTELS = np.array([2.2, 2.3, 2.4])
_GAP = 0.5  # a gap of the ground this wide is closed [m], or
_HOLE = 6.0  # one with ground all around, up to this size [m2]
BELOW = 0.3  # ground may lie this much lower than the floor [m]
_LEVEL = 0.15  # the floor itself is no higher [m]
_MOST_CELLS = 1_000_000
_COARSEST = 0.2  # a map so large that cells are wider has no rooms that could be found [m]
_DOORS = frozenset({"door", "doors", "curtain", "curtains", "gate", "partition", "shutter"})
_WALL_WORDS = frozenset({"wall", "walls"})
_BUILT, _TALL, _OVER = (
    2,
    7,
    2,
)  # of how many of these planes cut what is built, a tall thing, a lintel

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
Corners = NDArray[np.float32]


class Grid(NamedTuple):
    """Square cells of the floor."""

    origin: Floats
    cell: float
    shape: tuple[int, int]


def grid_of(corners: Corners) -> Grid | None:
    """Grid around triangles, with a margin in which gaps can be closed."""
    if not len(corners):
        return None
    flat = corners[:, :, :2].astype(np.float64)
    low, high = flat.min(axis=(0, 1)) - 2.0 * _GAP, flat.max(axis=(0, 1)) + 2.0 * _GAP
    cell = max(CELL, float(np.sqrt(np.prod(high - low) / _MOST_CELLS)))
    if cell > _COARSEST:
        return None
    nx, ny = np.ceil((high - low) / cell).astype(int).tolist()
    return Grid(low, cell, (nx, ny))


def wall_cells(mesh: Mesh, labels: Sequence[str], corners: Corners, grid: Grid) -> Mask:
    """Cells (nx, ny) that no room goes through."""
    words = [(label_words(label) or [""])[-1] for label in labels]
    built = structure(labels) | np.array([word in _DOORS for word in words], np.bool_)
    nameless = np.array([not word or word in NAMELESS for word in words], np.bool_)
    if not any(word in _WALL_WORDS for word in words):
        nameless |= ~built
    kind = np.where(built, 0, np.where(nameless, 1, -1))
    found = np.zeros((2, *grid.shape), np.uint32)
    planes = np.concatenate([_WALLS, _LINTELS])
    cut(corners, kind[mesh.object_of], planes, grid.origin, grid.cell, found)
    own = found & np.uint32((1 << len(_WALLS)) - 1)
    tall = (own[1] > 0) & (_bits(_around(own[1])) >= _TALL)
    walls = (_bits(own[0]) >= _BUILT) | tall
    over = (found[0] | found[1]) >> np.uint32(len(_WALLS))
    return walls | _doors(_bits(_around(over)) >= _OVER, walls, (over > 0), grid)


def _doors(lintel: Mask, walls: Mask, over: Mask, grid: Grid) -> Mask:
    """Cells below a wall, where they are no wider than a door."""
    open_below = lintel & over & ~(_around(walls.astype(np.uint32)) > 0)
    part, count = pieces(open_below)
    if not count:
        return open_below
    x, y = np.nonzero(open_below)
    own = part[x, y]
    ends = np.empty((4, count))
    for row, values in enumerate((x, -x, y, -y)):
        ends[row] = -np.inf
        np.maximum.at(ends[row], own, values)
    # with the cells beside the walls, which were taken off
    wide = (np.maximum(ends[0] + ends[1], ends[2] + ends[3]) + 3.0) * grid.cell > LINTEL
    closed = np.zeros_like(walls)
    closed[x, y] = ~wide[own]
    # to the walls on both sides
    return (_around(closed.astype(np.uint32)) > 0) & lintel & over


def _bits(cells: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """How many bits are set."""
    count = np.zeros(cells.shape, np.uint8)
    for k in range(len(_WALLS) + len(_LINTELS)):
        count += ((cells >> np.uint32(k)) & np.uint32(1)).astype(np.uint8)
    return count


def _around(cells: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Bits of each cell and its eight neighbours."""
    out = cells.copy()
    for axis in (0, 1):
        rows = np.moveaxis(out, axis, 0)
        before = rows.copy()
        rows[1:] |= before[:-1]
        rows[:-1] |= before[1:]
    return out


def ground_cells(normals: Floats, corners: Corners, walls: Mask, grid: Grid) -> tuple[Mask, Mask]:
    """Cells (nx, ny) of the floor, and those with something level there or on it, gaps closed."""
    level = np.abs(normals[:, 2]) > 0.7 * np.linalg.norm(normals, axis=1)
    level &= corners[:, :, 2].min(axis=1) > -BELOW
    level &= corners[:, :, 2].max(axis=1) < _WALLS[-1]
    floor, ground = np.zeros((2, *grid.shape), np.bool_)
    cover(corners, level, grid.origin, grid.cell, ground)
    cover(corners, level & (corners[:, :, 2].max(axis=1) < _LEVEL), grid.origin, grid.cell, floor)
    radius = int(_GAP / 2.0 / grid.cell)
    grown = nearest(ground, radius)[1] >= 0
    ground |= nearest(~grown, radius)[1] < 0
    part, count = pieces(~ground & ~walls)
    if count:
        sizes = np.bincount(part[part >= 0], minlength=count) * grid.cell**2
        hole = sizes <= _HOLE
        for edge in (part[0], part[-1], part[:, 0], part[:, -1]):
            hole[edge[edge >= 0]] = False
        ground |= (part >= 0) & hole[part]
    return floor, ground
