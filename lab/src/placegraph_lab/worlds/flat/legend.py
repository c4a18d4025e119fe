"""Settings and legends of drawn flats: what a glyph is, checked line by line."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field

from PIL import ImageColor

from placegraph.errors import InputError
from placegraph_lab.worlds.drawing import legend_line
from placegraph_lab.worlds.flat.furniture import MODELS
from placegraph_lab.worlds.flat.textures import PAINTERS, Look

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
    looks: Mapping[str, Look] = field(default_factory=dict)
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
            f"{where}, column {max(1, read.kind_column)}: {read.kind!r} is no kind of thing; "
            f"write one of {', '.join(_KEYS)}."
        )
    place = f"{where}, column {read.values_column}"
    allowed = _KEYS[read.kind]
    unknown = sorted(set(read.values) - allowed)
    if read.rest or unknown:
        raise InputError(
            f"{place}: {'no key=value' if read.rest else unknown[0]} after a {read.kind}; "
            + (f"its keys are {', '.join(sorted(allowed))}." if allowed else "nothing may follow.")
        )
    given = _defaults(read.kind) | read.values
    numbers = {key: _metres(given[key], key, place) for key in _NUMBERS if key in given}
    if read.kind in OPENINGS | set(MODELS) and numbers["height"] <= 0.0:
        raise InputError(f"{place}: height is 0; write a number of metres greater than 0.")
    for key in ("in", "faces"):
        if len(given.get(key, "x")) != 1 and not (key == "faces" and given[key] in COMPASS):
            also = "" if key == "in" else f" or one of {', '.join(COMPASS)}"
            raise InputError(f"{place}: {key}={given[key]!r} is no glyph; write one{also}.")
    return read.glyph, Symbol(
        read.kind,
        given.get("label", read.kind),
        height=numbers.get("height", 0.0),
        base=numbers.get("base"),
        depth=numbers.get("depth"),
        faces=given.get("faces", ""),
        host=given.get("in", ""),
        looks={
            key: look(given[key], f"{place}, {key}")
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
    return {"look": model.look, "trim": model.trim} | {
        key: str(value) for key, value in numbers.items() if value is not None
    }


def look(text: str, place: str) -> Look:
    """Read a look such as ``wood saddlebrown`` or ``plaster #e9e3d5``.

    Raises `InputError`: the kind or the colour is unknown.
    """
    kind, _, colour = text.partition(" ")
    if kind not in PAINTERS:
        raise InputError(f"{place}: {kind!r} is no look; write one of {', '.join(PAINTERS)}.")
    try:
        red, green, blue = ImageColor.getrgb(colour.strip())[:3]
    except ValueError:
        raise InputError(
            f"{place}: {colour.strip()!r} is no colour; write {kind} and a name such as tan, "
            "or #rrggbb."
        ) from None
    return Look(kind, (red, green, blue))


def _metres(text: str, key: str, place: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value <= 100.0:
        raise InputError(f"{place}: {key}={text!r} is no length; write metres from 0 to 100.")
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
            f"{source}, [flat]: metres = {text!r} is no size of a character; "
            "write one or two numbers from 0.01 to 2."
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
            f"{source}, [flat]: height = {text!r} is no height of rooms; "
            "write a number of metres from 1 to 20."
        )
    return height
