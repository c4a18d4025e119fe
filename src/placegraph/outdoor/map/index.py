"""Viewpoints of a city and what stands around each: what candidates are found by.

A sentence is spoken somewhere, not "in a tile". Every 20 m where anything is in sight there is a
viewpoint; for each the objects in sight are listed with their nearest points, and for each *token*
(a label or a name) the viewpoints that have it in sight, as in an inverted index.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from placegraph.outdoor.map.index_kernels import _postings
from placegraph.outdoor.map.raster import Grid, Sightings, sightings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.outdoor.map.objects import CityObjects


POINT, AREA = 0, 2


STRIDE = 20.0
"""Distance of neighbouring viewpoints [m]."""


SIGHT = 25.0
"""Distance at which half the things are still spoken of [m]."""


FADE = 3.5
"""Width of the fall around `SIGHT` [m]."""


REACH = 38.0
"""Beyond this distance a thing is not listed at a viewpoint [m]."""


ENOUGH = 2.0
"""A viewpoint needs this much in sight (sum of `sight`), or a point object close by."""


SECOND_LABEL = (1.0, 0.35, 0.2)
"""How readily a thing is called by its first, second, third ... label."""


_MOST = 4
"""Viewpoints of a line, and lines, within `STRIDE` of a place to both sides; one is to spare."""


class ViewColumns(NamedTuple):
    """Columns of `ViewIndex` under the same names, for compiled code."""

    positions: NDArray[np.float32]
    starts: NDArray[np.int64]
    objects: NDArray[np.int32]
    offsets: NDArray[np.float32]
    sight: NDArray[np.float32]
    total: NDArray[np.float32]
    pairs: NDArray[np.float32]
    posting_starts: NDArray[np.int64]
    posting_views: NDArray[np.int32]
    posting_mass: NDArray[np.float32]
    posting_boxes: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class ViewIndex:
    """Viewpoints (W), objects in sight of each (CSR), and viewpoints by token (CSR)."""

    positions: NDArray[np.float32]
    """(W, 2) east, north [m]."""
    starts: NDArray[np.int64]
    """(W + 1,) entries of a viewpoint."""
    objects: NDArray[np.int32]
    """(E,) row of the object in sight."""
    offsets: NDArray[np.float32]
    """(E, 2) its nearest point seen from the viewpoint [m]."""
    sight: NDArray[np.float32]
    """(E,) how readily a thing at this distance is spoken of, 0 to 1."""
    total: NDArray[np.float32]
    """(W,) sum of `sight` over a viewpoint's entries."""
    pairs: NDArray[np.float32]
    """(W,) sum of products of `sight` over ordered pairs of what one does not stand in."""
    token_starts: NDArray[np.int32]
    """(N + 1,) tokens of an object: its labels, then its names (shifted by the number of labels)."""
    token_values: NDArray[np.int32]
    token_weights: NDArray[np.float32]
    """How readily the object is called so."""
    posting_starts: NDArray[np.int64]
    """(T + 1,) viewpoints of a token."""
    posting_views: NDArray[np.int32]
    """Viewpoint, ascending within a token."""
    posting_mass: NDArray[np.float32]
    """Sum of `sight` times token weight over the viewpoint's objects of this token."""
    posting_boxes: NDArray[np.int32]
    """(P,) ends of the offsets of these objects [m]: west, south, east, north, a byte each."""

    @classmethod
    def build(cls, objects: CityObjects) -> ViewIndex:
        """Viewpoints of a city; about 1 s for 50,000 objects."""
        low, high = objects.points.min(axis=0) - REACH, objects.points.max(axis=0) + REACH
        columns, rows = (int(n) for n in np.ceil((high - low) / STRIDE) + 1)
        grid = Grid(float(low[0]), float(low[1]), STRIDE, columns, rows)
        seen = sightings(
            objects.kind,
            objects.part_starts,
            objects.point_starts,
            objects.points,
            grid=grid,
            radius=REACH,
        )
        seen, sight = _worth_standing(seen, objects.kind)
        row, column = np.divmod(seen.points, columns)
        positions = np.stack([low[0] + STRIDE * column, low[1] + STRIDE * row], axis=1)
        total = np.add.reduceat(sight, seen.starts[:-1])
        inside = (objects.kind[seen.objects] == AREA) & ~seen.offsets.any(axis=1)
        apart = np.where(inside, np.float32(0.0), sight)  # what one stands in lies in no direction
        pairs = np.add.reduceat(apart, seen.starts[:-1]) ** 2 - np.add.reduceat(
            apart * apart, seen.starts[:-1]
        )
        tokens = tokens_of(objects)
        n_tokens = len(objects.labels) + len(objects.names)
        postings = _postings(seen.starts, seen.objects, seen.offsets, sight, *tokens, n_tokens)
        return cls(
            positions.astype(np.float32),
            seen.starts,
            seen.objects,
            seen.offsets,
            sight,
            total,
            np.maximum(pairs, 0.0),
            *tokens,
            *postings,
        )

    @cached_property
    def columns(self) -> ViewColumns:
        """Columns that the scanning kernels read."""
        return ViewColumns(*(getattr(self, name) for name in ViewColumns._fields))

    def frequency(self, tokens: NDArray[np.int32], weights: NDArray[np.float32]) -> float:
        """Share of all things in sight, over all viewpoints, that these tokens stand for."""
        return float(weights @ self._token_share[tokens])

    def near(self, position: NDArray[np.float64], reach: float) -> NDArray[np.int64]:
        """Viewpoints (K,) within `reach` [m] of a position (2,) in east and in north, nearest first."""
        first, last = self.rows_near(position, reach)
        delta = _farther(self.positions[first:last] - position)
        found = np.flatnonzero(delta <= reach)
        return first + found[np.argsort(delta[found], kind="stable")]

    def nearest(self, positions: NDArray[np.float64]) -> NDArray[np.int64]:
        """First (K,) of what `near` finds within `STRIDE` of positions (K, 2); -1 where it is none."""
        norths, low, width, order = self._lines
        line = np.searchsorted(norths, positions[:, 1] - STRIDE)[:, None] + np.arange(_MOST)
        east = np.clip(positions[:, :1] - STRIDE - low, -STRIDE, width - 2.0 * STRIDE)
        first = np.searchsorted(order, line * width + east)
        found = first[:, :, None] + np.arange(_MOST)
        found = np.sort(np.minimum(found.reshape(len(positions), _MOST**2), len(order) - 1))
        delta = _farther(self.positions[found] - positions[:, None])
        best = np.argmin(delta, axis=1)[:, None]
        there = np.take_along_axis(delta, best, 1) <= STRIDE
        return np.where(there, np.take_along_axis(found, best, 1), -1)[:, 0]

    def rows_near(self, position: NDArray[np.floating[Any]], reach: float) -> tuple[int, int]:
        """First and last + 1 of the viewpoints within `reach` [m] of a position (2,) in north."""
        ends = (position[1] - reach, position[1] + reach)
        first, last = (bisect_left(self._north, end) for end in ends)
        return first, last

    @cached_property
    def _north(self) -> NDArray[np.float32]:
        return np.ascontiguousarray(self.positions[:, 1])  # ascending: viewpoints are row-major

    @cached_property
    def _lines(self) -> tuple[NDArray[np.float32], float, float, NDArray[np.float64]]:
        """Lines of viewpoints from west to east.

        Their norths, their west end, a length that no line has [m], and how far (W,) each viewpoint
        is along all lines laid end to end.
        """
        norths, line = np.unique(self._north, return_inverse=True)
        east = self.positions[:, 0].astype(np.float64)
        low = float(east.min(initial=0.0))
        width = float(east.max(initial=0.0)) - low + 4.0 * STRIDE
        return norths, low, width, line * width + (east - low)

    @cached_property
    def _token_share(self) -> NDArray[np.float64]:
        mass = np.concatenate(([0.0], np.cumsum(self.posting_mass, dtype=np.float64)))
        return np.diff(mass[self.posting_starts]) / float(self.total.sum())


