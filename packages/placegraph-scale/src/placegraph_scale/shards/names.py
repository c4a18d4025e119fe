"""Names of a world, looked up where they lie in its table: no more is read than a text asks for."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from placegraph.core.mapfile import STARTS, Column, damaged, stretches
from placegraph.core.mapfile import Texts as Lying
from placegraph.outdoor.map.names import CROWDED, LONGEST, NameIndex, is_alphabetic, spoken, stems
from placegraph_scale.shards.merge import AT_ONCE, Columns, Texts, by_key

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from placegraph.core.mapfile import MapFile

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
