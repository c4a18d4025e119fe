"""Readers of SQLite, ZIP, compressed chunks and RVL depth images, within limits of memory."""

from __future__ import annotations

import bz2
import io
import sqlite3
import struct
import sys
import weakref
import zipfile
import zlib
from functools import partial
from pathlib import Path, PurePosixPath
from struct import unpack
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.errors import InputError

LARGEST_VALUE = 1 << 28  # bytes of a database value or a file of a ZIP; images have some millions


class Database:
    """Read-only SQLite database, pickled by its path; `InputError` where it cannot be opened."""

    def __init__(self, path: Path) -> None:
        self.path = check_regular(path)
        self._lock = Lock()
        wal = path.with_name(path.name + "-wal")
        alone = not (wal.exists() and wal.stat().st_size)
        where = f"{path.resolve().as_uri()}?{'immutable=1' if alone else 'mode=ro'}"
        try:
            self._base = sqlite3.connect(where, uri=True, check_same_thread=False)
            self._base.text_factory = partial(str, encoding="utf-8", errors="replace")
            self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_VALUE)
            self._base.execute("PRAGMA trusted_schema = OFF")
        except sqlite3.Error as error:
            raise InputError(f"{path} cannot be opened as a database ({error}).") from error
        weakref.finalize(self, self._base.close)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path,)

    def select(self, columns: str, table: str, then: str = "") -> Any:  # noqa: ANN401  # rows
        """Select rows of a table, never of a view. Raises `sqlite3.Error` or `ValueError`."""
        query = "SELECT type || substr(sql, 1, 13) FROM sqlite_master WHERE name = ? COLLATE NOCASE"
        row = self._base.execute(query, (table,)).fetchone()
        if row is None or str(row[0]).upper() != "TABLECREATE TABLE ":
            raise ValueError(f"it has no table {table}")
        return self._base.execute(f"SELECT {columns} FROM {table} {then}")  # noqa: S608  # our words

    def columns(self, table: str) -> set[str]:
        """Return the names of a table's columns, in lower case. Raises `sqlite3.Error`."""
        return {str(row[1]).lower() for row in self._base.execute(f"PRAGMA table_info({table})")}

    def blob(self, place: tuple[str, str, int], name: str, most: int | None = None) -> bytes:
        """Read a value (table, column, row), all or its first bytes; `InputError` begins with `name`."""
        try:
            with self._lock, self._base.blobopen(*place, readonly=True) as value:
                if len(value) >= LARGEST_VALUE:
                    raise InputError(
                        f"{name} has {len(value):,} bytes, which is too large; record or export it "
                        "again."
                    )
                return value.read(len(value) if most is None else most)
        except (sqlite3.Error, OverflowError) as error:
            raise InputError(
                f"{name} cannot be read ({error}); rescue the rest with `sqlite3 {self.path.name} "
                ".recover`."
            ) from error


class Archive:
    """Files of a ZIP by name; `InputError` where the ZIP or a file is missing, damaged or too large."""

    def __init__(self, path: Path, *, flat: bool = False) -> None:
        """Read the directory; `flat`: drop folders from names."""
        self.path = path
        try:
            with zipfile.ZipFile(check_regular(path)) as archive:
                entries = [entry for entry in archive.infolist() if not entry.is_dir()]
        except (zipfile.BadZipFile, OSError, ValueError, LookupError, RuntimeError) as error:
            raise InputError(f"{path} cannot be read as a ZIP ({error}); copy it again.") from error
        self._entries = {PurePosixPath(e.filename).name if flat else e.filename: e for e in entries}
        self.names = frozenset(self._entries)

    def where(self, name: str) -> str:
        """Return the name of a file in messages."""
        return f"{self.path}, {name}" if name else str(self.path)

    def read(self, name: str) -> bytes:
        """Return the content of a file."""
        entry = self._entries.get(name)
        if entry is None:
            raise InputError(f"{self.path} contains no {name}; export or download it again.")
        if entry.file_size > LARGEST_VALUE:
            raise InputError(
                f"{self.where(name)} has {entry.file_size} bytes, which is too large; record or "
                "export it again."
            )
        try:
            with self.path.open("rb") as file:
                file.seek(entry.header_offset)
                head = struct.unpack("<4s22xHH", file.read(30))
                file.seek(head[1] + head[2], io.SEEK_CUR)
                packed = file.read(min(entry.compress_size, LARGEST_VALUE))
            data = packed
            if entry.compress_type == zipfile.ZIP_DEFLATED:
                data = zlib.decompressobj(-zlib.MAX_WBITS).decompress(packed, LARGEST_VALUE)
            good = zlib.crc32(data) == entry.CRC and not entry.flag_bits & 1
        except (OSError, struct.error, zlib.error, ValueError, OverflowError) as error:
            raise InputError(f"{self.where(name)} is damaged ({error}); copy it again.") from error
        if not good:
            raise InputError(f"{self.where(name)} is damaged or encrypted; copy it again.")
        return data


