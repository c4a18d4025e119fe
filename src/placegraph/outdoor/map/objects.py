"""Columns of the objects of a city: what OpenStreetMap says of each, where it lies, and its lines."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.pickling import PickleFields
from placegraph.outdoor.map.geometry_kernels import _boxes, _keep, compute_centers

Rows = NDArray[np.int64]

POINT, LINE, AREA = 0, 1, 2
"""Kinds of geometry."""
GRAIN = 0.5
"""Coordinates are stored in these steps [m]."""
FARTHEST = 2.1e7
"""No place is farther from another [m]: half the way around the Earth, and a little."""


@dataclass(frozen=True)
class CityObjects(PickleFields):
    """Columns of the objects of a city; row i of every column is one object.

    CSR columns come as pairs: the entries of row i are ``values[starts[i]:starts[i + 1]]``.
    """

    osm_type: NDArray[np.uint8]
    """(N,) 0 node, 1 way, 2 relation."""
    osm_id: NDArray[np.int64]
    """(N,)"""
    kind: NDArray[np.uint8]
    """(N,) POINT, LINE or AREA."""
    label_starts: NDArray[np.int32]
    """(N + 1,)"""
    label_values: NDArray[np.int32]
    """Indices into `labels`, most specific first."""
    name_starts: NDArray[np.int32]
    """(N + 1,)"""
    name_values: NDArray[np.int32]
    """Indices into `names`, the name proper first, then other names."""
    part_starts: NDArray[np.int32]
    """(N + 1,) parts (lines, or outer and inner rings) of an object."""
    point_starts: NDArray[np.int32]
    """(P + 1,) points of a part."""
    points: NDArray[np.float32]
    """(V, 2) east, north [m]. Rings are closed: the first point is the last."""
    labels: tuple[str, ...]
    """``key=value``, sorted."""
    names: tuple[str, ...]
    """Names as written, sorted."""

    def __post_init__(self) -> None:
        kind = self.kind.view()
        kind.flags.writeable = False  # as in a map file: kernels are compiled for each of the two
        object.__setattr__(self, "kind", kind)

    def __len__(self) -> int:
        return len(self.osm_id)

    @cached_property
    def center(self) -> NDArray[np.float32]:
        """(N, 2) east, north [m]: the point, the middle of the line, the centroid of the area."""
        return compute_centers(self.kind, self.part_starts, self.point_starts, self.points)

    def check(self) -> None:
        """Raise `ValueError` where columns contradict each other (a damaged or hand-made map)."""
        n = len(self)
        ends = (
            (self.osm_type, n, "osm_type"),
            (self.kind, n, "kind"),
            (self.label_values, self.label_starts[-1], "label_values"),
            (self.name_values, self.name_starts[-1], "name_values"),
            (self.point_starts, self.part_starts[-1] + 1, "point_counts"),
            (self.points, self.point_starts[-1], "points"),
        )
        for column, length, name in ends:
            if len(column) != length:
                raise ValueError(f"{name} has {len(column)} entries instead of {length}")
        for starts, name in (
            (self.label_starts, "labels"),
            (self.name_starts, "names"),
            (self.part_starts, "parts"),
        ):
            if len(starts) != n + 1:
                raise ValueError(f"{name} are of {len(starts) - 1} objects instead of {n}")
        starts_of_all = (self.label_starts, self.part_starts, self.point_starts)
        if not n or any(np.diff(starts).min(initial=1) < 1 for starts in starts_of_all):
            raise ValueError("there is no object, or one lacks a label or a point")
        if not -FARTHEST <= self.points.min() <= self.points.max() <= FARTHEST:
            raise ValueError("a point is out of range")
        if max(self.kind.max(), self.osm_type.max()) > 2:
            raise ValueError("an object has an unknown kind")
        for values, table, name in (
            (self.label_values, self.labels, "label_values"),
            (self.name_values, self.names, "name_values"),
        ):
            if len(values) and not 0 <= values.min() <= values.max() < len(table):
                raise ValueError(f"{name} point outside their table")

    def osm(self, i: int) -> str:
        """Return OpenStreetMap's own id of object i: ``node/1``, ``way/2``, ``relation/3``."""
        return f"{('node', 'way', 'relation')[self.osm_type[i]]}/{self.osm_id[i]}"

    def label(self, i: int) -> str:
        """Return the most specific label of object i."""
        return self.labels[self.label_values[self.label_starts[i]]]

    def name(self, i: int) -> str:
        """Return the name of object i, or an empty string."""
        start = self.name_starts[i]
        return self.names[self.name_values[start]] if start < self.name_starts[i + 1] else ""

    def parts(self, i: int) -> list[NDArray[np.float32]]:
        """Return the lines or rings of object i, each (n, 2) east, north [m]."""
        bounds = self.point_starts[self.part_starts[i] : self.part_starts[i + 1] + 1]
        return [self.points[a:b] for a, b in itertools.pairwise(bounds)]


