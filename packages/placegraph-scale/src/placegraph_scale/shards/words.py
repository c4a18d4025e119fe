"""Table of the words of a world in shards: how it is counted, written, opened and looked up.

The table says in which shards each label and each name occurs, and how often. Its names are read where
they lie: no more than a text asks for.
"""

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
from numpy.typing import NDArray

from placegraph.core.files import FileWatch, write_error
from placegraph.core.geo import are_in_tile, check_zoom, parse_tile_key, tile_bounds
from placegraph.core.mapfile import (
    MapFile,
    check_contents,
    damage_error,
    pack_strings,
    read_map,
    write_map,
)
from placegraph.errors import InputError, MapError, OptionError, PlacegraphError
from placegraph.outdoor.map.index import Core
from placegraph.outdoor.map.names import (
    CROWDED,
    LONGEST,
    NameIndex,
    is_alphabetic,
    list_spoken_forms,
    stems,
)
from placegraph_scale.folder import SHARDS, WORDS, ShardFile, WorldFile, digest_of
from placegraph_scale.shards.columns import (
    OFFSETS,
    PAGE_CHECKSUMS,
    PagedColumn,
    PagedTexts,
    add_page_checksums,
    open_pages,
    read_offsets,
)

if TYPE_CHECKING:
    from placegraph.core.geometry import LocalPlane
    from placegraph.outdoor.map.city import City

Found = TypeVar("Found")

KIND, VERSION = "words", 4
MEND = "Finish the world with `placegraph world build`."
AROUND = 100.0
"""Shards have viewpoints so far around their cores [m], and more to the end of a tile: an object that
nothing else has in sight makes those within 20 m of it viewpoints, which others up to 58 m away prevent."""
SCRATCH = ".finish"
"""Folder for words of shards while they are sorted."""
AT_ONCE = 1 << 20
"""Entries held in memory, some 150 bytes each."""
SOME = 1 << 16
"""Entries read at once."""
ROOM = 1 << 20
"""Bytes of a column that wait until they are written."""
SPARE = 32
"""Bits of the hashes of names that are not stored: names are compared themselves."""
REMEMBERED = 1 << 16
"""Words whose place is cached."""
COUNTS = ("objects", "mass", "shares", "peak")
"""Columns of `WordCounts` with a row a word."""
ENTRIES = {"starts": OFFSETS, "shards": "<i4", "objects": "<i4"} | dict.fromkeys(COUNTS[1:], "<f4")
"""Columns of the shards that hold each word."""
OF_SHARDS = {"viewpoints": "<i8", "sight": "<f8", "spread": "<f8", "pull": "<f8"}
"""Columns with a row a shard."""
OF_NAMES = {
    "name_starts": OFFSETS, "name_text": "|u1", "said": "<u4", "said_rows": "<u4",
    "first": "<u8", "first_longest": "|u1", "stem_starts": OFFSETS, "stem_text": "|u1",
    "posting_starts": OFFSETS, "postings": "<u4",
}  # fmt: skip
"""Columns of names."""


class TextSorter:
    """External sort of texts with numbers: they wait in memory, and then in files that are merged."""

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

    def merge(self) -> Iterator[tuple[str, list[int]]]:
        """Yield all texts, sorted, and the numbers of each in the order in which they were added."""
        each = [self._read(n) for n in range(self._files)]
        both = merge(*each, iter(sorted(self._known.items())), key=itemgetter(0))
        for text, same in groupby(both, key=itemgetter(0)):
            yield text, [number for _, numbers in same for number in numbers]

    def _read(self, number: int) -> Iterator[tuple[str, list[int]]]:
        with (self.folder / f"{number}").open(encoding="utf-8") as file:
            for line in file:
                text, numbers = json.loads(line)
                yield text, numbers


