"""Which cities the outdoor benchmarks use, and which parts of them nothing was trained on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.outdoor.city import CityMap, build_city
from placegraph_lab.tables.outdoor.queries import JITTER, Query, Setting, make_queries
from placegraph_learn.city.descriptions import evaluated

Where = Callable[[Floats], NDArray[np.bool_]]


TRAINED = {
    "vancouver": "vancouver_2015.osm.pbf",
    "ankara": "ankara_2019.osm.pbf",
    "liechtenstein": "liechtenstein_2021.osm.pbf",
    "andorra": "andorra_2026.osm.pbf",
}
"""Tuned on, and trained on but for the tiles held out."""
UNSEEN = {"monaco": "monaco_2025.osm.pbf", "toronto": "toronto_downtown_2020.osm.bz2"}
"""Never tuned or trained on."""
EXTRACTS = TRAINED | UNSEEN


def names_of(cities: str) -> list[str]:
    """Names of cities, given with commas; all where there are none.

    Raises
    ------
    OptionError
        Where there is no such city.
    """
    names = [c.strip() for c in cities.split(",") if c.strip()] or list(EXTRACTS)
    for name in names:
        if name not in EXTRACTS:
            raise OptionError(f"There is no extract {name!r}; choose from {', '.join(EXTRACTS)}.")
    return names


def open_city(name: str, data: Path, maps: Path) -> CityMap:
    """Map of a city from the folder `maps`; built there from the extract where it is not."""
    path = maps / f"{name}.city"
    if not path.exists():
        maps.mkdir(parents=True, exist_ok=True)
        build_city(data / EXTRACTS[name], path)
    return CityMap.open(path)


def in_held_out_tiles(city: CityMap) -> Where:
    """Predicate for `make_queries`: whether positions (n, 2) [deg] lie in tiles for evaluation."""

    def where(lonlat: Floats) -> NDArray[np.bool_]:
        return evaluated(*city.plane.to_plane(lonlat).T)

    return where


def near_centers(city: CityMap, radius: float = JITTER) -> Where:
    """Predicate for `make_queries`: whether a position is this near to the centre of its cell [m]."""
    grid = city.cells.grid

    def where(lonlat: Floats) -> NDArray[np.bool_]:
        step = (city.plane.to_plane(lonlat) - (grid.east, grid.north)) / grid.stride
        off = grid.stride * (step - np.round(step))
        return np.asarray(np.hypot(*off.T) <= radius)

    return where


def unseen_queries(
    name: str,
    city: CityMap,
    path: Path,
    *,
    n: int,
    seed: int,
    setting: Setting = "none",
    statements: int = 6,
    in_the_middle: bool = False,
) -> list[Query]:
    """Queries from places that nothing was trained on: held-out tiles, or all of an unseen city.

    What is searched is always all of the city. Viewpoints lie anywhere in a cell, so that no grid
    is told where to look; `in_the_middle`, they lie within 10 m of the centres of the map's own
    cells, as in the published generator.
    """
    parts = [in_held_out_tiles(city)] if name in TRAINED else []
    parts += [near_centers(city)] if in_the_middle else []

    def where(lonlat: Floats) -> NDArray[np.bool_]:
        return np.logical_and.reduce([part(lonlat) for part in parts], axis=0)

    return make_queries(
        path,
        statements=statements,
        setting=setting,
        n=n,
        seed=seed,
        anywhere=True,
        where=where if parts else None,
    )
