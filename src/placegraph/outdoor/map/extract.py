"""From an OpenStreetMap extract to the objects of a city (Eq. 1-2): read, label, simplify, sort."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import InputError
from placegraph.formats.place.osm import LINE, POINT, LeftOut, OsmElement, read_osm
from placegraph.formats.place.overture import Overture, read_overture
from placegraph.geometry import LocalPlane
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.index import STRIDE
from placegraph.outdoor.map.objects import GRAIN, CityObjects, centers, simplify
from placegraph.outdoor.map.raster import EACH, MOST

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from os import PathLike

    from numpy.typing import NDArray

Progress = Callable[[str, int], None]
"""Called with the step's name and how many elements are done."""

TOLERANCE = 0.75
"""Outlines and lines are simplified to this error [m]: directions between things do not feel it."""
LONGEST = 50_000.0
"""Things longer than this are left out [m]: meridians, sea lanes, long-distance roads in one piece."""
UNKNOWN = "name=*"
"""Label of things that have a name and no tag the vocabulary knows."""
NOT_THINGS = frozenset({"boundary", "route", "type"})
"""What carries such a key and no known tag is a line on the map, not a thing."""
NAME_KEY = re.compile(
    r"(name|alt_name|official_name|short_name|loc_name|old_name|int_name|nat_name|reg_name|brand"
    r"|(name|brand|official_name):[a-z]{2,3}(-[A-Za-z]+)?)$"
)
RUN = frozenset({"amenity", "shop", "office", "craft", "healthcare", "leisure", "tourism"})
"""What carries such a key and no name is called by who runs it: a letter box of the post."""


@dataclass
class _Columns:
    """Growing columns, one entry an element."""

    elements: list[tuple[int, int, int]]
    labels: list[tuple[str, ...]]
    names: list[tuple[str, ...]]
    parts: list[list[NDArray[np.float64]]]


def read_extract(
    path: str | PathLike[str] | Overture,
    vocabulary: Vocabulary | None = None,
    progress: Progress | None = None,
) -> tuple[LocalPlane, CityObjects, dict[str, int]]:
    """Objects of an extract, or of Overture, in a plane of their own, and what was left out, by reason.

    Raises
    ------
    InputError
        The file cannot be read, or holds nothing worth naming.

    """
    vocabulary, left_out = vocabulary or Vocabulary.default(), LeftOut()
    if isinstance(path, Overture):
        elements = read_overture(path, left_out)
    else:
        elements = read_osm(path, keys_read(vocabulary), left_out)
    columns = _label(elements, vocabulary, progress or (lambda _step, _n: None))
    if columns.elements:
        columns = _without_largest(columns, left_out)
    if not columns.elements:
        raise InputError(
            f"{path} holds nothing worth naming (roads, buildings, shops ...); left out: "
            f"{left_out}. Choose a larger extract, or extend the vocabulary."
        )
    return *_objects(columns), dict(sorted(left_out.counts.items()))


def keys_read(vocabulary: Vocabulary | None = None) -> frozenset[str]:
    """Keys of the elements that a city is made of, by the shipped vocabulary where none is given."""
    return frozenset((*(vocabulary or Vocabulary.default()).keys, "name"))


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
    """Names of an element, the name proper first, the address last, without repetitions."""
    found = [tags["name"]] if "name" in tags else []
    found += [
        value
        for key, value in sorted(tags.items())
        if "name" in key or "brand" in key
        if NAME_KEY.match(key)
    ]
    if not found and "operator" in tags and not RUN.isdisjoint(tags):
        found.append(tags["operator"])
    if "addr:housenumber" in tags and "addr:street" in tags:
        number = tags["addr:housenumber"].partition(",")[0]
        found.append(f"{number} {tags['addr:street']}")
    split = (part.strip() for value in found for part in value.split(";"))
    return tuple(dict.fromkeys(part for part in split if part))


def named_labels(element: OsmElement, vocabulary: Vocabulary) -> tuple[str, ...]:
    """Labels of a thing known by its name alone; a name such as "parking lot" says what it is."""
    tags = element.tags
    if "name" not in tags or element.kind == LINE or not tags.keys().isdisjoint(NOT_THINGS):
        return ()
    roads = {s.label for s in vocabulary.senses("road")} if element.kind == POINT else set()
    best = [
        sense.label
        for sense in vocabulary.senses(tags["name"])
        if sense.weight >= 0.9 and not sense.label.endswith("*")
        if sense.label not in roads  # a place called "Avenues" is no avenue
    ]
    return tuple(best[:3]) or (UNKNOWN,)


def _without_largest(columns: _Columns, left_out: LeftOut) -> _Columns:
    """Leave out what would stretch the map far beyond a city, or fill it with grid points."""
    lonlat = np.concatenate([part for parts in columns.parts for part in parts])
    at = _plane(lonlat).to_plane(lonlat)
    counts = [sum(map(len, parts)) for parts in columns.parts]
    first = _starts(counts)[:-1]
    span = np.maximum.reduceat(at, first) - np.minimum.reduceat(at, first)
    keep = span.max(axis=1) <= LONGEST
    points = span / STRIDE + 5.0  # of the grid of viewpoints
    cost = keep * (points.prod(axis=1) + points[:, 1] * counts)
    order = np.argsort(cost, kind="stable")
    keep[order] &= 2.0 * np.cumsum(cost[order]) <= MOST + EACH * len(keep)
    if keep.all():
        return columns
    left_out.counts["things larger than a city"] += int((~keep).sum())
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
