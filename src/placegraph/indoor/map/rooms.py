"""Rooms of a scene: cells of free floor, cut at doors and narrow passages, and names of places.

On a grid of cells seen from above,

1. *ground* is where something level lies at the floor or stands on it; gaps of a scan are closed;
2. *walls* are cut by level planes between 0.3 and 1.9 m: objects that are built (walls, windows,
   doors, by their labels) wherever they are cut, objects without a label where they are cut at nearly
   all heights. Where no object is called a wall, anything may be one. Above a doorway the wall goes
   on: a gap that is free below and built above, no wider than 2.2 m, is a door, and closed;
3. each cell of free ground has a half-width, its distance to the nearest cell that is not free.
   Flooded from the widest cells down, basins that meet stay apart if the pass between them is narrow:
   at most 0.6 of the narrower basin's width, or 0.75 if it is no wider than 1 m;
4. a *room* is a basin of at least 2 m2; smaller ones belong to the next one.

An object is in the room above whose floor, or within 0.5 m of it, most of its surface lies. Walls,
floors, ceilings are in a room only where two thirds of them lie there: a wall between rooms, or
around several, is in none.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.indoor.map import map_kernels as kernels
from placegraph.indoor.map.floor import NAMELESS, find_storey, is_structural, split_label
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene import Scene

CELL = 0.05  # Side of a cell [m], where the map is no larger than `_MOST_CELLS` of them
LINTEL = 2.2  # Widest door [m] below a wall
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
_BUILT, _TALL, _OVER = 2, 7, 2  # planes that cut built things, tall things, lintels

Mask = NDArray[np.bool_]
Floats = NDArray[np.float64]
Corners = NDArray[np.float32]


class Grid(NamedTuple):
    """Square cells of the floor."""

    origin: Floats
    cell: float
    shape: tuple[int, int]


def make_grid(corners: Corners) -> Grid | None:
    """Return grid around triangles, with a margin in which gaps can be closed."""
    if not len(corners):
        return None
    flat = corners[:, :, :2].astype(np.float64)
    low, high = flat.min(axis=(0, 1)) - 2.0 * _GAP, flat.max(axis=(0, 1)) + 2.0 * _GAP
    cell = max(CELL, float(np.sqrt(np.prod(high - low) / _MOST_CELLS)))
    if cell > _COARSEST:
        return None
    nx, ny = np.ceil((high - low) / cell).astype(int).tolist()
    return Grid(low, cell, (nx, ny))


def find_wall_cells(mesh: Mesh, labels: Sequence[str], corners: Corners, grid: Grid) -> Mask:
    """Return cells (nx, ny) that no room goes through."""
    words = [(split_label(label) or [""])[-1] for label in labels]
    built = is_structural(labels) | np.array([word in _DOORS for word in words], np.bool_)
    nameless = np.array([not word or word in NAMELESS for word in words], np.bool_)
    if not any(word in _WALL_WORDS for word in words):
        nameless |= ~built
    kind = np.where(built, 0, np.where(nameless, 1, -1))
    found = np.zeros((2, *grid.shape), np.uint32)
    planes = np.concatenate([_WALLS, _LINTELS])
    kernels.draw_cuts(corners, kind[mesh.object_of], planes, grid.origin, grid.cell, found)
    own = found & np.uint32((1 << len(_WALLS)) - 1)
    tall = (own[1] > 0) & (_count_bits(_dilate_bits(own[1])) >= _TALL)
    walls = (_count_bits(own[0]) >= _BUILT) | tall
    over = (found[0] | found[1]) >> np.uint32(len(_WALLS))
    return walls | _find_doors(_count_bits(_dilate_bits(over)) >= _OVER, walls, (over > 0), grid)


def _find_doors(lintel: Mask, walls: Mask, over: Mask, grid: Grid) -> Mask:
    """Return cells below a wall, where they are no wider than a door."""
    open_below = lintel & over & ~(_dilate_bits(walls.astype(np.uint32)) > 0)
    part, count = kernels.label_components(open_below)
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
    return (_dilate_bits(closed.astype(np.uint32)) > 0) & lintel & over


def _count_bits(cells: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Count the bits that are set."""
    count = np.zeros(cells.shape, np.uint8)
    for k in range(len(_WALLS) + len(_LINTELS)):
        count += ((cells >> np.uint32(k)) & np.uint32(1)).astype(np.uint8)
    return count


