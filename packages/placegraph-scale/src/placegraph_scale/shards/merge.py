"""More than memory holds, put in order on disk: texts with numbers, and columns by their keys."""

from __future__ import annotations

import json
from heapq import merge
from itertools import groupby, pairwise
from operator import itemgetter
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

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
