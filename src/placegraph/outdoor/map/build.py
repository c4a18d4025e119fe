"""From an OpenStreetMap extract to a city map (Eq. 1-8): read, label, simplify, sort, store."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import InputError, OptionError
from placegraph.formats.place.osm import LINE, LeftOut, OsmElement, read_osm
from placegraph.geometry import LocalPlane
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.map.objects import CityObjects
from placegraph.outdoor.map.simplify import centers, simplify

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from os import PathLike

    from numpy.typing import NDArray

    from placegraph.outdoor.language.vocabulary import Vocabulary

Progress = Callable[[str, int], None]
"""Called with the step's name and how many elements are done."""

TOLERANCE = 0.75
"""Outlines and lines are simplified to this error [m]: directions between things do not feel it."""
GRAIN = 0.5
"""Coordinates are stored in these steps [m]."""
LONGEST = 50_000.0
"""Things longer than this, and longer than the city, are left out [m]: meridians, sea lanes."""
UNKNOWN = "name=*"
"""Label of things that have a name and no tag the vocabulary knows."""
NOT_THINGS = frozenset({"boundary", "route", "type"})
"""What carries such a key and no known tag is a line on the map, not a thing."""
NAME_KEY = re.compile(
    r"(name|alt_name|official_name|short_name|loc_name|old_name|brand|name:[a-z]{2,3})$"
)


@dataclass
class _Columns:
    """Growing columns, one entry an element."""

    elements: list[tuple[int, int, int]]
    labels: list[tuple[str, ...]]
    names: list[tuple[str, ...]]
    parts: list[list[NDArray[np.float64]]]


def build_city(
    osm_path: str | PathLike[str],
    out_path: str | PathLike[str],
    *,
    cell_size: float = 50.0,
    stride: float | None = None,
    edge_distance: float | None = None,
    vocabulary: Vocabulary | None = None,
    progress: Progress | None = None,
) -> CityMap:
    """Build a city map from an OpenStreetMap extract and write it to `out_path`.

    Parameters
    ----------
    osm_path
        `.osm.pbf`, `.osm`, `.osm.gz` or `.osm.bz2`.
    out_path
        Map file to write (atomically; an old one is replaced only by a whole new one).
    cell_size
        Edge of a cell [m].
    stride
        Distance of neighbouring cells' centres [m]; the cell size where not given.
    edge_distance
        Objects of a cell nearer than this are joined by an edge [m]; the cell size where not given.
    vocabulary
        Which tags are worth naming; the shipped one where not given.
    progress
        Is told how far the build is.

    Raises
    ------
    InputError
        The file cannot be read, or holds nothing worth naming.
    OptionError
        A size is not positive.
    MapLockedError
        Somebody else is writing the same map.

    """
    if os.path.realpath(osm_path) == os.path.realpath(out_path):
        raise OptionError(f"{osm_path} would be overwritten by its map; name another file.")
    stride = cell_size if stride is None else stride
    edge_distance = cell_size if edge_distance is None else edge_distance
    for name, value in (
        ("cell_size", cell_size),
        ("stride", stride),
        ("edge_distance", edge_distance),
    ):
        if not 1.0 <= value <= 10_000.0:
            raise OptionError(f"{name} is {value} m; choose between 1 and 10,000 m.")
    if vocabulary is None:
        from placegraph.outdoor.language.vocabulary import Vocabulary as Shipped

        vocabulary = Shipped.default()
    left_out = LeftOut()
    elements = read_osm(osm_path, {*vocabulary.keys, "name"}, left_out)
    columns = _label(elements, vocabulary, progress or (lambda _step, _n: None))
    if columns.elements:
        columns = _without_longest(columns, left_out)
    if not columns.elements:
        raise InputError(
            f"{osm_path} holds nothing worth naming (roads, buildings, shops ...); left out: "
            f"{left_out}. Choose a larger extract, or extend the vocabulary."
        )
    plane, objects = _objects(columns)
    city = CityMap.create(
        plane,
        objects,
        cell_size=cell_size,
        stride=stride,
        edge_distance=edge_distance,
        source=Path(osm_path).name,
        left_out=dict(sorted(left_out.counts.items())),
    )
    city.save(out_path)
    return city


def _label(elements: Iterable[OsmElement], vocabulary: Vocabulary, progress: Progress) -> _Columns:
    columns = _Columns([], [], [], [])
    for n, element in enumerate(elements):
        if n % 1000 == 0:
            progress("reading", n)
        labels = vocabulary.labels_of(element.tags) or named_labels(element, vocabulary)
        if labels:
            columns.elements.append((element.osm_type, element.osm_id, element.kind))
            columns.labels.append(labels)
            columns.names.append(names_of(element.tags))
            columns.parts.append(element.parts)
    return columns


def names_of(tags: Mapping[str, str]) -> tuple[str, ...]:
    """Names of an element, the name proper first, without repetitions."""
    found = [tags["name"]] if "name" in tags else []
    found += [
        value
        for key, value in sorted(tags.items())
        if "name" in key or key == "brand"
        if NAME_KEY.match(key)
    ]
    split = (part.strip() for value in found for part in value.split(";"))
    return tuple(dict.fromkeys(part for part in split if part))


