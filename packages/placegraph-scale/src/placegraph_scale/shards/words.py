"""Words of a world in shards: its table of labels and names, how it is written, opened and looked up."""

from __future__ import annotations

import json
import shutil
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from hashlib import blake2b
from heapq import merge
from itertools import chain, groupby, pairwise
from operator import itemgetter
from os import PathLike
from pathlib import Path
from sys import intern
from typing import TYPE_CHECKING, Any, NamedTuple, Self, TypeVar

import numpy as np

from placegraph.core.files import cannot_write
from placegraph.core.geo import bounds, check_zoom, held, tile_of
from placegraph.core.mapfile import (
    STARTS,
    SUMS,
    Column,
    damaged,
    open_pages,
    pack_strings,
    read_map,
    sound,
    stretches,
    with_sums,
    write_map,
)
from placegraph.core.mapfile import Texts as Lying
from placegraph.errors import InputError, MapError, OptionError, PlacegraphError
from placegraph.outdoor.map.index_write import Core
from placegraph.outdoor.map.names import CROWDED, LONGEST, NameIndex, is_alphabetic, spoken, stems
from placegraph_scale.folder import SHARDS, WORDS, ShardFile, WorldFile, digest_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.core.files import Watch
    from placegraph.core.mapfile import MapFile
    from placegraph.outdoor.map.city import City

AT_ONCE = 1 << 20
"""Entries that are held in memory, some 150 bytes each."""
SOME = 1 << 16
"""Entries that are read at once."""
ROOM = 1 << 20
"""Bytes of a column that wait until they are written."""


class Texts:
    """Texts, each with numbers, that are added in any order, and come out in theirs.

    They wait in memory up to `at_once`, and then in a file each time, of which all are merged.
    """

    def __init__(self, folder: Path, at_once: int = AT_ONCE) -> None:
        self.folder, self.at_once = folder, at_once
        folder.mkdir()
        self._known: dict[str, list[int]] = {}
        self._size = self._files = 0

    def add(self, text: str, numbers: Sequence[int]) -> None:
        """Add numbers to those of a text."""
        self._known.setdefault(text, []).extend(numbers)
        self._size += 1
        if self._size >= self.at_once:
            with (self.folder / f"{self._files}").open("w", encoding="utf-8") as file:
                file.writelines(json.dumps(pair) + "\n" for pair in sorted(self._known.items()))
            self._known, self._size, self._files = {}, 0, self._files + 1

    def merged(self) -> Iterator[tuple[str, list[int]]]:
        """All texts, sorted, and the numbers of each in the order in which they were added."""
        if not self._files:
            yield from sorted(self._known.items())
            return
        each = [self._read(n) for n in range(self._files)]
        both = merge(*each, iter(sorted(self._known.items())), key=itemgetter(0))
        for text, same in groupby(both, key=itemgetter(0)):
            yield text, [number for _, numbers in same for number in numbers]

    def _read(self, number: int) -> Iterator[tuple[str, list[int]]]:
        with (self.folder / f"{number}").open(encoding="utf-8") as file:
            for line in file:
                text, numbers = json.loads(line)
                yield text, numbers


