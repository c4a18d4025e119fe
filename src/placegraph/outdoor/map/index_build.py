"""The index of viewpoints, built: once, when a map is written, and band after band of a large one."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from placegraph.outdoor.map.index_build_kernels import runs_of
from placegraph.outdoor.map.index_kernels import (
    FADED,
    FINE,
    GRADES,
    LEAST,
    REACHED,
    SIDE,
    STEP,
    WIDTH,
)
from placegraph.outdoor.map.raster import Grid, Sightings, sightings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.outdoor.map.objects import CityObjects

POINT, AREA = 0, 2
STRIDE = 20.0
"""Distance of neighbouring viewpoints [m]."""
ENOUGH = 2.0
"""A viewpoint needs this much in sight (sum of `sight`), or a point object close by."""
SECOND_LABEL = (1.0, 0.35, 0.2)
"""How readily a thing is called by its first, second, third ... label."""
LEVELS = (LEAST * np.exp(STEP * np.arange(GRADES))).astype(np.float32)
"""(GRADES,) mass of a grade."""
AT_ONCE = 150_000
"""Objects of a band, about."""


class _Band(NamedTuple):
    """Lines of the grid from `first` to `last`, and what may be in sight of them."""

    first: int
    last: int
    rows: NDArray[np.int64]
    """Rows of objects."""


def fade(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """How readily a thing at `distance` [m] is spoken of, 0 to 1."""
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
    low, high = objects.points.min(axis=0) - REACHED, objects.points.max(axis=0) + REACHED
    columns, rows = (SIDE * int(n) for n in np.ceil((np.ceil((high - low) / STRIDE) + 1) / SIDE))
    return Grid(float(low[0]), float(low[1]), STRIDE, columns, rows)


def build(
    objects: CityObjects, all_seen: Sightings | None = None, at_once: int = AT_ONCE
) -> dict[str, NDArray[Any]]:
    """Columns of a `ViewIndex`; memory grows with what is in sight of a band, time with the map.

    `all_seen` is what `seen_from` gives of the whole grid, where it is known.
    """
    grid, tokens = grid_of(objects), tokens_of(objects)
    n_tokens = len(objects.labels) + len(objects.names)
    bands = _bands(objects, grid, len(objects) if all_seen else at_once)
    seen = [all_seen or _seen(objects, grid, bands[0])] if len(bands) == 1 else []
    found = np.zeros(len(objects), np.bool_)
    for i, band in enumerate(bands):
        now = seen[i] if seen else _seen(objects, grid, band)
        keep, _, _ = _worth_standing(now, objects.kind)
        found[now.objects[np.repeat(keep, np.diff(now.starts))]] = True
    mass = np.zeros(n_tokens + 1)
    parts = [
        _columns(seen[i] if seen else _seen(objects, grid, band), band, grid, objects, tokens, found, mass)
        for i, band in enumerate(bands)
    ]  # fmt: skip
    return _joined(parts, n_tokens) | {"share": mass[:-1] / max(mass[-1], 1e-30)}


def _bands(objects: CityObjects, grid: Grid, at_once: int) -> list[_Band]:
    """Bands of whole tiles from south to north, about as many objects in each."""
    ends = objects.point_starts[objects.part_starts]
    south = np.minimum.reduceat(objects.points[:, 1], ends[:-1]) - grid.north
    north = np.maximum.reduceat(objects.points[:, 1], ends[:-1]) - grid.north
    many = max(1, min(grid.rows // SIDE, round(len(objects) / at_once)))
    shares = np.quantile(north, np.linspace(0.0, 1.0, many + 1)[1:-1])
    lines = np.unique(np.rint(shares / STRIDE / SIDE).astype(np.int64)) * SIDE
    lines = np.unique(np.concatenate(([0], lines.clip(0, grid.rows), [grid.rows])))
    return [
        _Band(a, b, np.flatnonzero((north >= STRIDE * a - REACHED - 1) & (south <= STRIDE * b + REACHED)))
        for a, b in zip(lines[:-1].tolist(), lines[1:].tolist(), strict=True)
    ]  # fmt: skip


def _seen(objects: CityObjects, grid: Grid, band: _Band) -> Sightings:
    """What is in sight of the grid points of a band."""
    part = grid._replace(north=grid.north + band.first * STRIDE, rows=band.last - band.first)
    return seen_from(objects, part, band.rows)


def seen_from(objects: CityObjects, grid: Grid, rows: NDArray[np.int64] | None = None) -> Sightings:
    """What of objects, or of these rows of them, is in sight of points of a grid."""
    columns = (objects.kind, objects.part_starts, objects.point_starts, objects.points)
    return sightings(*columns, grid=grid, radius=REACHED, rows=rows)


def _worth_standing(
    seen: Sightings, kind: NDArray[np.uint8]
) -> tuple[NDArray[np.bool_], NDArray[np.float32], NDArray[np.bool_]]:
    """Which grid points see enough to be told from their neighbours, `fade`, and which entries are close."""
    distance = np.hypot(seen.offsets[:, 0], seen.offsets[:, 1])
    sight, close = fade(distance), distance < STRIDE
    if not len(seen.points):
        return np.zeros(0, np.bool_), sight, close
    total = np.add.reduceat(sight, seen.starts[:-1])
    lone = (kind[seen.objects] == POINT) & close
    keep = (total >= ENOUGH) | np.logical_or.reduceat(lone, seen.starts[:-1])
    return keep, sight, close


def _columns(
    seen: Sightings,
    band: _Band,
    grid: Grid,
    objects: CityObjects,
    tokens: tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]],
    found: NDArray[np.bool_],
    mass: NDArray[np.float64],
) -> dict[str, NDArray[Any]]:
    """Columns of a band; adds to the `mass` in sight of each token, and of all things (the last)."""
    keep, sight, close = _worth_standing(seen, objects.kind)
    if len(keep):
        hut = ~found[seen.objects] & close  # in the hills: nothing else is in sight
        keep |= np.logical_or.reduceat(hut, seen.starts[:-1])
    row, column = np.divmod(seen.points[keep], grid.columns)
    row += band.first
    key = (row // SIDE) * (grid.columns // SIDE) + column // SIDE
    slot = (row % SIDE) * SIDE + column % SIDE
    order = np.argsort(key * SIDE * SIDE + slot, kind="stable")
    views, entries = _gathered(seen.starts, np.flatnonzero(keep)[order])
    who, where, sight = seen.objects[entries], seen.offsets[entries], sight[entries]
    key, slot = key[order], slot[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    tile_starts = np.append(first, len(key))
    inside = (objects.kind[who] == AREA) & ~where.any(axis=1)
    apart = np.where(inside, np.float32(0.0), sight)  # what one stands in lies in no direction
    total, alone, squared = (_sums(x, views) for x in (sight, apart, apart * apart))
    total = (np.searchsorted(LEVELS, total, side="right") - 1).clip(0).astype(np.uint8)
    pairs = np.sqrt(np.maximum(alone * alone - squared, 0.0))
    pairs = np.floor(pairs * FINE).clip(0, 65535).astype(np.uint16)
    runs = runs_of(
        tile_starts, slot, views, who, where, sight, LEVELS[total], (pairs / FINE) ** 2,
        *tokens, len(mass) - 1,
    )  # fmt: skip
    starts, values, weights = tokens
    of_objects = np.bincount(who, sight, len(objects))
    mass += np.bincount(values, np.repeat(of_objects, np.diff(starts)) * weights, len(mass))
    mass[-1] += of_objects.sum()
    near = np.unique(np.repeat(np.arange(len(first)), _sizes(views, tile_starts)) << 32 | who)
    present = np.zeros(len(first), np.int64)
    np.bitwise_or.at(present, np.repeat(np.arange(len(first)), np.diff(tile_starts)), 1 << slot)
    names = ("token", "run_tiles", "run_slots", "size", "run_pairs", "run_total", "postings")
    return dict(zip(names, runs, strict=True)) | {
        "tiles": key[first],
        "present": present,
        "total": total,
        "pairs": pairs,
        "things": (near & 0xFFFFFFFF).astype(np.int32),
        "thing_counts": np.bincount(near >> 32, minlength=len(first)).astype(np.uint32),
    }


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


def _gathered(
    starts: NDArray[np.int64], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Starts of rows taken out of a CSR, and their entries."""
    sizes = np.diff(starts)[rows]
    taken = np.concatenate(([0], np.cumsum(sizes)))
    return taken, np.arange(taken[-1]) + np.repeat(starts[rows] - taken[:-1], sizes)


def _sums(values: NDArray[np.float32], starts: NDArray[np.int64]) -> NDArray[np.float32]:
    """Sums of the rows of a CSR, none of which is empty."""
    return np.add.reduceat(values, starts[:-1]) if len(starts) > 1 else values[:0]


def _sizes(starts: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """How many entries lie between rows of a CSR."""
    return np.diff(starts[rows])