def _farther(delta: NDArray[np.float64]) -> NDArray[np.float64]:
    """The larger of the distances in east and in north of differences (..., 2)."""
    return np.maximum(np.abs(delta[..., 0]), np.abs(delta[..., 1]))


def fade(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """How readily a thing at `distance` [m] is spoken of, 0 to 1."""
    return np.float32(1.0) / (
        np.float32(1.0) + np.exp((distance - np.float32(SIGHT)) / np.float32(FADE))
    )


def _worth_standing(
    seen: Sightings, kind: NDArray[np.uint8]
) -> tuple[Sightings, NDArray[np.float32]]:
    """Drop viewpoints from which too little is seen to be told from their neighbours.

    Returns what is left, and `fade` of its distances.
    """
    distance = np.hypot(seen.offsets[:, 0], seen.offsets[:, 1])
    sight, close = fade(distance), distance < STRIDE
    total = np.add.reduceat(sight, seen.starts[:-1])
    lone = (kind[seen.objects] == POINT) & close
    keep = (total >= ENOUGH) | np.logical_or.reduceat(lone, seen.starts[:-1])
    found = np.zeros(len(kind), np.bool_)
    found[seen.objects[np.repeat(keep, np.diff(seen.starts))]] = True
    hut = ~found[seen.objects] & close  # in the hills: nothing else is in sight
    keep |= np.logical_or.reduceat(hut, seen.starts[:-1])
    entries = np.repeat(keep, np.diff(seen.starts))
    starts = np.concatenate(([0], np.cumsum(np.diff(seen.starts)[keep])))
    kept = Sightings(seen.points[keep], starts, seen.objects[entries], seen.offsets[entries])
    return kept, sight[entries]


def tokens_of(
    objects: CityObjects,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Tokens of every object as CSR (starts, values, weights): its labels, then its names."""
    n_labels, n_names = np.diff(objects.label_starts), np.diff(objects.name_starts)
    starts = np.concatenate(([0], np.cumsum(n_labels + n_names))).astype(np.int32)
    owner_label = np.repeat(np.arange(len(objects)), n_labels)
    owner_name = np.repeat(np.arange(len(objects)), n_names)
    rank = np.arange(len(owner_label)) - objects.label_starts[owner_label]
    values = np.empty(starts[-1], np.int32)
    weights = np.ones(starts[-1], np.float32)
    at_label = starts[owner_label] + rank
    values[at_label] = objects.label_values
    weights[at_label] = np.array(SECOND_LABEL, np.float32)[np.minimum(rank, len(SECOND_LABEL) - 1)]
    rank = np.arange(len(owner_name)) - objects.name_starts[owner_name]
    values[starts[owner_name] + n_labels[owner_name] + rank] = objects.name_values + len(
        objects.labels
    )
    return starts, values, weights
