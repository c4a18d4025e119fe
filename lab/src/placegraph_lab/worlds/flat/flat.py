"""Flats drawn in ASCII: demo and test worlds that become scene maps and captures.

A text has the sections ``[drawing]`` and ``[legend]``, and ``[flat]`` before them where the
defaults do not suit::

    [flat]
    name = Chamber
    metres = 0.25
    height = 2.6

    [drawing]
    ####==####
    #SS.1   B#
    #SS     B#
    #   TT   :
    #   TT c #
    ##########

    [legend]
    1 room: label=study floor=parquet sienna walls=wallpaper palegoldenrod
    S sofa: look=fabric darkred
    B shelf: label=bookcase height=2.1
    T table: label=desk
    c chair: faces=T

A character is a rectangle of `metres`: one number, or width and height. x grows to the right of
the page, y up the page, from its lower left corner; z from the floor. ``#`` is wall, ``=`` a
window, ``+`` a closed door, ``:`` a doorway; blanks and ``.`` are floor within walls and nothing
outside of them. A legend line reads ``glyph kind: key=value key=value``, where a value runs up to
the next ``key=``. Kinds are

``wall``, ``window``, ``door``, ``doorway``
    openings lie in a wall and lead through it: `base`, `height` [m];
``room``
    a label that stands on the floor and gives its room a name and the materials `walls`, `floor` and
    `ceiling`;
``spot``
    floor, and a place to ask for by `Flat.position`;
a model of `flat_furniture.MODELS`
    every connected blot is a thing (from rectangles, where it is none): `label`, `height`, `base`
    above the floor, `depth` from its back [m], `look` and `trim` such as ``wood saddlebrown``,
    `faces` a direction or the glyph of what it looks at (else its back is to the wall), and
    `in`, the glyph of what it stands on or in: its cells belong to both.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor

from placegraph.errors import InputError
from placegraph_lab.worlds.drawing import Cell, Drawing, blots, legend_line, load, page, sections
from placegraph_lab.worlds.flat.furniture import MODELS
from placegraph_lab.worlds.flat.textures import PAINTERS, Material

if TYPE_CHECKING:
    from placegraph_lab.worlds.flat.interior import Interior

HEADROOM = 1.9  # what hangs higher than this is walked under [m]
OUTSIDE = -1
SOLID = -2  # entries of `Flat.room_of` that are no room: outside, and walls with what is in them


@dataclass(frozen=True, eq=False)
class Room:
    """Floor enclosed by walls."""

    name: str
    symbol: Symbol
    cells: frozenset[Cell]


@dataclass(frozen=True, eq=False)
class Blot:
    """Connected cells of one glyph, with those of what stands in it."""

    glyph: str
    symbol: Symbol
    cells: frozenset[Cell]
    own: Cell  # first cell, in reading order, that is drawn with this very glyph


@dataclass(frozen=True)
class Flat(Drawing):
    """A flat drawn in characters: make it an `Interior` with `furnish`."""

    name: str
    metres: tuple[float, float]  # width and height of a character [m]
    height: float  # height of the rooms [m]
    rows: tuple[str, ...]  # the drawing
    legend: dict[str, Symbol]  # meaning of every glyph
    source: str = "<text>"  # file the flat was read from, for messages
    first_line: int = 1  # line of that file that holds ``rows[0]``, for messages

    @classmethod
    def parse(cls, text: str, *, source: str = "<text>") -> Self:
        """Read a flat from text.

        Raises `InputError`: the text is no flat; the message names line and column and says how to
        mend it.
        """
        parts = sections(text, source, "flat")
        rows, first_line = page(parts["drawing"], source, "flat")
        name, metres, height = settings(parts["flat"], source)
        flat = cls(
            name=name,
            metres=metres,
            height=height,
            rows=rows,
            legend=COMMON
            | dict(symbol(line, f"{source}, line {n}") for n, line in parts["legend"]),
            source=source,
            first_line=first_line,
        )
        flat._check_glyphs()
        if not flat.rooms:
            raise InputError(f"{source}: no room; close the walls (#) around some floor.")
        flat._check_places()
        return flat

    @classmethod
    def load(cls, name: str) -> Self:
        """Read a flat that ships with the package, such as ``altbau``.

        Raises `OptionError`: no flat of this name ships with the package.
        """
        return cls.parse(load("flats", name, "flat"), source=f"{name}.txt")

    def furnish(self, rng: np.random.Generator) -> Interior:
        """Walls, floors, ceilings and furniture with their meshes and painted textures.

        Raises `InputError`: an opening leads through no wall, or what hangs has no wall behind it.
        """
        from placegraph_lab.worlds.flat.interior import furnish

        return furnish(self, rng)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the page [m]."""
        return len(self.rows[0]) * self.metres[0], len(self.rows) * self.metres[1]

    def corner(self, row: float, column: float) -> tuple[float, float]:
        """Place x, y [m] of a row and column on the page; (0, 0) is its upper left corner."""
        return column * self.metres[0], (len(self.rows) - row) * self.metres[1]

    def cell(self, x: float, y: float) -> Cell:
        """Row and column of the character at x, y [m]; beyond the page too."""
        row = len(self.rows) - y / self.metres[1]
        return int(np.floor(row)), int(np.floor(x / self.metres[0]))

    def positions(self, glyph: str) -> list[tuple[float, float]]:
        """Middles x, y [m] of the connected blots of a glyph, in reading order."""
        groups = (np.mean(sorted(group), axis=0) + 0.5 for group in blots(self.cells(glyph)))
        return [self.corner(*middle.tolist()) for middle in groups]

    @cached_property
    def room_of(self) -> NDArray[np.int32]:
        """Row of `rooms` of every cell (R, C); `OUTSIDE` and `SOLID` are none."""
        solid = {cell for cell, glyph in self.drawn.items() if self._is_solid(glyph)}
        shape = len(self.rows), len(self.rows[0])
        found = np.full(shape, SOLID, np.int32)
        index = 0
        for group in blots(cell for cell in np.ndindex(shape) if cell not in solid):
            rows, columns = zip(*group, strict=True)
            open_air = (
                min(rows) == 0
                or min(columns) == 0
                or max(rows) == shape[0] - 1
                or max(columns) == shape[1] - 1
            )
            found[rows, columns] = OUTSIDE if open_air else index
            index += not open_air
        return found

    @cached_property
    def rooms(self) -> tuple[Room, ...]:
        """Rooms in reading order.

        Raises `InputError`: A room has two labels.
        """
        labels = [cell for cell, glyph in self.drawn.items() if self.legend[glyph].kind == ROOM]
        found = []
        for index in range(int(self.room_of.max()) + 1):
            here = [cell for cell in labels if self.room_of[cell] == index]
            if len(here) > 1:
                raise InputError(f"{self.where(here[1])}: the room has two labels; leave one.")
            style = self.legend[self.drawn[here[0]]] if here else symbol("1 room:", "")[1]
            name = style.label if style.label != ROOM else f"room {index + 1}"
            cells = frozenset((int(r), int(c)) for r, c in np.argwhere(self.room_of == index))
            found.append(Room(name, style, cells))
        return tuple(found)

    @cached_property
    def objects(self) -> tuple[Blot, ...]:
        """Furniture in reading order."""
        return tuple(
            sorted(
                (
                    blot
                    for glyph, meaning in self.legend.items()
                    if meaning.is_furniture
                    for blot in self._blots(glyph)
                ),
                key=lambda blot: blot.own,
            )
        )

    @cached_property
    def openings(self) -> tuple[Blot, ...]:
        """Windows, doors and doorways in reading order."""
        found = [
            Blot(glyph, meaning, frozenset(group), min(group))
            for glyph, meaning in self.legend.items()
            if meaning.kind in OPENINGS
            for group in blots(self.cells(glyph))
        ]
        return tuple(sorted(found, key=lambda blot: blot.own))

    @cached_property
    def blocked(self) -> NDArray[np.bool_]:
        """Cells (R, C) that nobody walks through: walls, furniture, closed doors, outside."""
        mask = self.room_of < 0
        for cell, glyph in self.drawn.items():
            kind = self.legend[glyph].kind
            if kind in OPENINGS:
                mask[cell] = kind in (WINDOW, DOOR)
        for blot in self.objects:
            if self.base(blot) < HEADROOM and blot.symbol.kind not in ("rug", "picture"):
                mask[tuple(np.array(sorted(blot.cells)).T)] = True
        return mask

    def host(self, blot: Blot) -> Blot | None:
        """Return the thing that carries another."""
        return next((b for b in self.objects if self._carries(b, blot)), None)

    def base(self, blot: Blot) -> float:
        """Height of a thing's lower edge above the floor [m]."""
        if blot.symbol.kind == "pendant":
            return self.height - blot.symbol.height
        if blot.symbol.base is not None:
            return blot.symbol.base
        host = self.host(blot)
        return self.base(host) + host.symbol.height if host else 0.0

    def _carries(self, host: Blot, blot: Blot) -> bool:
        return host.glyph == blot.symbol.host and blot.own in host.cells

    def _is_solid(self, glyph: str) -> bool:
        return self.legend[glyph].kind in OPENINGS | {WALL}

    def _blots(self, glyph: str) -> list[Blot]:
        """Blots of a piece of furniture: its own cells and those of all that stands in it."""
        inner, fresh = {glyph}, {glyph}
        while fresh:
            fresh = {g for g, s in self.legend.items() if s.host in fresh} - inner
            inner |= fresh
        found = []
        for group in blots(cell for g in inner for cell in self.cells(g)):
            own = sorted(cell for cell in group if self.drawn[cell] == glyph)
            if not own:  # what stands in it here stands in none of it
                lost = min(group)
                raise InputError(
                    f"{self.where(lost)}: {self.drawn[lost]!r} stands in {glyph!r}, but touches "
                    f"none; draw {glyph!r} around it, or leave out in={glyph}."
                )
            found.append(Blot(glyph, self.legend[glyph], frozenset(group), own[0]))
        return found

    def _check_glyphs(self) -> None:
        for cell, glyph in self.drawn.items():
            if glyph not in self.legend:
                raise InputError(
                    f"{self.where(cell)}: {glyph!r} has no meaning; "
                    f"add a line such as '{glyph} table: label=desk' to [legend]."
                )
        if self.legend["#"].kind != WALL:
            raise InputError(f"{self.source}, [legend]: # is always a wall; choose another glyph.")
        for glyph, meaning in self.legend.items():
            for other in {meaning.host, meaning.faces if len(meaning.faces) == 1 else ""} - {""}:
                known = self.legend.get(other)
                if known is None or not known.is_furniture or other == glyph:
                    raise InputError(
                        f"{self.source}, [legend]: {glyph!r} refers to {other!r}, which is not "
                        "another piece of furniture; give the glyph of one."
                    )
            carriers = [glyph]
            while (host := self.legend[carriers[-1]].host) and host not in carriers:
                carriers.append(host)
            if host:
                raise InputError(
                    f"{self.source}, [legend]: {host!r} stands in {self.legend[host].host!r}, "
                    "which stands in it; let one of them stand on the floor."
                )

    def _check_places(self) -> None:
        for cell, glyph in self.drawn.items():
            if self.room_of[cell] == OUTSIDE and self.legend[glyph].kind != SPOT:
                raise InputError(
                    f"{self.where(cell)}: {glyph!r} stands in no room; "
                    "draw it inside, or close the walls (#) around it."
                )
        _ = self.objects  # says what stands in nothing


