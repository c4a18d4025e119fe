"""Larger maps than there are extracts: copies of a city's map side by side, their words shuffled."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.outdoor.city import CityMap
from placegraph.outdoor.map.objects import CityObjects, centers

GAP = 400.0
"""Space between copies [m], in steps of the grid of cells."""
FARTHEST_IN = 1e-3
"""Share of objects to either side that stick out of a city and do not count for its size."""


def tiled(city: CityMap, copies: int, rng: Generator) -> CityMap:
    """Map of `copies` copies of a city on a square grid.

    The first stands where the city does and keeps its words; in every other one, labels and names
    are exchanged among points, among lines and among areas.
    """
    o, stride = city.objects, city.cells.grid.stride
    ends = np.quantile(o.center, [FARTHEST_IN, 1.0 - FARTHEST_IN], axis=0)
    size = np.ceil((ends[1] - ends[0] + GAP) / stride) * stride
    side = int(np.ceil(np.sqrt(copies)))
    rows = [_bags(o, None if k == 0 else rng) for k in range(copies)]
    rows_of_all = np.concatenate(rows)
    label_counts, label_values = _taken(o.label_starts, o.label_values, rows_of_all)
    name_counts, name_values = _taken(o.name_starts, o.name_values, rows_of_all)
    shifts = np.stack([np.arange(copies) % side, np.arange(copies) // side], 1) * size
    points = np.concatenate([o.points + shift.astype(np.float32) for shift in shifts])
    part_starts = _again(np.diff(o.part_starts), copies)
    point_starts = _again(np.diff(o.point_starts), copies)
    kind = np.tile(o.kind, copies)
    objects = CityObjects(
        osm_type=np.tile(o.osm_type, copies),
        osm_id=np.arange(copies * len(o), dtype=np.int64) + 1,
        kind=kind,
        label_starts=_starts(label_counts),
        label_values=label_values,
        name_starts=_starts(name_counts),
        name_values=name_values,
        part_starts=part_starts,
        point_starts=point_starts,
        points=points,
        center=centers(kind, part_starts, point_starts, points),
        labels=o.labels,
        names=o.names,
    )
    return CityMap.create(
        city.plane, objects, cell_size=city.cells.size, stride=stride,
        edge_distance=city.cells.edge_distance, source=f"{copies} x {city.source}", left_out={},
    )  # fmt: skip


def _bags(o: CityObjects, rng: Generator | None) -> NDArray[np.int64]:
    """Of which object (N,) each has the words."""
    rows = np.arange(len(o))
    if rng is None:
        return rows
    for kind in range(3):
        of_kind = np.flatnonzero(o.kind == kind)
        rows[of_kind] = rng.permutation(of_kind)
    return rows


def _taken(
    starts: NDArray[np.int32], values: NDArray[np.int32], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Counts and values of rows taken out of a CSR."""
    counts = np.diff(starts)[rows].astype(np.int64)
    ends = np.cumsum(counts)
    at = np.arange(ends[-1]) + np.repeat(starts[rows] - ends + counts, counts)
    return counts, values[at]


def _again(counts: NDArray[np.int32], copies: int) -> NDArray[np.int32]:
    return _starts(np.tile(counts, copies))


def _starts(counts: NDArray[np.integer]) -> NDArray[np.int32]:
    return np.concatenate(([0], np.cumsum(counts, dtype=np.int64))).astype(np.int32)