class ColumnFiles:
    """Columns that grow in the files of a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        self._waiting: dict[str, bytearray] = {}

    def add(self, name: str, dtype: str, values: Sequence[Any] | NDArray[Any] | bytes) -> None:
        """Append values, or their bytes, to a column of this type."""
        waiting = self._waiting.setdefault(name, bytearray())
        waiting += values if isinstance(values, bytes) else np.asarray(values, dtype).tobytes()
        if len(waiting) >= ROOM:
            self._write(name)

    def add_text(self, name: str, text: str) -> None:
        """Append a text to the columns ``NAME_text`` and ``NAME_sizes``."""
        data = text.encode()
        self.add(f"{name}_sizes", "<i8", len(data).to_bytes(8, "little"))
        self.add(f"{name}_text", "|u1", data)

    def _write(self, name: str) -> None:
        with (self.folder / name).open("ab") as file:
            file.write(self._waiting.pop(name, b""))

    def open(self, name: str, dtype: str) -> NDArray[Any]:
        """Map a column that is complete."""
        self._write(name)
        path = self.folder / name
        return np.memmap(path, dtype, "r") if path.stat().st_size else np.zeros(0, dtype)

    def take(self, name: str, column: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
        """Write rows of a column as another one, and map that."""
        for at in range(0, len(rows), SOME):
            self.add(name, column.dtype.str, column[rows[at : at + SOME]])
        return self.open(name, column.dtype.str)

    def starts(self, name: str, sizes: NDArray[np.integer[Any]]) -> NDArray[Any]:
        """Write the starts of runs of these sizes, and where the last ends; map them."""
        total, dtype = 0, "<u4" if int(sizes.sum(dtype=np.int64)) < 1 << 32 else "<u8"
        self.add(name, dtype, [0])
        for at in range(0, len(sizes), SOME):
            ends = total + np.cumsum(sizes[at : at + SOME], dtype=np.int64)
            total = int(ends[-1])
            self.add(name, dtype, ends)
        return self.open(name, dtype)


def sort_rows(keys: NDArray[np.uint64], at_once: int = AT_ONCE) -> Iterator[NDArray[np.int64]]:
    """Yield rows in the stable order of evenly spread keys below 2^63, some at a time."""
    cuts = np.linspace(0, 1 << 63, 1 + -(-len(keys) // at_once), dtype=np.float64).astype(np.uint64)
    for low, high in pairwise(cuts):
        there = [
            at + np.flatnonzero((keys[at : at + SOME] >= low) & (keys[at : at + SOME] < high))
            for at in range(0, len(keys), SOME)
        ]
        rows = np.concatenate(there)
        yield rows[np.argsort(keys[rows], kind="stable")]


def write_names(
    names: Iterable[str], scratch: Path, at_once: int = AT_ONCE
) -> tuple[dict[str, int], dict[str, NDArray[Any]]]:
    """Return counts and columns of sorted names; the columns lie in files of `scratch`, which is made."""
    scratch.mkdir()
    made, words = ColumnFiles(scratch / "columns"), TextSorter(scratch / "words", at_once)
    n_rows = 0
    for row, name in enumerate(names):
        n_rows += 1
        made.add_text("name", name)
        for way, said in enumerate(list_spoken_forms(name)):
            key = " ".join(said)
            made.add("key", "<u8", _hash(key).to_bytes(8, "little"))
            made.add("entry", "<u4", (2 * row + way).to_bytes(4, "little"))
            made.add("begin", "<u8", _hash(said[0]).to_bytes(8, "little"))
            made.add("many", "|u1", bytes([min(len(said), LONGEST)]))
            for stem in stems(key):
                words.add(f"{int(not is_alphabetic(stem))}{stem}", [2 * row + way])
    # one way of speaking that several names share stands once among their words: of the first
    fresh = np.memmap(scratch / "fresh", np.bool_, "w+", shape=(2 * n_rows + 1,))
    keys, entry, ways = made.open("key", "<u8"), made.open("entry", "<u4"), 0
    for rows in sort_rows(keys, at_once):
        first = np.flatnonzero(_is_new(keys[rows]))
        fresh[entry[rows[first]]] = True
        made.add("said", "<u4", keys[rows] >> np.uint64(SPARE))
        made.add("said_rows", "<u4", entry[rows] >> 1)
        ways += len(first)
    begin, many = made.open("begin", "<u8"), made.open("many", "|u1")
    for rows in sort_rows(begin, at_once):
        if len(first := np.flatnonzero(_is_new(begin[rows]))):
            made.add("first", "<u8", begin[rows[first]])
            made.add("first_longest", "|u1", np.maximum.reduceat(many[rows], first))
    alphabetic = 0
    for word, entries in words.merge():
        kept = np.array(entries, np.uint32)[fresh[entries]]
        alphabetic += word[0] == "0"
        made.add_text("stem", word[1:])
        made.add("posting_sizes", "<i8", len(kept).to_bytes(8, "little"))
        made.add("postings", "<u4", kept)
    return {"spoken": ways, "alphabetic": alphabetic}, {
        name: made.open(name, dtype) if dtype != OFFSETS
        else made.starts(name, made.open(name.replace("starts", "sizes"), "<i8"))
        for name, dtype in OF_NAMES.items()
    }  # fmt: skip


def _is_new(keys: NDArray[np.uint64]) -> NDArray[np.bool_]:
    """Return which of sorted keys differ from the one before."""
    return np.append(np.ones(min(1, len(keys)), np.bool_), keys[1:] != keys[:-1])


def _hash(words: str) -> int:
    return int.from_bytes(blake2b(words.encode(), digest_size=8).digest(), "little") >> 1


@dataclass(frozen=True, eq=False)
class _Lookup(Mapping[str, Found]):
    """Mapping whose keys are only looked up."""

    find: Callable[[str], Found | None]
    size: int

    def __getitem__(self, key: str) -> Found:
        found = self.find(key)
        if found is None:
            raise KeyError(key)
        return found

    def __len__(self) -> int:
        return self.size

    def __iter__(self) -> Iterator[str]:
        raise TypeError("the names of a world can only be looked up one by one")


@dataclass(frozen=True, eq=False)
class _FirstTexts(Sequence[str]):
    """The first of many texts."""

    every: PagedTexts
    size: int

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, row: Any) -> Any:  # noqa: ANN401  # as of `PagedTexts`
        return self.every[slice(*row.indices(self.size)) if isinstance(row, slice) else row]


@dataclass(frozen=True, eq=False, kw_only=True)
class WorldNames(NameIndex):
    """Names of a world; finds what a `NameIndex` of all of them in memory would.

    But a misspelt name is only compared with those that share a word with it, or one much like it.
    """

    names: PagedTexts
    words: PagedTexts
    """Stems of the words of names: those that may be misspelt come first, both sorted."""
    alphabetic: int
    """Number of stems that may be misspelt."""
    columns: Mapping[str, PagedColumn]

    @classmethod
    def of_file(cls, file: MapFile, columns: Mapping[str, PagedColumn]) -> WorldNames:
        """Open names as `write_names` made them; raises `ValueError` where columns do not fit."""
        size = {name: len(column) for name, column in columns.items()}
        names = PagedTexts(columns["name_starts"], columns["name_text"])
        words = PagedTexts(columns["stem_starts"], columns["stem_text"])
        ways, alphabetic = int(file.meta["spoken"]), int(file.meta["alphabetic"])
        if not 0 <= alphabetic <= len(words) == max(0, size["posting_starts"] - 1):
            raise ValueError("words and their places have different lengths")
        if size["said"] != size["said_rows"] or size["first"] != size["first_longest"]:
            raise ValueError("columns of names have different lengths")
        if not 0 <= ways <= size["said"]:
            raise ValueError(f"names have {ways} spellings")
        called = _Lookup(partial(_find_called, names, columns), ways)
        first = _Lookup(partial(_find_longest, columns), size["first"])
        return cls(called, first, names=names, words=words, alphabetic=alphabetic, columns=columns)

    def _list_similar(self, words: str) -> Sequence[str]:
        said = dict.fromkeys(map(self._written, stems(words)))
        known = sorted((self._counts[word], word) for word in said if word in self._counts)
        return self._postings[known[0][1]] if known and known[0][0] <= CROWDED else ()

    @cached_property
    def _alphabetic(self) -> Sequence[str]:
        return _FirstTexts(self.words, self.alphabetic)

    @cached_property
    def _counts(self) -> Mapping[str, int]:
        def count(word: str) -> int | None:
            found = self._entries(word)
            return None if found is None else found[1] - found[0]

        return _Lookup(count, len(self.words))

    @cached_property
    def _postings(self) -> Mapping[str, Sequence[str]]:
        """Names by each of their words, in order."""

        def find(word: str) -> Sequence[str] | None:
            found, by = self._entries(word), self.columns["postings"]
            if found is None:
                return None
            called = []
            for entry in by[slice(*found)].tolist():
                ways = list_spoken_forms(_find_name(self.names, by, entry // 2))
                if entry % 2 >= len(ways):
                    where = f"column {by.name!r} points to a missing spelling of a name"
                    raise damage_error(by.path, where)
                called.append(" ".join(ways[entry % 2]))
            return called

        return _Lookup(find, len(self.words))

    @cached_property
    def _entries(self) -> Callable[[str], list[int] | None]:
        """First and last entry of a word; cached."""

        def find(word: str) -> list[int] | None:
            n, c = self.alphabetic, self.columns
            part = (0, n) if is_alphabetic(word) else (n, len(self.words))
            row = bisect_left(self.words, word, *part)
            if row == part[1] or self.words[row] != word:
                return None
            return read_offsets(c["posting_starts"], row, row + 1, len(c["postings"]))

        return lru_cache(REMEMBERED)(find)


def _find_called(
    names: PagedTexts, columns: Mapping[str, PagedColumn], words: str
) -> list[int] | None:
    """Return the rows of names that are called so."""
    # names of equal bits are told apart by what is written
    key, by = _hash(words) >> SPARE, columns["said_rows"]
    first, last = (columns["said"].find(k) for k in (key, key + 1))
    found = [
        row for row in by[first:last].tolist()
        if words in map(" ".join, list_spoken_forms(_find_name(names, by, row)))
    ]  # fmt: skip
    return found or None


def _find_name(names: PagedTexts, by: PagedColumn, row: int) -> str:
    """Return a name; raises `MapError` where a column points to none."""
    if row >= len(names):
        raise damage_error(by.path, f"column {by.name!r} points to a missing name")
    return names[row]


def _find_longest(columns: Mapping[str, PagedColumn], word: str) -> int | None:
    """Return the number of words of the longest name that begins with a word."""
    key = _hash(word)
    row = columns["first"].find(key)
    if columns["first"][row : row + 1].tolist() != [key]:
        return None
    return int(columns["first_longest"][row : row + 1][0])


class WordCounts(NamedTuple):
    """Counts of the words of one shard, in its core; a row a word (labels, then names)."""

    labels: tuple[str, ...]
    names: tuple[str, ...]
    objects: NDArray[np.int32]
    """(T,) objects of a word whose centre lies in the core."""
    mass: NDArray[np.float32]
    """(T,) sum over viewpoints of how much of a word is in sight ..."""
    shares: NDArray[np.float32]
    """(T,) ... and of its share of all that is in sight."""
    peak: NDArray[np.float32]
    """(T,) largest such share."""
    sight: float
    """Sum over viewpoints of all that is in sight."""
    spread: float
    """Largest sum of the shares of all labels: objects have more than one."""
    pull: float
    """Largest square of all in sight against its pairs in sight."""
    total: int
    """Objects whose centre lies in the core."""
    cells: int
    viewpoints: int

    def save(self, path: Path, digest: str) -> None:
        """Write the counts of the shard with this digest; raises `MapError` where that fails."""
        meta = {name: value for name, value in self._asdict().items() if np.ndim(value) == 0}
        arrays = {"labels": pack_strings(self.labels), "names": pack_strings(self.names)}
        arrays |= {name: getattr(self, name) for name in COUNTS}
        write_map(path, "counts", VERSION, meta | {"digest": digest}, arrays)

    @classmethod
    def load(cls, path: Path, digest: str) -> Self | None:
        """Read the counts of the shard with this digest; None where they are missing or damaged."""
        try:
            file = read_map(path, "counts", VERSION)
            found: dict[str, Any] = {
                n: tuple(map(intern, file.strings(n))) for n in ("labels", "names")
            }
            found |= {name: file.arrays[name] for name in COUNTS} | file.meta
        except (PlacegraphError, LookupError):  # or by a version that counted something else
            return None
        return cls(**found) if found.pop("digest") == digest else None


def core_of(key: str, plane: LocalPlane) -> Core:
    """Return the core of a shard, by its key and the plane of its city."""
    box = tile_bounds(key).expand(AROUND)
    low, high = plane.to_plane(np.array([box[:2], box[2:]]))
    return Core(low, high, lambda places: are_in_tile(plane.to_lonlat(places), key))


def count_words(city: City, key: str) -> WordCounts:
    """Count the words of a shard in its core; `City.views` are those about the core afterwards."""
    objects, plane = city.objects, city.plane
    seen = city.look_around(core_of(key, plane))
    own = are_in_tile(plane.to_lonlat(objects.center.astype(np.float64)), key)
    starts, values, _ = city.tokens
    owner = np.repeat(np.arange(len(objects)), np.diff(starts))
    middles = plane.to_lonlat(city.cells.centers(np.arange(len(city.cells))))
    return WordCounts(
        objects.labels, objects.names,
        np.bincount(values[own[owner]], minlength=len(seen.mass)).astype(np.int32),
        seen.mass.astype(np.float32), seen.shares.astype(np.float32), seen.peak,
        seen.visibility, seen.spread, seen.pull,
        int(own.sum()), int(are_in_tile(middles, key).sum()), seen.viewpoints,
    )  # fmt: skip


def count_file(path: Path) -> WordCounts:
    """Count the words of the shard in a file."""
    from placegraph.outdoor.city import CityMap

    return count_words(CityMap.open(path), path.stem)


class Entries(NamedTuple):
    """Shards that hold a word; columns as of `WordCounts`."""

    shards: NDArray[np.int32]
    """(E,) row of each, ascending."""
    objects: NDArray[np.int32]
    mass: NDArray[np.float32]
    shares: NDArray[np.float32]
    peak: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class WordTable:
    """Words of all shards, and the shards that hold each; `write_table` makes it.

    Words are labels, then names, as the tokens of a city; rows of shards are in order of their keys.
    Labels and the columns of shards are in memory. All else is read when it is asked for, and
    checked then: `MapError` where it is damaged.
    """

    labels: tuple[str, ...]
    """Sorted."""
    names: WorldNames
    """Sorted."""
    columns: Mapping[str, PagedColumn]
    viewpoints: NDArray[np.int64]
    """(N,) of each shard, and so are ..."""
    sight: NDArray[np.float64]
    spread: NDArray[np.float64]
    pull: NDArray[np.float64]
    watch: FileWatch

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a table; `InputError` or `MapError` where it is missing, damaged or of another version."""
        file, columns = open_pages(path, KIND, VERSION, ENTRIES | OF_NAMES, MEND)
        with check_contents(path, MEND):
            of_shards = {name: file.array(name, dtype) for name, dtype in OF_SHARDS.items()}
            names = WorldNames.of_file(file, columns)
            labels = file.strings("labels", max_count=len(columns["starts"]))
            assert file.watch is not None  # noqa: S101  # `open_pages` gives one
            size = {name: len(column) for name, column in columns.items()}
            if size["starts"] != len(labels) + len(names.names) + 1:
                raise ValueError("words and their counts have different lengths")
            if len({size[name] for name in Entries._fields}) > 1:
                raise ValueError("entries of words have different lengths")
            if len(set(map(len, of_shards.values()))) > 1:
                raise ValueError("columns of shards have different lengths")
            if not all((np.isfinite(c) & (c >= 0)).all() for c in of_shards.values()):
                raise ValueError("bounds of shards contain invalid values")
            return cls(labels, names, columns, **of_shards, watch=file.watch)

    def text(self, word: int) -> str:
        """Return the text of a word: a label, or a name behind a tilde."""
        n = len(self.labels)
        return self.labels[word] if word < n else f"~{self.names.names[word - n]}"

    def entries(self, word: int) -> Entries:
        """Read the shards that hold a word."""
        starts = self.columns["starts"]
        part = slice(*read_offsets(starts, word, word + 1, len(self.columns["shards"])))
        found = Entries(*(self.columns[name][part] for name in Entries._fields))
        wrong = len(found.shards) and not 0 <= found.shards.min() <= found.shards.max() < len(self)
        if wrong or not all((np.isfinite(x) & (x >= 0)).all() for x in found[1:]):
            raise damage_error(
                starts.path, f"entries of {self.text(word)!r} are not among its shards"
            )
        return found

    def __len__(self) -> int:
        return len(self.viewpoints)

    def counts(self, words: Sequence[int]) -> NDArray[np.int64]:
        """Return the number of objects (K,) that bear each of these words."""
        every = [self.entries(word).objects.sum(dtype=np.int64) for word in words]
        return np.array(every, np.int64)

    def shares(self, words: Sequence[int]) -> NDArray[np.float64]:
        """Return the share (K,) of each word of all in sight, over all viewpoints of the world."""
        mass = np.array(
            [self.entries(word).mass.sum(dtype=np.float64) for word in words], np.float64
        )
        return mass / max(float(self.sight.sum()), 1e-30)