class CityColumns(NamedTuple):
    """Columns of `CityObjects` and of their tokens, for compiled code."""

    kind: NDArray[np.uint8]
    part_starts: NDArray[np.int32]
    point_starts: NDArray[np.int32]
    points: NDArray[np.float32]
    center: NDArray[np.float32]
    box: NDArray[np.float32]
    """(N, 4) its west, south, east and north end [m]."""
    token_starts: NDArray[np.int32]
    token_values: NDArray[np.int32]
    token_weights: NDArray[np.float32]


def of_name(name: str) -> str:
    """Return the token that stands for a proper name."""
    return "~" + " ".join(name.split()).casefold()


def index_of(labels: tuple[str, ...]) -> dict[str, list[int]]:
    """Index the rows of labels by label and by ``key=*``."""
    index: dict[str, list[int]] = {}
    for row, label in enumerate(labels):
        index.setdefault(label, []).append(row)
        wildcard = label.partition("=")[0] + "=*"
        if wildcard != label:
            index.setdefault(wildcard, []).append(row)
    return index


def columns_of(
    o: CityObjects, tokens: tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]
) -> CityColumns:
    """Return the columns of objects and their tokens (starts, values, weights) for compiled code."""
    box = _boxes(o.part_starts, o.point_starts, o.points)
    return CityColumns(o.kind, o.part_starts, o.point_starts, o.points, o.center, box, *tokens)