class Columns:
    """Columns that grow in the files of a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        self._waiting: dict[str, bytearray] = {}

    def add(self, name: str, dtype: str, values: Sequence[Any] | NDArray[Any] | bytes) -> None:
        """Add values to a column of this type; bytes are those of it."""
        waiting = self._waiting.setdefault(name, bytearray())
        waiting += values if isinstance(values, bytes) else np.asarray(values, dtype).tobytes()
        if len(waiting) >= ROOM:
            self._write(name)

    def _write(self, name: str) -> None:
        with (self.folder / name).open("ab") as file:
            file.write(self._waiting.pop(name, b""))

    def of(self, name: str, dtype: str) -> NDArray[Any]:
        """A column, where it lies; none of it is added to afterwards."""
        self._write(name)
        path = self.folder / name
        return np.memmap(path, dtype, "r") if path.stat().st_size else np.zeros(0, dtype)

    def taken(self, name: str, column: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
        """Rows of a column as another."""
        for at in range(0, len(rows), SOME):
            self.add(name, column.dtype.str, column[rows[at : at + SOME]])
        return self.of(name, column.dtype.str)

    def starts(self, name: str, sizes: NDArray[np.integer[Any]]) -> NDArray[Any]:
        """As `starts_of`."""
        total, dtype = 0, "<u4" if int(sizes.sum(dtype=np.int64)) < 1 << 32 else "<u8"
        self.add(name, dtype, [0])
        for at in range(0, len(sizes), SOME):
            ends = total + np.cumsum(sizes[at : at + SOME], dtype=np.int64)
            total = int(ends[-1])
            self.add(name, dtype, ends)
        return self.of(name, dtype)


def by_key(keys: NDArray[np.uint64], at_once: int = AT_ONCE) -> Iterator[NDArray[np.int64]]:
    """Rows in the stable order of keys below 2^63 that are spread evenly, some at a time."""
    cuts = np.linspace(0, 1 << 63, 1 + -(-len(keys) // at_once), dtype=np.float64).astype(np.uint64)
    for low, high in pairwise(cuts):
        there = [
            at + np.flatnonzero((keys[at : at + SOME] >= low) & (keys[at : at + SOME] < high))
            for at in range(0, len(keys), SOME)
        ]
        rows = np.concatenate(there)
        yield rows[np.argsort(keys[rows], kind="stable")]


Found = TypeVar("Found")
COLUMNS = {
    "name_starts": STARTS, "name_text": "|u1", "said": "<u8", "said_rows": "<u4",
    "first": "<u8", "first_longest": "|u1", "stem_starts": STARTS, "stem_text": "|u1",
    "posting_starts": STARTS, "postings": "<u4",
}  # fmt: skip
"""Columns of names, and what they are."""

REMEMBERED = 1 << 16
"""Words whose place is kept in mind."""


def columns_of(
    names: Iterable[str], scratch: Path, at_once: int = AT_ONCE
) -> tuple[dict[str, int], dict[str, NDArray[Any]]]:
    """Counts and columns of names, which are sorted; these lie in files of `scratch`, which is made."""
    scratch.mkdir()
    made, words = Columns(scratch / "columns"), Texts(scratch / "words", at_once)
    n_rows = 0
    for row, name in enumerate(names):
        n_rows += 1
        _add_text(made, "name", name)
        for way, said in enumerate(spoken(name)):
            key = " ".join(said)
            made.add("key", "<u8", _hash(key).to_bytes(8, "little"))
            made.add("entry", "<u4", (2 * row + way).to_bytes(4, "little"))
            made.add("begin", "<u8", _hash(said[0]).to_bytes(8, "little"))
            made.add("many", "|u1", bytes([min(len(said), LONGEST)]))
            for stem in stems(key):
                words.add(f"{int(not is_alphabetic(stem))}{stem}", [2 * row + way])
    # what several names are called stands once among their words: of the first
    fresh = np.memmap(scratch / "fresh", np.bool_, "w+", shape=(2 * n_rows + 1,))
    keys, entry, ways = made.of("key", "<u8"), made.of("entry", "<u4"), 0
    for rows in by_key(keys, at_once):
        first = np.flatnonzero(_new(keys[rows]))
        fresh[entry[rows[first]]] = True
        made.add("said", "<u8", keys[rows])
        made.add("said_rows", "<u4", entry[rows] >> 1)
        ways += len(first)
    begin, many = made.of("begin", "<u8"), made.of("many", "|u1")
    for rows in by_key(begin, at_once):
        if len(first := np.flatnonzero(_new(begin[rows]))):
            made.add("first", "<u8", begin[rows[first]])
            made.add("first_longest", "|u1", np.maximum.reduceat(many[rows], first))
    alphabetic = 0
    for word, entries in words.merged():
        kept = np.array(entries, np.uint32)[fresh[entries]]
        alphabetic += word[0] == "0"
        _add_text(made, "stem", word[1:])
        made.add("posting_sizes", "<i8", len(kept).to_bytes(8, "little"))
        made.add("postings", "<u4", kept)
    return {"spoken": ways, "alphabetic": alphabetic}, {
        name: made.of(name, dtype) if dtype != STARTS
        else made.starts(name, made.of(name.replace("starts", "sizes"), "<i8"))
        for name, dtype in COLUMNS.items()
    }  # fmt: skip


def _add_text(made: Columns, of: str, text: str) -> None:
    data = text.encode()
    made.add(f"{of}_sizes", "<i8", len(data).to_bytes(8, "little"))
    made.add(f"{of}_text", "|u1", data)


def _new(keys: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Which of sorted keys differ from those before."""
    return np.append(np.ones(min(1, len(keys)), np.bool_), keys[1:] != keys[:-1])


