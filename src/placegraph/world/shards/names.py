"""Names of a world, looked up where they lie in its table: no more is read than a text asks for."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from hashlib import blake2b
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from placegraph.header import damaged
from placegraph.outdoor.map.names import CROWDED, LONGEST, NameIndex, is_alphabetic, spoken, stems
from placegraph.pages import STARTS, Column, Texts, packed, starts_of, stretches

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.store import MapFile

Found = TypeVar("Found")
COLUMNS = {
    "name_starts": STARTS, "name_text": "|u1", "said": "<u8", "said_rows": "<u4",
    "first": "<u8", "first_longest": "|u1", "stem_starts": STARTS, "stem_text": "|u1",
    "posting_starts": STARTS, "postings": "<u4",
}  # fmt: skip
"""Columns of names, and what they are."""

REMEMBERED = 1 << 16
"""Words whose place is kept in mind."""


def columns_of(names: Sequence[str]) -> tuple[dict[str, int], dict[str, NDArray[Any]]]:
    """Counts and columns of names, which are sorted."""
    said: list[tuple[int, int]] = []
    known: set[str] = set()
    first: dict[int, int] = {}
    postings: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        for way, words in enumerate(spoken(name)):
            key, begin = " ".join(words), _hash(words[0])
            said.append((_hash(key), row))
            first[begin] = max(first.get(begin, 0), min(len(words), LONGEST))
            for stem in stems(key) if key not in known else ():
                postings.setdefault(stem, []).append(2 * row + way)
            known.add(key)
    said.sort()
    words = sorted(postings, key=lambda word: (not is_alphabetic(word), word))
    name_starts, name_text = packed(names)
    stem_starts, stem_text = packed(words)
    counts = {"spoken": len(known), "alphabetic": sum(map(is_alphabetic, words))}
    return counts, {
        "name_starts": name_starts, "name_text": name_text,
        "said": np.array([key for key, _ in said], np.uint64),
        "said_rows": np.array([row for _, row in said], np.uint32),
        "first": np.array(sorted(first), np.uint64),
        "first_longest": np.array([first[key] for key in sorted(first)], np.uint8),
        "stem_starts": stem_starts, "stem_text": stem_text,
        "posting_starts": starts_of([len(postings[word]) for word in words]),
        "postings": np.array([entry for word in words for entry in postings[word]], np.uint32),
    }  # fmt: skip


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

    every: Texts
    size: int

    def __len__(self) -> int:
        return self.size

    def __getitem__(self, row: Any) -> Any:  # noqa: ANN401  # as of `Texts`
        return self.every[slice(*row.indices(self.size)) if isinstance(row, slice) else row]


@dataclass(frozen=True, eq=False, kw_only=True)
class WorldNames(NameIndex):
    """Names of a world; finds what a `NameIndex` of all of them in memory would.

    But a misspelt name is only compared with those that have one of its words, or one much like it.
    """

    names: Texts
    words: Texts
    """Stems of the words of names: those that may be misspelt come first, both sorted."""
    alphabetic: int
    """How many these are."""
    columns: Mapping[str, Column]

    @classmethod
    def of(cls, file: MapFile, columns: Mapping[str, Column]) -> WorldNames:
        """Names of a file, as `columns_of` made them; raises `ValueError` where these are none."""
        size = {name: len(column) for name, column in columns.items()}
        names = Texts(columns["name_starts"], columns["name_text"])
        words = Texts(columns["stem_starts"], columns["stem_text"])
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


def _called(names: Texts, columns: Mapping[str, Column], words: str) -> list[int] | None:
    """Rows of names that are called so."""
    key = _hash(words)
    first, last = (columns["said"].find(k) for k in (key, key + 1))
    rows = columns["said_rows"][first:last].tolist()
    found = [
        row for row in rows
        if words in map(" ".join, spoken(_name(names, columns["said_rows"], row)))
    ]  # fmt: skip
    return found or None


def _name(names: Texts, by: Column, row: int) -> str:
    """A name; `MapError` where there is none of a row that a column has."""
    if row >= len(names):
        raise damaged(by.path, f"column {by.name!r} points to a name that is not there")
    return names[row]


def _said(names: Texts, by: Column, entry: int) -> str:
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
