"""Which cities the outdoor benchmarks use, and which parts of them nothing was trained on."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Floats, LocalPlane
from placegraph.core.mapfile import offsets_of
from placegraph.errors import InputError, OptionError
from placegraph.outdoor.city import CityMap, build_city
from placegraph.outdoor.map.cells import find_in_cells
from placegraph.outdoor.map.objects import CityObjects
from placegraph_lab.tables.outdoor.matchers import cell_centers
from placegraph_lab.tables.outdoor.places import Bounds
from placegraph_lab.tables.outdoor.queries import FEWEST, JITTER, Query, Setting, make_queries
from placegraph_lab.worlds.shards import Rows, exchange_in_kinds, take_objects, take_rows
from placegraph_learn.city.descriptions import TILE, held_out, is_evaluation

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


_PRESETS = "karlsruhe=PATH, sydney=PATH and toronto=PATH take the area and the number of cells of Table VI."
CITY = f"Name of a shared city, or path of an OpenStreetMap extract; {_PRESETS}"
CITIES = f"Names of shared cities or paths of OpenStreetMap extracts, with commas; {_PRESETS}"
"""Help of the options that choose cities (`extracts_of`)."""


@dataclass(frozen=True)
class Area:
    """Area of the paper's Table VI: a square of its size around the city, and a number of cells.

    The paper prints neither outlines nor which places became cells. Cells are drawn among those that
    hold at least `FEWEST` objects, as in the published generator.
    """

    longitude: float
    latitude: float  # of the middle [deg]
    km2: float
    cells: int

    @property
    def bounds(self) -> Bounds:
        """West, south, east, north [deg]."""
        half = 500.0 * self.km2**0.5
        corners = LocalPlane(self.longitude, self.latitude).to_lonlat(
            [(-half, -half), (half, half)]
        )
        west, south, east, north = corners.ravel().tolist()
        return west, south, east, north


AREAS = {
    "karlsruhe": Area(8.404, 49.009, 173.5, 1000),
    "sydney": Area(150.93, -33.80, 12145.0, 486),
    "toronto": Area(-79.38, 43.72, 630.2, 479),
}


@dataclass(frozen=True)
class Extract:
    """City of a table: a shared extract by its name, or anybody's by its path."""

    name: str
    path: Path
    area: Area | None = None  # what of the extract is the map; all where None

    @property
    def is_trained(self) -> bool:
        """Whether the shipped network was trained on the city, but for its held-out tiles."""
        return self.name in TRAINED

    @cached_property
    def key(self) -> str:
        """Name of the city in caches: other files of the same name have other keys."""
        if self.name in EXTRACTS:
            return self.name
        about = self.path.stat()
        seen = f"{self.path.resolve()} {about.st_size} {about.st_mtime_ns} {self.area}"
        return f"{self.path.name.split('.')[0]}-{hashlib.sha256(seen.encode()).hexdigest()[:12]}"

    def cells_of(self, city: CityMap) -> Floats | None:
        """Centres (C, 2) [deg] of cells to speak in; None where viewpoints may lie in all of a city."""
        return None if self.area is None else city.plane.to_lonlat(cell_centers(city))

    def osm(self, maps: Path) -> Path:
        """Return the extract, or its part in the area, which is cut out once into the folder `maps`."""
        if self.area is None:
            return self.path
        out = maps / f"{self.key}.osm.pbf"
        if not out.exists():
            maps.mkdir(parents=True, exist_ok=True)
            check_covered(self, self.area)
            cut_out(self.path, out, self.area.bounds)
        return out

    def open(self, maps: Path) -> CityMap:
        """Open the map in the folder `maps`; it is built there if it is missing."""
        path = maps / f"{self.key}.city"
        if not path.exists():
            maps.mkdir(parents=True, exist_ok=True)
            build_city(self.osm(maps), path)
        city = CityMap.open(path)
        return city if self.area is None else draw_cells(city, self, self.area)


