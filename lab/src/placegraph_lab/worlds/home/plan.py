"""Floor plans of homes: rectangular rooms side by side, with doors and windows in their walls.

A cell is a character of `CELL` metres; rectangles are half open: top, left, bottom, right.
"""

from __future__ import annotations

import string
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph_lab.worlds.home.change import (
    KINDS,
    ROOMS,
    SYNONYMS,
    Items,
    Kind,
    RoomKind,
    Style,
)

CELL = 0.125  # side of a character [m]
SHARED = 13  # cells of wall that neighbours share at least: enough for a door
SIDES = ("north", "east", "south", "west")
OPPOSITE = dict(zip(SIDES, ("south", "west", "north", "east"), strict=True))
CORNER = 2  # cells between a corner and an opening


class Box(NamedTuple):
    """Cells of a rectangle."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def rows(self) -> slice:
        """Rows on the page."""
        return slice(self.top, self.bottom)

    @property
    def columns(self) -> slice:
        """Columns on the page."""
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

    def grow(self, cells: int) -> Box:
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

    def move(self, down: int, right: int) -> Box:
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
        """Properties of rooms of this kind."""
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
        Area(kind, floor.move(-top, -left)) for kind, floor in zip(kinds, floors, strict=True)
    )
    page = np.full(
        (max(a.floor.bottom for a in areas) + 1, max(a.floor.right for a in areas) + 1), " "
    )
    for area in areas:
        page[area.floor.grow(1).rows, area.floor.grow(1).columns] = "#"
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
    """Return a position of a floor beside an earlier one, and which one and side."""
    while True:  # the outermost side of the outermost room is always free
        which, side = int(rng.integers(len(floors))), str(rng.choice(SIDES))
        first, last = floors[which].span(side)
        across = side in {"north", "south"}
        width, depth = (fresh.right, fresh.bottom) if across else (fresh.bottom, fresh.right)
        at = int(rng.integers(first + SHARED - width, last - SHARED + 1))
        found = floors[which].outward(side, at, width, depth, gap=1)
        if not any(found.grow(1).meets(floor) for i, floor in enumerate(floors) if i != which):
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
        if any(behind.grow(CORNER).meets(box) for box in taken if box != area.floor):
            continue
        page[hole.rows, hole.columns] = glyph
        area.openings.append(Opening(glyph, side, hole))
        return True
    return False


GLYPHS = string.ascii_letters + "*%&$@!?<>^~|+/;,_"  # one for every thing that stands alone
BEFORE_DOORS = 6  # cells that stay free before a door or doorway
ELBOW = 2  # cells of free floor at either side of who walks
MOST = (18, 10, 6)  # things of a room in a home of one, two, three rooms
TRIES = 14  # places that are tried for a thing
LOW = 0.8  # what is no higher may stand before a window [m]
CHIEF = 0.75  # what is at least as likely is placed first
OWN = 0.2  # share of things that are not of the style: what people brought along

_COLOURS = ("#7d3b33", "#35618e", "#3f6b5c", "#6a5a7d", "#c99e68", "#2b2d33", "#a9883f", "#8a8f94")


class Furnisher:
    """Draws things on a plan's page and writes their legend.

    `plan`: rooms; its page is drawn on; `style`: looks; `rng`: draws everything.
    """

    def __init__(self, plan: Plan, style: Style, rng: np.random.Generator) -> None:
        self.page = plan.page
        self.legend: list[str] = []
        self.blocked = np.ones(plan.page.shape, bool)  # for who walks
        self.kept = np.zeros(plan.page.shape, bool)
        self.words = {plain: str(rng.choice(words)) for plain, words in SYNONYMS.items()}
        self._style, self._rng = style, rng
        self._glyphs = list(GLYPHS)
        self._end = 0  # of the legend, once a room is full
        self._most = MOST[len(plan.areas) - 1]
        for area in plan.areas:
            self.blocked[area.floor.rows, area.floor.columns] = False
            for opening in area.openings:
                self.blocked[opening.box.rows, opening.box.columns] = opening.glyph != ":"
                if opening.glyph != "=":
                    self._keep_free(area, opening.side, opening.box)

    def furnish(self, area: Area) -> None:
        """Place the things of a room: what makes it that kind of room first, then the rest."""
        likely = {some.what for some in area.of.objects if some.chance >= CHIEF}
        wanted = [what for what, count in self._drawn(area.of.objects) for _ in range(count)]
        order = self._rng.permutation(len(wanted)).tolist()
        self._end = len(self.legend) + self._most
        for i in sorted(order, key=lambda i: wanted[i] not in likely):
            self._place(wanted[i], area)

    # ------------------------------------------------------------------------------- places

    def _place(self, what: str, area: Area) -> None:
        kind = KINDS[what]
        size = self._size(kind)
        for _ in range(TRIES):
            box, facing = self._somewhere(kind, size, area)
            if self._has_space(kind, box, area, size[2]) and self._walkable(kind, box):
                self._put(what, box, facing, size[2], area)
                return

    def _somewhere(self, kind: Kind, size: tuple[int, int, float], area: Area) -> tuple[Box, str]:
        """Box and direction of a thing against a wall, or anywhere."""
        rng, floor = self._rng, area.floor
        width, depth, _ = size
        side = str(rng.choice(SIDES))
        if kind.place in {"middle", "ceiling"}:
            down, right = (depth, width) if side in {"north", "south"} else (width, depth)
            rows, columns = floor.bottom - floor.top - down, floor.right - floor.left - right
            if min(rows, columns) < 0:
                return floor, side
            corner = [
                (int(rng.integers(0, n // 2 + 1)) + int(rng.integers(0, n - n // 2 + 1)))
                for n in (rows, columns)
            ]
            top, left = floor.top + corner[0], floor.left + corner[1]
            return Box(top, left, top + down, left + right), side
        first, last = floor.span(side)
        if last - first < width:
            return floor, side
        at = int(rng.integers(first, last - width + 1))
        if rng.random() < 0.3:  # into a corner
            at = int(rng.choice([first, last - width]))
        return floor.inward(side, at, width, depth), OPPOSITE[side]

    def _has_space(self, kind: Kind, box: Box, area: Area, height: float) -> bool:
        if box == area.floor or not (
            area.floor.top <= box.top
            and area.floor.left <= box.left
            and box.bottom <= area.floor.bottom
            and box.right <= area.floor.right
        ):
            return False
        if (self.page[box.rows, box.columns] != " ").any():
            return False
        if kind.place == "ceiling":
            return True
        hung = kind.place == "hung"
        if not hung and self.kept[box.rows, box.columns].any():
            return False
        near = [o for o in area.openings if o.box.grow(1).meets(box)]
        return not near if hung else all(o.glyph == "=" and height <= LOW for o in near)

    def _walkable(self, kind: Kind, box: Box) -> bool:
        """Whether who walks still gets everywhere, once a box is taken."""
        if kind.place in {"hung", "ceiling"} or kind.model == "rug":
            return True
        taken = self.blocked.copy()
        taken[box.rows, box.columns] = True
        return _connected(taken)

    # -------------------------------------------------------------------------- what is put

    def _put(
        self,
        what: str,
        box: Box,
        facing: str,
        height: float,
        area: Area,
        *,
        host: str = "",
        faces: str = "",
    ) -> None:
        """Draw a thing, if the room is to hold another one, and what comes with it."""
        if len(self.legend) >= self._end:
            return
        glyph = self._glyphs.pop(0)
        kind = KINDS[what]
        self.page[box.rows, box.columns] = glyph
        if kind.place not in {"hung", "ceiling", "on"} and kind.model != "rug":
            self.blocked[box.rows, box.columns] = True
        self.legend.append(self._line(glyph, what, height, faces or facing, host))
        self._accompany(glyph, kind, box, facing, area)

    def _accompany(self, glyph: str, kind: Kind, box: Box, facing: str, area: Area) -> None:
        for what, count in self._drawn(kind.on):
            for _ in range(count):
                self._put_on(what, glyph, box, facing, area)
        for what, count in self._drawn(kind.front):
            for _ in range(count):
                self._put_before(what, glyph, box, facing, area)
        for what, count in self._drawn(kind.beside):
            for _ in range(count):
                self._put_beside(what, box, facing, area)
        for what, chance, most in kind.around:
            for _ in range(int(self._rng.binomial(most, chance))):
                side = str(self._rng.choice(SIDES))
                self._put_before(what, glyph, box, side, area)

    def _put_on(self, what: str, glyph: str, box: Box, facing: str, area: Area) -> None:
        """On a thing, over it, or on the wall behind it."""
        kind, rng = KINDS[what], self._rng
        size = self._size(kind)
        back = OPPOSITE[facing]
        first, last = box.span(back)
        deep = box.bottom - box.top if back in {"north", "south"} else box.right - box.left
        width, depth = min(size[0], last - first), min(size[1], deep)
        if width * depth >= (last - first) * deep or width < round(kind.width[0] / CELL) - 1:
            return
        for _ in range(TRIES):
            at = int(rng.integers(first, last - width + 1))
            gap = 0 if kind.place in {"on", "hung"} else (deep - depth) // 2
            if kind.place == "ceiling":
                at = (first + last - width) // 2
            spot = box.inward(back, at, width, depth, gap=gap)
            on_it = (self.page[spot.rows, spot.columns] == glyph).all()
            if on_it and (kind.place != "middle" or self._walkable(kind, spot)):
                self._put(what, spot, facing, size[2], area, host=glyph)
                return

    def _put_before(self, what: str, glyph: str, box: Box, side: str, area: Area) -> None:
        """At a side of a thing, looking at it."""
        kind, rng = KINDS[what], self._rng
        size = self._size(kind)
        first, last = box.span(side)
        gap = 3 if kind.model == "table" else 0
        for _ in range(TRIES // 2):
            low, high = sorted((first, last - size[0]))
            spot = box.outward(side, int(rng.integers(low, high + 1)), *size[:2], gap=gap)
            if self._has_space(kind, spot, area, size[2]) and self._walkable(kind, spot):
                faces = glyph if kind.model == "chair" else ""
                self._put(what, spot, OPPOSITE[side], size[2], area, faces=faces)
                return

    def _put_beside(self, what: str, box: Box, facing: str, area: Area) -> None:
        """At one end of a thing, its back to the same wall."""
        kind = KINDS[what]
        size = self._size(kind)
        back = OPPOSITE[facing]
        first, last = box.span(back)
        for at in self._rng.permutation([first - size[0], last]).tolist():
            spot = box.inward(back, int(at), *size[:2])
            if self._has_space(kind, spot, area, size[2]) and self._walkable(kind, spot):
                self._put(what, spot, facing, size[2], area)
                return

    # --------------------------------------------------------------------------------- small

    def _drawn(self, some: Iterable[Items]) -> list[tuple[str, int]]:
        """Draw the number of things of each kind."""
        found = []
        for what, chance, most in some:
            count = int(self._rng.random() < chance)
            while 0 < count < most and self._rng.random() < 0.5:
                count += 1
            found.append((what, count))
        return found

    def _size(self, kind: Kind) -> tuple[int, int, float]:
        """Cells along the back and to the front, and height [m]."""
        width, depth = (self._rng.uniform(*given) for given in (kind.width, kind.depth))
        height = round(float(self._rng.uniform(*kind.height)), 3)
        return max(1, round(width / CELL)), max(1, int(np.ceil(depth / CELL - 0.3))), height

    def _line(self, glyph: str, what: str, height: float, faces: str, host: str) -> str:
        """One line of the legend."""
        kind = KINDS[what]
        words = [f"{glyph} {kind.model}: label={self.words.get(what, what)} height={height:g}"]
        if kind.base is not None:
            words.append(f"base={kind.base:g}")
        if kind.place in {"wall", "hung"} or what == "wall cupboard":
            words.append(f"depth={self._rng.uniform(*kind.depth):.2f}")
        words.append(f"faces={faces}")
        words += [f"in={host}"] * bool(host)
        own = self._rng.random() < OWN and kind.material in {"fabric", "second", "wood"}
        material = self._material(kind.material)
        if own:
            material = f"{material.split()[0]} {self._rng.choice(_COLOURS)}"
        trim = material if kind.trim == kind.material else self._material(kind.trim)
        return " ".join([*words, f"look={material} trim={trim}"])

    def _material(self, slot: str) -> str:
        return self._style.materials.get(slot, slot)

    def _keep_free(self, area: Area, side: str, hole: Box) -> None:
        first, last = hole.span(side)
        free = area.floor.inward(side, first - 1, last - first + 2, BEFORE_DOORS)
        self.kept[free.rows, free.columns] = True


def _connected(blocked: NDArray[np.bool_]) -> bool:
    """Whether the places where one can stand, with elbows, are one region."""
    free = ~blocked
    reach = ELBOW
    padded = np.pad(free, reach)
    stand = np.ones_like(free)
    rows, columns = free.shape
    for i in range(2 * reach + 1):
        for j in range(2 * reach + 1):
            stand &= padded[i : i + rows, j : j + columns]
    cells = np.argwhere(stand)
    if not len(cells):
        return False
    seen = np.zeros(np.add(stand.shape, 2), bool)
    inner = np.pad(stand, 1)
    seen[tuple(cells[0] + 1)] = True
    while True:
        grown = seen.copy()
        grown[1:] |= seen[:-1]
        grown[:-1] |= seen[1:]
        grown[:, 1:] |= seen[:, :-1]
        grown[:, :-1] |= seen[:, 1:]
        grown &= inner
        if (grown == seen).all():
            return bool((seen == inner).all())
        seen = grown
