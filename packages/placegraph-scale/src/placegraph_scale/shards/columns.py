"""Columns of a map file that are read in pages, each of which has a checksum of its own."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, overload
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import FileWatch
from placegraph.core.mapfile import (
    MapFile,
    damage_error,
    is_mappable,
    map_blocks,
    open_file,
    read_block,
    read_head,
    to_plain_array,
)
from placegraph.errors import MapError

PAGE = 4096
"""Bytes of a page."""
OFFSETS = "offsets"
"""Type of columns of offsets: unsigned integers of 32 or 64 bits."""
PAGE_CHECKSUMS = "pages"
"""Column of the checksums of all pages, in the order of their columns' names."""


def add_page_checksums(
    arrays: Mapping[str, NDArray[Any]], paged: Collection[str]
) -> dict[str, NDArray[Any]]:
    """Return the arrays of a map file with the checksums of those that are to be read in pages."""
    columns = {name: to_plain_array(name, a) for name, a in arrays.items()}
    checksums = [
        crc32(block[at : at + PAGE])
        for name in sorted(paged)
        for block in (columns[name].reshape(-1).view(np.uint8).data,)
        for at in range(0, len(block), PAGE)
    ]
    return {**columns, PAGE_CHECKSUMS: np.array(checksums, np.uint32)}


@dataclass(frozen=True, eq=False)
class PagedColumn:
    """A column (N,) of a file; pages are checked when a slice first needs them."""

    path: Path
    name: str
    values: NDArray[Any]
    checksums: NDArray[np.uint32]
    """One of each page."""
    is_checked: bytearray
    """Whether each page was compared with its checksum."""

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, part: slice) -> NDArray[Any]:
        """Return a slice, read-only; `MapError` where it is damaged."""
        first, last, _ = part.indices(len(self.values))
        size = self.values.itemsize
        for page in range(first * size // PAGE, -(-last * size // PAGE)):
            if not self.is_checked[page]:
                block = self.values.view(np.uint8)[page * PAGE : (page + 1) * PAGE]
                if crc32(block.data) != self.checksums[page]:
                    raise damage_error(
                        self.path, f"column {self.name!r} does not match its checksum"
                    )
                self.is_checked[page] = True
        return self.values[first:last]

    def find(self, value: int) -> int:
        """Return the first row of a sorted column that is no less than a value."""
        each = PAGE // self.values.itemsize
        low, high = 0, -(-len(self) // each)  # the last page that begins below the value
        while high - low > 1:
            middle = (low + high) // 2
            if self[middle * each : middle * each + 1][0] < value:
                low = middle
            else:
                high = middle
        page = self[low * each : (low + 1) * each]
        return low * each + int(np.searchsorted(page, page.dtype.type(value)))


@dataclass(frozen=True, eq=False)
class PagedTexts(Sequence[str]):
    """Strings of a file: the offset of each, and the bytes of all."""

    starts: PagedColumn
    """(N + 1,)"""
    text: PagedColumn

    def __len__(self) -> int:
        return max(0, len(self.starts) - 1)

    @overload
    def __getitem__(self, row: int) -> str: ...

    @overload
    def __getitem__(self, row: slice) -> list[str]: ...

    def __getitem__(self, row: int | slice) -> str | list[str]:
        """Return one string or a slice; `MapError` where the file is damaged."""
        if not isinstance(row, slice):
            if not 0 <= row < len(self):
                raise IndexError(row)
            return self[row : row + 1][0]
        first, last, _ = row.indices(len(self))
        if first >= last:
            return []
        ends = read_offsets(self.starts, first, last, len(self.text))
        blob = self.text[ends[0] : ends[-1]].tobytes()
        cuts = [end - ends[0] for end in ends]
        try:
            return [blob[a:b].decode() for a, b in pairwise(cuts)]
        except UnicodeDecodeError as error:
            raise damage_error(
                self.text.path, f"column {self.text.name!r} is not text: {error.reason}"
            ) from error


def read_offsets(starts: PagedColumn, first: int, last: int, size: int) -> list[int]:
    """Return the offsets `first` to `last` into a column of `size` rows.

    Raises `MapError` where they decrease or point beyond the column.
    """
    ends: list[int] = starts[first : last + 1].tolist()
    if any(a > b for a, b in pairwise(ends)) or ends[-1] > size:
        raise damage_error(starts.path, f"column {starts.name!r} points beyond its target")
    return ends


def open_pages(
    path: Path, kind: str, version: int, paged: Mapping[str, str], remedy: str
) -> tuple[MapFile, dict[str, PagedColumn]]:
    """Open a map file; its columns `paged` (names and types) are read in pages, all others now.

    Raises `InputError`: the file is missing, empty, a folder, or may not be read; `MapError`: its
    head or another column is damaged; it is of another kind or version.
    """
    with open_file(path) as file:
        header, start = read_head(file, path), file.tell()
        if (header.kind, header.version) != (kind, version):
            raise MapError(
                f"{path} is a {header.kind} map of version {header.version}, not a {kind} map of "
                f"version {version}. {remedy}"
            )
        mapped = [
            b for b in header.blocks if b.name in (*paged, PAGE_CHECKSUMS) and is_mappable(b, start)
        ]
        watch = FileWatch(file, path)
        arrays = {
            b.name: read_block(file, start, path, b) for b in header.blocks if b not in mapped
        }
        arrays |= {b.name: a for b, a in map_blocks(file, mapped, start).items()} if mapped else {}
    opened = MapFile(header, arrays, watch)
    checksums, columns, at = opened.array(PAGE_CHECKSUMS, "<u4"), {}, 0
    unchecked = {b.name for b in mapped}
    for name in sorted(paged):
        dtype = paged[name]
        if dtype == OFFSETS:
            is_short = name in arrays and arrays[name].dtype == np.uint32
            dtype = "<u4" if is_short else "<u8"
        values = opened.array(name, dtype)
        n = -(-values.nbytes // PAGE)
        flags = bytearray(n) if name in unchecked else bytearray(b"\1" * n)
        columns[name] = PagedColumn(path, name, values, checksums[at : at + n], flags)
        at += n
    if at != len(checksums):
        raise damage_error(path, f"it has {len(checksums)} checksums of {at} pages")
    return opened, columns