def extracts_of(cities: str, data: Path) -> list[Extract]:
    """Extracts of cities, given with commas (`CITIES`); all shared ones in `data` where there are none.

    Raises `OptionError` where a name is unknown, a file is missing, or two cities have one name.
    """
    found = []
    for city in [c.strip() for c in cities.split(",") if c.strip()] or EXTRACTS:
        preset, given, path = city.partition("=")
        if not given and city in EXTRACTS:
            found.append(Extract(city, data / EXTRACTS[city]))
            continue
        if given and preset not in AREAS:
            raise OptionError(
                f"{city}: the paper has no area of {preset!r}; choose from {', '.join(AREAS)}, or "
                "give the path alone, for the whole extract."
            )
        file = Path(path if given else city)
        if not file.is_file():
            raise OptionError(
                f"There is no extract {str(file)!r}: it is neither a file nor one of "
                f"{', '.join(EXTRACTS)}."
            )
        name = f"{preset}, {AREAS[preset].km2:g} km²" if given else file.name
        found.append(Extract(name, file, AREAS[preset] if given else None))
    names = [extract.name for extract in found]
    for name in names:
        if names.count(name) > 1:
            raise OptionError(f"Two extracts are called {name!r}; rename one of the files.")
    return found


def extract_of(city: str, data: Path) -> Extract:
    """Extract of one city; see `extracts_of`."""
    found = extracts_of(city, data)
    if len(found) != 1:
        raise OptionError(f"{city!r} names {len(found)} cities; give one.")
    return found[0]


def check_covered(extract: Extract, area: Area) -> None:
    """Raise `InputError` where the box of an extract does not hold the area.

    The box is that of the file's header, or that of its nodes where the header has none.
    """
    import osmium
    import osmium.io

    try:
        box = osmium.io.Reader(str(extract.path)).header().box()
        if not box.valid():
            for node in osmium.FileProcessor(str(extract.path), osmium.osm.NODE):
                if isinstance(node, osmium.osm.Node):
                    box.extend(node.location)
    except RuntimeError as error:
        raise InputError(f"{extract.path} cannot be read as OpenStreetMap data: {error}") from error
    if box.valid():
        low, high = box.bottom_left, box.top_right
        west, south, east, north = area.bounds
        if low.lon <= west and low.lat <= south and high.lon >= east and high.lat >= north:
            return
        has = f"{low.lon:.3f} to {high.lon:.3f} E, {low.lat:.3f} to {high.lat:.3f} N"
    else:
        has = "nothing"
    west, south, east, north = area.bounds
    raise InputError(
        f"{extract.path} holds {has}, but the area of {extract.name} is {west:.3f} to {east:.3f} E, "
        f"{south:.3f} to {north:.3f} N; take a larger extract, or the path alone for all of this one."
    )


def cut_out(path: Path, out: Path, bounds: Bounds) -> None:
    """Write what of an extract touches a box: nodes in it, ways with such a node, their relations."""
    import osmium

    west, south, east, north = bounds
    part = out.with_name(f"part-{out.name}")
    inside: dict[str, set[int]] = {"n": set(), "w": set()}
    with osmium.BackReferenceWriter(
        str(part), ref_src=str(path), overwrite=True, remove_tags=False
    ) as writer:
        for o in osmium.FileProcessor(str(path)):
            if isinstance(o, osmium.osm.Node):
                at = o.location
                if at.valid() and west <= at.lon <= east and south <= at.lat <= north:
                    inside["n"].add(o.id)
                    if o.tags:
                        writer.add(o)
            elif isinstance(o, osmium.osm.Way):
                if o.tags and any(node.ref in inside["n"] for node in o.nodes):
                    inside["w"].add(o.id)
                    writer.add(o)
            elif (
                isinstance(o, osmium.osm.Relation)
                and o.tags
                and any(member.ref in inside.get(member.type, ()) for member in o.members)
            ):
                writer.add(o)
    part.replace(out)


