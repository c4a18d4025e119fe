"""The index of viewpoints, written: derived once, band after band of a large map, as columns of its file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from placegraph.outdoor.map.cells import EACH, MOST, Grid, out_of_proportion
from placegraph.outdoor.map.index_kernels import (
    FADED,
    GRADES,
    LEAST,
    REACHED,
    SIDE,
    STEP,
    WIDTH,
    runs_of,
    seen,
    standing,
    with_huts,
)
from placegraph.outdoor.map.objects import ends_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from placegraph.outdoor.map.objects import CityObjects

STRIDE = 20.0
"""Distance of neighbouring viewpoints [m]."""
ENOUGH = 2.0
"""A viewpoint needs this much in sight (sum of `sight`), or a point object close by."""
SECOND_LABEL = (1.0, 0.35, 0.2)
"""How readily a thing is called by its first, second, third ... label."""
LEVELS = (LEAST * np.exp(STEP * np.arange(GRADES))).astype(np.float32)
"""(GRADES,) mass of a grade."""
WORTH = 10_000
"""Maps of fewer objects are stored without one: it is several times as large as they are, and derived
in a fifth of a second."""
PREFIX = "view_"
DTYPES = {
    "tiles": "<i8", "present": "<i8", "total": "|u1", "pairs": "<u2", "thing_counts": "<u4",
    "things": "<i4", "run_counts": "<u4", "run_tiles": "<u4", "run_slots": "<i8",
    "run_first": "<u4", "run_pairs": "|u1", "run_total": "|u1", "postings": "<u4", "share": "<f8",
}  # fmt: skip
MAPPED = frozenset(
    PREFIX + name
    for name in (
        "run_slots", "run_tiles", "run_first", "postings", "things", "pairs", "total", "run_pairs",
        "run_total",
    )
)  # fmt: skip
"""Columns that are read where they lie ..."""
LARGE = 16 << 20
"""... where they have so many bytes together: what is read is held, whatever becomes of the file."""
AT_ONCE = 150_000
"""Objects of a band, about."""


class Core(NamedTuple):
    """A part of a map that is counted; there are no viewpoints far from it."""

    low: NDArray[np.float64]
    """(2,) east and north [m] from where on there are viewpoints ..."""
    high: NDArray[np.float64]
    """... and up to where, about."""
    holds: Callable[[NDArray[np.float64]], NDArray[np.bool_]]
    """Which viewpoints (K, 2) [m] are counted."""


class SightTotals(NamedTuple):
    """Sums and maxima of what the viewpoints of a core have in sight."""

    mass: NDArray[np.float64]
    """(T,) sum over viewpoints of how much of a token is in sight ..."""
    shares: NDArray[np.float64]
    """(T,) ... and of which share that is of all that one has in sight."""
    peak: NDArray[np.float32]
    """(T,) largest such share."""
    sight: float
    """Sum over viewpoints of all that is in sight."""
    spread: float
    """Largest sum of the shares of all labels."""
    pull: float
    """Largest square of all in sight against its pairs, and `CROWDED`."""
    viewpoints: int


class _Band(NamedTuple):
    """Tiles of the grid, and what may be in sight of them."""

    window: tuple[int, int, int, int]
    """From column to column, and from line to line."""
    rows: NDArray[np.int64]
    """Rows of objects."""


class InSight(NamedTuple):
    """Things in sight of tiles: one entry for each tile and thing."""

    things: NDArray[np.int32]
    """(R,) rows of objects, tile after tile, and ascending within a tile."""
    slots: NDArray[np.int64]
    """(R,) from which points of the tile."""
    first: NDArray[np.int64]
    """(R,) where its vectors begin."""
    offsets: NDArray[np.float32]
    """(E, 2) from points to things [m]."""
    sight: NDArray[np.float32]
    """(E,) `fade` of them."""


def fade(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return how readily a thing at `distance` [m] is spoken of, 0 to 1."""
    return np.float32(1.0) / (
        np.float32(1.0) + np.exp((distance - np.float32(FADED)) / np.float32(WIDTH))
    )


