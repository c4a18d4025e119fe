"""Columns of the objects of a city: what OpenStreetMap says of each and where it lies."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.pickling import PickleFields
from placegraph.outdoor.map.geometry_kernels import _boxes, _centers, _keep

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
    center: NDArray[np.float32]
    """(N, 2) east, north [m]: the point, the middle of the line, the centroid of the area."""
    labels: tuple[str, ...]
    """``key=value``, sorted."""
    names: tuple[str, ...]
    """Names as written, sorted."""

    def __len__(self) -> int:
        return len(self.osm_id)

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


def centers(
    kind: NDArray[np.uint8],
    part_starts: NDArray[np.int32],
    point_starts: NDArray[np.int32],
    points: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Compute centres (N, 2) [m] of objects: the point, the middle of the line, the area's centroid."""
    return _centers(kind, part_starts, point_starts, points)


def columns_of(
    o: CityObjects, tokens: tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]
) -> CityColumns:
    """Return the columns of objects and their tokens (starts, values, weights) for compiled code."""
    kind, box = o.kind.view(), _boxes(o.part_starts, o.point_starts, o.points)
    kind.flags.writeable = False  # as of a map that was opened: compiled code tells the two apart
    return CityColumns(kind, o.part_starts, o.point_starts, o.points, o.center, box, *tokens)


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