def write_table(
    path: Path, shards: Iterable[WordCounts], scratch: Path, at_once: int = AT_ONCE
) -> None:
    """Write the table of shards in this order, in one step; raises `MapError` where that fails.

    Memory holds one shard, all labels, and `at_once` words; the others lie in the folder `scratch`
    meanwhile, which is made, and removed.
    """
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        scratch.mkdir()
        _write_table(path, shards, scratch, at_once)
    except OSError as error:
        raise write_error(scratch, error) from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _write_table(path: Path, shards: Iterable[WordCounts], scratch: Path, at_once: int) -> None:
    made, words = ColumnFiles(scratch / "entries"), TextSorter(scratch / "words", at_once)
    of_shards: dict[str, list[float]] = {name: [] for name in OF_SHARDS}
    entries = 0
    for i, c in enumerate(shards):
        here = (c.objects > 0) | (c.mass > 0.0)
        numbers = (entries + np.cumsum(here) - 1).tolist()
        texts = chain((f"0{label}" for label in c.labels), (f"1{name}" for name in c.names))
        for text, number, there in zip(texts, numbers, here.tolist(), strict=True):
            words.add(text, (number,) if there else ())
        many = int(here.sum())
        made.add("shards", "<i4", np.full(many, i))
        for name in COUNTS:
            made.add(name, ENTRIES[name], getattr(c, name)[here])
        for name, column in of_shards.items():
            column.append(getattr(c, name))
        entries += many
    labels: list[str] = []

    def names() -> Iterator[str]:
        for text, numbers in words.merge():
            made.add("sizes", "<i8", len(numbers).to_bytes(8, "little"))
            made.add("order", "<i8", numbers)
            if text[0] == "0":
                labels.append(text[1:])
            else:
                yield text[1:]

    meta, of_names = write_names(names(), scratch / "names", at_once)
    order = made.open("order", "<i8")
    paged = {
        name: made.take(f"{name}_by_word", made.open(name, ENTRIES[name]), order)
        for name in Entries._fields
    }
    paged |= of_names | {"starts": made.starts("starts", made.open("sizes", "<i8"))}
    known = {name: np.array(of_shards[name], dtype) for name, dtype in OF_SHARDS.items()}
    arrays = add_page_checksums({"labels": pack_strings(labels), **known, **paged}, paged)
    write_map(path, KIND, VERSION, meta, arrays, mapped=(*paged, PAGE_CHECKSUMS))


