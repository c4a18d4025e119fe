"""Lettering: which names stand on the map and where, none on top of another.

Candidates are tried by rank, then by length of what they name; a name takes its place where it is
free. Streets are lettered along a stretch that is straight enough, points beside their symbol,
areas in the middle.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import atan2, ceil, floor, hypot, pi

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.outdoor.map.objects import CityObjects
from placegraph.view.draw.canvas import Area, Dot, Face, Line, MapItem, Points, Text
from placegraph.view.draw.style import PAINTS

SIZES = {2: 13.0, 3: 12.0, 4: 12.0}
"""Size of lettering by rank [px]; 11 where nothing is said."""
STRAIGHT = 0.97
"""A stretch is straight enough where its chord is this share of its length."""
NAMED_SINCE = {5: 0.8, 6: 1.0, 7: 1.0, 8: 1.5}
"""Names of a rank are left out of maps drawn at a smaller scale than this [px/m]."""
REPEAT = 420.0
"""One street is lettered again after this distance [px]."""


class OccupiedPlaces:
    """Space occupied by lettering and marks: discs (x, y, radius) [px]."""

    SIDE = 32.0
    """Discs are kept by squares of this side, no smaller than the sum of two radii [px]."""

    def __init__(self) -> None:
        self._discs: dict[tuple[int, int], list[tuple[float, float, float]]] = {}

    def claim(self, discs: Sequence[tuple[float, float, float]], *, force: bool = False) -> bool:
        """Claim space if it is free (or by force); return whether it was claimed."""
        if not force and any(map(self._hit, discs)):
            return False
        for x, y, radius in discs:
            square = floor(x / self.SIDE), floor(y / self.SIDE)
            self._discs.setdefault(square, []).append((x, y, radius))
        return True

    def _hit(self, disc: tuple[float, float, float]) -> bool:
        x, y, radius = disc
        column, row = floor(x / self.SIDE), floor(y / self.SIDE)
        return any(
            (x - a) ** 2 + (y - b) ** 2 < (radius + r) ** 2
            for i in (column - 1, column, column + 1)
            for j in (row - 1, row, row + 1)
            for a, b, r in self._discs.get((i, j), ())
        )


def covering_discs(text: Text, width: float, scale: float) -> list[tuple[float, float, float]]:
    """Return discs (x, y, radius) [px] that cover a text; x grows to the right, y downwards."""
    x, y = text.at[0] * scale + text.shift[0], -text.at[1] * scale + text.shift[1]
    radius = 0.62 * text.size
    n = max(1, ceil(width / text.size))
    start = {"l": 0.0, "m": -0.5, "r": -1.0}[text.anchor]
    along = (start + (np.arange(n) + 0.5) / n) * width
    cos, sin = np.cos(text.angle), np.sin(text.angle)
    return [(float(x + d * cos), float(y - d * sin), radius) for d in along]


def place_names(
    objects: CityObjects,
    items: Iterable[MapItem],
    scale: float,
    face: Face,
    occupied: OccupiedPlaces,
    *,
    skip: frozenset[int] = frozenset(),
) -> list[Text]:
    """Place names for the items of a map drawn at `scale` [px/m], around `occupied` space.

    `objects`: what has names.
    `items`: what is on the map.
    `scale`: pixels per metre.
    `face`: typeface, for the widths.
    `occupied`: where nothing may stand; what is placed is added.
    `skip`: rows of objects that are lettered otherwise.
    """
    items = list(items)
    wanted = _wanted(objects, items, scale, face, skip)
    for item in items:
        if isinstance(item, Dot) and PAINTS[item.paint].rank < 9 and item.paint != "transit":
            occupied.claim([(item.at[0] * scale, -item.at[1] * scale, 4.0)], force=True)
    placed: list[Text] = []
    streets: dict[str, list[Points]] = {}
    for rank, extent, name, item in wanted:
        size = SIZES.get(rank, 11.0)
        width = face.width(name, size)
        if isinstance(item, Line) and -extent * scale < width:
            continue
        for text in _places(item, name, size, width, scale):
            near = (hypot(*(text.at - other)) * scale < REPEAT for other in streets.get(name, []))
            if isinstance(item, Line) and any(near):
                continue
            if occupied.claim(covering_discs(text, width + 4.0, scale)):
                placed.append(text)
                if not isinstance(item, Line):
                    break
                streets.setdefault(name, []).append(text.at)
    return placed


def _wanted(
    objects: CityObjects,
    items: Iterable[MapItem],
    scale: float,
    face: Face,
    skip: frozenset[int],
) -> list[tuple[int, float, str, MapItem]]:
    """Sort what is worth a name at this scale: rank, -extent [m], name, item."""
    wanted: list[tuple[int, float, str, MapItem]] = []
    for item in items:
        rank = PAINTS[item.paint].rank
        if item.row < 0 or item.row in skip or rank > 8 or NAMED_SINCE.get(rank, 0.0) > scale:
            continue
        if name := face.drawable(objects.name(item.row)):
            wanted.append((rank, -_extent(item), name, item))
    return sorted(wanted, key=lambda entry: (*entry[:3], entry[3].row))


def _extent(item: MapItem) -> float:
    """Return the length of a line or of an area's box [m]; 0 for a point."""
    match item:
        case Line(parts):
            return float(sum(np.hypot(*np.diff(part, axis=0).T).sum() for part in parts))
        case Area(rings):
            return float(np.ptp(rings[0], axis=0).sum())
        case _:
            return 0.0


def _places(item: MapItem, name: str, size: float, width: float, scale: float) -> Iterator[Text]:
    """Yield candidate positions of a name, best first."""
    ink = PAINTS[item.paint].ink
    match item:
        case Dot(at):
            beside = PAINTS[item.paint].width / 2 + 4.0
            yield Text(at, name, size, ink, 0.0, "l", (beside, 0.0), item.row)
            yield Text(at, name, size, ink, 0.0, "r", (-beside, 0.0), item.row)
            yield Text(at, name, size, ink, 0.0, "m", (0.0, -beside - size / 2), item.row)
            yield Text(at, name, size, ink, 0.0, "m", (0.0, beside + size / 2), item.row)
        case Area(rings):
            box = np.ptp(rings[0], axis=0) * scale
            if width <= 1.1 * box[0] and size <= 0.8 * box[1]:
                center = (rings[0].max(axis=0) + rings[0].min(axis=0)) / 2
                yield Text(center, name, size, ink, row=item.row)
                yield Text(center, name, size, ink, 0.0, "m", (0.0, 1.6 * size), item.row)
        case Line(parts):
            for part in parts:
                for at, angle in _straight_stretches(part, (width + 8.0) / scale):
                    yield Text(at, name, size, ink, angle, row=item.row)


def _straight_stretches(line: Points, length: float) -> Iterator[tuple[Floats, float]]:
    """Yield middles [m] and angles [rad] of stretches of a line that fit a name."""
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
    if along[-1] < length:
        return
    slack = along[-1] - length
    # from the middle outwards
    starts = sorted(
        np.linspace(0.0, slack, 1 + int(slack / length * 4)), key=lambda s: abs(s - slack / 2)
    )
    for start in starts:
        ends = np.array([start, start + length / 2, start + length])
        points = np.stack([np.interp(ends, along, line[:, k]) for k in range(2)], axis=1)
        chord = points[2] - points[0]
        sag = hypot(*(points[1] - (points[0] + points[2]) / 2))
        if hypot(*chord) >= STRAIGHT * length and sag < 0.06 * length:
            angle = atan2(chord[1], chord[0])
            yield points[1], (angle + pi / 2) % pi - pi / 2