COMPASS = {"north": (0, 1), "east": (1, 0), "south": (0, -1), "west": (-1, 0)}
"""Directions on the page as x to the right and y upwards."""

METRES = "0.25"  # side of a character of a flat that says nothing of its own [m]
HEIGHT = "2.6"  # height of its rooms [m]

WALL, WINDOW, DOOR, DOORWAY, ROOM, SPOT = "wall", "window", "door", "doorway", "room", "spot"
OPENINGS = frozenset({WINDOW, DOOR, DOORWAY})

_SETTING = re.compile(r"(name|metres|height)\s*=\s*(.*)$")
_NUMBERS = ("height", "base", "depth")
_FURNITURE = frozenset({"label", "height", "base", "depth", "look", "trim", "faces", "in"})
_KEYS: dict[str, frozenset[str]] = {
    WALL: frozenset(),
    WINDOW: frozenset({"label", "base", "height", "look", "trim"}),
    DOOR: frozenset({"label", "height", "look", "trim"}),
    DOORWAY: frozenset({"label", "height", "look", "trim"}),
    ROOM: frozenset({"label", "walls", "floor", "ceiling"}),
    SPOT: frozenset(),
} | dict.fromkeys(MODELS, _FURNITURE)

_DEFAULTS: dict[str, dict[str, str]] = {
    WINDOW: {"base": "0.9", "height": "1.3", "look": "window white", "trim": "plain white"},
    DOOR: {"base": "0", "height": "2.05", "look": "panel peru", "trim": "wood peru"},
    DOORWAY: {"base": "0", "height": "2.05", "look": "wood tan", "trim": "plain white"},
    ROOM: {"walls": "plaster #e9e3d5", "floor": "parquet #b0804a", "ceiling": "plaster #f4f2ec"},
}


