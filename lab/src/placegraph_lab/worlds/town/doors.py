"""Entrances of a drawn town stand in the walls of their buildings, on the side of the nearest road."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise

from placegraph.errors import InputError
from placegraph_lab.worlds.town.town import Kind, Town
from placegraph_lab.worlds.trace import ORTHOGONAL, Cell, step

FAR = 12
"""Characters within which a door looks for a road."""


def door(town: Town, ground: Mapping[Cell, str], cell: Cell) -> tuple[float, float]:
    """Row and column of an entrance drawn in the outermost characters of a building.

    Raises
    ------
    InputError
        It is drawn outside of buildings, or far within one.

    """
    own = ground.get(cell, "")
    walls = [side for side in ORTHOGONAL if ground.get(step(cell, side)) != own]
    if not own or "building" not in town.legend[own].tags or not walls:
        raise InputError(
            f"{town.where(cell)}: {town.drawn[cell]!r} is an entrance without a wall; "
            "draw it within a building, at its edge."
        )
    row, column = min(walls, key=lambda side: _to_road(town, cell, side))
    return cell[0] + 0.5 + row / 2, cell[1] + 0.5 + column / 2


def with_doors(
    ring: list[tuple[float, float]], doors: Iterable[tuple[float, float]]
) -> list[tuple[float, float]]:
    """A closed ring of corners, with the doors in its edges."""
    out = []
    for a, b in pairwise(ring):
        between = [p for p in doors if abs(_length(a, p) + _length(p, b) - _length(a, b)) < 1e-9]
        out += [a, *sorted(between, key=lambda p: _length(a, p))]
    return [*out, ring[-1]]


def _to_road(town: Town, cell: Cell, side: Cell) -> int:
    """Characters from a cell to the first road on one side."""
    for n in range(1, FAR):
        cell = step(cell, side)
        if town.kind(cell) == Kind.ROAD:
            return n
    return FAR


def _length(a: tuple[float, float], b: tuple[float, float]) -> float:
    return abs(a[0] - b[0]) + abs(a[1] - b[1])
