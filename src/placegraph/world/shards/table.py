"""The table of words: in which shards each label and each name occurs, and how much of it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from sys import intern
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar

import numpy as np

from placegraph.columns import spans
from placegraph.errors import PlacegraphError
from placegraph.outdoor.map.index_build import STRIDE, fade, grid_of, seen_from
from placegraph.outdoor.map.objects import AREA
from placegraph.store import pack_strings, read_map, sound, write_map
from placegraph.world.shards.table_kernels import words_in_sight

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from placegraph.outdoor.map.city import City
    from placegraph.outdoor.map.raster import Sightings

KIND, VERSION = "words", 1
Number = TypeVar("Number", np.int64, np.float64)
CROWD = 30.0
"""As of `Statements.crowd`: pairs in sight are counted with so many more."""


class Counted(NamedTuple):
    """What is counted of one shard, in its core; a row a word (labels, then names)."""

    labels: tuple[str, ...]
    names: tuple[str, ...]
    objects: NDArray[np.int32]
    """(T,) objects of a word; those count whose centre lies in the core."""
    mass: NDArray[np.float32]
    """(T,) sum over viewpoints of how much of a word is in sight."""
    peak: NDArray[np.float32]
    """(T,) largest share that a word has of all that one viewpoint has in sight."""
    sight: float
    """Sum over viewpoints of all that is in sight."""
    spread: float
    """Largest sum of the shares of all labels: things have more than one."""
    pull: float
    """Largest square of all in sight against its pairs, and `CROWD`."""
    total: int
    """Objects whose centre lies in the core."""
    cells: int
    viewpoints: int


def keep(found: Counted, path: Path, digest: str) -> None:
    """Put aside what was counted of the shard with this digest; `MapError` where that fails."""
    told = {name: value for name, value in found._asdict().items() if np.ndim(value) == 0}
    arrays = {"labels": pack_strings(found.labels), "names": pack_strings(found.names)}
    arrays |= {name: getattr(found, name) for name in _OF_A_SHARD}
    write_map(path, "counts", VERSION, told | {"digest": digest}, arrays, quick=True)


def kept(path: Path, digest: str) -> Counted | None:
    """What `keep` put aside of the shard with this digest; None where it did not, or it is damaged."""
    try:
        file = read_map(path, "counts", VERSION)
        found: dict[str, Any] = {
            n: tuple(map(intern, file.strings(n))) for n in ("labels", "names")
        }
    except PlacegraphError:
        return None
    found |= {name: file.arrays[name] for name in _OF_A_SHARD} | file.meta
    return Counted(**found) if found.pop("digest") == digest else None


def counted(city: City, key: str, around: Sightings | None = None) -> Counted:
    """Count the words of a shard in its core; `around` is what `City.look_around` gives, where known."""
    from placegraph.tiles import held

    views, objects = city.views, city.objects
    n, n_labels = len(objects.labels) + len(objects.names), len(objects.labels)
    inside = np.flatnonzero(held(city.plane.to_lonlat(views.positions.astype(np.float64)), key))
    bounds, seen, offsets = _in_sight(city, inside, around)
    sight = fade(np.hypot(*offsets.T))
    view = np.repeat(np.arange(len(inside)), np.diff(bounds))
    stood_in = (objects.kind[seen] == AREA) & ~offsets.any(axis=1)
    apart = np.where(stood_in, 0.0, sight)
    total, alone, squared = (np.bincount(view, x, len(inside)) for x in (sight, apart, apart**2))
    pairs = np.maximum(alone**2 - squared, 0.0)
    mass, peak, spread = words_in_sight(bounds, seen, sight, total, city.tokens, n_labels, n)
    own = held(city.plane.to_lonlat(objects.center.astype(np.float64)), key)
    starts, values, _ = city.tokens
    owner = np.repeat(np.arange(len(objects)), np.diff(starts))
    middles = city.plane.to_lonlat(city.cells.centers(np.arange(len(city.cells))))
    return Counted(
        objects.labels, objects.names,
        np.bincount(values[own[owner]], minlength=n).astype(np.int32),
        mass.astype(np.float32), peak, float(total.sum()), spread,
        float((total**2 / (pairs + CROWD)).max(initial=0.0)),
        int(own.sum()), int(held(middles, key).sum()), len(inside),
    )  # fmt: skip


def _in_sight(
    city: City, rows: NDArray[np.int64], around: Sightings | None
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
    """What viewpoints (K,) have in sight: bounds (K + 1,), objects, and their offsets [m].

    As of `City.in_sight`, in half the time where it is most of them.
    """
    grid = grid_of(city.objects)
    at = (city.views.positions[rows].astype(np.float64) - (grid.east, grid.north)) / STRIDE
    points = np.rint(at).astype(np.int64) @ (1, grid.columns)
    seen = around or seen_from(city.objects, grid)
    bounds, entries = spans(seen.starts, np.searchsorted(seen.points, points))
    return bounds, seen.objects[entries], seen.offsets[entries]


@dataclass(frozen=True, eq=False)
class WordTable:
    """Words of all shards, with the shards (CSR) that hold each.

    Words are labels, then names, as the tokens of a city; rows of shards are in order of their keys.
    """

    labels: tuple[str, ...]
    """Sorted."""
    names: tuple[str, ...]
    """Sorted."""
    starts: NDArray[np.int64]
    """(T + 1,)"""
    shards: NDArray[np.int32]
    """(E,) row of a shard, ascending within a word."""
    objects: NDArray[np.int32]
    """(E,) as `Counted.objects` ..."""
    mass: NDArray[np.float32]
    """... `mass` ..."""
    peak: NDArray[np.float32]
    """... and `peak`."""
    viewpoints: NDArray[np.int64]
    """(N,) of each shard, and so are ..."""
    sight: NDArray[np.float64]
    spread: NDArray[np.float64]
    pull: NDArray[np.float64]

    @classmethod
    def joined(cls, found: Sequence[Counted]) -> Self:
        """Table of shards in this order."""
        labels = tuple(sorted({label for c in found for label in c.labels}))
        names = tuple(sorted({name for c in found for name in c.names}))
        label_rows = {label: row for row, label in enumerate(labels)}
        name_rows = {name: row + len(labels) for row, name in enumerate(names)}
        words, shards, columns = [], [], []
        for i, c in enumerate(found):
            rows = [*map(label_rows.__getitem__, c.labels), *map(name_rows.__getitem__, c.names)]
            here = np.flatnonzero((c.objects > 0) | (c.mass > 0.0))
            words.append(np.array(rows, np.int64)[here])
            shards.append(np.full(len(here), i, np.int32))
            columns.append((c.objects[here], c.mass[here], c.peak[here]))
        word = np.concatenate(words)
        order = np.argsort(word, kind="stable")
        size = np.bincount(word, minlength=len(labels) + len(names))
        objects, mass, peak = (np.concatenate(part)[order] for part in zip(*columns, strict=True))
        return cls(
            labels, names, np.concatenate(([0], np.cumsum(size))).astype(np.int64),
            np.concatenate(shards)[order], objects, mass, peak,
            np.array([c.viewpoints for c in found], np.int64),
            *(np.array(part, np.float64)
              for part in zip(*((c.sight, c.spread, c.pull) for c in found), strict=True)),
        )  # fmt: skip

    def write(self, path: Path) -> None:
        """Write the table in one step; `MapError` where that fails."""
        arrays = {
            "labels": pack_strings(self.labels), "names": pack_strings(self.names),
            "word_counts": np.diff(self.starts).astype(np.uint32),
            **{name: getattr(self, name) for name in _COLUMNS},
        }  # fmt: skip
        write_map(path, KIND, VERSION, {}, arrays)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a table; `InputError` or `MapError` where it is missing, damaged or newer."""
        file = read_map(path, KIND, VERSION)
        with sound(path, "Finish the world again with `placegraph world build`."):
            counts = file.array("word_counts", "<u4").astype(np.int64)
            starts = np.concatenate(([0], np.cumsum(counts)))
            columns = {name: file.array(name, dtype) for name, dtype in _COLUMNS.items()}
            labels = file.strings("labels", most=len(counts))
            names = file.strings("names", most=len(counts))
            made = cls(labels, names, starts, **columns)
            made.check()
        return made

    def check(self) -> None:
        """Raise `ValueError` where columns contradict each other."""
        n = len(self.viewpoints)
        if len(self.starts) != len(self.labels) + len(self.names) + 1:
            raise ValueError("words and their counts are of different lengths")
        if any(len(getattr(self, k)) != self.starts[-1] for k in list(_COLUMNS)[:4]):
            raise ValueError("entries of words are of different lengths")
        if any(len(getattr(self, k)) != n for k in list(_COLUMNS)[4:]):
            raise ValueError("columns of shards are of different lengths")
        if len(self.shards) and not 0 <= self.shards.min() <= self.shards.max() < n:
            raise ValueError("a word is of no shard")
        for k in list(_COLUMNS)[2:]:
            if not (np.isfinite(getattr(self, k)).all() and (getattr(self, k) >= 0).all()):
                raise ValueError(f"{k} holds what is no amount")

    def row(self, word: int) -> slice:
        """Entries of a word."""
        return slice(int(self.starts[word]), int(self.starts[word + 1]))

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """Objects (T,) that bear each word."""
        return _sums(self.objects.astype(np.int64), self.starts)

    @cached_property
    def shares(self) -> NDArray[np.float64]:
        """Share (T,) of each word of all things in sight, over all viewpoints of the world."""
        return _sums(self.mass.astype(np.float64), self.starts) / max(
            float(self.sight.sum()), 1e-30
        )


_OF_A_SHARD = ("objects", "mass", "peak")
_COLUMNS = {
    "shards": "<i4", "objects": "<i4", "mass": "<f4", "peak": "<f4",
    "viewpoints": "<i8", "sight": "<f8", "spread": "<f8", "pull": "<f8",
}  # fmt: skip


def _sums(values: NDArray[Number], starts: NDArray[np.int64]) -> NDArray[Number]:
    """Sum of each stretch of values."""
    found: NDArray[Number] = np.diff(np.concatenate(([0], np.cumsum(values)))[starts])
    return found