def _dilate_bits(cells: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return bits of each cell and its eight neighbours."""
    out = cells.copy()
    for axis in (0, 1):
        rows = np.moveaxis(out, axis, 0)
        before = rows.copy()
        rows[1:] |= before[:-1]
        rows[:-1] |= before[1:]
    return out


def find_ground_cells(
    normals: Floats, corners: Corners, walls: Mask, grid: Grid
) -> tuple[Mask, Mask]:
    """Return cells (nx, ny) of the floor, and those with something level there or on it, gaps closed."""
    level = np.abs(normals[:, 2]) > 0.7 * np.linalg.norm(normals, axis=1)
    level &= corners[:, :, 2].min(axis=1) > -BELOW
    level &= corners[:, :, 2].max(axis=1) < _WALLS[-1]
    floor, ground = np.zeros((2, *grid.shape), np.bool_)
    kernels.rasterize_triangles(corners, level, grid.origin, grid.cell, ground)
    kernels.rasterize_triangles(
        corners, level & (corners[:, :, 2].max(axis=1) < _LEVEL), grid.origin, grid.cell, floor
    )
    radius = int(_GAP / 2.0 / grid.cell)
    grown = kernels.distance_transform(ground, radius)[1] >= 0
    ground |= kernels.distance_transform(~grown, radius)[1] < 0
    part, count = kernels.label_components(~ground & ~walls)
    if count:
        sizes = np.bincount(part[part >= 0], minlength=count) * grid.cell**2
        hole = sizes <= _HOLE
        for edge in (part[0], part[-1], part[:, 0], part[:, -1]):
            hole[edge[edge >= 0]] = False
        ground |= (part >= 0) & hole[part]
    return floor, ground


MIN_ROOM_AREA = 2.0  # Of a room [m2]
MIN_ROOM_WIDTH = 0.8  # Of a room, at its widest place [m]
NARROW, NARROW_DOOR = 0.6, 0.75
"""Width of a pass that ends a room, as a share of the room's; where it is as narrow as a door."""
DOOR = 1.0  # Widest door [m] in a wall that is not known above it
REACH = 0.5
"""Maximum distance of an object from the floor of its room [m]; walls and what hangs on them are within."""

_MOSTLY, _PARTLY = 2.0 / 3.0, 1.0 / 3.0  # of a wall, or of a thing, that lies in its room
_STOREY = 3.5  # what begins higher above the floor is in another storey [m]
_WIDEST = 6.0  # wider rooms are taken for this wide: no pass wider than 0.6 of it is narrow [m]
_SEEN = 0.5  # of a room's floor is in the map [m2]; a table in nowhere is no room

Cells = NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Rooms:
    """R rooms, the largest first."""

    room_of: NDArray[np.int32]  # (N,) int32, room of each object; -1: none
    areas: Floats  # (R,) free floor [m2], under furniture too
    cells: Cells  # (nx, ny) int32, room of each cell of the floor; -1: none
    origin: Floats  # (2,) lower corner of cell (0, 0) [m]
    cell: float  # Side of a cell [m]

    def __len__(self) -> int:
        return len(self.areas)

    def __repr__(self) -> str:
        areas = ", ".join(f"{area:.1f}" for area in self.areas)
        return f"Rooms({len(self)} of {areas} m2)" if len(self) else "Rooms(none)"

    def at(self, points: ArrayLike) -> NDArray[np.int32]:
        """Return room (K,) of the floor under points (K, 2 or 3) [m]; -1: none."""
        xy = np.asarray(points, np.float64)[:, :2]
        x, y = np.floor((xy - self.origin) / self.cell).astype(np.int64).T
        inside = (x >= 0) & (y >= 0) & (x < self.cells.shape[0]) & (y < self.cells.shape[1])
        room = np.full(len(xy), -1, np.int32)
        room[inside] = self.cells[x[inside], y[inside]]
        return room

    def attributes(self) -> list[dict[str, str]]:
        """Return (N,) what a map's attributes say: the number of each object's room, from "1" on."""
        return [{"room": str(room + 1)} if room >= 0 else {} for room in self.room_of.tolist()]


def assign_rooms(
    mesh: Mesh, labels: Sequence[str], floor: float, attributes: Sequence[Mapping[str, str]]
) -> tuple[NDArray[np.int32], list[dict[str, str]]]:
    """Return room of each object (N,), -1 none, and attributes (N,) that say so under "room".

    As the attributes name rooms already, if any does; else as `find_rooms` finds them.
    """
    named = [a.get("room", "") for a in attributes]
    if any(named):
        number = {name: i for i, name in enumerate(sorted({*named} - {""}))}
        given = np.array([number.get(name, -1) for name in named], np.int32)
        return given, [dict(a) for a in attributes]
    rooms = find_rooms(mesh, labels, floor)
    both = zip(attributes, rooms.attributes(), strict=True)
    return rooms.room_of, [{**old, **new} for old, new in both]


def find_rooms(mesh: Mesh, labels: Sequence[str], floor: float) -> Rooms:
    """Return rooms of a mesh of N objects.

    `mesh`: triangles of the objects, z up, metres.
    `labels`: of the N objects.
    `floor`: height of the floor [m, map]. Of several storeys it is this one's rooms that are found.
    """
    corners, normals = mesh.vertices[mesh.triangles], mesh.normals()
    corners[:, :, 2] -= floor
    near = (corners[:, :, 2].min(axis=1, initial=np.inf) < _STOREY) & (
        corners[:, :, 2].max(axis=1, initial=-np.inf) > -BELOW
    )
    grid = make_grid(corners[near])
    if grid is None:
        none = np.full(len(labels), -1, np.int32)
        return Rooms(none, np.zeros(0), np.full((1, 1), -1, np.int32), np.zeros(2), CELL)
    walls = find_wall_cells(mesh, labels, corners, grid)
    floor_cells, ground = find_ground_cells(normals, corners, walls, grid)
    cells = _segment_rooms(ground & ~walls, floor_cells, grid)
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
        number = kernels.distance_transform(rooms.cells >= 0, int(REACH / rooms.cell))[1]
        within = np.where(number >= 0, rooms.cells.reshape(-1)[number], np.int32(-1))
        votes = np.zeros((len(labels), len(rooms) + 1))
        kernels.sum_areas(corners, areas, mesh.object_of, rooms.origin, rooms.cell, within, votes)
        best = votes[:, :-1].argmax(axis=1)
        share = votes[np.arange(len(labels)), best] / np.maximum(votes.sum(axis=1), 1e-12)
        needed = np.where(is_structural(labels), _MOSTLY, _PARTLY)
        rooms.room_of[:] = np.where(share >= needed, best, -1).astype(np.int32)
    return rooms


def _segment_rooms(free: Mask, floor: Mask, grid: Grid) -> Cells:
    """Return number (nx, ny) of the room of each free cell; -1: none."""
    squared = kernels.distance_transform(~free, int(_WIDEST / 2.0 / grid.cell))[0]
    width = np.sqrt(squared) * grid.cell
    chosen = np.flatnonzero(free)
    # numbers of 16 bits are sorted by their digits
    order = chosen[np.argsort(-squared.reshape(-1)[chosen].astype(np.int16), kind="stable")]
    basin, meetings = kernels.flood_basins(
        width, order, MIN_ROOM_WIDTH / 2.0, NARROW, DOOR / 2.0, NARROW_DOOR
    )
    flat = basin.reshape(-1)
    roots = np.flatnonzero(flat == np.arange(flat.size))
    index = np.full(flat.size, -1)
    index[roots] = np.arange(len(roots))
    own = np.where(flat >= 0, index[flat], -1)
    sizes = _measure_areas(own, len(roots), grid)
    owner = _merge_basins(sizes, list(dict.fromkeys(map(tuple, index[meetings].tolist()))))
    wide = width.reshape(-1)[roots] >= MIN_ROOM_WIDTH / 2.0
    seen = np.bincount(owner, _measure_areas(own[floor.reshape(-1)], len(roots), grid), len(roots))
    kept = wide & (sizes >= MIN_ROOM_AREA) & (seen >= _SEEN) & (owner == np.arange(len(owner)))
    number = np.append(np.where(kept, np.cumsum(kept) - 1, -1)[owner], -1)
    return number[own].reshape(basin.shape).astype(np.int32)


def _measure_areas(own: NDArray[np.int64], count: int, grid: Grid) -> Floats:
    """Return area (count,) [m2] of cells by their number; -1: of none."""
    cells = np.bincount(own[own >= 0], minlength=count)
    return cells.astype(np.float64) * grid.cell**2


def _merge_basins(sizes: Floats, meetings: list[tuple[int, ...]]) -> NDArray[np.int64]:
    """Return basin that each basin becomes part of; `sizes` [m2] are added up.

    What is too small joins the one that it has the widest pass to, the smallest first.
    """
    owner = np.arange(len(sizes))
    for i in np.argsort(sizes, kind="stable").tolist():
        if sizes[i] >= MIN_ROOM_AREA:
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


_HIGHEST = 3.0  # what is higher above a floor is in none of its rooms [m]


def find_room_name(scene: Scene, point: ArrayLike) -> str:
    """Return name of the room in which a point (3,) x, y, z [m] lies; empty: in none, or rooms have no names.

    A room has the name that most things in it say.
    """
    x, y, z = np.asarray(point, np.float64).tolist()
    _, floor = find_storey(scene, point)
    if not -0.5 <= z - floor <= _HIGHEST or not any("room" in a for a in scene.attributes):
        return ""
    rooms, names = scene.compute_once(("rooms", floor), lambda s: _name_rooms(s, floor))
    room = int(rooms.at([(x, y)])[0])
    return names[room] if room >= 0 else ""


def most_common_name(names: Sequence[str]) -> str:
    """Return the name that most things have, the first of several; things without one have no say."""
    given = sorted({name for name in names if name})
    return max(given, key=names.count, default="")


def _name_rooms(scene: Scene, floor: float) -> tuple[Rooms, list[str]]:
    graph = scene.graph
    rooms = find_rooms(scene.mesh, graph.labels, floor)
    is_movable = ~is_structural(graph.labels)
    names = []
    for room in range(len(rooms)):
        members = np.flatnonzero(is_movable & (rooms.room_of == room)).tolist()
        names.append(most_common_name([scene.attributes[i].get("room", "") for i in members]))
    return rooms, names