def ends_of(points: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the south-western and north-eastern corner (2,) of points (N, 2)."""
    axes = np.ascontiguousarray(points.T)  # NumPy is slow across rows of two
    return axes.min(axis=1), axes.max(axis=1)


def simplify(
    points: NDArray[np.float64], starts: NDArray[np.int64], tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Drop points that lie within `tolerance` [m] of the simplified line of their part.

    `points` is (V, 2), `starts` (P + 1,) bounds the parts; both come back shorter. Ends stay;
    rings (first point = last) keep at least the corner farthest from their first point.
    """
    keep = _keep(points, starts, tolerance)
    kept = np.concatenate(([0], np.cumsum(keep)))
    return points[keep], kept[starts]


class Lines(NamedTuple):
    """Lines of objects, one behind the other: a place on them is one number, its distance along all."""

    points: Floats
    """(V, 2) [m]"""
    along: Floats
    """(V,) [m], ascending; one line begins 1 m after the end of the one before."""
    ends: Floats
    """(L, 2) distances of the ends of every line [m]."""
    row: Rows
    """(L,) row of its object."""

    @classmethod
    def of_objects(cls, objects: CityObjects, rows: Rows) -> Lines:
        """Take the lines and outlines of objects (n,)."""
        own, part = expand(objects.part_starts[rows], np.diff(objects.part_starts)[rows])
        count = np.diff(objects.point_starts)[part]
        at = expand(objects.point_starts[part], count)[1]
        points = objects.points[at].astype(np.float64)
        step = np.hypot(*np.diff(points, axis=0, prepend=points[:1]).T)
        last = np.cumsum(count) - 1
        step[last + 1 - count] = 1.0
        along = np.cumsum(step)
        ends = np.column_stack([along[last + 1 - count], along[last]])
        return cls(points, along, ends, rows[own])

    def locate(self, at: Floats) -> Floats:
        """Return the points (n, 2) [m] at distances (n,)."""
        if not len(at):
            return np.zeros((0, 2))
        return np.column_stack([np.interp(at, self.along, axis) for axis in self.points.T])

    def find_line(self, at: Floats) -> Rows:
        """Find the line of distances (n,)."""
        return np.searchsorted(self.ends[:, 0], at, "right") - 1

    def sample(self, step: float, ends: Floats | None = None) -> tuple[Rows, Floats, Floats]:
        """Sample lines, or stretches with ends (E, 2), at most `step` [m] apart.

        Returns the stretch of every sample, its position (K, 2) [m], and the direction there (K, 2).
        """
        begin, end = (self.ends if ends is None else ends).T
        count = np.ceil((end - begin) / step).astype(np.int64) + 1
        own, k = expand(np.zeros(len(count), np.int64), count)
        points = self.locate(begin[own] + (end - begin)[own] * k / np.maximum(count[own] - 1, 1))
        each = np.arange(len(own))
        ahead = points[each + (k < count[own] - 1)] - points[each - (k > 0)]
        return own, points, ahead


def expand(first: NDArray[np.integer[Any]], count: Rows) -> tuple[Rows, Rows]:
    """Return the owner and the value of all entries of ranges (n,) by their begin and length."""
    own = np.repeat(np.arange(len(first)), count)
    return own, np.arange(len(own)) - np.repeat(np.cumsum(count) - count - first, count)


def join(a: Floats, b: Floats, reach: float) -> tuple[Rows, Rows]:
    """Return all pairs of rows of points (N, 2) and (M, 2) that lie within `reach` of each other."""

    def keys(cells: Floats) -> Rows:
        return (cells[:, 0].astype(np.int64) << 32) + cells[:, 1].astype(np.int64)

    order = np.argsort(keys(np.floor(b / reach)), kind="stable")
    sorted_keys = keys(np.floor(b / reach))[order]
    i, j = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for shift in np.ndindex(3, 3):
        key = keys(np.floor(a / reach) + shift - 1)
        first, last = np.searchsorted(sorted_keys, key), np.searchsorted(sorted_keys, key, "right")
        own, at = expand(first, last - first)
        near = ((a[own] - b[order[at]]) ** 2).sum(axis=1) <= reach**2
        i.append(own[near])
        j.append(order[at[near]])
    return np.concatenate(i), np.concatenate(j)


def find_labelled(objects: CityObjects, labels: frozenset[str]) -> Rows:
    """Find the rows of objects that bear one of some labels."""
    wanted = [i for i, label in enumerate(objects.labels) if label in labels]
    hits = np.flatnonzero(np.isin(objects.label_values, wanted))
    return np.unique(np.searchsorted(objects.label_starts, hits, "right") - 1)


HIDDEN = frozenset(("tunnel=yes", "parking=underground", "railway=abandoned", "railway=razed"))
"""Labels of objects that nobody sees."""


def find_hidden(objects: CityObjects) -> Rows:
    """Find the rows of objects that nobody sees: in tunnels or under the ground, and subways off bridges."""
    subways = find_labelled(objects, frozenset(("railway=subway",)))
    tracks = subways[objects.kind[subways] == LINE]
    bridges = find_labelled(objects, frozenset(("bridge=yes", "bridge=viaduct")))
    return np.union1d(find_labelled(objects, HIDDEN), np.setdiff1d(tracks, bridges))