def _hash(words: str) -> int:
    """Of words, by which they are sorted."""
    return int.from_bytes(blake2b(words.encode(), digest_size=8).digest(), "little") >> 1


@dataclass(frozen=True, eq=False)
class _Lookup(Mapping[str, Found]):
    """A mapping whose keys are only looked up."""

    found: Callable[[str], Found | None]
    size: int

    def __getitem__(self, key: str) -> Found:
        found = self.found(key)
        if found is None:
            raise KeyError(key)
        return found

    def __len__(self) -> int:
        return self.size

    def __iter__(self) -> Iterator[str]:
        raise TypeError("names of a world are looked up one by one")


@dataclass(frozen=True, eq=False)
class _Alphabetic(Sequence[str]):
    """Those words of all that may be inflected or misspelt; they come first."""

    every: Lying
    size: int

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, row: Any) -> Any:  # noqa: ANN401  # as of `Lying`
        return self.every[slice(*row.indices(self.size)) if isinstance(row, slice) else row]


@dataclass(frozen=True, eq=False, kw_only=True)
class WorldNames(NameIndex):
    """Names of a world; finds what a `NameIndex` of all of them in memory would.

    But a misspelt name is only compared with those that have one of its words, or one much like it.
    """

    names: Lying
    words: Lying
    """Stems of the words of names: those that may be misspelt come first, both sorted."""
    alphabetic: int
    """How many these are."""
    columns: Mapping[str, Column]

    @classmethod
    def of(cls, file: MapFile, columns: Mapping[str, Column]) -> WorldNames:
        """Names of a file, as `columns_of` made them; raises `ValueError` where these are none."""
        size = {name: len(column) for name, column in columns.items()}
        names = Lying(columns["name_starts"], columns["name_text"])
        words = Lying(columns["stem_starts"], columns["stem_text"])
        ways, alphabetic = int(file.meta["spoken"]), int(file.meta["alphabetic"])
        if not 0 <= alphabetic <= len(words) == max(0, size["posting_starts"] - 1):
            raise ValueError("words and where they occur are of different lengths")
        if size["said"] != size["said_rows"] or size["first"] != size["first_longest"]:
            raise ValueError("what names are called is of different lengths")
        if not 0 <= ways <= size["said"]:
            raise ValueError(f"names are called in {ways} ways")
        called = _Lookup(partial(_called, names, columns), ways)
        first = _Lookup(partial(_longest, columns), size["first"])
        return cls(called, first, names=names, words=words, alphabetic=alphabetic, columns=columns)

    def _alike(self, words: str) -> Sequence[str]:
        said = dict.fromkeys(map(self._written, stems(words)))
        known = sorted((self._counts[word], word) for word in said if word in self._counts)
        return self._postings[known[0][1]] if known and known[0][0] <= CROWDED else ()

    @cached_property
    def _alphabetic(self) -> Sequence[str]:
        return _Alphabetic(self.words, self.alphabetic)

    @cached_property
    def _counts(self) -> Mapping[str, int]:
        return _Lookup(self._count, len(self.words))

    @cached_property
    def _postings(self) -> Mapping[str, Sequence[str]]:
        return _Lookup(self._called_with, len(self.words))

    def _count(self, word: str) -> int | None:
        found = self._of(word)
        return None if found is None else found[1] - found[0]

    def _called_with(self, word: str) -> Sequence[str] | None:
        """What names that have a word are called, in the order of the names."""
        found = self._of(word)
        if found is None:
            return None
        by = self.columns["postings"]
        return [_said(self.names, by, entry) for entry in by[slice(*found)].tolist()]

    @cached_property
    def _of(self) -> Callable[[str], list[int] | None]:
        return lru_cache(REMEMBERED)(self._entries_of)

    def _entries_of(self, word: str) -> list[int] | None:
        """Where the entries of a word begin and end."""
        part = (0, self.alphabetic) if is_alphabetic(word) else (self.alphabetic, len(self.words))
        row = bisect_left(self.words, word, *part)
        if row == part[1] or self.words[row] != word:
            return None
        c = self.columns
        return stretches(c["posting_starts"], row, row + 1, len(c["postings"]))


