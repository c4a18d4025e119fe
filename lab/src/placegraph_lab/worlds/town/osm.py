"""Entrances of a drawn town stand in the walls of their buildings, on the side of the nearest road."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from xml.sax.saxutils import quoteattr

from placegraph.errors import InputError
from placegraph_lab.worlds.drawing import (
    DIAGONAL,
    EAST,
    NORTH,
    ORTHOGONAL,
    SOUTH,
    WEST,
    Cell,
    blots,
    rings,
    step,
    strokes,
    without_straight_points,
)
from placegraph_lab.worlds.town.town import ROAD_PORTS, Kind, Tags, Town

FAR = 12  # characters within which a door looks for a road


def door(town: Town, ground: Mapping[Cell, str], cell: Cell) -> tuple[float, float]:
    """Row and column of an entrance drawn in the outermost characters of a building.

    Raises `InputError`: it is drawn outside of buildings, or far within one.
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


Links = dict[Cell, list[Cell]]
Spot = tuple[float, float]  # row and column on the page, in characters


@dataclass
class _File:
    """Nodes, ways and relations, numbered in the order in which they come up."""

    nodes: dict[Spot, int] = field(default_factory=dict)
    node_tags: dict[Spot, Tags] = field(default_factory=dict)
    ways: list[tuple[list[int], Tags]] = field(default_factory=list)
    relations: list[tuple[list[tuple[str, int]], Tags]] = field(default_factory=list)

    def way(self, line: list[Spot], tags: Tags) -> int:
        """Add a way and return its id; ways that meet at a spot share the node."""
        self.ways.append(([self.nodes.setdefault(p, len(self.nodes) + 1) for p in line], tags))
        return len(self.ways)


def write(town: Town, path: str | Path) -> Path:
    """Write a town as OpenStreetMap XML; the same town gives the same bytes."""
    path = Path(path)
    file = _File()
    ground = _ground(town)
    for cell, glyph in town.drawn.items():
        if town.legend[glyph].kind == Kind.POINT:
            tags = town.legend[glyph].tags
            spot = door(town, ground, cell) if "entrance" in tags else _middle(cell)
            file.nodes.setdefault(spot, len(file.nodes) + 1)
            file.node_tags[spot] = tags
    _roads(town, file)
    _lines(town, file)
    _areas(town, file)
    path.write_text("\n".join(_xml(town, file)) + "\n", encoding="utf-8")
    return path


def _roads(town: Town, file: _File) -> None:
    links = _road_links(town)
    crossings = {cell for cell, arms in links.items() if len(arms) > 2}
    water = _water(town)
    for cell, glyph in town.drawn.items():
        if town.legend[glyph].kind != Kind.ROAD:
            continue
        if cell not in links:
            raise InputError(f"{town.where(cell)}: {glyph!r} joins no road; put it into a stroke "
                             "of '-', '|', '/' or '\\', or bend the road with '+'.")  # fmt: skip
        if cell in crossings and glyph != "+":
            raise InputError(f"{town.where(cell)}: more than two roads leave {glyph!r}; "
                             "put '+' here and the label beside it.")  # fmt: skip
    for line in strokes(links):
        tags = _road_tags(town, line)
        for piece, wet in _pieces(line, water):
            kept = without_straight_points(piece, keep=crossings)
            bridge = {"bridge": "yes", "layer": "1"} if wet else {}
            file.way([_middle(cell) for cell in kept], tags | bridge)


def _road_links(town: Town) -> Links:
    """Return for every cell of a road the cells it joins; a road passes over points in its way."""
    links: Links = defaultdict(list)
    anywhere = ROAD_PORTS["+"]
    for cell, glyph in town.drawn.items():
        if town.legend[glyph].kind != Kind.ROAD:
            continue
        ports = ROAD_PORTS.get(glyph, anywhere)
        for d in ports:
            there = step(cell, d)
            if town.kind(there) in (Kind.POINT, Kind.SPOT):
                there = step(there, d)
            if town.kind(there) != Kind.ROAD:
                continue
            theirs = ROAD_PORTS.get(town.drawn[there], anywhere)
            askew = d in DIAGONAL and ports is anywhere and theirs is anywhere
            if (-d[0], -d[1]) in theirs and not askew:
                links[cell].append(there)
    return links


