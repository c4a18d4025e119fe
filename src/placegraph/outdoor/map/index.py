"""Index of the viewpoints of a city, and of what stands around each; candidates are found by it.

A sentence is spoken somewhere, not "in a tile". Every 20 m where anything is in sight there is a
viewpoint. For each *token* (a label or a name) the index lists the viewpoints that have it in sight,
tile by tile: in a tile of 8 times 8 viewpoints 64 bits tell which, and how much there is at most.
It is built when a map is written (`index_write`), and read where it lies: a search looks at few
tiles, and what is in sight of a viewpoint is worked out for the few that are compared in full.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.mapfile import MapFile
from placegraph.outdoor.map.index_kernels import FADED, REACHED, SIDE, WIDTH
from placegraph.outdoor.map.index_write import DTYPES, LEVELS, PREFIX, STRIDE, build, grid_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from placegraph.core.files import Watch
    from placegraph.outdoor.map.index_write import Core, SightTotals
    from placegraph.outdoor.map.objects import CityObjects

POINT, AREA = 0, 2
SIGHT = FADED
"""Distance at which half the things are still spoken of [m]."""
FADE = WIDTH
"""Width of the fall around `SIGHT` [m]."""
REACH = REACHED
"""Beyond this distance a thing is not listed at a viewpoint [m]."""
FEW = 500_000
"""The positions of no more viewpoints than this are kept at hand."""
_AROUND = 2
"""Points of the grid to every side among which the nearest viewpoint within `STRIDE` is."""


_DERIVED = frozenset({"grid", "first", "thing_starts", "token_starts", "levels"})
"""Fields of `ViewColumns` that are not stored as they are."""


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
    total: NDArray[np.uint8]
    """(W,) grade, rounded down, of the sum of `sight` of what a viewpoint has in sight."""
    pairs: NDArray[np.uint16]
    """(W,) root of its sum of products of `sight` over pairs of what one does not stand in, in steps
    of 1 / 64, rounded down."""
    thing_starts: NDArray[np.int64]
    """(T + 1,)"""
    things: NDArray[np.int32]
    """Rows of the objects in sight of any viewpoint of a tile, ascending."""
    token_starts: NDArray[np.int64]
    """(tokens + 1,) runs of a token: a run is a token in a tile."""
    run_tiles: NDArray[np.uint32]
    """(R,) its tile, ascending within a token."""
    run_slots: NDArray[np.int64]
    """(R,) which of the viewpoints have it in sight: 64 bits."""
    run_first: NDArray[np.uint32]
    """(R,) its first posting; they follow by slot."""
    run_pairs: NDArray[np.uint8]
    """(R,) grade of the largest mass over the root of pairs and crowd."""
    run_total: NDArray[np.uint8]
    """(R,) grade of the largest mass over total."""
    postings: NDArray[np.uint32]
    """(P,) `unpack`: grade of the mass of a viewpoint's objects of the token (the sum of `sight`
    times the token's weight), and the box that they lie in."""
    levels: NDArray[np.float32]
    """(GRADES,) mass of a grade."""


