r"""Towns drawn in ASCII: examples, demo and test worlds that become OpenStreetMap files.

A text has the sections ``[drawing]`` and ``[legend]``, and ``[town]`` before them where the
defaults do not suit::

    [town]
    name = Crossing
    center = 9.99 53.55
    metres = 10

    [drawing]
    ##K#  |   ""T""
    ------+--1-----
          |     b

    [legend]
    K: shop=bakery name=Bäckerei Kern
    T: amenity=fountain
    b: amenity=bench
    1 road: highway=residential name=Gartenweg

Every character is a square of `metres`; the top of the page is north. A legend line reads
``glyph kind: key=value key=value``, where a value runs up to the next ``key=``. Kinds are

``point``
    (may be left out) every occurrence is a node;
``area``
    every connected blot is traced to a polygon, with holes where it has some;
``line``
    every connected run is a line, which passes over roads and points in its way;
``road``
    a label that stands in a road and gives it its tags;
``spot``
    written nowhere: a place to ask for by `Town.position`.

Roads are drawn by ``-``, ``|``, ``/`` and ``\``, which join, cross and bend at ``+`` and go
straight on where they can. Points and spots stand *in* the area whose glyph lies on both sides of
them (left and right, or above and below); so do roads and lines, buildings excepted. An
``entrance=main`` in the edge of a building stands in its wall. A road over water is a bridge. These
glyphs need no legend: ``#`` building, ``"`` park, ``≈`` water, ``~`` river, ``*`` tree; blanks
and ``.`` are nothing.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Self

from placegraph.core.geometry import LocalPlane
from placegraph.errors import InputError
from placegraph_lab.worlds.drawing import (
    DIAGONAL,
    EAST,
    NORTH,
    ORTHOGONAL,
    SOUTH,
    WEST,
    Cell,
    Drawing,
    blots,
    legend_line,
    load,
    page,
    sections,
)

Tags = dict[str, str]

CENTER = (9.9937, 53.5511)  # longitude and latitude of a town that says nothing of its own [deg]
METRES = 10.0  # side of a character of a town that says nothing of its own [m]


class Kind(StrEnum):
    """Kind of a glyph."""

    POINT = "point"
    AREA = "area"
    LINE = "line"
    ROAD = "road"
    SPOT = "spot"


@dataclass(frozen=True, slots=True)
class Symbol:
    """Meaning of a glyph."""

    kind: Kind
    tags: Tags

    @property
    def is_water(self) -> bool:
        """Whether a road over it is a bridge."""
        return self.tags.get("natural") == "water" or "waterway" in self.tags


ROAD_PORTS: dict[str, tuple[Cell, ...]] = {
    "-": (EAST, WEST),
    "|": (NORTH, SOUTH),
    "/": ((-1, 1), (1, -1)),
    "\\": ((-1, -1), (1, 1)),
    "+": ORTHOGONAL + DIAGONAL,
}
"""Directions in which a road's glyph reaches out; labels reach out as ``+`` does."""

COMMON: dict[str, Symbol] = {
    **{glyph: Symbol(Kind.ROAD, {}) for glyph in ROAD_PORTS},
    "#": Symbol(Kind.AREA, {"building": "yes"}),
    '"': Symbol(Kind.AREA, {"leisure": "park"}),
    "≈": Symbol(Kind.AREA, {"natural": "water"}),
    "~": Symbol(Kind.LINE, {"waterway": "river"}),
    "*": Symbol(Kind.POINT, {"natural": "tree"}),
}
"""Glyphs that need no legend; a legend may give all but the roads' another meaning."""

_SETTING = re.compile(r"(name|center|metres)\s*=\s*(.*)$")