def _road_tags(town: Town, line: list[Cell]) -> Tags:
    """Tags of the one label in a road, or of a residential road."""
    labels = {glyph: cell for cell in line if (glyph := town.drawn[cell]) not in ROAD_PORTS}
    labels = {g: cell for g, cell in labels.items() if town.legend[g].kind == Kind.ROAD}
    if len(labels) > 1:
        (one, here), (other, there) = list(labels.items())[:2]
        raise InputError(
            f"{town.where(there)}: one road has the labels {one!r} ({town.where(here)}) and "
            f"{other!r}; leave one out, or part the road by a blank."
        )
    return town.legend[next(iter(labels))].tags if labels else {"highway": "residential"}


def _pieces(line: list[Cell], water: set[Cell]) -> Iterator[tuple[list[Cell], bool]]:
    """Cut a road into pieces on land (False) and over water (True)."""
    wet = [a in water or b in water for a, b in pairwise(line)]
    start = 0
    for end in range(1, len(line)):
        if end == len(wet) or wet[end] != wet[start]:
            yield line[start : end + 1], wet[start]
            start = end


def _lines(town: Town, file: _File) -> None:
    for glyph, symbol in town.legend.items():
        if symbol.kind != Kind.LINE:
            continue
        links, _ = _line_links(town, glyph)
        for cell in town.cells(glyph):
            if cell not in links:
                raise InputError(f"{town.where(cell)}: {glyph!r} is a line of one character; "
                                 "draw two or more.")  # fmt: skip
        crossings = {cell for cell, arms in links.items() if len(arms) > 2}
        for line in strokes(links):
            kept = without_straight_points(line, keep=crossings)
            file.way([_middle(cell) for cell in kept], symbol.tags)


def _line_links(town: Town, glyph: str) -> tuple[Links, set[Cell]]:
    """Return which cells of a line join, and the cells of roads and points it passes over."""
    cells = set(town.cells(glyph))
    links: Links = defaultdict(list)
    passed: set[Cell] = set()

    def abreast(cell: Cell, d: Cell) -> bool:
        """Whether the line runs across the direction here: it does not pass over anything then."""
        return step(cell, (d[1], d[0])) in cells or step(cell, (-d[1], -d[0])) in cells

    for cell in sorted(cells):
        for d in ORTHOGONAL:
            next_to, beyond = step(cell, d), step(step(cell, d), d)
            if next_to in cells:
                links[cell].append(next_to)
            elif (
                beyond in cells
                and town.kind(next_to) not in (None, Kind.AREA)
                and not abreast(cell, d)
                and not abreast(beyond, d)
            ):
                links[cell].append(beyond)
                passed.add(next_to)
        for d in DIAGONAL:
            corners = step(cell, (d[0], 0)), step(cell, (0, d[1]))
            if step(cell, d) in cells and cells.isdisjoint(corners):
                links[cell].append(step(cell, d))
    return links, passed


def _areas(town: Town, file: _File) -> None:
    ground = _ground(town)
    doors = [spot for spot, tags in file.node_tags.items() if "entrance" in tags]
    for glyph, symbol in town.legend.items():
        if symbol.kind != Kind.AREA:
            continue
        for blot in blots(cell for cell, drawn in ground.items() if drawn == glyph):
            filled = blot if "building" in symbol.tags else blot | _islands(town, blot)
            traced = [[(float(r), float(c)) for r, c in ring] for ring in rings(filled)]
            outer, *inner = [with_doors(ring, doors) for ring in traced]
            if not inner:
                file.way(outer, symbol.tags)
                continue
            members = [("outer", file.way(outer, {}))]
            members += [("inner", file.way(ring, {})) for ring in inner]
            file.relations.append((members, {"type": "multipolygon"} | symbol.tags))


