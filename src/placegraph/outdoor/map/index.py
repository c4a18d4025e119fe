"""Index of the viewpoints of a city, and of what stands around each; candidates are found by it.

A sentence is spoken somewhere, not "in a tile". Every 20 m where anything is in sight there is a
viewpoint. For each *token* (a label or a name) the index lists the viewpoints that have it in sight,
tile by tile: which viewpoints of a tile of 8 times 8, and what share of all in sight it is at most.
The index is built when a map is written, band after band of a large map, and read from the file in
place: a search reads few tiles, and derives what is in sight of the few viewpoints that it compares.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import floor
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.mapfile import MapFile, gather_spans, offsets_of
from placegraph.outdoor.map.cells import EACH, MOST, Grid, make_extent_error
from placegraph.outdoor.map.index_kernels import (
    FADED,
    GRADES,
    JUMP,
    LEAST,
    REACHED,
    SIDE,
    STEP,
    WIDTH,
    collect_visible,
    mark_isolated,
    mark_viewpoints,
    place_views,
    runs_of,
)
from placegraph.outdoor.map.objects import ends_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from placegraph.core.files import FileWatch
    from placegraph.outdoor.map.objects import CityObjects

STRIDE = 20.0
"""Distance of neighbouring viewpoints [m]."""
ENOUGH = 2.0
"""A viewpoint needs this much in sight (sum of `sight`), or a point object close by."""
SECOND_LABEL = (1.0, 0.35, 0.2)
"""Probability that an object is called by its first, second, third ... label."""
LEVELS = (LEAST * np.exp(STEP * np.arange(GRADES))).astype(np.float32)
"""(GRADES,) share of a grade."""
WORTH = 10_000
"""Maps of fewer objects are stored without one: it is several times as large as they are, and derived
in a fifth of a second."""
PREFIX = "view_"
DTYPES = {
    "tiles": "<i8", "present": "<i8", "density": "|u1", "thing_bytes": "<u4", "things": "|u1",
    "run_counts": "<u4", "run_bytes": "<u4", "run_tiles": "<u2", "run_sizes": "|u1", "run_pairs": "|u1",
    "run_total": "|u1", "postings": "|u1", "share": "<f4",
}  # fmt: skip
MAPPED = frozenset(
    PREFIX + name
    for name in (
        "run_sizes",
        "run_tiles",
        "postings",
        "things",
        "density",
        "run_pairs",
        "run_total",
    )
)
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
    visibility: float
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

    objects: NDArray[np.int32]
    """(R,) rows of objects, tile after tile, and ascending within a tile."""
    slots: NDArray[np.int64]
    """(R,) from which points of the tile."""
    first: NDArray[np.int64]
    """(R,) where its vectors begin."""
    offsets: NDArray[np.float32]
    """(E, 2) from points to things [m]."""
    visibility: NDArray[np.float32]
    """(E,) `fade` of them."""


def fade(distance: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the weight (0 to 1) with which descriptions mention an object at `distance` [m]."""
    return np.float32(1.0) / (
        np.float32(1.0) + np.exp((distance - np.float32(FADED)) / np.float32(WIDTH))
    )


