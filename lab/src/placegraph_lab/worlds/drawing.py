"""Tracing drawn characters: strokes become lines, blots become polygons.

A cell is (row, column), row 0 on top. Corners share the lattice: cell (r, c) has the corners
(r, c), (r, c + 1), (r + 1, c + 1) and (r + 1, c).
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import TYPE_CHECKING

from placegraph.errors import InputError, OptionError

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

Cell = tuple[int, int]

EAST, SOUTH, WEST, NORTH = (0, 1), (1, 0), (0, -1), (-1, 0)
ORTHOGONAL = (EAST, SOUTH, WEST, NORTH)
DIAGONAL = ((1, 1), (1, -1), (-1, -1), (-1, 1))


def step(cell: Cell, direction: Cell) -> Cell:
    """Return the neighbour of a cell in a direction."""
    return cell[0] + direction[0], cell[1] + direction[1]


def heading(a: Cell, b: Cell) -> Cell:
    """Return the direction from a to b, as a unit step."""
    rows, columns = b[0] - a[0], b[1] - a[1]
    return (rows > 0) - (rows < 0), (columns > 0) - (columns < 0)


def blots(cells: Iterable[Cell]) -> list[set[Cell]]:
    """Split cells into 4-connected components, in reading order of their first cell."""
    left = set(cells)
    found: list[set[Cell]] = []
    for seed in sorted(left):
        if seed not in left:
            continue
        blot, frontier = {seed}, [seed]
        left.discard(seed)
        while frontier:
            cell = frontier.pop()
            fresh = [n for d in ORTHOGONAL if (n := step(cell, d)) in left]
            left.difference_update(fresh)
            blot.update(fresh)
            frontier.extend(fresh)
        found.append(blot)
    return found


def rings(blot: set[Cell]) -> list[list[Cell]]:
    """Outline a 4-connected blot: closed rings of corners, the outer ring first, then holes.

    Every border edge is walked with the blot on its right (clockwise on the page). Where the blot
    touches itself at a corner the walk turns left, so that no ring touches itself.
    """
    leaving: dict[Cell, list[Cell]] = defaultdict(list)
    for row, column in sorted(blot):
        corners = [(row, column), (row, column + 1), (row + 1, column + 1), (row + 1, column)]
        outside = (NORTH, EAST, SOUTH, WEST)
        for k, side in enumerate(outside):
            if step((row, column), side) not in blot:
                leaving[corners[k]].append(corners[(k + 1) % 4])
    found: list[list[Cell]] = []
    for start in sorted(leaving):
        while leaving[start]:
            ring = [start, leaving[start].pop(0)]
            while ring[-1] != start:
                came = heading(ring[-2], ring[-1])
                left = (-came[1], came[0])
                exits = leaving[ring[-1]]
                ahead = next((c for c in exits if heading(ring[-1], c) == left), exits[0])
                exits.remove(ahead)
                ring.append(ahead)
            found.append(without_straight_points(ring))
    return found


def strokes(links: Mapping[Cell, Iterable[Cell]]) -> list[list[Cell]]:
    """Follow links from cell to cell: maximal lines that go straight on at crossings.

    At a cell, opposite arms belong to one line; two arms that are left over, and only two, are a
    bend of one line; every other arm ends there. A closed line starts and ends in one cell.
    """
    onward: dict[tuple[Cell, Cell], Cell] = {}  # (from, at) -> where the line goes on
    edges: set[tuple[Cell, Cell]] = set()
    for cell, arms in links.items():
        towards = {heading(cell, arm): arm for arm in sorted(arms)}
        edges.update((cell, arm) for arm in towards.values())
        straight = {d: arm for d, arm in towards.items() if (-d[0], -d[1]) in towards}
        for (row, column), arm in straight.items():
            onward[towards[(-row, -column)], cell] = arm
        if not straight and len(towards) == 2:
            one, other = towards.values()
            onward[one, cell], onward[other, cell] = other, one
    found: list[list[Cell]] = []
    ends = sorted(edge for edge in edges if (edge[1], edge[0]) not in onward)
    for first in [*ends, *sorted(edges)]:  # what no end leads to is a closed line
        if first not in edges:
            continue
        line = list(first)
        edges -= {first, first[::-1]}
        while (ahead := onward.get((line[-2], line[-1]))) and (line[-1], ahead) in edges:
            edges -= {(line[-1], ahead), (ahead, line[-1])}
            line.append(ahead)
        found.append(line)
    return found


def without_straight_points(line: list[Cell], keep: Iterable[Cell] = ()) -> list[Cell]:
    """Leave out points that lie straight between their neighbours, unless they are to be kept."""
    kept = set(keep)
    inner = [
        here
        for before, here, after in zip(line, line[1:], line[2:], strict=False)
        if here in kept or heading(before, here) != heading(here, after)
    ]
    return [line[0], *inner, line[-1]]


BLANKS = " ."
LARGEST = 1_000_000  # most characters of a drawing

_SYMBOL = re.compile(r"(?P<glyph>\S)(?:[ \t]+(?P<kind>\w+))?[ \t]*:(?P<values>.*)$")
_VALUE = re.compile(r"\s*([\w:]+)=(.*?)(?=\s+[\w:]+=|\s*$)")


def sections(text: str, source: str, head: str) -> dict[str, list[tuple[int, str]]]:
    """Lines of every section with their numbers; outside the drawing without the empty ones.

    Raises `InputError`: text stands before the first section, or a tab in the drawing.
    """
    found: dict[str, list[tuple[int, str]]] = {head: [], "drawing": [], "legend": []}
    here = ""
    for number, line in enumerate(text.splitlines(), 1):
        if (name := line.rstrip()[1:-1]) in found and line.rstrip() == f"[{name}]":
            here = name
        elif not line.strip() and here != "drawing":
            continue
        elif not here:
            raise InputError(
                f"{source}, line {number}, column 1: text before the first section; "
                f"begin with a line [{head}] or [drawing]."
            )
        elif "\t" in line and here == "drawing":
            raise InputError(
                f"{source}, line {number}, column {line.index(chr(9)) + 1}: "
                "a tab in the drawing; write blanks."
            )
        else:
            found[here].append((number, line.rstrip()))
    return found


def page(lines: list[tuple[int, str]], source: str, head: str) -> tuple[tuple[str, ...], int]:
    """Rows of the drawing, all of one length, and the number of the first one's line.

    Raises `InputError`: there is no drawing, or it is too large.
    """
    numbers = [number for number, line in lines if line]
    if not numbers:
        raise InputError(f"{source}: no drawing; add a line [drawing] and the {head} below it.")
    rows = [line for number, line in lines if numbers[0] <= number <= numbers[-1]]
    width = max(map(len, rows))
    if width * len(rows) > LARGEST:
        raise InputError(f"{source}: the drawing has over {LARGEST:,} characters; cut it.")
    return tuple(row.ljust(width) for row in rows), numbers[0]


class Drawing:
    """Base of drawn worlds: positions of glyphs."""

    rows: tuple[str, ...]  # the drawing
    source: str  # file that it was read from, for messages
    first_line: int  # line of that file that holds ``rows[0]``, for messages

    @cached_property
    def drawn(self) -> dict[Cell, str]:
        """Glyph of every cell that is not blank, in reading order."""
        return {
            (r, c): glyph
            for r, row in enumerate(self.rows)
            for c, glyph in enumerate(row)
            if glyph not in BLANKS
        }

    def cells(self, glyph: str) -> list[Cell]:
        """Row and column of every occurrence of a glyph, in reading order."""
        return [cell for cell, drawn in self.drawn.items() if drawn == glyph]

    @abstractmethod
    def positions(self, glyph: str) -> list[tuple[float, float]]:
        """Return the positions of a glyph's objects, in reading order."""

    def position(self, glyph: str) -> tuple[float, float]:
        """Return the position of a glyph's only object, in the units of `positions`.

        Raises `OptionError`: the glyph drew nothing, or several things.
        """
        found = self.positions(glyph)
        if len(found) != 1:
            raise OptionError(
                f"{self.source} has {len(found)} places drawn {glyph!r}, not one; "
                "ask with `positions`, or draw the place with a glyph of its own."
            )
        return found[0]

    def where(self, cell: Cell) -> str:
        """Name file, line and column of a cell, for messages."""
        return f"{self.source}, line {self.first_line + cell[0]}, column {cell[1] + 1}"