_MOST_PIXELS = 1 << 24  # of a depth image
_MOST_NIBBLES = 10  # of three bits, in a number of 30 bits


def rvl_size(data: bytes) -> tuple[int, int]:
    """Return the width and height [px] of an RVL image."""
    width, height = unpack("<II", data[:8].ljust(8, b"\0"))
    return width, height


def rvl_image(data: bytes, name: str) -> NDArray[np.uint16]:
    """Decode an RVL image (h, w) uint16: width and height (uint32, little-endian), then pixels.

    Raises `InputError`, beginning with `name`, where the stream is damaged.
    """
    width, height = rvl_size(data)
    if not 0 < width * height <= _MOST_PIXELS:
        raise InputError(f"{name} declares {width} x {height} pixels; record that image again.")
    if len(data) - 8 > 3 * width * height + 16:  # the largest encoding
        raise InputError(
            f"{name}: {len(data):,} bytes are too many for {width} x {height} pixels; record that "
            "image again."
        )
    pixels = _pixels(_numbers(data[8:]), width * height)
    if pixels is None:
        raise InputError(f"{name} ends before its {width} x {height} pixels; copy the file again.")
    return pixels.reshape(height, width)


def _numbers(data: bytes) -> NDArray[np.int64]:
    """Decode integers of nibbles: three bits each, low ones first; bit 8: more follow."""
    words = np.frombuffer(data[: len(data) // 4 * 4], "<u4")
    nibbles = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 15).astype(np.uint8)
    nibbles = nibbles.ravel()
    ends = np.flatnonzero(nibbles < 8)
    lengths = np.diff(ends, prepend=-1)
    too_long = np.flatnonzero(lengths > _MOST_NIBBLES)
    if too_long.size:  # damaged from here on
        ends, lengths = ends[: too_long[0]], lengths[: too_long[0]]
    if not ends.size:
        return np.zeros(0, np.int64)
    starts = ends - lengths + 1
    place = np.arange(ends[-1] + 1) - np.repeat(starts, lengths)
    values: NDArray[np.int64] = np.add.reduceat(
        (nibbles[: ends[-1] + 1] & 7).astype(np.int64) << (3 * place), starts
    )
    return values


def _pixels(numbers: NDArray[np.int64], count: int) -> NDArray[np.uint16] | None:
    """Decode pixels (count,): alternating runs of zeros and of differences of nonzero pixels."""
    steps = np.zeros(count, np.int32)
    read = np.zeros(count, np.bool_)
    at = pixel = 0
    while pixel < count:
        if at + 2 > len(numbers):
            return None
        zeros, others = int(numbers[at]), int(numbers[at + 1])
        pixel, at = pixel + zeros, at + 2
        if pixel + others > count or at + others > len(numbers):
            return None
        steps[pixel : pixel + others] = numbers[at : at + others]
        read[pixel : pixel + others] = True
        pixel, at = pixel + others, at + others
    differences = steps[read]
    out = np.zeros(count, np.uint16)
    out[read] = np.cumsum((differences >> 1) ^ -(differences & 1)).astype(np.uint16)
    return out


LARGEST_MESSAGE = 1 << 30  # bytes of a message or of an unpacked chunk
_STEP = 1 << 18  # bytes that are unpacked at once


class CompressedBytes:
    """Compressed bytes, unpacked from the beginning as far as they are read."""

    def __init__(self, data: bytes, compression: str, name: str) -> None:
        """`name` stands in messages: "walk.mcap, the chunk at byte 8,"."""
        self._unpacker = _make_unpacker(compression, name)
        self._left, self._content, self._name = data, bytearray(), name

    def read(self, offset: int, count: int) -> bytes:
        """Return at most `count` bytes; `InputError` where damaged, or beyond `LARGEST_MESSAGE`."""
        if offset + count > LARGEST_MESSAGE:
            raise InputError(
                f"{self._name} unpacks to more than {LARGEST_MESSAGE:,} bytes, which is too large; "
                "record or export it again."
            )
        try:
            while len(self._content) < offset + count and not self._unpacker.eof:
                part = self._unpacker.decompress(self._left, _STEP)
                self._left = b""
                if not part:
                    break
                self._content += part
        except Exception as error:  # libraries have no common one
            raise InputError(f"{self._name} is damaged ({error}); copy the bag again.") from error
        return bytes(memoryview(self._content)[offset : offset + count])


def _make_unpacker(compression: str, name: str) -> Any:  # noqa: ANN401  # of three libraries
    if compression == "zstd":
        if sys.version_info >= (3, 14):
            from compression.zstd import ZstdDecompressor
        else:
            from backports.zstd import ZstdDecompressor
        return ZstdDecompressor()
    if compression == "lz4":
        from lz4.frame import LZ4FrameDecompressor

        return LZ4FrameDecompressor()
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    raise InputError(f"{name} uses the compression {compression!r}; write it with zstd or lz4.")