def _called(names: Lying, columns: Mapping[str, Column], words: str) -> list[int] | None:
    """Rows of names that are called so."""
    key = _hash(words)
    first, last = (columns["said"].find(k) for k in (key, key + 1))
    rows = columns["said_rows"][first:last].tolist()
    found = [
        row for row in rows
        if words in map(" ".join, spoken(_name(names, columns["said_rows"], row)))
    ]  # fmt: skip
    return found or None


def _name(names: Lying, by: Column, row: int) -> str:
    """A name; `MapError` where there is none of a row that a column has."""
    if row >= len(names):
        raise damaged(by.path, f"column {by.name!r} points to a name that is not there")
    return names[row]


def _said(names: Lying, by: Column, entry: int) -> str:
    """What a name is called; `MapError` where it is not called in the way that a column has."""
    ways = spoken(_name(names, by, entry // 2))
    if entry % 2 >= len(ways):
        raise damaged(by.path, f"column {by.name!r} points to a way in which no name is called")
    return " ".join(ways[entry % 2])


def _longest(columns: Mapping[str, Column], word: str) -> int | None:
    """Words of the longest name that begins with a word."""
    key = _hash(word)
    row = columns["first"].find(key)
    if columns["first"][row : row + 1].tolist() != [key]:
        return None
    return int(columns["first_longest"][row : row + 1][0])


KIND, VERSION = "words", 3
MEND = "Finish the world again: `placegraph_scale.shards.words`."
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
        file, columns = open_pages(path, KIND, VERSION, _ENTRIES | COLUMNS, MEND)
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

    counts, of_names = columns_of(every(), scratch / "names", at_once)
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


Each = Callable[[Callable[[Path], Counted], "list[Path]"], Iterable[Counted]]
SCRATCH = ".finish"
"""Folder for words of shards while they are put in order."""


def finish(
    folder: str | PathLike[str], zoom: int, overlap: float, each: Each | None = None
) -> WorldFile:
    """Read all shards of a folder, and write `words.table` and `world.json`, each in one step.

    Parameters
    ----------
    folder
        Holds ``shards/KEY.city``: maps of squares of the quadtree, and of `overlap` around.
    zoom
        Level of the quadtree: the number of digits of a key.
    overlap
        How far shards reach beyond their squares [m].
    each
        Applies a function to all paths, in order; one after the other where not given. The function
        and what it returns can be sent to other processes.

    Raises
    ------
    InputError
        There is no shard.
    MapError
        A shard is damaged, is no city, or is called by no key of this zoom; a file cannot be written.
    OptionError
        `zoom` or `overlap` is out of its range.

    """
    check_zoom(zoom)
    folder = Path(folder)
    if not 0.0 <= overlap < np.inf:
        raise OptionError(f"overlap is {overlap!r}; give a number of metres from 0 on.")
    paths = sorted((folder / SHARDS).glob("*.city"))
    if not paths:
        raise InputError(
            f"{folder / SHARDS} holds no shard; build the world with `placegraph world build`."
        )
    for path in paths:
        _check_key(path, zoom)
    shards: list[ShardFile] = []

    def found() -> Iterator[Counted]:
        for p, c in zip(paths, (each or map)(count, paths), strict=True):
            held = c.total, c.cells, c.viewpoints
            shards.append(
                ShardFile(p.stem, f"{SHARDS}/{p.name}", digest_of(p), p.stat().st_size, *held)
            )
            yield c

    write(folder / WORDS, found(), folder / SCRATCH)
    made = WorldFile(folder, zoom, float(overlap), digest_of(folder / WORDS), tuple(shards))
    made.write()
    return made


def count(path: Path) -> Counted:
    """What `counted` counts of the shard in a file."""
    from placegraph.outdoor.city import CityMap

    return counted(CityMap.open(path), path.stem)


def _check_key(path: Path, zoom: int) -> None:
    try:
        tile_of(path.stem)
        good = len(path.stem) == zoom
    except ValueError:
        good = False
    if not good:
        raise MapError(
            f"{path}: {path.stem!r} is no key of zoom {zoom}; a shard is called by {zoom} digits "
            "from 0 to 3. Move it away, or build the world again."
        )
