"""Floor plans of homes: rectangular rooms side by side, with doors and windows in their walls.

A cell is a character of `CELL` metres; rectangles are half open: top, left, bottom, right.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph_lab.worlds.home.catalogue import ROOMS, RoomKind

CELL = 0.125
"""Side of a character [m]."""
SHARED = 13
"""Cells of wall that neighbours share at least: enough for a door."""
SIDES = ("north", "east", "south", "west")
OPPOSITE = dict(zip(SIDES, ("south", "west", "north", "east"), strict=True))
CORNER = 2
"""Cells between a corner and an opening."""


class Box(NamedTuple):
    """Cells of a rectangle."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def rows(self) -> slice:
        """Of the page."""
        return slice(self.top, self.bottom)

    @property
    def columns(self) -> slice:
        """Of the page."""
        return slice(self.left, self.right)

    def span(self, side: str) -> tuple[int, int]:
        """First and last cell but one along a side."""
        across = side in {"north", "south"}
        return (self.left, self.right) if across else (self.top, self.bottom)

    def inward(self, side: str, at: int, width: int, depth: int, *, gap: int = 0) -> Box:
        """Box within this one, `gap` cells from a side, from cell `at` on along it."""
        if side == "north":
            return Box(self.top + gap, at, self.top + gap + depth, at + width)
        if side == "south":
            return Box(self.bottom - gap - depth, at, self.bottom - gap, at + width)
        if side == "west":
            return Box(at, self.left + gap, at + width, self.left + gap + depth)
        return Box(at, self.right - gap - depth, at + width, self.right - gap)

    def outward(self, side: str, at: int, width: int, depth: int, *, gap: int = 0) -> Box:
        """Box outside of this one, beyond a side."""
        return self.inward(side, at, width, depth, gap=-gap - depth)

    def grown(self, cells: int) -> Box:
        """Larger box."""
        return Box(self.top - cells, self.left - cells, self.bottom + cells, self.right + cells)

    def meets(self, other: Box) -> bool:
        """Whether two boxes share a cell."""
        return (
            self.top < other.bottom
            and other.top < self.bottom
            and self.left < other.right
            and other.left < self.right
        )

    def moved(self, down: int, right: int) -> Box:
        """Box elsewhere on the page."""
        return Box(self.top + down, self.left + right, self.bottom + down, self.right + right)


class Opening(NamedTuple):
    """A door, doorway or window in a wall of a room."""

    glyph: str
    side: str
    box: Box


@dataclass(frozen=True, slots=True)
class Area:
    """A room: its kind, its floor, what opens into it."""

    kind: str
    floor: Box
    openings: list[Opening] = field(default_factory=list)

    @property
    def of(self) -> RoomKind:
        """What is known of rooms of this kind."""
        return ROOMS[self.kind]


@dataclass(frozen=True, slots=True)
class Plan:
    """A page (rows, columns) of characters with walls and openings, and its rooms."""

    page: NDArray[np.str_]
    areas: tuple[Area, ...]


def plan(kinds: tuple[str, ...], rng: np.random.Generator) -> Plan:
    """Draw rooms of these kinds, every one but the first beside an earlier one."""
    floors = [_sized(kinds[0], rng)]
    doors = []
    for kind in kinds[1:]:
        floor, door = _beside(floors, _sized(kind, rng), rng)
        doors.append((*door, len(floors)))
        floors.append(floor)
    top, left = (min(f[k] for f in floors) - 1 for k in (0, 1))
    areas = tuple(
        Area(kind, floor.moved(-top, -left)) for kind, floor in zip(kinds, floors, strict=True)
    )
    page = np.full(
        (max(a.floor.bottom for a in areas) + 1, max(a.floor.right for a in areas) + 1), " "
    )
    for area in areas:
        page[area.floor.grown(1).rows, area.floor.grown(1).columns] = "#"
    for area in areas:
        page[area.floor.rows, area.floor.columns] = " "
    for one, side, other in doors:
        _doorway(page, areas[one], side, areas[other], rng)
    # who lives there comes in by the hall, or by whatever room has an outer wall
    for area in sorted(areas, key=lambda a: a.kind != "hall"):
        if _outer(page, areas, area, "+", (7, 8), rng):
            break
    for area in areas:
        for _ in range(area.of.windows):
            if rng.random() < (0.6 if area.of.wet else 0.9):
                _outer(page, areas, area, "=", (8, 16), rng)
    return Plan(page, areas)


