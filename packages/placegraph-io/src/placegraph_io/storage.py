"""Containers read in place within limits of memory: SQLite, ZIP, compressed chunks, RVL depth images."""

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

LARGEST_VALUE = 1 << 28
"""Bytes of one value; images have some millions."""


class Database:
    """A database that is only read; opened again where it is sent to.

    Raises `InputError` where the file cannot be opened, or is none.
    """

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
        """Rows of a table, which must be one: no view runs. Raises `sqlite3.Error` or `ValueError`."""
        asked = "SELECT type || substr(sql, 1, 13) FROM sqlite_master WHERE name = ? COLLATE NOCASE"
        made = self._base.execute(asked, (table,)).fetchone()
        if made is None or str(made[0]).upper() != "TABLECREATE TABLE ":
            raise ValueError(f"it has no table {table}")
        return self._base.execute(f"SELECT {columns} FROM {table} {then}")  # noqa: S608  # our words

    def columns(self, table: str) -> set[str]:
        """Return the names of a table's columns, in lower case. Raises `sqlite3.Error`."""
        return {str(row[1]).lower() for row in self._base.execute(f"PRAGMA table_info({table})")}

    def blob(self, place: tuple[str, str, int], name: str, most: int | None = None) -> bytes:
        """Bytes of a table's column in a row, all or the first; `InputError`, which begins with `name`."""
        try:
            with self._lock, self._base.blobopen(*place, readonly=True) as held:
                if len(held) >= LARGEST_VALUE:
                    raise InputError(f"{name} has {len(held):,} bytes; it is refused.")
                return held.read(len(held) if most is None else most)
        except (sqlite3.Error, OverflowError) as error:
            raise InputError(
                f"{name} cannot be read ({error}); `sqlite3 {self.path.name} .recover` saves what is left."
            ) from error


_LARGEST_FILE = 1 << 28  # bytes of one file; images have some millions


class Archive:
    """Files of a ZIP by name, each found by the place that its directory says.

    Raises `InputError` where it is no ZIP, or a file of it is missing, damaged, or too large.
    """

    def __init__(self, path: Path, *, flat: bool = False) -> None:
        """Read the directory; `flat`: names are without folders."""
        self.path = path
        try:
            with zipfile.ZipFile(check_regular(path)) as archive:
                held = [entry for entry in archive.infolist() if not entry.is_dir()]
        except (zipfile.BadZipFile, OSError, ValueError, LookupError, RuntimeError) as error:
            raise InputError(f"{path} is no readable ZIP ({error}); copy it again.") from error
        self._entries = {PurePosixPath(e.filename).name if flat else e.filename: e for e in held}
        self.names = frozenset(self._entries)

    def where(self, name: str) -> str:
        """Return what a file is called in messages."""
        return f"{self.path}, {name}" if name else str(self.path)

    def read(self, name: str) -> bytes:
        """Return the content of a file."""
        entry = self._entries.get(name)
        if entry is None:
            raise InputError(f"{self.path} holds no {name}; export or download it again.")
        if entry.file_size > _LARGEST_FILE:
            raise InputError(
                f"{self.where(name)} would have {entry.file_size} bytes; it is refused."
            )
        try:
            with self.path.open("rb") as file:
                file.seek(entry.header_offset)
                head = struct.unpack("<4s22xHH", file.read(30))
                file.seek(head[1] + head[2], io.SEEK_CUR)
                packed = file.read(min(entry.compress_size, _LARGEST_FILE))
            data = packed
            if entry.compress_type == zipfile.ZIP_DEFLATED:
                data = zlib.decompressobj(-zlib.MAX_WBITS).decompress(packed, _LARGEST_FILE)
            good = zlib.crc32(data) == entry.CRC and not entry.flag_bits & 1
        except (OSError, struct.error, zlib.error, ValueError, OverflowError) as error:
            raise InputError(f"{self.where(name)} is damaged ({error}); copy it again.") from error
        if not good:
            raise InputError(f"{self.where(name)} is damaged or encrypted; copy it again.")
        return data


_MOST_PIXELS = (
    1 << 24
)  # pixels; no sensor of depth has as many, and a few bytes could claim any number
_LONGEST = 10  # nibbles of three bits that a number of 30 bits has


def rvl_size(data: bytes) -> tuple[int, int]:
    """Return the width and height [px], which stand before the pixels as those who pack by RVL write them."""
    width, height = unpack("<II", data[:8].ljust(8, b"\0"))
    return width, height


def rvl_image(data: bytes, name: str) -> NDArray[np.uint16]:
    """Return the image (h, w) uint16: width and height as uint32, little-endian, and the pixels' stream.

    Raises `InputError`, which begins with `name`, where the stream does not make up the image.
    """
    width, height = rvl_size(data)
    if not 0 < width * height <= _MOST_PIXELS:
        raise InputError(f"{name} says it has {width} x {height} pixels; record that image again.")
    if len(data) - 8 > 3 * width * height + 16:  # the worst that packing can do
        raise InputError(f"{name}: {len(data):,} bytes are too many for {width} x {height} pixels.")
    pixels = _pixels(_numbers(data[8:]), width * height)
    if pixels is None:
        raise InputError(f"{name} ends before its {width} x {height} pixels; copy the file again.")
    return pixels.reshape(height, width)


def _numbers(data: bytes) -> NDArray[np.int64]:
    """Return the whole numbers of a stream of nibbles, three bits each, low ones first; 8: more follow."""
    words = np.frombuffer(data[: len(data) // 4 * 4], "<u4")
    nibbles = ((words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32)) & 15).astype(np.uint8)
    nibbles = nibbles.ravel()
    ends = np.flatnonzero(nibbles < 8)
    lengths = np.diff(ends, prepend=-1)
    too_long = np.flatnonzero(lengths > _LONGEST)
    if too_long.size:  # no number, and nothing after it can be believed
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
    """Pixels (count,): by turns how many are 0, how many are not, and those, each by its difference."""
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
    held = steps[read]
    out = np.zeros(count, np.uint16)
    out[read] = np.cumsum((held >> 1) ^ -(held & 1)).astype(np.uint16)
    return out


LARGEST_MESSAGE = 1 << 30
"""Bytes of a message or of an unpacked chunk beyond which a number is not believed."""
_STEP = 1 << 18  # bytes at once: little more than is read, and none of it copied in vain


class CompressedBytes:
    """Compressed bytes, unpacked from their beginning as far as somebody reads."""

    def __init__(self, data: bytes, compression: str, name: str) -> None:
        """`name` is what the parts are called in messages: "walk.mcap, the chunk at byte 8,"."""
        self._unpacker = _unpacker(compression, name)
        self._left, self._content, self._name = data, bytearray(), name

    def read(self, offset: int, count: int) -> bytes:
        """At most `count` bytes: fewer where they end. `InputError`: damaged, or beyond `LARGEST_MESSAGE`."""
        if offset + count > LARGEST_MESSAGE:
            raise InputError(
                f"{self._name} would unpack to more than {LARGEST_MESSAGE:,} bytes; it is refused."
            )
        try:
            while len(self._content) < offset + count and not self._unpacker.eof:
                part = self._unpacker.decompress(self._left, _STEP)
                self._left = b""
                if not part:
                    break
                self._content += part
        except Exception as error:  # each library has its own, without a common root
            raise InputError(f"{self._name} is damaged ({error}); copy the bag again.") from error
        return bytes(memoryview(self._content)[offset : offset + count])


def _unpacker(compression: str, name: str) -> Any:  # noqa: ANN401  # of three libraries
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
    raise InputError(f"{name} is compressed by {compression!r}; write it with zstd or lz4.")
