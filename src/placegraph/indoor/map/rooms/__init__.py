"""Rooms of a scene that names none: free floor, cut at doors and narrow passages.

On a grid of cells seen from above,

1. *ground* is where something level lies at the floor or stands on it; gaps of a scan are closed;
2. *walls* are cut by level planes between 0.3 and 1.9 m: what is built (walls, windows, doors, by
   their labels) wherever it is cut, what has no label where it is cut at nearly all heights. Where
   no object is called a wall, anything may be one. Above a doorway the wall goes on: what is free
   below and built above, no wider than 2.2 m, is a door, and closed;
3. each cell of free ground has a half-width, its distance to what is not free. Flooded from the
   widest cells down, basins that meet stay apart if the pass between them is narrow: at most 0.6 of
   the narrower basin's width, or 0.75 if it is no wider than 1 m;
4. a *room* is a basin of at least 2 m2; what is smaller belongs to the next one.

An object is in the room above whose floor, or within 0.5 m of it, most of its surface lies. Walls,
floors, ceilings are in a room only where two thirds of them lie there: what lies between rooms, or
around several, is in none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.rooms.cells import (
    BELOW,
    CELL,
    Corners,
    Floats,
    Grid,
    Mask,
    grid_of,
    ground_cells,
    wall_cells,
)
from placegraph.indoor.map.rooms.rooms_kernels import areas_within, flood, nearest
from placegraph.indoor.map.structure import structure

LEAST_AREA = 2.0
"""Of a room [m2]."""
LEAST_WIDTH = 0.8
"""Of a room, at its widest place [m]."""
NARROW, NARROW_DOOR = 0.6, 0.75
"""Width of a pass that ends a room, as a share of the room's; where it is as narrow as a door."""
DOOR = 1.0
"""Widest door [m] in a wall that is not known above it."""
REACH = 0.5
"""What is no farther from a room's floor belongs to it [m]: what hangs on its walls, the walls."""

_MOSTLY, _PARTLY = 2.0 / 3.0, 1.0 / 3.0  # of a wall, or of a thing, that lies in its room
_STOREY = 3.5  # what begins higher above the floor is in another storey [m]
_WIDEST = 6.0  # wider rooms are taken for this wide: no pass wider than 0.6 of it is narrow [m]
_SEEN = 0.5  # of a room's floor is in the map [m2]; a table in nowhere is no room

Cells = NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Rooms:
    """R rooms, the largest first."""

    room_of: NDArray[np.int32]
    """(N,) int32, room of each object; -1: none."""
    areas: Floats
    """(R,) free floor [m2], under furniture too."""
    cells: Cells
    """(nx, ny) int32, room of each cell of the floor; -1: none."""
    origin: Floats
    """(2,) lower corner of cell (0, 0) [m]."""
    cell: float
    """Side of a cell [m]."""

    def __len__(self) -> int:
        return len(self.areas)

    def __repr__(self) -> str:
        areas = ", ".join(f"{area:.1f}" for area in self.areas)
        return f"Rooms({len(self)} of {areas} m2)" if len(self) else "Rooms(none)"

    def at(self, points: ArrayLike) -> NDArray[np.int32]:
        """Room (K,) of the floor under points (K, 2 or 3) [m]; -1: none."""
        xy = np.asarray(points, np.float64)[:, :2]
        x, y = np.floor((xy - self.origin) / self.cell).astype(np.int64).T
        inside = (x >= 0) & (y >= 0) & (x < self.cells.shape[0]) & (y < self.cells.shape[1])
        room = np.full(len(xy), -1, np.int32)
        room[inside] = self.cells[x[inside], y[inside]]
        return room

    def attributes(self) -> list[dict[str, str]]:
        """(N,) what a map's attributes say: the number of each object's room, from "1" on."""
        return [{"room": str(room + 1)} if room >= 0 else {} for room in self.room_of.tolist()]


def with_rooms(
    mesh: Mesh, labels: Sequence[str], floor: float, attributes: Sequence[Mapping[str, str]]
) -> tuple[NDArray[np.int32], list[dict[str, str]]]:
    """Room of each object (N,), -1 none, and attributes (N,) that say so under "room".

    As the attributes name rooms already, if any does; else as `rooms_of` finds them.
    """
    named = [a.get("room", "") for a in attributes]
    if any(named):
        number = {name: i for i, name in enumerate(sorted({*named} - {""}))}
        given = np.array([number.get(name, -1) for name in named], np.int32)
        return given, [dict(a) for a in attributes]
    rooms = rooms_of(mesh, labels, floor)
    both = zip(attributes, rooms.attributes(), strict=True)
    return rooms.room_of, [{**old, **new} for old, new in both]


