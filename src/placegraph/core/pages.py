"""Columns of a map file that are read where they lie, and no more of them than is asked for.

Opening such a file costs the same however long its columns are. A page is compared with its checksum
when it is first read; so what is damaged is found by who needs it, and by nobody else.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from placegraph.core import columns, files
from placegraph.core.header import damaged, opened, read_head
from placegraph.core.store import MapFile, lies_there, read_block, windows
from placegraph.errors import MapError

PAGE = 4096
"""Bytes that have a checksum of their own."""
STARTS = "starts"
"""Type of columns that `starts_of` makes: of 32 or 64 bits."""
SUMS = "pages"
"""Column of these checksums: of all that are read in pages, in the order of their names."""


def with_sums(
    arrays: Mapping[str, NDArray[Any]], paged: Collection[str]
) -> dict[str, NDArray[Any]]:
    """Arrays of a map file, with the checksums of those that are to be read in pages."""
    plain = {name: columns.plain(name, a) for name, a in arrays.items()}
    sums = [
        crc32(block[at : at + PAGE])
        for name in sorted(paged)
        for block in (plain[name].reshape(-1).view(np.uint8).data,)
        for at in range(0, len(block), PAGE)
    ]
    return {**plain, SUMS: np.array(sums, np.uint32)}


@dataclass(frozen=True, eq=False)
class Column:
    """A column (N,) of a file; what is sliced out of it is checked."""

    path: Path
    name: str
    values: NDArray[Any]
    sums: NDArray[np.uint32]
    """Of its pages."""
    good: bytearray
    """Which of them were compared."""

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, part: slice) -> NDArray[Any]:
        """A stretch of it, read-only; `MapError` where it is damaged."""
        first, last, _ = part.indices(len(self.values))
        size = self.values.itemsize
        for page in range(first * size // PAGE, -(-last * size // PAGE)):
            if not self.good[page]:
                self._check(page)
        return self.values[first:last]

    def _check(self, page: int) -> None:
        block = self.values.view(np.uint8)[page * PAGE : (page + 1) * PAGE]
        if crc32(block.data) != self.sums[page]:
            raise damaged(self.path, f"column {self.name!r} does not fit its checksum")
        self.good[page] = True

    def find(self, value: int) -> int:
        """First row of a sorted column that is no less than a value."""
        each = PAGE // self.values.itemsize
        low, high = 0, -(-len(self) // each)  # the last page that begins below it
        while high - low > 1:
            middle = (low + high) // 2
            if self[middle * each : middle * each + 1][0] < value:
                low = middle
            else:
                high = middle
        page = self[low * each : (low + 1) * each]
        return low * each + int(np.searchsorted(page, page.dtype.type(value)))


@dataclass(frozen=True, eq=False)
class Texts(Sequence[str]):
    """Strings of a file: where each begins, and the bytes of all."""

    starts: Column
    """(N + 1,)"""
    text: Column

    def __len__(self) -> int:
        return max(0, len(self.starts) - 1)

    @overload
    def __getitem__(self, row: int) -> str: ...

    @overload
    def __getitem__(self, row: slice) -> list[str]: ...

    def __getitem__(self, row: int | slice) -> str | list[str]:
        """One string, or some; `MapError` where the file is damaged."""
        if not isinstance(row, slice):
            if not 0 <= row < len(self):
                raise IndexError(row)
            return self[row : row + 1][0]
        first, last, _ = row.indices(len(self))
        if first >= last:
            return []
        ends = stretches(self.starts, first, last, len(self.text))
        blob = self.text[ends[0] : ends[-1]].tobytes()
        cuts = [end - ends[0] for end in ends]
        try:
            return [blob[a:b].decode() for a, b in itertools.pairwise(cuts)]
        except UnicodeDecodeError as error:
            raise damaged(
                self.text.path, f"column {self.text.name!r} is no text: {error.reason}"
            ) from error


def stretches(starts: Column, first: int, last: int, size: int) -> list[int]:
    """Where stretches of a column of this size begin, and the last ends; `MapError` where they cannot."""
    ends: list[int] = starts[first : last + 1].tolist()
    if any(a > b for a, b in itertools.pairwise(ends)) or ends[-1] > size:
        raise damaged(starts.path, f"column {starts.name!r} points beyond what it is of")
    return ends


def packed(texts: Sequence[str]) -> tuple[NDArray[np.unsignedinteger[Any]], NDArray[np.uint8]]:
    """Columns of `Texts`."""
    parts = [text.encode() for text in texts]
    return starts_of([len(part) for part in parts]), np.frombuffer(b"".join(parts), np.uint8)


def starts_of(
    sizes: Sequence[int] | NDArray[np.integer[Any]],
) -> NDArray[np.unsignedinteger[Any]]:
    """Where stretches begin, and the last ends (N + 1,); in 32 bits where these do."""
    ends = np.concatenate(([0], np.cumsum(sizes, dtype=np.int64)))
    return ends.astype(np.uint32 if ends[-1] < 1 << 32 else np.uint64)


def open_pages(
    path: Path, kind: str, version: int, paged: Mapping[str, str], mend: str
) -> tuple[MapFile, dict[str, Column]]:
    """A map file with its other columns, and those of `paged` (names and types) to be read in pages.

    Raises
    ------
    InputError
        The file is missing, empty, a folder, or may not be read.
    MapError
        Its head or another column is damaged; it is of another kind or version.

    """
    with opened(path) as file:
        header, start = read_head(file, path), file.tell()
        if (header.kind, header.version) != (kind, version):
            raise MapError(
                f"{path} is a {header.kind} map of version {header.version}, and not a {kind} map of "
                f"version {version}. {mend}"
            )
        lie = [b for b in header.blocks if b.name in (*paged, SUMS) and lies_there(b, start)]
        watch = files.Watch(file, path)
        arrays = {b.name: read_block(file, start, path, b) for b in header.blocks if b not in lie}
        arrays |= {b.name: a for b, a in windows(file, lie, start).items()} if lie else {}
    made = MapFile(header, arrays, watch)
    sums, found, at = made.array(SUMS, "<u4"), {}, 0
    mapped = {b.name for b in lie}
    for name in sorted(paged):
        values = _column(made, name, paged[name])
        n = -(-values.nbytes // PAGE)
        good = bytearray(n) if name in mapped else bytearray(b"\1" * n)
        found[name] = Column(path, name, values, sums[at : at + n], good)
        at += n
    if at != len(sums):
        raise damaged(path, f"it has {len(sums)} checksums of {at} pages")
    return made, found


def _column(file: MapFile, name: str, dtype: str) -> NDArray[Any]:
    """Column of a type."""
    held = file.arrays.get(name)
    short = dtype == STARTS and held is not None and held.dtype == np.uint32
    return file.array(name, "<u4" if short else "<u8" if dtype == STARTS else dtype)