@dataclass(frozen=True, slots=True)
class LegendLine:
    """One line ``glyph kind: key=value key=value`` of a legend."""

    glyph: str
    kind: str  # the word before the colon, or an empty string
    kind_column: int
    values: dict[str, str]
    values_column: int
    has_junk: bool  # whether something behind the colon is no ``key=value``


def legend_line(line: str, where: str) -> LegendLine:
    """Read one line of a legend.

    Raises `InputError`: the line has no colon, or its glyph is a blank.
    """
    match = _SYMBOL.match(line)
    if not match or match["glyph"] in BLANKS:
        raise InputError(f"{where}, column 1: expected 'glyph kind: key=value key=value'.")
    values = match["values"]
    found = list(_VALUE.finditer(values))
    return LegendLine(
        match["glyph"],
        match["kind"] or "",
        match.start("kind") + 1,
        {value[1]: value[2] for value in found},
        match.start("values") + 1,
        sum(len(value[0]) for value in found) < len(values.rstrip()),
    )


def list_shipped(folder: str) -> tuple[str, ...]:
    """Names of the drawings in a folder of `worlds/data` that ship with the package."""
    return tuple(
        sorted(
            file.name.removesuffix(".txt")
            for file in _data(folder).iterdir()
            if file.name.endswith(".txt")
        )
    )


def load(folder: str, name: str, what: str) -> str:
    """Text of a drawing that ships with the package.

    Raises `OptionError`: no drawing of this name ships with the package.
    """
    if name not in (known := list_shipped(folder)):
        raise OptionError(f"There is no {what} {name!r}; there are {', '.join(known)}.")
    return (_data(folder) / f"{name}.txt").read_text("utf-8")


def _data(folder: str) -> Traversable:
    return resources.files("placegraph_lab.worlds") / "data" / folder
