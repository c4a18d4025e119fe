"""The shell of a drawn flat: walls in stretches, floors, ceilings, windows and doors.

A stretch is a straight run of one room's wall; what stands in the wall leaves a hole in it, which
the opening's own reveal closes. All vertical edges have the same breaks, so that no ray passes
between two stretches.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np

from placegraph.errors import InputError
from placegraph_lab.worlds.drawing import EAST, NORTH, SOUTH, WEST, Cell, step
from placegraph_lab.worlds.flat.flat import DOOR, SOLID, WINDOW, Blot, Flat, Room
from placegraph_lab.worlds.flat.furniture import Floats, Part, Size, box, quad
from placegraph_lab.worlds.flat.textures import Material

CASING = 0.07  # width of the boards around an opening [m]
BOARD = 0.015  # how far they stand out of the wall [m]
SEAM = (
    0.005  # how far floors and ceilings reach under walls, so that no ray passes between them [m]
)


@dataclass(frozen=True, eq=False)
class Piece:
    """A thing before it is numbered and painted."""

    label: str
    room: str
    parts: list[Part]
    emission: float = 0.0  # how brightly it shines of itself
    lamp: Floats | None = None  # where the light that it gives starts from (3,) [m]
    is_window: bool = False


@dataclass(frozen=True, eq=False)
class Hole:
    """An opening in its wall: rectangle x0, y0, x1, y1 [m], heights [m], direction of passage."""

    blot: Blot
    rectangle: tuple[float, float, float, float]
    heights: tuple[float, float]
    through_y: bool  # whether it leads up and down the page; else from left to right
    rooms: tuple[int, int]  # entries of `Flat.room_of` below and above, or right and left


def shell(flat: Flat) -> list[Piece]:
    """Floors and ceilings, walls, windows and doors of a flat.

    Raises `InputError`: an opening does not lead straight through one wall.
    """
    holes = [_hole(flat, blot) for blot in flat.openings]
    levels = sorted({0.0, flat.height, *(z for hole in holes for z in hole.heights)})
    hole_at = {cell: hole for hole in holes for cell in hole.blot.cells}
    pieces = []
    for index, room in enumerate(flat.rooms):
        pieces += [_slab(flat, room, "floor"), _slab(flat, room, "ceiling")]
        pieces += [
            _stretch(flat, room, side, line, run, hole_at, levels)
            for side, line, run in _runs(flat, index)
        ]
    return pieces + [_opening(flat, hole, levels) for hole in holes]


def rectangles(flat: Flat, cells: Iterable[Cell]) -> list[tuple[float, float, float, float]]:
    """Rectangles x0, y0, x1, y1 [m] that tile cells: runs of a row, joined to equal ones below."""
    spans: dict[tuple[int, int], list[int]] = defaultdict(list)
    for row, line in groupby(sorted(cells), key=lambda cell: cell[0]):
        for columns in _straight([column for _, column in line]):
            spans[columns[0], columns[-1] + 1].append(row)
    found = []
    for (left, right), lines in sorted(spans.items(), key=lambda item: (item[1][0], item[0])):
        for rows in _straight(lines):
            x0, y0 = flat.corner(rows[-1] + 1, left)
            x1, y1 = flat.corner(rows[0], right)
            found.append((x0, y0, x1, y1))
    return found


def _straight(numbers: list[int]) -> Iterator[list[int]]:
    """Split ascending numbers into runs of neighbours."""
    run: list[int] = []
    for number in numbers:
        if run and number != run[-1] + 1:
            yield run
            run = []
        run.append(number)
    yield run


def _slab(flat: Flat, room: Room, which: str) -> Piece:
    """Floor or ceiling of a room; the texture covers the room once."""
    tiles = [
        (x0 - SEAM, y0 - SEAM, x1 + SEAM, y1 + SEAM)
        for x0, y0, x1, y1 in rectangles(flat, room.cells)
    ]
    x0, y0 = (min(t[k] for t in tiles) for k in (0, 1))
    x1, y1 = (max(t[k] for t in tiles) for k in (2, 3))
    size = (x1 - x0, y1 - y0)
    parts = []
    for left, low, right, high in tiles:
        wide, deep = (right - left, 0, 0), (0, high - low, 0)
        if which == "floor":
            part = quad((left, low, 0), wide, deep, room.symbol.materials["floor"], size)
            shift = (left - x0, y1 - high)
        else:
            back = (0, low - high, 0)
            part = quad(
                (left, high, flat.height), wide, back, room.symbol.materials["ceiling"], size
            )
            shift = (left - x0, low - y0)
        part.uv[:] += np.array(shift) / size
        parts.append(part)
    return Piece(which, room.name, parts)


# ---------------------------------------------------------------------------------------- walls


def _runs(flat: Flat, index: int) -> Iterator[tuple[Cell, int, list[int]]]:
    """Straight walls of a room: the side of the floor they are on, row or column, and cells."""
    lines: dict[tuple[Cell, int], list[int]] = defaultdict(list)
    for row, column in sorted(flat.rooms[index].cells):
        for side in (NORTH, EAST, SOUTH, WEST):
            if flat.room_of[step((row, column), side)] == SOLID:
                key, at = (row, column) if side in (NORTH, SOUTH) else (column, row)
                lines[side, key].append(at)
    for (side, key), places in lines.items():
        for run in _straight(places):
            yield side, key, run


def _stretch(
    flat: Flat,
    room: Room,
    side: Cell,
    line: int,
    run: list[int],
    hole_at: dict[Cell, Hole],
    levels: list[float],
) -> Piece:
    """One straight wall of a room, with a gap for every opening in it."""

    def behind(at: int) -> Hole | None:
        cell = (line, at) if side in (NORTH, SOUTH) else (at, line)
        return hole_at.get(step(cell, side))

    far = side in (SOUTH, EAST)  # the wall is at the cell's lower or right edge

    def place(at: int) -> np.ndarray:
        row, column = (line + far, at) if side in (NORTH, SOUTH) else (at, line + far)
        return np.array([*flat.corner(row, column), 0.0])

    breaks = [run[0], *(b for a, b in pairwise(run) if behind(a) is not behind(b)), run[-1] + 1]
    # As seen from the room, the wall runs from left to right: with the rows or against them.
    ends = list(pairwise(breaks)) if side in (NORTH, EAST) else list(pairwise(breaks[::-1]))
    start, finish = place(ends[0][0]), place(ends[-1][1])
    size: Size = (float(np.linalg.norm(finish - start)), flat.height)
    parts = []
    for first, last in ends:
        hole = behind(min(first, last))
        left, right = place(first), place(last)
        for low, high in pairwise(levels):
            if hole and hole.heights[0] <= low and high <= hole.heights[1]:
                continue
            up = np.array([0.0, 0.0, high - low])
            part = quad(
                left + np.array([0.0, 0.0, low]),
                right - left,
                up,
                room.symbol.materials["walls"],
                size,
            )
            offset = np.linalg.norm(left - start), flat.height - high
            part.uv[:] += np.array(offset) / size
            parts.append(part)
    return Piece("wall", room.name, parts)


# ------------------------------------------------------------------------------------- openings


def _hole(flat: Flat, blot: Blot) -> Hole:
    """Find how an opening leads through its wall."""
    rows, columns = (sorted({cell[k] for cell in blot.cells}) for k in (0, 1))
    where = flat.where(blot.own)
    if len(rows) * len(columns) != len(blot.cells):
        raise InputError(f"{where}: this {blot.symbol.kind} is not a rectangle; draw it straight.")
    around = {
        SOUTH: {_room(flat, (rows[-1] + 1, c)) for c in columns},
        NORTH: {_room(flat, (rows[0] - 1, c)) for c in columns},
        WEST: {_room(flat, (r, columns[0] - 1)) for r in rows},
        EAST: {_room(flat, (r, columns[-1] + 1)) for r in rows},
    }
    walled = {side for side, found in around.items() if found == {SOLID}}
    if walled not in ({WEST, EAST}, {NORTH, SOUTH}):
        raise InputError(
            f"{where}: this {blot.symbol.kind} leads through no wall; draw it with wall (#) at "
            "two opposite ends, and floor or the outside at the other two."
        )
    through_y = walled == {WEST, EAST}
    sides = (SOUTH, NORTH) if through_y else (EAST, WEST)  # y of the opening's own frame
    if any(len(around[side]) > 1 for side in sides):
        raise InputError(
            f"{where}: this {blot.symbol.kind} opens to more than one room, or to wall and room, "
            "on one side; draw it narrower, or split it."
        )
    base = blot.symbol.base or 0.0
    top = base + blot.symbol.height
    if top >= flat.height:
        raise InputError(
            f"{where}: this {blot.symbol.kind} ends {top:g} m above the floor of a room "
            f"{flat.height:g} m high; make its height less."
        )
    return Hole(
        blot,
        rectangles(flat, blot.cells)[0],
        (base, top),
        through_y,
        (next(iter(around[sides[0]])), next(iter(around[sides[1]]))),
    )


def _room(flat: Flat, cell: Cell) -> int:
    inside = 0 <= cell[0] < len(flat.rows) and 0 <= cell[1] < len(flat.rows[0])
    return int(flat.room_of[cell]) if inside else -1


def _opening(flat: Flat, hole: Hole, levels: list[float]) -> Piece:
    """Reveal, boards around it, and the pane or leaf in it."""
    symbol = hole.blot.symbol
    x0, y0, x1, y1 = hole.rectangle
    wide, thick = (x1 - x0, y1 - y0) if hole.through_y else (y1 - y0, x1 - x0)
    low, high = hole.heights
    parts = _reveal(wide, thick, [z for z in levels if low <= z <= high], symbol.materials["trim"])
    for room, near in zip(hole.rooms, (True, False), strict=True):
        if room >= 0:
            parts += _casing(wide, thick, low, high, symbol.materials["trim"], near=near)
    if symbol.kind in (WINDOW, DOOR):
        middle = thick / 2
        if symbol.kind == WINDOW:  # towards the outside
            middle = thick * (0.7 if hole.rooms[1] < 0 else 0.3)
        half = min(0.02, thick / 4)
        pane = symbol.materials["look"]
        parts += [
            quad((0, middle - half, low), (wide, 0, 0), (0, 0, high - low), pane, None),
            quad((wide, middle + half, low), (-wide, 0, 0), (0, 0, high - low), pane, None),
        ]
    if symbol.kind == DOOR:
        for y in (middle - half - 0.05, middle + half):
            parts += box(
                (wide - 0.12, y, 1.03), (wide - 0.06, y + 0.05, 1.06), symbol.materials["trim"]
            )
    inner = [flat.rooms[r].name for r in hole.rooms if r >= 0]
    origin, rotation = _frame(hole)
    turned = [part.transform(rotation, origin) for part in parts]
    if symbol.kind != WINDOW:
        return Piece(symbol.label, inner[0] if inner else "", turned)
    light = (wide / 2, -0.4 if hole.rooms[0] >= 0 else thick + 0.4, (low + high) / 2)
    lamp = rotation @ light + origin
    return Piece(symbol.label, inner[0] if inner else "", turned, 1.0, lamp, is_window=True)


def _frame(hole: Hole) -> tuple[Floats, Floats]:
    """Origin and rotation on the page of the opening's frame: x along the wall, y through it."""
    x0, y0, x1, _ = hole.rectangle
    if hole.through_y:
        return np.array([x0, y0, 0.0]), np.eye(3)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return np.array([x1, y0, 0.0]), quarter