def draw_cells(city: CityMap, extract: Extract, area: Area) -> CityMap:
    """Return the map of as many cells as the paper has, drawn among those in the area."""
    seen = find_in_cells(city.objects, city.cells.grid, city.cells.size)
    counts = np.diff(seen.starts)[np.searchsorted(seen.points, city.cells.points)]
    west, south, east, north = area.bounds
    lonlat = city.plane.to_lonlat(cell_centers(city))
    inside = ((lonlat >= (west, south)) & (lonlat <= (east, north))).all(axis=1)
    rows = np.flatnonzero(inside & (counts >= FEWEST))
    if len(rows) < area.cells:
        raise InputError(
            f"{extract.path} has {len(rows):,} cells with {FEWEST} objects in the area of "
            f"{extract.name}; the paper has {area.cells:,}. Take a larger extract, or the path "
            "alone for all of this one."
        )
    rng = np.random.default_rng(0)
    return take_cells(city, np.sort(rng.choice(rows, area.cells, replace=False)))


def open_city(name: str, data: Path, maps: Path) -> CityMap:
    """Map of a shared city from the folder `maps`; built there from the extract where it is not."""
    return Extract(name, data / EXTRACTS[name]).open(maps)


def in_held_out_tiles(city: CityMap) -> Where:
    """Predicate for `make_queries`: whether positions (n, 2) [deg] lie in tiles for evaluation."""

    def where(lonlat: Floats) -> NDArray[np.bool_]:
        return is_evaluation(*city.plane.to_plane(lonlat).T)

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
    extract: Extract,
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
    cells, as in the published generator. Of an area of the paper, viewpoints lie in the map's cells.
    """
    if extract.area is not None:
        return make_queries(
            path, setting=setting, n=n, seed=seed, anywhere=not in_the_middle,
            cells=extract.cells_of(city),
        )  # fmt: skip
    parts = [in_held_out_tiles(city)] if extract.is_trained else []
    parts += [near_centers(city)] if in_the_middle else []

    def where(lonlat: Floats) -> NDArray[np.bool_]:
        return np.logical_and.reduce([part(lonlat) for part in parts], axis=0)

    among = where if parts else None
    return make_queries(path, setting=setting, n=n, seed=seed, anywhere=True, where=among)


GAP = 200.0  # between copies at the least [m]


def crop(city: CityMap, cells: int, around: ArrayLike | None = None) -> CityMap:
    """The `cells` cells that are nearest to a place, and what is seen in them.

    `around`: east and north (2,) [m]; the median of all objects if None. Smaller parts lie within
    larger ones around the same place.
    """
    if not 1 <= cells <= len(city.cells):
        raise OptionError(f"{cells:,} cells of a city that has {len(city.cells):,}.")
    middle = np.median(city.objects.center, axis=0) if around is None else np.asarray(around)
    off = cell_centers(city) - middle
    return take_cells(city, np.sort(np.argsort(np.hypot(*off.T), kind="stable")[:cells]))


def take_cells(city: CityMap, chosen: Rows) -> CityMap:
    """Map of cells `chosen` (rising rows of `city.cells.points`), and what is seen in them."""
    points = city.cells.points[chosen]
    seen = find_in_cells(city.objects, city.cells.grid, city.cells.size)
    _, entries = take_rows(seen.starts.astype(np.int32), np.searchsorted(seen.points, points))
    rows = np.unique(seen.objects[entries]).astype(np.int64)
    return replace(
        city, objects=take_objects(city.objects, rows), cells=replace(city.cells, points=points)
    )


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
    order = [np.arange(n), *(exchange_in_kinds(o.kind, rng) for _ in range(copies - 1))]
    tagged = np.concatenate(order)
    label_starts, labels = take_rows(o.label_starts, tagged)
    name_starts, names = take_rows(o.name_starts, tagged)
    last = int(o.osm_id.max()) + 1
    objects = CityObjects(
        np.tile(o.osm_type, copies), np.concatenate([o.osm_id + k * last for k in range(copies)]),
        np.tile(o.kind, copies), label_starts, o.label_values[labels],
        name_starts, o.name_values[names],
        offsets_of(np.tile(np.diff(o.part_starts), copies)).astype(np.int32),
        offsets_of(np.tile(np.diff(o.point_starts), copies)).astype(np.int32),
        np.concatenate([o.points + shift for shift in shifts]).astype(np.float32),
        o.labels, o.names,
    )  # fmt: skip
    return CityMap.create(
        city.plane, objects, cell_size=city.cells.size, stride=step,
        edge_distance=city.cells.edge_distance, source=f"{copies} x {city.source}", left_out={},
    )  # fmt: skip
