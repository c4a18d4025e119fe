"""Objects around viewpoints, and the triples (label, relation, label) between them (Eq. 5-6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Floats
from placegraph_lab.tables.outdoor.outdoor_kernels import (
    BIN,
    EAST,
    LONGEST,
    NORTH,
    SOUTH,
    WEST,
    _nearest_around,
    _pairs,
    _rasterize,
)
from placegraph_lab.tables.outdoor.places import AREA, Ints, RawCity


@dataclass(frozen=True)
class Around:
    """Objects around V viewpoints; the entries of viewpoint v are `starts[v]:starts[v + 1]`."""

    starts: Ints  # (V + 1,)
    objects: NDArray[np.int32]  # (E,) rows of the `RawCity`, rising within a viewpoint
    points: Floats  # (E, 2) where they stand: east, north [m]


@dataclass(frozen=True)
class Bins:
    """Segments of a city by the square they pass; made once a city."""

    city: RawCity
    low: Floats  # (2,) corner of the first bin [m]
    shape: tuple[int, int]
    starts: Ints  # (bins + 1,)
    owners: NDArray[np.int32]  # objects that pass the bin, rising

    @classmethod
    def of(cls, city: RawCity) -> Bins:
        """Sort the segments, and every area's centre, into bins."""
        ends = city.segments.reshape(-1, 2)
        low = np.minimum(ends.min(0), city.center.min(0)) - BIN
        high = np.maximum(ends.max(0), city.center.max(0)) + BIN
        nx, ny = (int(n) for n in np.ceil((high - low) / BIN))
        owner = np.repeat(np.arange(len(city)), np.diff(city.segment_starts))
        passed, segment = _rasterize(city.segments, low, nx, ny)
        # a wide area is found by its centre too: its rim may be far from a viewpoint within
        areas = np.flatnonzero(city.kind == AREA)
        entries = np.stack(
            [
                np.concatenate([passed, _bin(city.center[areas], low, ny)]),
                np.concatenate([owner[segment], areas]),
            ]
        )
        bins, owners = np.unique(entries, axis=1)
        starts = np.searchsorted(bins, np.arange(nx * ny + 1))
        return cls(city, low, (nx, ny), starts, owners.astype(np.int32))

    def around(self, viewpoints: Floats, radius: float) -> Around:
        """Objects within `radius` of viewpoints (V, 2) east, north [m].

        An object stands at its point nearest to the viewpoint; an area that holds the viewpoint
        stands at its centroid where that is within the radius, else it is left out.
        """
        city = self.city
        counted, objects, points = _nearest_around(
            np.ascontiguousarray(viewpoints, np.float64), radius, (self.low, *self.shape),
            (self.starts, self.owners), (city.segment_starts, city.segments),
            (city.kind == AREA, city.center),
        )  # fmt: skip
        return Around(np.concatenate([[0], np.cumsum(counted)]), objects, points)

    def cells(self, points: Floats, step: float) -> Ints:
        return np.floor((points - self.low) / step).astype(np.int64)

    def centers(self, step: float) -> Floats:
        """Centres (V, 2) of the squares of a grid over the city, empty surroundings left out.

        The grid starts at the extract's south-west corner; east, north [m].
        """
        busy = np.flatnonzero(np.diff(self.starts))
        corner = BIN * np.stack(np.divmod(busy, self.shape[1]), 1)  # from the first bin's corner
        reach = np.arange(-1, int(np.ceil(BIN / step)) + 1)
        steps = np.stack(np.meshgrid(reach, reach, indexing="ij"), -1).reshape(-1, 2)
        first = np.floor(corner / step).astype(np.int64)
        at = np.unique((first[:, None] + steps).reshape(-1, 2), axis=0)
        return np.asarray(self.low + (at + 0.5) * step)


def _bin(points: Floats, low: Floats, ny: int) -> Ints:
    at = np.floor((points - low) / BIN).astype(np.int64)
    return np.asarray(at[:, 0] * ny + at[:, 1])


DIRECTIONS = ("north", "south", "east", "west")


def relations(delta: ArrayLike) -> NDArray[np.int8]:
    """Direction (...) of A seen from B, for A - B (..., 2) east, north [m] (Eq. 6).

    An index into `DIRECTIONS`. The equation leaves |dx| = |dy| open: north and south win here.
    """
    dx, dy = np.moveaxis(np.asarray(delta, np.float64), -1, 0)
    upright = np.where(dy > 0.0, NORTH, SOUTH)
    return np.where(np.abs(dx) <= np.abs(dy), upright, np.where(dx > 0.0, EAST, WEST)).astype(
        np.int8
    )


@dataclass(frozen=True)
class Triples:
    """Ordered pairs of objects around V viewpoints; viewpoint v has `starts[v]:starts[v + 1]`."""

    starts: Ints  # (V + 1,)
    source: NDArray[np.int32]  # (T,) entry of the `Around`: what is described
    target: NDArray[np.int32]  # (T,) entry of the `Around`: what it is described by
    relation: NDArray[np.int8]  # (T,) index into `DIRECTIONS`: the source seen from the target

    @classmethod
    def of(cls, around: Around, longest: float = LONGEST) -> Triples:
        """All ordered pairs of objects `SHORTEST` to `longest` apart [m]."""
        return cls(*_pairs(around.starts, around.points, longest))

    def codes(self, around: Around, label: NDArray[np.int32], labels: int) -> Ints:
        """(T,) one integer a triple of labels, where `label` (N,) counts up to `labels`."""
        return encode(
            label[around.objects[self.source]],
            self.relation,
            label[around.objects[self.target]],
            labels,
        )


def encode(source: ArrayLike, relation: ArrayLike, target: ArrayLike, labels: int) -> Ints:
    """Code of triples: ``(source * 4 + relation) * labels + target``."""
    head = np.asarray(source, np.int64) * len(DIRECTIONS) + np.asarray(relation, np.int64)
    return np.asarray(head * labels + np.asarray(target, np.int64))