@dataclass(frozen=True, eq=False)
class ViewIndex:
    """Viewpoints (W) of a map, and where each of its tokens is in sight."""

    columns: ViewColumns
    share: NDArray[np.float64]
    """(tokens,) share of each in all that is in sight of all viewpoints."""
    watch: Watch | None = None
    """Of the map file that columns are windows on."""

    @classmethod
    def build(cls, objects: CityObjects, core: Core | None = None) -> tuple[Self, SightTotals]:
        """Index of a map that has none yet, about a core if one is given, and what is seen there."""
        grid = grid_of(objects)
        columns, seen = build(objects, core=core)
        return cls.of(columns, (grid.east, grid.north, grid.columns // SIDE)), seen

    @classmethod
    def of(cls, columns: Mapping[str, NDArray[Any]], grid: tuple[float, float, int]) -> Self:
        """Index of the columns that `build` makes; `ValueError` where they contradict each other."""
        east, north, width = grid
        columns = {name: _locked(column) for name, column in columns.items()}
        given = ViewColumns(
            grid=(float(east), float(north), STRIDE, int(width)),
            tiles=columns["tiles"],
            present=columns["present"],
            first=_starts(_ones(columns["present"])),
            total=columns["total"],
            pairs=columns["pairs"],
            thing_starts=_starts(columns["thing_counts"]),
            things=columns["things"],
            token_starts=_starts(columns["run_counts"]),
            levels=LEVELS,
            **{name: columns[name] for name in ViewColumns._fields if name.startswith("run_")},
            postings=columns["postings"],
        )
        _check(given, columns["share"])
        return cls(given, columns["share"])

    def arrays(self) -> dict[str, NDArray[Any]]:
        """The columns that `of` takes."""
        c = self.columns
        own = {name: value for name, value in c._asdict().items() if name not in _DERIVED}
        counts = {"thing_counts": c.thing_starts, "run_counts": c.token_starts}
        sizes = {name: np.diff(starts).astype(np.uint32) for name, starts in counts.items()}
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
        return self._at(*np.nonzero(_bits(self.columns.present)))

    def positions_of(self, rows: NDArray[np.integer[Any]]) -> NDArray[np.float32]:
        """(K, 2) east, north of viewpoints (K,) [m]."""
        if len(rows) > len(self) // 8 or len(self) <= FEW:
            return self.positions[rows]
        tile = np.searchsorted(self.columns.first, rows, side="right") - 1
        rank = np.asarray(rows) - self.columns.first[tile]
        upto = np.cumsum(_bits(self.columns.present[tile]), axis=1, dtype=np.int8)
        return self._at(tile, np.argmax(upto > rank[:, None], axis=1))

    def _at(
        self, tile: NDArray[np.integer[Any]], slot: NDArray[np.integer[Any]]
    ) -> NDArray[np.float32]:
        east, north, stride, width = self.columns.grid
        line, column = np.divmod(self.columns.tiles[tile], width)
        x = east + (column * SIDE + slot % SIDE) * stride
        return np.stack([x, north + (line * SIDE + slot // SIDE) * stride], 1).astype(np.float32)

    def frequency(self, tokens: NDArray[np.int32], weights: NDArray[np.float32]) -> float:
        """Share of all things in sight, over all viewpoints, that these tokens stand for."""
        return float(weights @ self.share[tokens])

    def near(self, position: NDArray[np.floating[Any]], reach: float) -> NDArray[np.int64]:
        """Viewpoints (K,) within `reach` [m] of a position (2,) in east and in north, nearest first."""
        found = self.around(position, reach)
        delta = _farther(self.positions_of(found) - position)
        inside = delta <= reach
        found, delta = found[inside], delta[inside]
        return found[np.argsort(delta, kind="stable")]

    def around(self, position: NDArray[np.floating[Any]], reach: float) -> NDArray[np.int64]:
        """Viewpoints (K,) of all tiles that have points within `reach` [m] of a position, ascending."""
        east, north, stride, width = self.columns.grid
        tile = SIDE * stride
        low = np.floor((np.asarray(position, np.float64) - reach - (east, north)) / tile)
        high = np.floor((np.asarray(position, np.float64) + reach - (east, north)) / tile)
        if high[0] < 0 or low[0] >= width or not len(self.columns.tiles):
            return np.zeros(0, np.int64)
        last = int(self.columns.tiles[-1]) // width
        lines = np.arange(max(0, int(low[1])), min(last, int(high[1])) + 1)
        ends = lines[:, None] * width + [max(0, int(low[0])), min(width - 1, int(high[0])) + 1]
        rows = self.columns.first[np.searchsorted(self.columns.tiles, ends)]
        return np.concatenate([np.zeros(0, np.int64), *(np.arange(a, b) for a, b in rows)])

    def nearest(self, positions: NDArray[np.float64]) -> NDArray[np.int64]:
        """First (K,) of what `near` finds within `STRIDE` of positions (K, 2); -1 where it is none."""
        east, north, stride, _ = self.columns.grid
        at = (np.asarray(positions, np.float64) - (east, north)) / stride
        steps = np.arange(1 - _AROUND, 1 + _AROUND)
        offsets = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)[:, ::-1]
        points = np.floor(at).astype(np.int64)[:, None] + offsets
        rows = self._rows(points[..., 0], points[..., 1])
        places = (points * stride + (east, north)).astype(np.float32)
        delta = np.where(rows >= 0, _farther(places - np.asarray(positions)[:, None]), np.inf)
        best = np.min(delta, axis=1)
        first = np.min(np.where(delta == best[:, None], rows, len(self)), axis=1)
        return np.where(best <= STRIDE, first, -1)

    def _rows(self, column: NDArray[np.int64], row: NDArray[np.int64]) -> NDArray[np.int64]:
        """Viewpoints at points of the grid; -1 where there is none."""
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
    """The larger of the distances in east and in north of differences (..., 2)."""
    return np.maximum(np.abs(delta[..., 0]), np.abs(delta[..., 1]))


def _bits(numbers: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Bits (n, 64) of numbers (n,), the lowest first."""
    in_bytes = numbers.astype("<i8").view(np.uint8).reshape(-1, 8)
    return np.unpackbits(in_bytes, axis=1, bitorder="little")


_IN_BYTE = np.array([i.bit_count() for i in range(256)], np.uint8)


def _ones(bits: NDArray[np.int64]) -> NDArray[np.int64]:
    """Count the bits that are set."""
    in_bytes = _IN_BYTE[np.ascontiguousarray(bits)[..., None].view(np.uint8)]
    return in_bytes.sum(axis=-1, dtype=np.int64)


def _starts(counts: NDArray[Any]) -> NDArray[np.int64]:
    return np.concatenate(([0], np.cumsum(counts, dtype=np.int64)))


def _locked(column: NDArray[Any]) -> NDArray[Any]:
    """The column, which nobody may write: compiled code tells the two apart."""
    column = np.ascontiguousarray(column).view()
    column.flags.writeable = False
    return column


def _check(c: ViewColumns, share: NDArray[np.float64]) -> None:
    """Raise `ValueError` where columns contradict each other, by what is short enough to be read whole.

    Compiled code checks what it reads of the rest: a run's tile and postings, and a tile's things.
    """
    lengths = (
        (c.present, len(c.tiles), "present"),
        (c.thing_starts, len(c.tiles) + 1, "thing_counts"),
        (c.total, c.first[-1], "total"),
        (c.pairs, c.first[-1], "pairs"),
        (c.things, c.thing_starts[-1], "things"),
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
        raise ValueError("shares of tokens are none")


def index_in(file: MapFile, words: int) -> ViewIndex | None:
    """The index that a map file has of as many `words`; None where it has none.

    Raises `MapError` where a column is missing, and what `store.sound` turns into one where columns
    contradict each other.
    """
    if "views" not in file.meta:
        return None
    columns = {name: file.array(PREFIX + name, dtype) for name, dtype in DTYPES.items()}
    east, north, width = file.meta["views"]
    index = ViewIndex.of(columns, (float(east), float(north), int(width)))
    index = replace(index, watch=file.watch)
    if len(index.share) != words:
        raise ValueError("the index of viewpoints is of other words")
    return index
