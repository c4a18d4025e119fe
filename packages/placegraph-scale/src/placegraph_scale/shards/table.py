"""The table of words: in which shards each label and each name occurs, and how much of it."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from itertools import chain
from sys import intern
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np

from placegraph.core.files import cannot_write
from placegraph.core.geo import bounds, held
from placegraph.core.mapfile import (
    STARTS,
    SUMS,
    damaged,
    open_pages,
    pack_strings,
    read_map,
    sound,
    stretches,
    with_sums,
    write_map,
)
from placegraph.errors import PlacegraphError
from placegraph.outdoor.map.index_write import Core
from placegraph_scale.shards import names
from placegraph_scale.shards.merge import AT_ONCE, Columns, Texts
from placegraph_scale.shards.names import WorldNames

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from placegraph.core.files import Watch
    from placegraph.core.mapfile import Column
    from placegraph.outdoor.map.city import City

KIND, VERSION = "words", 3
MEND = "Finish the world again: `placegraph_scale.shards.finish`."
AROUND = 100.0
"""Shards have viewpoints so far around their cores [m], and more to the end of a tile: a thing that
nothing else has in sight makes those within 20 m of it viewpoints, which others up to 58 m away prevent."""


class Counted(NamedTuple):
    """What is counted of one shard, in its core; a row a word (labels, then names)."""

    labels: tuple[str, ...]
    names: tuple[str, ...]
    objects: NDArray[np.int32]
    """(T,) objects of a word; those count whose centre lies in the core."""
    mass: NDArray[np.float32]
    """(T,) sum over viewpoints of how much of a word is in sight ..."""
    shares: NDArray[np.float32]
    """(T,) ... and of which share that is of all that one has in sight."""
    peak: NDArray[np.float32]
    """(T,) largest such share."""
    sight: float
    """Sum over viewpoints of all that is in sight."""
    spread: float
    """Largest sum of the shares of all labels: things have more than one."""
    pull: float
    """Largest square of all in sight against its pairs in sight."""
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
        found |= {name: file.arrays[name] for name in _OF_A_SHARD} | file.meta
    except (PlacegraphError, LookupError):  # or by a version that counted something else
        return None
    return Counted(**found) if found.pop("digest") == digest else None


def counted(city: City, key: str) -> Counted:
    """Count the words of a shard in its core; `City.views` are those about the core afterwards."""
    objects, plane, box = city.objects, city.plane, bounds(key).widened(AROUND)
    low, high = plane.to_plane(np.array([box[:2], box[2:]]))
    seen = city.look_around(Core(low, high, lambda places: held(plane.to_lonlat(places), key)))
    own = held(plane.to_lonlat(objects.center.astype(np.float64)), key)
    starts, values, _ = city.tokens
    owner = np.repeat(np.arange(len(objects)), np.diff(starts))
    middles = plane.to_lonlat(city.cells.centers(np.arange(len(city.cells))))
    return Counted(
        objects.labels, objects.names,
        np.bincount(values[own[owner]], minlength=len(seen.mass)).astype(np.int32),
        seen.mass.astype(np.float32), seen.shares.astype(np.float32), seen.peak,
        seen.sight, seen.spread, seen.pull,
        int(own.sum()), int(held(middles, key).sum()), seen.viewpoints,
    )  # fmt: skip


class Entries(NamedTuple):
    """What shards hold of a word."""

    shards: NDArray[np.int32]
    """(E,) row of each, ascending."""
    objects: NDArray[np.int32]
    """(E,) as `Counted.objects` ..."""
    mass: NDArray[np.float32]
    """... `mass` ..."""
    shares: NDArray[np.float32]
    """... `shares` ..."""
    peak: NDArray[np.float32]
    """... and `peak`."""


@dataclass(frozen=True, eq=False)
class WordTable:
    """Words of all shards, and the shards that hold each; made by `write`, opened by `open`.

    Words are labels, then names, as the tokens of a city; rows of shards are in order of their keys.
    Labels and what is known of shards are in memory. All else is read when it is asked for, and
    checked then: `MapError` where it is damaged.
    """

    labels: tuple[str, ...]
    """Sorted."""
    names: WorldNames
    """Sorted."""
    columns: Mapping[str, Column]
    viewpoints: NDArray[np.int64]
    """(N,) of each shard, and so are ..."""
    sight: NDArray[np.float64]
    spread: NDArray[np.float64]
    pull: NDArray[np.float64]
    watch: Watch

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a table; `InputError` or `MapError` where it is missing, damaged or of another version."""
        file, columns = open_pages(path, KIND, VERSION, _ENTRIES | names.COLUMNS, MEND)
        with sound(path, MEND):
            told = {name: file.array(name, dtype) for name, dtype in _OF_SHARDS.items()}
            known = WorldNames.of(file, columns)
            labels = file.strings("labels", most=len(columns["starts"]))
            assert file.watch is not None  # noqa: S101  # `open_pages` gives one
            made = cls(labels, known, columns, **told, watch=file.watch)
            made.check()
        return made

    def check(self) -> None:
        """Raise `ValueError` where columns contradict each other."""
        size = {name: len(column) for name, column in self.columns.items()}
        if size["starts"] != len(self.labels) + len(self.names.names) + 1:
            raise ValueError("words and their counts are of different lengths")
        if len({size[name] for name in Entries._fields}) > 1:
            raise ValueError("entries of words are of different lengths")
        of_shards = [getattr(self, name) for name in _OF_SHARDS]
        if len({len(column) for column in of_shards}) > 1:
            raise ValueError("columns of shards are of different lengths")
        if not all((np.isfinite(column) & (column >= 0)).all() for column in of_shards):
            raise ValueError("what is known of shards holds what is no amount")

    def reads(self, word: int) -> str:
        """What a word reads: a label, or a name behind a tilde."""
        n = len(self.labels)
        return self.labels[word] if word < n else f"~{self.names.names[word - n]}"

    def of(self, word: int) -> Entries:
        """Shards that hold a word."""
        starts = self.columns["starts"]
        part = slice(*stretches(starts, word, word + 1, len(self.columns["shards"])))
        found = Entries(*(self.columns[name][part] for name in Entries._fields))
        wrong = len(found.shards) and not 0 <= found.shards.min() <= found.shards.max() < len(self)
        if wrong or not all((np.isfinite(x) & (x >= 0)).all() for x in found[1:]):
            raise damaged(starts.path, f"entries of {self.reads(word)!r} are none of its shards")
        return found

    def __len__(self) -> int:
        return len(self.viewpoints)

    def counts(self, words: Sequence[int]) -> NDArray[np.int64]:
        """Objects (K,) that bear each of these words."""
        return np.array([self.of(word).objects.sum(dtype=np.int64) for word in words], np.int64)

    def shares(self, words: Sequence[int]) -> NDArray[np.float64]:
        """Share (K,) of each of these words of all things in sight, over all viewpoints of the world."""
        mass = np.array([self.of(word).mass.sum(dtype=np.float64) for word in words], np.float64)
        return mass / max(float(self.sight.sum()), 1e-30)