def named_labels(element: OsmElement, vocabulary: Vocabulary) -> tuple[str, ...]:
    """Labels of a thing known by its name alone; a name such as "parking lot" says what it is."""
    tags = element.tags
    if "name" not in tags or element.kind == LINE or not tags.keys().isdisjoint(NOT_THINGS):
        return ()
    senses = vocabulary.senses(tags["name"])
    best = [
        sense.label for sense in senses if sense.weight >= 0.9 and not sense.label.endswith("*")
    ]
    return tuple(best[:3]) or (UNKNOWN,)


def _without_longest(columns: _Columns, left_out: LeftOut) -> _Columns:
    """Leave out what would stretch the map far beyond the city."""
    lonlat = np.concatenate([part for parts in columns.parts for part in parts])
    at = _plane(lonlat).to_plane(lonlat)
    first = _starts([sum(map(len, parts)) for parts in columns.parts])[:-1]
    span = np.maximum.reduceat(at, first) - np.minimum.reduceat(at, first)
    city = np.ptp(np.percentile(at[first], (1, 99), axis=0), axis=0).max()
    keep = span.max(axis=1) <= max(LONGEST, city)
    if keep.all():
        return columns
    left_out.counts["things longer than the city"] += int((~keep).sum())
    return _Columns(
        list(compress(columns.elements, keep)),
        list(compress(columns.labels, keep)),
        list(compress(columns.names, keep)),
        list(compress(columns.parts, keep)),
    )


def _plane(lonlat: NDArray[np.float64]) -> LocalPlane:
    """Plane at the median: one far-off member of a clipped relation must not tilt it."""
    median = np.percentile(lonlat, 50, axis=0, method="lower")  # of a point: dates have a line
    return LocalPlane(*(round(float(x), 4) for x in median))


def _objects(columns: _Columns) -> tuple[LocalPlane, CityObjects]:
    n_parts = np.array([len(parts) for parts in columns.parts])
    flat = [part for parts in columns.parts for part in parts]
    lonlat = np.concatenate(flat)
    plane = _plane(lonlat)
    points, point_starts = simplify(
        plane.to_plane(lonlat), _starts([len(p) for p in flat]), TOLERANCE
    )
    steps = np.round(points / GRAIN).astype(np.int64)
    osm_type, osm_id, kind = np.array(columns.elements, np.int64).T
    part_starts = _starts(n_parts)
    first = steps[point_starts[part_starts[:-1]]]
    order = np.lexsort((osm_id, osm_type, _hilbert(first)))

    part_order = np.concatenate([np.arange(part_starts[i], part_starts[i + 1]) for i in order])
    point_order = np.concatenate(
        [np.arange(point_starts[p], point_starts[p + 1]) for p in part_order]
    )
    parts = _starts(n_parts[order]).astype(np.int32)
    ends = _starts(np.diff(point_starts)[part_order]).astype(np.int32)
    points = (steps[point_order] * GRAIN).astype(np.float32)
    kind = kind[order].astype(np.uint8)
    labels = [columns.labels[i] for i in order]
    names = [columns.names[i] for i in order]
    label_table, label_values = _table(labels)
    name_table, name_values = _table(names)
    return plane, CityObjects(
        osm_type=osm_type[order].astype(np.uint8),
        osm_id=osm_id[order],
        kind=kind,
        label_starts=_starts([len(x) for x in labels]).astype(np.int32),
        label_values=label_values,
        name_starts=_starts([len(x) for x in names]).astype(np.int32),
        name_values=name_values,
        part_starts=parts,
        point_starts=ends,
        points=points,
        center=centers(kind, parts, ends, points),
        labels=label_table,
        names=name_table,
    )


def _starts(lengths: Iterable[int] | NDArray[np.int64]) -> NDArray[np.int64]:
    return np.concatenate(([0], np.cumsum(np.asarray(list(lengths), np.int64))))


def _table(rows: list[tuple[str, ...]]) -> tuple[tuple[str, ...], NDArray[np.int32]]:
    table = tuple(sorted({word for row in rows for word in row}))
    index = {word: i for i, word in enumerate(table)}
    return table, np.array([index[word] for row in rows for word in row], np.int32)


def _hilbert(steps: NDArray[np.int64], bits: int = 18) -> NDArray[np.int64]:
    """Position (N,) along a Hilbert curve: neighbours in the file are neighbours on the ground."""
    x, y = (steps - steps.min(axis=0)).T.copy()
    d = np.zeros(len(x), np.int64)
    side = np.int64(1) << (bits - 1)
    while side > 0:
        rx, ry = (x & side) > 0, (y & side) > 0
        d += side * side * ((3 * rx) ^ ry)
        flip = ~ry
        mirror = flip & rx
        x[mirror], y[mirror] = side - 1 - x[mirror] % side, side - 1 - y[mirror] % side
        x[flip], y[flip] = y[flip], x[flip].copy()
        x, y = x % side, y % side
        side >>= 1
    return d
