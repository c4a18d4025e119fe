"""Tracing drawn characters: strokes become lines, blots become polygons.

A cell is (row, column), row 0 on top. Corners share the lattice: cell (r, c) has the corners
(r, c), (r, c + 1), (r + 1, c + 1) and (r + 1, c).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping

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
