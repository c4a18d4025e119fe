"""Which cities the outdoor benchmarks use, and which parts of them nothing was trained on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Floats
from placegraph.core.mapfile import gather_spans, offsets_of
from placegraph.errors import OptionError
from placegraph.outdoor.city import CityMap, build_city
from placegraph.outdoor.map.cells import find_in_cells
from placegraph.outdoor.map.objects import CityObjects
from placegraph_lab.tables.outdoor.matchers import cell_centers
from placegraph_lab.tables.outdoor.queries import JITTER, Query, Setting, make_queries
from placegraph_learn.city.descriptions import TILE, evaluated, held_out

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
    """Names of cities, given with commas; all where there are none."""
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

    among = where if parts else None
    return make_queries(path, setting=setting, n=n, seed=seed, anywhere=True, where=among)


Rows = NDArray[np.int64]
GAP = 200.0  # between copies at the least [m]


def take(objects: CityObjects, rows: Rows) -> CityObjects:
    """Objects `rows`, with those labels and names that they bear."""
    label_starts, entries = _rows(objects.label_starts, rows)
    labels, label_values = _used(objects.labels, objects.label_values[entries])
    name_starts, entries = _rows(objects.name_starts, rows)
    names, name_values = _used(objects.names, objects.name_values[entries])
    part_starts, parts = _rows(objects.part_starts, rows)
    point_starts, points = _rows(objects.point_starts, parts)
    return CityObjects(
        objects.osm_type[rows], objects.osm_id[rows], objects.kind[rows],
        label_starts, label_values, name_starts, name_values, part_starts, point_starts,
        objects.points[points], objects.center[rows], labels, names,
    )  # fmt: skip


def crop(city: CityMap, cells: int, around: ArrayLike | None = None) -> CityMap:
    """The `cells` cells that are nearest to a place, and what is seen in them.

    `around`: east and north (2,) [m]; the median of all objects if None. Smaller parts lie within
    larger ones around the same place.
    """
    if not 1 <= cells <= len(city.cells):
        raise OptionError(f"{cells:,} cells of a city that has {len(city.cells):,}.")
    middle = np.median(city.objects.center, axis=0) if around is None else np.asarray(around)
    off = cell_centers(city) - middle
    kept = np.sort(np.argsort(np.hypot(*off.T), kind="stable")[:cells])
    points = city.cells.points[kept]
    seen = find_in_cells(city.objects, city.cells.grid, city.cells.size)
    _, entries = _rows(seen.starts.astype(np.int32), np.searchsorted(seen.points, points))
    rows = np.unique(seen.objects[entries]).astype(np.int64)
    return replace(city, objects=take(city.objects, rows), cells=replace(city.cells, points=points))


def busiest_tile(city: CityMap, *, unseen: bool = False) -> Floats:
    """Middle (2,) [m] of the square kilometre with the most objects; `unseen`, of those held out."""
    at = city.objects.center
    at = at[held_out(*at.T)] if unseen else at
    tiles, counts = np.unique(np.floor(at / TILE), axis=0, return_counts=True)
    return np.asarray((tiles[counts.argmax()] + 0.5) * TILE)


def tile(city: CityMap, copies: int, rng: Generator) -> CityMap:
    """Copies of a city on a square grid; in all but the first, tags and names are exchanged.

    They are exchanged among points, among lines and among areas, both together, so that no copy
    repeats another: the distractors grow with the map, the truth does not.
    """
    o, n = city.objects, len(city.objects)
    step = city.cells.grid.stride
    size = step * np.ceil((np.ptp(o.points, axis=0) + GAP) / step)
    side = int(np.ceil(np.sqrt(copies)))
    shifts = [np.array([k % side, k // side]) * size for k in range(copies)]
    order = [np.arange(n), *(_exchanged(o.kind, rng) for _ in range(copies - 1))]
    tagged = np.concatenate(order)
    label_starts, labels = _rows(o.label_starts, tagged)
    name_starts, names = _rows(o.name_starts, tagged)
    last = int(o.osm_id.max()) + 1
    objects = CityObjects(
        np.tile(o.osm_type, copies), np.concatenate([o.osm_id + k * last for k in range(copies)]),
        np.tile(o.kind, copies), label_starts, o.label_values[labels],
        name_starts, o.name_values[names],
        offsets_of(np.tile(np.diff(o.part_starts), copies)).astype(np.int32),
        offsets_of(np.tile(np.diff(o.point_starts), copies)).astype(np.int32),
        np.concatenate([o.points + shift for shift in shifts]).astype(np.float32),
        np.concatenate([o.center + shift for shift in shifts]).astype(np.float32),
        o.labels, o.names,
    )  # fmt: skip
    return CityMap.create(
        city.plane, objects, cell_size=city.cells.size, stride=step,
        edge_distance=city.cells.edge_distance, source=f"{copies} x {city.source}", left_out={},
    )  # fmt: skip


def _exchanged(kind: NDArray[np.uint8], rng: Generator) -> Rows:
    """Permutation (N,) of objects within their kinds."""
    order = np.arange(len(kind))
    for k in np.unique(kind):
        rows = np.flatnonzero(kind == k)
        order[rows] = rng.permutation(rows)
    return order


def _rows(bounds: NDArray[np.int32], rows: Rows) -> tuple[NDArray[np.int32], Rows]:
    """CSR of some rows: their starts, and which entries they have."""
    made, entries = gather_spans(bounds.astype(np.int64), rows)
    return made.astype(np.int32), entries


def _used(
    table: tuple[str, ...], values: NDArray[np.int32]
) -> tuple[tuple[str, ...], NDArray[np.int32]]:
    used, inverse = np.unique(values, return_inverse=True)
    return tuple(table[i] for i in used), inverse.astype(np.int32)