def rooms_of(style: str, rng: np.random.Generator) -> tuple[str, ...]:
    """One to three rooms that go together."""
    count = int(rng.choice([1, 2, 3], p=[0.45, 0.43, 0.12]))
    kinds = [kind for kind in ROOMS if (kind != "office") or style == "office"]
    weights = np.array([0.5 if kind == "hall" else 1.0 for kind in kinds])
    if style == "office":
        weights[kinds.index("office")] = 8.0
        weights[[kinds.index(k) for k in ("bedroom", "living room")]] = 0.0
    chosen = rng.choice(len(kinds), size=count, replace=False, p=weights / weights.sum())
    return tuple(kinds[i] for i in chosen)


def _sized(kind: str, rng: np.random.Generator) -> Box:
    """Floor of a room at the origin."""
    short = rng.uniform(*ROOMS[kind].side)
    sides = [round(short / CELL), round(short * rng.uniform(*ROOMS[kind].stretch) / CELL)]
    rng.shuffle(sides)
    return Box(0, 0, sides[0], sides[1])


def _beside(floors: list[Box], fresh: Box, rng: np.random.Generator) -> tuple[Box, tuple[int, str]]:
    """Where a floor can go, flush with an earlier one; and which, on which of its sides."""
    while True:  # the outermost side of the outermost room is always free
        which, side = int(rng.integers(len(floors))), str(rng.choice(SIDES))
        first, last = floors[which].span(side)
        across = side in {"north", "south"}
        width, depth = (fresh.right, fresh.bottom) if across else (fresh.bottom, fresh.right)
        at = int(rng.integers(first + SHARED - width, last - SHARED + 1))
        found = floors[which].outward(side, at, width, depth, gap=1)
        if not any(found.grown(1).meets(floor) for i, floor in enumerate(floors) if i != which):
            return found, (which, side)


def _doorway(
    page: NDArray[np.str_], one: Area, side: str, other: Area, rng: np.random.Generator
) -> None:
    spans = one.floor.span(side), other.floor.span(side)
    first, last = max(s[0] for s in spans) + CORNER, min(s[1] for s in spans) - CORNER
    wide = rng.random() < 0.3 and last - first > 16
    width = int(rng.integers(12, min(18, last - first) + 1)) if wide else int(rng.integers(8, 10))
    width = min(width, last - first)
    at = int(rng.integers(first, last - width + 1))
    hole = one.floor.outward(side, at, width, 1)
    page[hole.rows, hole.columns] = ":"
    one.openings.append(Opening(":", side, hole))
    other.openings.append(Opening(":", OPPOSITE[side], hole))


def _outer(
    page: NDArray[np.str_],
    areas: tuple[Area, ...],
    area: Area,
    glyph: str,
    widths: tuple[int, int],
    rng: np.random.Generator,
) -> bool:
    """Put an opening into a wall with nothing behind it; returns whether there was one."""
    for _ in range(12):
        side, width = str(rng.choice(SIDES)), int(rng.integers(widths[0], widths[1] + 1))
        first, last = area.floor.span(side)
        if last - first < width + 2 * CORNER:
            continue
        at = int(rng.integers(first + CORNER, last - width - CORNER + 1))
        hole = area.floor.outward(side, at, width, 1)
        behind = area.floor.outward(side, at - 1, width + 2, 3)
        taken = [o.box for o in area.openings] + [a.floor for a in areas]
        if any(behind.grown(CORNER).meets(box) for box in taken if box != area.floor):
            continue
        page[hole.rows, hole.columns] = glyph
        area.openings.append(Opening(glyph, side, hole))
        return True
    return False