@dataclass(frozen=True)
class Town(Drawing):
    """A town drawn in characters: write it with `write_osm`, ask for places with `position`."""

    name: str  # name, or an empty string
    center: tuple[float, float]  # longitude and latitude of the drawing's middle [deg]
    metres: float  # side of a character [m]
    rows: tuple[str, ...]  # the drawing, north on top
    legend: dict[str, Symbol]  # meaning of every glyph
    source: str = "<text>"  # file the town was read from, for messages
    first_line: int = 1  # line of that file that holds ``rows[0]``, for messages

    @classmethod
    def parse(cls, text: str, *, source: str = "<text>") -> Self:
        """Read a town from text.

        Raises `InputError`: the text is no town; the message names line and column and says how to
        mend it.
        """
        parts = sections(text, source, "town")
        rows, first_line = page(parts["drawing"], source, "town")
        settings = dict(_setting(line, f"{source}, line {n}") for n, line in parts["town"])
        town = cls(
            name=" ".join(settings.get("name", [])),
            center=_center(settings.get("center", []), source),
            metres=_metres(settings.get("metres", []), source),
            rows=rows,
            legend=COMMON
            | dict(_symbol(line, f"{source}, line {n}") for n, line in parts["legend"]),
            source=source,
            first_line=first_line,
        )
        town._check_glyphs()
        return town

    @classmethod
    def load(cls, name: str) -> Self:
        """Read a town that ships with the package, such as ``hafenstadt``.

        Raises `OptionError`: no town of this name ships with the package.
        """
        return cls.parse(load("towns", name, "town"), source=f"{name}.txt")

    @property
    def size(self) -> tuple[float, float]:
        """Width and height [m]."""
        return len(self.rows[0]) * self.metres, len(self.rows) * self.metres

    @property
    def plane(self) -> LocalPlane:
        """East-north plane with its origin in the drawing's middle."""
        return LocalPlane(*self.center)

    def lonlat(self, row: float, column: float) -> tuple[float, float]:
        """Longitude and latitude [deg] of a place on the page; (0, 0) is its north-west corner."""
        width, height = self.size
        east_north = (column * self.metres - width / 2, height / 2 - row * self.metres)
        longitude, latitude = self.plane.to_lonlat(east_north).tolist()
        return longitude, latitude

    def positions(self, glyph: str) -> list[tuple[float, float]]:
        """Longitude and latitude [deg] of what a glyph drew, in reading order.

        A point, spot or label stands in the middle of its character; an area or line in the mean
        of each of its connected blots.
        """
        cells = self.cells(glyph)
        symbol = self.legend.get(glyph)
        if symbol and symbol.kind in (Kind.AREA, Kind.LINE):
            groups = blots(cells)
        else:
            groups = [{cell} for cell in cells]
        return [
            self.lonlat(
                sum(row for row, _ in group) / len(group) + 0.5,
                sum(column for _, column in group) / len(group) + 0.5,
            )
            for group in groups
        ]

    def write_osm(self, path: str | Path) -> Path:
        """Write an OpenStreetMap XML file; the same town gives the same bytes.

        Raises `InputError`: A road or line cannot be followed; the message names line and column.
        """
        from placegraph_lab.worlds.town.osm import write

        return write(self, path)

    def kind(self, cell: Cell) -> Kind | None:
        """Kind of what is drawn in a cell; None for a blank."""
        glyph = self.drawn.get(cell)
        return self.legend[glyph].kind if glyph else None

    def _check_glyphs(self) -> None:
        for cell, glyph in self.drawn.items():
            if glyph not in self.legend:
                raise InputError(
                    f"{self.where(cell)}: {glyph!r} has no meaning; "
                    f"add a line such as '{glyph}: amenity=bench' to [legend]."
                )


def _setting(line: str, where: str) -> tuple[str, list[str]]:
    """Read one line of [town]: key and words."""
    if not (match := _SETTING.match(line)):
        raise InputError(f"{where}, column 1: expected name, center or metres = value.")
    return match[1], match[2].split()


def _center(words: list[str], source: str) -> tuple[float, float]:
    """Read longitude and latitude [deg]."""
    try:
        longitude, latitude = map(float, words) if words else CENTER
    except ValueError:
        longitude, latitude = 0.0, 90.0
    if not (abs(longitude) <= 180.0 and abs(latitude) <= 85.0):
        raise InputError(
            f"{source}, [town]: center = {' '.join(words)!r} is not a longitude and latitude; "
            "write two numbers of degrees, such as 9.99 53.55, between 85 south and 85 north."
        )
    return longitude, latitude


def _metres(words: list[str], source: str) -> float:
    """Read the side of a character [m]."""
    try:
        metres = float(*words) if words else METRES
    except (TypeError, ValueError):
        metres = 0.0
    if not 0.1 <= metres <= 1000.0:
        raise InputError(
            f"{source}, [town]: metres = {' '.join(words)!r} is not the side of a character; write "
            "a number from 0.1 to 1000."
        )
    return metres


def _symbol(line: str, where: str) -> tuple[str, Symbol]:
    """Read one line of the legend: glyph and meaning."""
    read = legend_line(line, where)
    kind = read.kind or "point"
    if read.glyph in ROAD_PORTS:
        raise InputError(
            f"{where}, column 1: {read.glyph!r} always draws a road; give the road its tags by a "
            "label, such as '1 road: highway=primary', and put 1 into it."
        )
    if kind not in set(Kind):
        raise InputError(
            f"{where}, column {read.kind_column}: {kind!r} is not a kind; write one of "
            f"{', '.join(Kind)}."
        )
    if read.has_junk or bool(read.values) == (kind == Kind.SPOT):
        raise InputError(
            f"{where}, column {read.values_column}: expected "
            f"{'nothing after a spot' if kind == Kind.SPOT else 'tags as key=value key=value'}."
        )
    return read.glyph, Symbol(Kind(kind), read.values)