@dataclass(frozen=True, slots=True)
class Symbol:
    """Meaning of a glyph."""

    kind: str  # A model of furniture, or ``wall``, ``window``, ``door``, ``doorway``, ``room``, ``spot``
    label: str
    height: float = 0.0  # own height [m]
    base: float | None = None  # lower edge above the floor [m]; None: it stands on what carries it
    depth: float | None = None  # depth from its back [m]; None: as drawn
    faces: str = ""  # A direction of the page, a glyph to look at, or empty: away from the wall
    host: str = ""  # glyph of what it stands on or in
    materials: Mapping[str, Material] = field(default_factory=dict)
    """``look`` and ``trim``; of rooms ``walls``, ``floor`` and ``ceiling``."""

    @property
    def is_furniture(self) -> bool:
        """Whether the glyph stands for a thing in a room."""
        return self.kind in MODELS


def symbol(line: str, where: str) -> tuple[str, Symbol]:
    """Read one line of the legend: glyph and meaning.

    Raises `InputError`: the kind, a key or a value is unknown; the message names the column and the
    mend.
    """
    read = legend_line(line, where)
    if read.kind not in _KEYS:
        raise InputError(
            f"{where}, column {max(1, read.kind_column)}: {read.kind!r} is not a kind of object; "
            f"write one of {', '.join(_KEYS)}."
        )
    place = f"{where}, column {read.values_column}"
    allowed = _KEYS[read.kind]
    unknown = sorted(set(read.values) - allowed)
    if read.has_junk or unknown:
        raise InputError(
            f"{place}: {'no key=value' if read.has_junk else unknown[0]} after a {read.kind}; "
            + (f"its keys are {', '.join(sorted(allowed))}." if allowed else "nothing may follow.")
        )
    given = _defaults(read.kind) | read.values
    numbers = {key: _metres(given[key], key, place) for key in _NUMBERS if key in given}
    if read.kind in OPENINGS | set(MODELS) and numbers["height"] <= 0.0:
        raise InputError(f"{place}: height is 0; write a number of metres greater than 0.")
    for key in ("in", "faces"):
        if len(given.get(key, "x")) != 1 and not (key == "faces" and given[key] in COMPASS):
            also = "" if key == "in" else f" or one of {', '.join(COMPASS)}"
            raise InputError(f"{place}: {key}={given[key]!r} is not a glyph; write one{also}.")
    return read.glyph, Symbol(
        read.kind,
        given.get("label", read.kind),
        height=numbers.get("height", 0.0),
        base=numbers.get("base"),
        depth=numbers.get("depth"),
        faces=given.get("faces", ""),
        host=given.get("in", ""),
        materials={
            key: read_material(given[key], f"{place}, {key}")
            for key in ("look", "trim", "walls", "floor", "ceiling")
            if key in given
        },
    )