def _reveal(wide: float, thick: float, levels: list[float], material: Material) -> list[Part]:
    """Jambs, head and sill, seen from within the opening."""
    through, along = np.array([0.0, thick, 0.0]), np.array([wide, 0.0, 0.0])
    size = (1.0, 1.0)
    parts = [
        quad((0, 0, levels[0]), along, through, material, size),
        quad((0, thick, levels[-1]), along, -through, material, size),
    ]
    for low, high in pairwise(levels):
        up = (0.0, 0.0, high - low)
        parts.append(quad((0, 0, low), through, up, material, size))
        parts.append(quad((wide, thick, low), -through, up, material, size))
    return parts


def _casing(
    wide: float, thick: float, low: float, high: float, material: Material, *, near: bool
) -> list[Part]:
    """Boards around the opening on one face of the wall."""
    y0, y1 = (-BOARD, 0.0) if near else (thick, thick + BOARD)
    boards = [((-CASING, y0, low), (0, y1, high)), ((wide, y0, low), (wide + CASING, y1, high))]
    boards.append(((-CASING, y0, high), (wide + CASING, y1, high + CASING)))
    if low > 0.0:
        boards.append(((-CASING, y0, low - CASING), (wide + CASING, y1, low)))
    return [part for a, b in boards for part in box(a, b, material)]