def _ground(town: Town) -> dict[Cell, str]:
    """Glyph of the area in every cell: drawn there, or on both sides of what stands there."""
    ground = {
        cell: glyph for cell, glyph in town.drawn.items() if town.legend[glyph].kind == Kind.AREA
    }
    changed = True
    while changed:  # a bridge over the middle of a river waits for the bridge over its edge
        changed = False
        for cell, glyph in town.drawn.items():
            if cell in ground:
                continue
            for sides in ((WEST, EAST), (NORTH, SOUTH)):
                one, other = (_next_area(town, ground, cell, side) for side in sides)
                in_street = town.legend[glyph].kind in (Kind.ROAD, Kind.LINE)
                if "entrance" in town.legend[glyph].tags:
                    one = other = one or other
                if one and one == other and not (in_street and "building" in town.legend[one].tags):
                    ground[cell] = one
                    changed = True
                    break
    return ground


def _islands(town: Town, blot: set[Cell]) -> set[Cell]:
    """Cells of things drawn within an area, such as a pond in a park: the area runs on below."""
    rows, columns = [r for r, _ in blot], [c for _, c in blot]
    box = {
        (r, c)
        for r in range(min(rows) - 1, max(rows) + 2)
        for c in range(min(columns) - 1, max(columns) + 2)
    }
    _, *holes = blots(box - blot)  # reading order: the box's corner comes first
    return {cell for hole in holes if hole <= town.drawn.keys() for cell in hole}


def _next_area(town: Town, ground: dict[Cell, str], cell: Cell, side: Cell) -> str | None:
    """Glyph of the first area to one side, with nothing but things drawn in between."""
    while (cell := step(cell, side)) in town.drawn:
        if cell in ground:
            return ground[cell]
    return None


def _water(town: Town) -> set[Cell]:
    """Cells in which a road is a bridge."""
    wet = {cell for cell, glyph in _ground(town).items() if town.legend[glyph].is_water}
    for glyph, symbol in town.legend.items():
        if symbol.kind == Kind.LINE and symbol.is_water:
            wet |= _line_links(town, glyph)[1]
    return wet


def _middle(cell: Cell) -> Spot:
    return cell[0] + 0.5, cell[1] + 0.5


def _xml(town: Town, file: _File) -> Iterator[str]:
    """Lines of the file, coordinates to 1e-7 degrees (about 1 cm) as in OpenStreetMap."""
    height, width = len(town.rows), len(town.rows[0])
    (west, north), (east, south) = town.lonlat(0, 0), town.lonlat(height, width)
    yield "<?xml version='1.0' encoding='UTF-8'?>"
    yield '<osm version="0.6" generator="placegraph">'
    yield (f'  <bounds minlat="{south:.7f}" minlon="{west:.7f}" '
           f'maxlat="{north:.7f}" maxlon="{east:.7f}"/>')  # fmt: skip
    for spot, number in file.nodes.items():
        longitude, latitude = town.lonlat(*spot)
        place = f'lat="{latitude:.7f}" lon="{longitude:.7f}"'
        yield from _element("node", number, place, [], file.node_tags.get(spot, {}))
    for number, (nodes, tags) in enumerate(file.ways, 1):
        yield from _element("way", number, "", [f'<nd ref="{n}"/>' for n in nodes], tags)
    for number, (members, tags) in enumerate(file.relations, 1):
        lines = [f'<member type="way" ref="{way}" role="{role}"/>' for role, way in members]
        yield from _element("relation", number, "", lines, tags)
    yield "</osm>"


def _element(kind: str, number: int, place: str, inner: list[str], tags: Tags) -> Iterator[str]:
    inner = [*inner, *(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in tags.items())]
    head = f'<{kind} id="{number}" version="1"{" " * bool(place)}{place}'
    if not inner:
        yield f"  {head}/>"
        return
    yield f"  {head}>"
    yield from (f"    {line}" for line in inner)
    yield f"  </{kind}>"