Each = Callable[[Callable[[Path], WordCounts], "list[Path]"], Iterable[WordCounts]]


def finish(
    folder: str | PathLike[str], zoom: int, overlap: float, each: Each | None = None
) -> WorldFile:
    """Read all shards of a folder, and write `words.table` and `world.json`, each in one step.

    Raises `InputError`: there is no shard; `MapError`: a shard is damaged, is no city, or is called
    by no key of this zoom; a file cannot be written; `OptionError`: `zoom` or `overlap` is out of
    its range.

    `folder`: holds ``shards/KEY.city``: maps of squares of the quadtree, and of `overlap` around.
    `zoom`: level of the quadtree: the number of digits of a key.
    `overlap`: how far shards reach beyond their squares [m].
    `each`: applies a function to all paths, in order; one after the other where not given. The
        function and what it returns can be sent to other processes.
    """
    check_zoom(zoom)
    folder = Path(folder)
    if not 0.0 <= overlap < np.inf:
        raise OptionError(f"overlap is {overlap!r}; give metres, at least 0.")
    paths = sorted((folder / SHARDS).glob("*.city"))
    if not paths:
        raise InputError(
            f"{folder / SHARDS} contains no shard; build the world with `placegraph world build`."
        )
    for path in paths:
        try:
            parse_tile_key(path.stem)
            is_key = len(path.stem) == zoom
        except ValueError:
            is_key = False
        if not is_key:
            raise MapError(
                f"{path}: {path.stem!r} is not a key of zoom {zoom}; the names of shards have "
                f"{zoom} digits from 0 to 3. Move this file away, or build the world again."
            )
    shards: list[ShardFile] = []

    def counts() -> Iterator[WordCounts]:
        for p, c in zip(paths, (each or map)(count_file, paths), strict=True):
            size, file = p.stat().st_size, f"{SHARDS}/{p.name}"
            own = c.total, c.cells, c.viewpoints
            shards.append(ShardFile(p.stem, file, digest_of(p), size, *own))
            yield c

    write_table(folder / WORDS, counts(), folder / SCRATCH)
    made = WorldFile(folder, zoom, float(overlap), digest_of(folder / WORDS), tuple(shards))
    made.write()
    return made