def _defaults(kind: str) -> dict[str, str]:
    """Values that a kind has where the legend is silent."""
    if kind not in MODELS:
        return _DEFAULTS.get(kind, {})
    model = MODELS[kind]
    numbers = {"height": model.height, "base": model.base, "depth": model.depth}
    return {"look": model.material, "trim": model.trim} | {
        key: str(value) for key, value in numbers.items() if value is not None
    }


def read_material(text: str, place: str) -> Material:
    """Read a material such as ``wood saddlebrown`` or ``plaster #e9e3d5``.

    Raises `InputError`: the kind or the colour is unknown.
    """
    kind, _, colour = text.partition(" ")
    if kind not in PAINTERS:
        raise InputError(
            f"{place}: {kind!r} is not a material; write one of {', '.join(PAINTERS)}."
        )
    try:
        red, green, blue = ImageColor.getrgb(colour.strip())[:3]
    except ValueError:
        raise InputError(
            f"{place}: {colour.strip()!r} is not a colour; write {kind} and a name such as tan, or "
            "#rrggbb."
        ) from None
    return Material(kind, (red, green, blue))


def _metres(text: str, key: str, place: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 100.0:
        raise InputError(f"{place}: {key}={text!r} is not a length; write metres from 0 to 100.")
    return value


COMMON: dict[str, Symbol] = dict(
    symbol(line, "<common>") for line in ("# wall:", "= window:", "+ door:", ": doorway:")
)
"""Glyphs that need no legend; a legend may give all but the wall's another meaning."""


def settings(lines: list[tuple[int, str]], source: str) -> tuple[str, tuple[float, float], float]:
    """Read the lines of [flat]: name, width and height of a character, height of the rooms [m].

    Raises `InputError`: A line is no setting, or its value is out of range.
    """
    found = dict(_setting(line, f"{source}, line {n}") for n, line in lines)
    metres = _size(found.get("metres", METRES), source)
    return found.get("name", ""), metres, _height(found.get("height", HEIGHT), source)


def _setting(line: str, where: str) -> tuple[str, str]:
    """Read one line of [flat]."""
    if not (match := _SETTING.match(line)):
        raise InputError(f"{where}, column 1: expected name, metres or height = value.")
    return match[1], match[2].strip()


def _size(text: str, source: str) -> tuple[float, float]:
    """Read width and height of a character [m]."""
    try:
        sides = [float(word) for word in text.split()]
    except ValueError:
        sides = []
    if len(sides) not in {1, 2} or not all(0.01 <= side <= 2.0 for side in sides):
        raise InputError(
            f"{source}, [flat]: metres = {text!r} is not the size of a character; write one or two "
            "numbers from 0.01 to 2."
        )
    return sides[0], sides[-1]


def _height(text: str, source: str) -> float:
    """Read the height of the rooms [m]."""
    try:
        height = float(text)
    except ValueError:
        height = 0.0
    if not 1.0 <= height <= 20.0:
        raise InputError(
            f"{source}, [flat]: height = {text!r} is not a height of rooms; write a number of "
            "metres from 1 to 20."
        )
    return height