def rooms_of(mesh: Mesh, labels: Sequence[str], floor: float) -> Rooms:
    """Rooms of a mesh of N objects.

    Parameters
    ----------
    mesh
        Triangles of the objects, z up, metres.
    labels
        Of the N objects.
    floor
        Height of the floor [m, map]. Of several storeys it is this one's rooms that are found.

    """
    corners, normals = mesh.vertices[mesh.triangles], mesh.normals()
    corners[:, :, 2] -= floor
    near = (corners[:, :, 2].min(axis=1, initial=np.inf) < _STOREY) & (
        corners[:, :, 2].max(axis=1, initial=-np.inf) > -BELOW
    )
    grid = grid_of(corners[near])
    if grid is None:
        return _no_rooms(len(labels))
    walls = wall_cells(mesh, labels, corners, grid)
    floor_cells, ground = ground_cells(normals, corners, walls, grid)
    cells = _cut(ground & ~walls, floor_cells, grid)
    areas = np.bincount(cells[cells >= 0], minlength=int(cells.max(initial=-1)) + 1)
    order = np.argsort(-areas, kind="stable")
    rank = np.empty(len(order) + 1, np.int32)
    rank[order], rank[-1] = np.arange(len(order)), -1
    rooms = Rooms(
        room_of=np.full(len(labels), -1, np.int32),
        areas=areas[order].astype(np.float64) * grid.cell**2,
        cells=rank[cells],
        origin=grid.origin,
        cell=grid.cell,
    )
    if len(rooms):
        areas = np.linalg.norm(normals, axis=1) / 2.0 * near
        rooms.room_of[:] = _rooms_of_objects(mesh.object_of, labels, corners, areas, rooms)
    return rooms


def _no_rooms(count: int) -> Rooms:
    none = np.full(count, -1, np.int32)
    return Rooms(none, np.zeros(0), np.full((1, 1), -1, np.int32), np.zeros(2), CELL)


def _cut(free: Mask, floor: Mask, grid: Grid) -> Cells:
    """Number (nx, ny) of the room of each free cell; -1: none."""
    squared = nearest(~free, int(_WIDEST / 2.0 / grid.cell))[0]
    width = np.sqrt(squared) * grid.cell
    chosen = np.flatnonzero(free)
    # numbers of 16 bits are sorted by their digits
    order = chosen[np.argsort(-squared.reshape(-1)[chosen].astype(np.int16), kind="stable")]
    basin, meetings = flood(width, order, LEAST_WIDTH / 2.0, NARROW, DOOR / 2.0, NARROW_DOOR)
    flat = basin.reshape(-1)
    roots = np.flatnonzero(flat == np.arange(flat.size))
    index = np.full(flat.size, -1)
    index[roots] = np.arange(len(roots))
    own = np.where(flat >= 0, index[flat], -1)
    sizes = _sizes(own, len(roots), grid)
    owner = _joined(sizes, list(dict.fromkeys(map(tuple, index[meetings].tolist()))))
    wide = width.reshape(-1)[roots] >= LEAST_WIDTH / 2.0
    seen = np.bincount(owner, _sizes(own[floor.reshape(-1)], len(roots), grid), len(roots))
    kept = wide & (sizes >= LEAST_AREA) & (seen >= _SEEN) & (owner == np.arange(len(owner)))
    number = np.append(np.where(kept, np.cumsum(kept) - 1, -1)[owner], -1)
    return number[own].reshape(basin.shape).astype(np.int32)


def _sizes(own: NDArray[np.int64], count: int, grid: Grid) -> Floats:
    """Area (count,) [m2] of cells by their number; -1: of none."""
    cells = np.bincount(own[own >= 0], minlength=count)
    return cells.astype(np.float64) * grid.cell**2


def _joined(sizes: Floats, meetings: list[tuple[int, ...]]) -> NDArray[np.int64]:
    """Basin that each basin becomes part of; `sizes` [m2] are added up.

    What is too small joins the one that it has the widest pass to, the smallest first.
    """
    owner = np.arange(len(sizes))
    for i in np.argsort(sizes, kind="stable").tolist():
        if sizes[i] >= LEAST_AREA:
            continue
        for pair in meetings:
            one, other = (_owner(owner, k) for k in pair)
            if i in (one, other) and one != other:
                into = other if one == i else one
                owner[i] = into
                sizes[into] += sizes[i]
                break
    return np.array([_owner(owner, i) for i in range(len(owner))], np.int64)


def _owner(owner: NDArray[np.int64], i: int) -> int:
    while owner[i] != i:
        i = int(owner[i])
    return i


def _rooms_of_objects(
    object_of: NDArray[np.int32],
    labels: Sequence[str],
    corners: Corners,
    areas: Floats,
    rooms: Rooms,
) -> NDArray[np.int32]:
    """Room (N,) over whose floor most of an object's triangles lie, by their areas [m2]; -1: none."""
    number = nearest(rooms.cells >= 0, int(REACH / rooms.cell))[1]
    within = np.where(number >= 0, rooms.cells.reshape(-1)[number], np.int32(-1))
    votes = np.zeros((len(labels), len(rooms) + 1))
    areas_within(corners, areas, object_of, rooms.origin, rooms.cell, within, votes)
    best = votes[:, :-1].argmax(axis=1)
    share = votes[np.arange(len(labels)), best] / np.maximum(votes.sum(axis=1), 1e-12)
    needed = np.where(structure(labels), _MOSTLY, _PARTLY)
    return np.where(share >= needed, best, -1).astype(np.int32)