def tokens_of(
    objects: CityObjects,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Tokens of every object as CSR (starts, values, weights): its labels, then its names."""
    n_labels, n_names = np.diff(objects.label_starts), np.diff(objects.name_starts)
    starts = np.concatenate(([0], np.cumsum(n_labels + n_names))).astype(np.int32)
    row = np.arange(len(objects), dtype=np.int32)
    owner_label, owner_name = np.repeat(row, n_labels), np.repeat(row, n_names)
    rank = np.arange(len(owner_label), dtype=np.int32) - objects.label_starts[owner_label]
    values = np.empty(starts[-1], np.int32)
    weights = np.ones(starts[-1], np.float32)
    at_label = starts[owner_label] + rank
    values[at_label] = objects.label_values
    weights[at_label] = np.array(SECOND_LABEL, np.float32)[np.minimum(rank, len(SECOND_LABEL) - 1)]
    rank = np.arange(len(owner_name), dtype=np.int32) - objects.name_starts[owner_name]
    values[starts[owner_name] + n_labels[owner_name] + rank] = objects.name_values + len(
        objects.labels
    )
    return starts, values, weights


def grid_of(objects: CityObjects) -> Grid:
    """Grid of the viewpoints; its sides are whole tiles."""
    low, high = ends_of(objects.points)
    low, high = low - REACHED, high + REACHED
    columns, rows = (SIDE * int(n) for n in np.ceil((np.ceil((high - low) / STRIDE) + 1) / SIDE))
    return Grid(float(low[0]), float(low[1]), STRIDE, columns, rows)


def build(
    objects: CityObjects, at_once: int = AT_ONCE, core: Core | None = None
) -> tuple[dict[str, NDArray[Any]], SightTotals]:
    """Columns of a `ViewIndex`, and what was seen from a core; of nothing, where there is none.

    Memory grows with what is in sight of a band, time with the map. Raises `MapError` where things
    reach over more ground than a map of so many is looked through for.
    """
    grid, tokens = grid_of(objects), tokens_of(objects)
    n_labels, n_tokens = len(objects.labels), len(objects.labels) + len(objects.names)
    bands = _bands(objects, grid, at_once, core)
    looked = [_look(objects, grid, bands[0])] if len(bands) == 1 else []
    found = np.zeros(len(objects), np.bool_)
    keeps = [
        standing(tile_starts, around, objects.kind, ENOUGH, STRIDE, found)
        for _, tile_starts, around in looked or (_look(objects, grid, band) for band in bands)
    ]
    mass, parts, sums, viewpoints = np.zeros(n_tokens + 1), [], [], 0
    for keep, band in zip(keeps, bands, strict=True):
        tiles, tile_starts, around = looked.pop() if looked else _look(objects, grid, band)
        with_huts(tile_starts, around, keep, STRIDE, found)
        counted, many = _counted(grid, tiles, keep, core)
        viewpoints += many
        runs, postings, (total, pairs, things, thing_counts), seen_ = runs_of(
            tile_starts, around, keep, counted, objects.kind, tokens, LEVELS, n_labels, mass
        )
        sums.append(seen_)
        there = keep != 0
        token, tile, slots, size, grades = runs
        parts.append({
            "token": token, "run_tiles": (np.cumsum(there) - 1)[tile].astype(np.uint32),
            "run_slots": slots, "size": size, "run_pairs": grades[:, 0], "run_total": grades[:, 1],
            "postings": postings, "tiles": tiles[there], "present": keep[there], "total": total,
            "pairs": pairs, "things": things, "thing_counts": thing_counts[there],
        })  # fmt: skip
    if core is not None and not any(
        len(part["tiles"]) for part in parts
    ):  # all lies beyond: a road's bend
        everywhere = np.full(2, np.inf)
        return build(objects, at_once, core._replace(low=-everywhere, high=everywhere))
    masses, shares, peaks, sights, spreads, pulls = zip(*sums, strict=True)
    most = (np.max(peaks, axis=0), sum(sights), max(spreads), max(pulls))
    seen_ = SightTotals(sum(masses), sum(shares), *most, viewpoints)
    return _joined(parts, n_tokens) | {"share": mass[:-1] / max(mass[-1], 1e-30)}, seen_


def _bands(objects: CityObjects, grid: Grid, at_once: int, core: Core | None) -> list[_Band]:
    """Bands of whole tiles from south to north, about as many objects in each."""
    ends = objects.point_starts[objects.part_starts]
    norths = objects.points[:, 1].astype(np.float64) - grid.north
    south, north = (end.reduceat(norths, ends[:-1]) for end in (np.minimum, np.maximum))
    wide = SIDE * STRIDE
    low, high = np.zeros(2, np.int64), np.array([grid.columns, grid.rows]) // SIDE
    if core is not None:
        corners = (np.stack([core.low, core.high]) - (grid.east, grid.north)) / wide
        low, high = np.clip([np.floor(corners[0]), np.ceil(corners[1])], low, high).astype(np.int64)
    many = max(1, min(grid.rows // SIDE, round(len(objects) / at_once)))
    shares = np.quantile(north, np.linspace(0.0, 1.0, many + 1)[1:-1])
    lines = np.rint(shares / wide).astype(np.int64).clip(low[1], high[1])
    lines = np.unique(np.concatenate(([low[1]], lines, [high[1]])))
    if len(lines) == 1:
        lines = np.repeat(lines, 2)
    return [
        _Band((int(low[0]), int(high[0]), a, b),
              np.flatnonzero((north >= wide * a - REACHED - 1) & (south <= wide * b + REACHED)))
        for a, b in zip(lines[:-1].tolist(), lines[1:].tolist(), strict=True)
    ]  # fmt: skip


def _look(
    objects: CityObjects, grid: Grid, band: _Band
) -> tuple[NDArray[np.int64], NDArray[np.int64], InSight]:
    """Tiles of a band that have anything in sight, where their entries begin, and these."""
    things, lines, columns, slots, first, offsets, done = seen(
        objects.kind, objects.part_starts, objects.point_starts, objects.points, band.rows,
        (grid.east, grid.north, grid.stride), band.window,
        max(1024, 32 * len(band.rows)), MOST + EACH * len(band.rows),
    )  # fmt: skip
    if not done:
        raise out_of_proportion(len(band.rows), grid.stride)
    key = lines.astype(np.int64) * (grid.columns // SIDE) + columns
    order = np.argsort(key, kind="stable")
    key = key[order]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    distance = np.hypot(offsets[:, 0], offsets[:, 1])
    around = InSight(things[order], slots[order], first[:-1][order], offsets, fade(distance))
    return key[starts], np.append(starts, len(key)), around


def _counted(
    grid: Grid, tiles: NDArray[np.int64], keep: NDArray[np.int64], core: Core | None
) -> tuple[NDArray[np.int64], int]:
    """Slots (T,) of viewpoints in the core, and how many these are."""
    bits = np.unpackbits(
        keep.astype("<i8").view(np.uint8).reshape(-1, 8), axis=1, bitorder="little"
    )
    tile, slot = np.nonzero(bits)
    if core is None or not len(tile):
        return np.zeros(len(keep), np.int64), 0
    line, column = np.divmod(tiles[tile], grid.columns // SIDE)
    steps = np.stack([column * SIDE + slot % SIDE, line * SIDE + slot // SIDE], 1)
    places = (steps * grid.stride + (grid.east, grid.north)).astype(np.float32)
    bits[tile, slot] = inside = core.holds(places.astype(np.float64))
    packed = np.packbits(bits, axis=1, bitorder="little").view("<i8")[:, 0]
    return packed.astype(np.int64), int(inside.sum())


def _joined(parts: list[dict[str, NDArray[Any]]], n_tokens: int) -> dict[str, NDArray[Any]]:
    """Bands put one after the other; runs by token, and within a token by tile."""
    for part, tiles in zip(parts, np.cumsum([0, *(len(p["tiles"]) for p in parts)]), strict=False):
        part["run_tiles"] = part["run_tiles"] + np.uint32(tiles)
    columns = {name: np.concatenate([p.pop(name) for p in parts]) for name in list(parts[0])}
    token, size = columns.pop("token"), columns.pop("size")
    first = np.cumsum(size, dtype=np.int64) - size
    order = np.argsort(token, kind="stable")
    for name in ("run_tiles", "run_slots", "run_pairs", "run_total"):
        columns[name] = columns[name][order]
    columns["run_first"] = first[order].astype(np.uint32)
    columns["run_counts"] = np.bincount(token, minlength=n_tokens).astype(np.uint32)
    return columns


def name_columns(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the columns of an index (`ViewIndex.arrays`) as a map file names them."""
    return {PREFIX + name: column for name, column in arrays.items()}