def tokens_of(
    objects: CityObjects,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
    """Return the tokens of every object as CSR (starts, values, weights): its labels, then its names."""
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
    """Return the grid of the viewpoints; its sides are whole tiles."""
    low, high = ends_of(objects.points)
    low, high = low - REACHED, high + REACHED
    columns, rows = (SIDE * int(n) for n in np.ceil((np.ceil((high - low) / STRIDE) + 1) / SIDE))
    return Grid(float(low[0]), float(low[1]), STRIDE, columns, rows)


def build(
    objects: CityObjects, at_once: int = AT_ONCE, core: Core | None = None
) -> tuple[dict[str, NDArray[Any]], SightTotals]:
    """Build the columns of a `ViewIndex`, and total what is seen from a core, if there is one.

    Memory grows with what is in sight of a band, time with the map. Raises `MapError` where things
    reach over more ground than a map of so many is looked through for.
    """
    grid, tokens = grid_of(objects), tokens_of(objects)
    n_labels, n_tokens = len(objects.labels), len(objects.labels) + len(objects.names)
    bands = _bands(objects, grid, at_once, core)
    looked = [_collect_band(objects, grid, bands[0])] if len(bands) == 1 else []
    found = np.zeros(len(objects), np.bool_)
    keeps = [
        mark_viewpoints(tile_starts, around, objects.kind, ENOUGH, STRIDE, found)
        for _, tile_starts, around in looked
        or (_collect_band(objects, grid, band) for band in bands)
    ]
    mass, parts, sums, viewpoints = np.zeros(n_tokens + 1), [], [], 0
    for keep, band in zip(keeps, bands, strict=True):
        tiles, tile_starts, around = looked.pop() if looked else _collect_band(objects, grid, band)
        mark_isolated(tile_starts, around, keep, STRIDE, found)
        counted, many = _counted(grid, tiles, keep, core)
        viewpoints += many
        runs, postings, (density, things, thing_counts), seen_ = runs_of(
            tile_starts, around, keep, counted, objects.kind, tokens, LEVELS, n_labels, mass
        )
        sums.append(seen_)
        there = keep != 0
        token, tile, size, grades = runs
        parts.append({
            "token": token, "run_tiles": (np.cumsum(there) - 1)[tile].astype(np.int64),
            "run_sizes": size, "run_pairs": grades[:, 0], "run_total": grades[:, 1],
            "postings": postings, "tiles": tiles[there], "present": keep[there], "density": density,
            "things": things, "thing_bytes": thing_counts[there],
        })  # fmt: skip
    if core is not None and not any(
        len(part["tiles"]) for part in parts
    ):  # all lies beyond: a road's bend
        everywhere = np.full(2, np.inf)
        return build(objects, at_once, core._replace(low=-everywhere, high=everywhere))
    masses, shares, peaks, sights, spreads, pulls = zip(*sums, strict=True)
    most = (np.max(peaks, axis=0), sum(sights), max(spreads), max(pulls))
    seen_ = SightTotals(sum(masses), sum(shares), *most, viewpoints)
    return _joined(parts, n_tokens) | {
        "share": (mass[:-1] / max(mass[-1], 1e-30)).astype(np.float32)
    }, seen_


def _bands(objects: CityObjects, grid: Grid, at_once: int, core: Core | None) -> list[_Band]:
    """Cut the grid into bands of whole tiles, from south to north, with about as many objects in each."""
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


def _collect_band(
    objects: CityObjects, grid: Grid, band: _Band
) -> tuple[NDArray[np.int64], NDArray[np.int64], InSight]:
    """Collect the tiles of a band that have anything in sight, where their entries begin, and these."""
    things, lines, columns, slots, first, offsets, done = collect_visible(
        objects.kind, objects.part_starts, objects.point_starts, objects.points, band.rows,
        (grid.east, grid.north, grid.stride), band.window,
        max(1024, 32 * len(band.rows)), MOST + EACH * len(band.rows),
    )  # fmt: skip
    if not done:
        raise make_extent_error(len(band.rows), grid.stride)
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
    """Return the slots (T,) of viewpoints in the core, and count these."""
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
    """Join bands; sort runs by token, and within a token by tile."""
    for part, tiles in zip(parts, np.cumsum([0, *(len(p["tiles"]) for p in parts)]), strict=False):
        part["run_tiles"] += tiles
    columns = {name: np.concatenate([p.pop(name) for p in parts]) for name in list(parts[0])}
    token, size, postings = (columns.pop(name) for name in ("token", "run_sizes", "postings"))
    order = np.argsort(token, kind="stable")
    columns["postings"] = postings[gather_spans(offsets_of(size), order)[1]]
    token, size, tile = token[order], size[order], columns["run_tiles"][order]
    before = np.where(np.diff(token, prepend=-1) != 0, -1, np.append(-1, tile[:-1]))
    jumps = (tile - before - 1) // JUMP
    rows = np.repeat(np.arange(len(tile)), 1 + jumps)
    last = np.cumsum(1 + jumps) - 1
    tile = tile[rows] % JUMP
    steps = np.arange(len(rows)) - (last - jumps)[rows] + 1  # from the run before
    is_jump = np.arange(len(rows)) != last[rows]
    columns["run_tiles"] = np.where(is_jump, (before[rows] + JUMP * steps) % JUMP, tile)
    columns["run_tiles"] = columns["run_tiles"].astype(np.uint16)
    columns["run_sizes"] = np.where(is_jump, np.uint8(0), size[rows])
    for name in ("run_pairs", "run_total"):
        columns[name] = np.where(is_jump, np.uint8(0), columns[name][order][rows])
    columns["run_counts"] = np.bincount(token[rows], minlength=n_tokens).astype(np.uint32)
    columns["run_bytes"] = np.bincount(token, size, n_tokens).astype(np.uint32)
    return columns


def name_columns(arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the columns of an index (`ViewIndex.arrays`) as a map file names them."""
    return {PREFIX + name: column for name, column in arrays.items()}


POINT, AREA = 0, 2
SIGHT = FADED
"""Distance at which half the things are still spoken of [m]."""
FADE = WIDTH
"""Width of the fall around `SIGHT` [m]."""
REACH = REACHED
"""Beyond this distance a thing is not listed at a viewpoint [m]."""
_AROUND = np.array([(x, y) for y in range(-1, 3) for x in range(-1, 3)])
"""(16, 2) steps to the points of the grid among which the nearest viewpoint within `STRIDE` is."""


_DERIVED = {
    "thing_starts": "thing_bytes",
    "token_starts": "run_counts",
    "posting_starts": "run_bytes",
}
"""Fields of `ViewColumns` that are stored as differences, and their names in the file."""


class ViewColumns(NamedTuple):
    """Columns of a `ViewIndex`, for compiled code."""

    grid: tuple[float, float, float, int]
    """East and north of the first point, stride [m], and tiles in a line."""
    tiles: NDArray[np.int64]
    """(T,) where a tile lies, ``line * tiles in a line + column``, ascending."""
    present: NDArray[np.int64]
    """(T,) which of its slots are viewpoints: 64 bits."""
    first: NDArray[np.int64]
    """(T + 1,) its first viewpoint; those of a tile are numbered by slot."""
    density: NDArray[np.uint8]
    """(W,) how much a viewpoint has in sight (`PULLS`, `TOTALS`)."""
    thing_starts: NDArray[np.int64]
    """(T + 1,)"""
    things: NDArray[np.uint8]
    """Rows of the objects in sight of any viewpoint of a tile, ascending, as steps (`read_step`)."""
    token_starts: NDArray[np.int64]
    """(tokens + 1,) runs of a token: a run is a token in a tile."""
    posting_starts: NDArray[np.int64]
    """(tokens + 1,) postings of a token."""
    run_tiles: NDArray[np.uint16]
    """(R,) its tile, modulo `JUMP`, ascending within a token."""
    run_sizes: NDArray[np.uint8]
    """(R,) its postings, which follow those of the run before."""
    run_pairs: NDArray[np.uint8]
    """(R,) grade of the largest share of the root of pairs and `CROWDED`."""
    run_total: NDArray[np.uint8]
    """(R,) grade of the largest share of all in sight."""
    postings: NDArray[np.uint8]
    """Which viewpoints have the token in sight, and how large a share of all in sight it is (`runs_of`)."""
    levels: NDArray[np.float32]
    """(GRADES,) share of a grade."""


@dataclass(frozen=True, eq=False)
class ViewIndex:
    """Viewpoints (W) of a map, and where each of its tokens is in sight."""

    columns: ViewColumns
    share: NDArray[np.float32]
    """(tokens,) share of each in all that is in sight of all viewpoints."""
    watch: FileWatch | None = None
    """Watch on the map file that the columns are read from."""

    @classmethod
    def build(cls, objects: CityObjects, core: Core | None = None) -> tuple[Self, SightTotals]:
        """Build the index of a map; total what is seen from a core, if there is one."""
        grid = grid_of(objects)
        columns, seen = build(objects, core=core)
        return cls.of(columns, (grid.east, grid.north, grid.columns // SIDE)), seen

    @classmethod
    def of(cls, columns: Mapping[str, NDArray[Any]], grid: tuple[float, float, int]) -> Self:
        """Make an index of the columns of `build`; raises `ValueError` where they contradict each other."""
        east, north, width = grid
        columns = {name: _locked(column) for name, column in columns.items()}
        starts: dict[str, Any] = {name: offsets_of(columns[of]) for name, of in _DERIVED.items()}
        first = offsets_of(_ones(columns["present"]))
        stored = {name: columns[name] for name in ViewColumns._fields if name in columns}
        place = (float(east), float(north), STRIDE, int(width))
        given = ViewColumns(grid=place, first=first, levels=LEVELS, **starts, **stored)
        _check(given, columns["share"])
        return cls(given, columns["share"])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the columns that `of` takes."""
        stored = self.columns._asdict()
        own = {name: stored[name] for name in DTYPES if name in stored}
        sizes = {name: np.diff(stored[of]).astype(np.uint32) for of, name in _DERIVED.items()}
        return own | sizes | {"share": self.share}

    @property
    def grid(self) -> tuple[float, float, int]:
        """East and north of the first point [m], and how many tiles a line has."""
        east, north, _, width = self.columns.grid
        return east, north, width

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).of, (self.arrays(), self.grid)

    def __len__(self) -> int:
        return int(self.columns.first[-1])

    @cached_property
    def positions(self) -> NDArray[np.float32]:
        """(W, 2) east, north of all viewpoints [m]; tile after tile, and row by row within each."""
        return self.positions_of(np.arange(len(self)))

    def positions_of(self, rows: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """Return the positions (K, 2) of viewpoints (K,), east and north [m]."""
        found: NDArray[np.float32] = place_views(self.columns, np.asarray(rows, np.int64))
        return found

    def near(self, position: NDArray[np.floating[Any]], reach: float) -> NDArray[np.int64]:
        """Find viewpoints (K,) within `reach` [m] of a position (2,) in east and in north, nearest first."""
        east, north, stride, width = self.columns.grid
        x, y, tile = float(position[0]), float(position[1]), SIDE * stride
        left, right = floor((x - reach - east) / tile), floor((x + reach - east) / tile)
        if right < 0 or left >= width or not len(self.columns.tiles):
            return np.zeros(0, np.int64)
        last = int(self.columns.tiles[-1]) // width
        low, high = floor((y - reach - north) / tile), floor((y + reach - north) / tile)
        lines = np.arange(max(0, low), min(last, high) + 1)[:, None]
        ends = lines * width + [max(0, left), min(width - 1, right) + 1]
        rows = self.columns.first[np.searchsorted(self.columns.tiles, ends)].tolist()
        found = np.concatenate([np.zeros(0, np.int64), *(np.arange(a, b) for a, b in rows)])
        delta = _farther(self.positions_of(found) - position)
        found, delta = found[delta <= reach], delta[delta <= reach]
        return found[np.argsort(delta, kind="stable")]

    def nearest(self, positions: NDArray[np.float64]) -> NDArray[np.int64]:
        """Find the viewpoints (K,) nearest to positions (K, 2), within `STRIDE`; -1 where there is none."""
        east, north, stride, _ = self.columns.grid
        at = (np.asarray(positions, np.float64) - (east, north)) / stride
        points = np.rint(at).astype(np.int64)
        found = self._rows(points[:, 0], points[:, 1])
        off = np.flatnonzero((found < 0) | (_farther(at - points) > 0.01))  # on no viewpoint
        points = np.floor(at[off]).astype(np.int64)[:, None] + _AROUND
        rows = self._rows(points[..., 0], points[..., 1])
        places = (points * stride + (east, north)).astype(np.float32)
        delta = np.where(rows >= 0, _farther(places - np.asarray(positions)[off, None]), np.inf)
        best = np.min(delta, axis=1)
        first = np.min(np.where(delta == best[:, None], rows, len(self)), axis=1)
        found[off] = np.where(best <= STRIDE, first, -1)
        return found

    def _rows(self, column: NDArray[np.int64], row: NDArray[np.int64]) -> NDArray[np.int64]:
        """Find the viewpoints at points of the grid; -1 where there is none."""
        c, width = self.columns, self.columns.grid[3]
        on = (column >= 0) & (column < width * SIDE) & (row >= 0)
        key = (row // SIDE) * width + column // SIDE
        tile = np.minimum(np.searchsorted(c.tiles, key), len(c.tiles) - 1)
        slot = (row % SIDE) * SIDE + column % SIDE
        bits = c.present[tile]
        on &= (c.tiles[tile] == key) & ((bits >> slot) & 1 == 1)
        rank = _ones(bits & ((np.int64(1) << slot) - 1))
        return np.where(on, c.first[tile] + rank, -1)


def _farther(delta: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Return the larger of the distances in east and in north of differences (..., 2)."""
    return np.maximum(np.abs(delta[..., 0]), np.abs(delta[..., 1]))


_IN_BYTE = np.array([i.bit_count() for i in range(256)], np.uint8)


def _ones(bits: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count the bits that are set."""
    in_bytes = _IN_BYTE[np.ascontiguousarray(bits)[..., None].view(np.uint8)]
    return in_bytes.sum(axis=-1, dtype=np.int64)


def _locked(column: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view of a column: compiled code tells the two apart."""
    column = np.ascontiguousarray(column).view()
    column.flags.writeable = False
    return column


def _check(c: ViewColumns, share: NDArray[np.float32]) -> None:
    """Raise `ValueError` where columns contradict each other, by what is short enough to be read whole.

    Compiled code checks what it reads of the rest: a run's tile and postings, and a tile's things.
    """
    lengths = (
        (c.present, len(c.tiles), "present"),
        (c.thing_starts, len(c.tiles) + 1, "thing_bytes"),
        (c.density, c.first[-1], "density"),
        (c.things, c.thing_starts[-1], "things"),
        (c.posting_starts, len(c.token_starts), "run_bytes"),
        (c.postings, c.posting_starts[-1], "postings"),
        (share, len(c.token_starts) - 1, "share"),
        *(
            (getattr(c, name), c.token_starts[-1], name)
            for name in ViewColumns._fields
            if name.startswith("run_")
        ),
    )
    for column, length, name in lengths:
        if len(column) != length:
            raise ValueError(f"{name} of viewpoints has {len(column)} entries instead of {length}")
    east, north, _, width = c.grid
    if not (
        np.isfinite((east, north)).all()
        and max(abs(east), abs(north)) <= 1e9
        and 0 < width < 1 << 31
    ):
        raise ValueError(f"grid of viewpoints {c.grid}")
    if not len(c.tiles) or (np.diff(c.tiles, prepend=-1) < 1).any() or c.tiles[-1] >= 1 << 48:
        raise ValueError("tiles of viewpoints are not in order")
    if not c.present.all():
        raise ValueError("a tile has no viewpoints")
    if not (np.isfinite(share).all() and (share >= 0.0).all()):
        raise ValueError("shares of tokens are invalid")


def index_in(file: MapFile, words: int) -> ViewIndex | None:
    """Read the index of a map file, of as many `words`; None where it has none.

    Raises `MapError` where a column is missing, and what `store.sound` turns into one where columns
    contradict each other.
    """
    if "viewpoints" not in file.meta:
        return None
    columns = {name: file.array(PREFIX + name, dtype) for name, dtype in DTYPES.items()}
    east, north, width = file.meta["viewpoints"]
    index = ViewIndex.of(columns, (float(east), float(north), int(width)))
    index = replace(index, watch=file.watch)
    if len(index.share) != words:
        raise ValueError("the index of viewpoints was built with another vocabulary")
    return index
