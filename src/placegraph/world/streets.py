"""On which street a building stands: by its address, else by what streets lie near it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.language.words import tokens
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts
from placegraph.outdoor.map.index import REACH
from placegraph.outdoor.map.objects import AREA, LINE

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap

NEAREST, NEXT, FALL, ANY = 0.8, 0.4, 12.0, 0.003
"""Share of houses whose address is of the nearest street with a name; of one that is hardly farther,
and by how much farther [m] this falls to a third; and of any street. Of 28,000 pairs of house and
street in Vancouver, Manhattan, Toronto, Ankara, Monaco and Liechtenstein."""
AROUND_IT = 0.1
"""Share of houses whose address is of any one street within 150 m."""
WRITTEN, ASIDE = 0.97, 0.3
"""Whose address is on the map is said to be on that street; a corner house now and then on the other."""
AWAY = 150.0
"""No building stands on a street that is farther off [m]."""


@dataclass(frozen=True, eq=False)
class OnStreet:
    """Whether somebody in a building says to be on a street."""

    probability: float
    position: NDArray[np.float64]
    """(2,) of the street, nearest to the building [m]."""


def roads_called(city: CityMap, name: str) -> NDArray[np.int64]:
    """Rows of the streets that a name means; none where it means other things, too."""
    starts, objects = city.token_objects
    found = [t + len(city.objects.labels) for t in city.name_index.named(name)]
    rows = np.concatenate([objects[starts[t] : starts[t + 1]] for t in found] or [objects[:0]])
    own = all(_is_road(city, int(row)) for row in rows)
    return np.unique(rows) if own else rows[:0]


def on_street(
    city: CityMap, roads: NDArray[np.int64], corners: NDArray[np.float64]
) -> OnStreet | None:
    """Whether the building around `corners` (4, 2) [m] is on a street, by its rows; None: it is far off."""
    middle = corners.mean(axis=0)
    around = np.unique(city.in_sight(city.views.near(middle, REACH)).objects)
    buildings = [
        int(row)
        for row in around
        if city.objects.kind[row] == AREA
        and city.objects.label(row).startswith("building")
        and _away(city, row, middle[None])[0] == 0.0
    ]
    walls = np.concatenate([corners, *(p for row in buildings for p in city.objects.parts(row))])
    there, position = min((_away(city, row, walls) for row in roads), key=lambda x: x[0])
    others = [
        _away(city, row, walls)[0]
        for row in around
        if _is_road(city, row) and city.objects.name(row)
    ]
    if there > AWAY:
        return None
    farther = there - min([there, *others])
    near = NEAREST if farther < 0.1 else max(ANY, NEXT * float(np.exp(-farther / FALL)))
    written = {street for row in buildings for street in _addresses(city, row)}
    if not written:
        return OnStreet(near, position)
    called = {" ".join(tokens(city.objects.name(int(row)))) for row in roads}
    return OnStreet(WRITTEN if written & called else max(ANY, ASIDE * near), position)


def _away(
    city: CityMap, row: int, points: NDArray[np.float64]
) -> tuple[float, NDArray[np.float64]]:
    """How far an object is from the nearest of points (N, 2), and where it is nearest (2,) [m]."""
    o = city.objects
    best = (np.inf, points[0])
    for x, y in points.tolist():
        east, north, square = nearest_on_parts(
            o.part_starts, o.point_starts, o.points, o.kind[row], row, x, y
        )
        if square < best[0] ** 2:
            best = (float(np.sqrt(square)), np.array([x + east, y + north]))
    return best


def _is_road(city: CityMap, row: int) -> bool:
    return bool(city.objects.kind[row] == LINE) and city.objects.label(row).startswith("highway")


def _addresses(city: CityMap, row: int) -> list[str]:
    """Streets of a building's addresses: "7 Lange Straße" is on Lange Straße."""
    o = city.objects
    names = [o.names[i] for i in o.name_values[o.name_starts[row] : o.name_starts[row + 1]]]
    split = [name.partition(" ") for name in names if name[:1].isdigit()]
    return [" ".join(tokens(street)) for _, _, street in split if street]