_OF_A_SHARD = ("objects", "mass", "shares", "peak")


def write(path: Path, found: Iterable[Counted], scratch: Path, at_once: int = AT_ONCE) -> None:
    """Write the table of shards in this order, in one step; `MapError` where that fails.

    Memory holds one shard, all labels, and `at_once` words; the others lie in the folder `scratch`
    meanwhile, which is made, and removed.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        scratch.mkdir()
        _write(path, found, scratch, at_once)
    except OSError as error:
        raise cannot_write(scratch, error) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _write(path: Path, found: Iterable[Counted], scratch: Path, at_once: int) -> None:
    made, words = Columns(scratch / "entries"), Texts(scratch / "words", at_once)
    of_shards: dict[str, list[float]] = {name: [] for name in _OF_SHARDS}
    entries = 0
    for i, c in enumerate(found):
        here = (c.objects > 0) | (c.mass > 0.0)
        numbers = (entries + np.cumsum(here) - 1).tolist()
        texts = chain((f"0{label}" for label in c.labels), (f"1{name}" for name in c.names))
        for text, number, there in zip(texts, numbers, here.tolist(), strict=True):
            words.add(text, (number,) if there else ())
        many = int(here.sum())
        made.add("shards", "<i4", np.full(many, i))
        for name in _OF_A_SHARD:
            made.add(name, _ENTRIES[name], getattr(c, name)[here])
        for name, known in of_shards.items():
            known.append(getattr(c, name))
        entries += many
    labels: list[str] = []

    def every() -> Iterator[str]:
        for text, numbers in words.merged():
            made.add("sizes", "<i8", len(numbers).to_bytes(8, "little"))
            made.add("order", "<i8", numbers)
            if text[0] == "0":
                labels.append(text[1:])
            else:
                yield text[1:]

    counts, of_names = names.columns_of(every(), scratch / "names", at_once)
    order = made.of("order", "<i8")
    paged = {
        name: made.taken(f"{name}_by_word", made.of(name, _ENTRIES[name]), order)
        for name in Entries._fields
    }
    paged |= of_names | {"starts": made.starts("starts", made.of("sizes", "<i8"))}
    told = {name: np.array(of_shards[name], dtype) for name, dtype in _OF_SHARDS.items()}
    arrays = with_sums({"labels": pack_strings(labels), **told, **paged}, paged)
    write_map(path, KIND, VERSION, counts, arrays, mapped=(*paged, SUMS))


_ENTRIES = {"starts": STARTS, "shards": "<i4", "objects": "<i4"} | dict.fromkeys(
    ("mass", "shares", "peak"), "<f4"
)
_OF_SHARDS = {"viewpoints": "<i8", "sight": "<f8", "spread": "<f8", "pull": "<f8"}
