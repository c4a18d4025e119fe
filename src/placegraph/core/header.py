"""The head of a map file: what kind of map it is, and where its columns lie.

Layout: `docs/formats.md`. Nothing is believed that was not checked.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
import struct
import zlib
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from placegraph.core import columns
from placegraph.errors import InputError, MapError

MAGIC = b"\x89PGMAP\r\n"
"""First eight bytes; a transfer as text, or through seven bits, damages them."""
CONTAINER_VERSION = 1
"""Version of the layout itself; what the columns mean has its own, per kind."""

PREFIX = struct.Struct("<8sIII")
"""Magic, container version, header length, header crc32."""
DIGEST = hashlib.sha256().digest_size
"""Bytes of the checksum at the end."""
MOST = 1 << 24
"""Bytes of a header."""

Path_ = str | os.PathLike[str]


@dataclass(frozen=True, slots=True)
class Block:
    """One entry of a map file's table of arrays."""

    name: str
    dtype: str
    """One of `columns.DTYPES`."""
    shape: tuple[int, ...]
    codec: str
    """``raw``, ``zlib`` or ``lzma``."""
    filter: str
    """``none``, ``shuffle`` or ``delta``, applied before the codec."""
    offset: int
    """Bytes from the end of the header."""
    length: int
    """Bytes as stored."""
    crc32: int
    """Of the bytes as stored."""

    @property
    def nbytes(self) -> int:
        """Bytes once decompressed."""
        return prod(self.shape) * np.dtype(self.dtype).itemsize


@dataclass(frozen=True, slots=True)
class Header:
    """What stands at the head of a map file."""

    path: Path
    kind: str
    """``city`` or ``scene``."""
    version: int
    """Version of the kind's columns."""
    meta: dict[str, Any]
    blocks: tuple[Block, ...]
    file_size: int
    """Bytes, everything included."""


def read_header(path: Path_) -> Header:
    """Head of a map file of any kind and version, checked; the columns are not read.

    Raises `InputError` and `MapError` as `read_map` does.
    """
    with opened(path) as file:
        return read_head(file, Path(path))


def read_head(file: BinaryIO, path: Path) -> Header:
    """Read up to the end of the header; the file stands there afterwards."""
    size = os.fstat(file.fileno()).st_size
    prefix = file.read(PREFIX.size)
    if not prefix:
        raise InputError(f"{path} is empty; build the map again.")
    if not prefix.startswith(MAGIC[: len(prefix)]):
        raise MapError(
            f"{path} is not a placegraph map; `placegraph city build` makes one from OpenStreetMap, "
            "`placegraph scene build` one from a 3D file."
        )
    if len(prefix) < PREFIX.size:
        raise damaged(path, "it ends within the header")
    _, container, length, crc = PREFIX.unpack(prefix)
    if container > CONTAINER_VERSION:
        raise MapError(
            f"{path} has file layout {container}, this placegraph reads up to {CONTAINER_VERSION}; "
            "update placegraph, or build the map again with this one."
        )
    if length > min(MOST, size):
        raise damaged(path, "it ends within the header")
    text = file.read(length)
    if len(text) != length or zlib.crc32(text) != crc:
        raise damaged(path, "its header does not fit its checksum")
    try:
        header = _parsed(json.loads(text), path, size)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise damaged(path, f"its header is not understood ({error!r})") from error
    stored = sum(b.length for b in header.blocks)
    if PREFIX.size + length + stored + DIGEST != size:
        raise damaged(path, f"it has {size} bytes, which is not what its header announces")
    if not plausible(sum(b.nbytes for b in header.blocks), stored):
        raise damaged(path, "its header announces more data than so short a file can hold")
    return header


def _parsed(content: dict[str, Any], path: Path, size: int) -> Header:
    """Raise any of KeyError, TypeError, ValueError where the header is not what it should be."""
    kind, version, meta = content["kind"], content["version"], content["meta"]
    table = content["arrays"]
    types = [type(value) for value in (kind, version, meta, table)]
    if types != [str, int, dict, list]:
        raise TypeError("kind, version, meta, arrays")
    blocks, offset = [], 0
    for entry in table:
        block = Block(**{**entry, "shape": tuple(entry["shape"])})
        numbers = (*block.shape, block.offset, block.length, block.crc32)
        if not (
            isinstance(block.name, str)
            and block.dtype in columns.DTYPES
            and block.codec in columns.CODECS
            and block.filter in columns.FILTERS
            and block.shape
            and all(type(n) is int and 0 <= n < 1 << 48 for n in numbers)
            and block.offset == offset
        ):
            raise ValueError(block)
        blocks.append(block)
        offset += block.length
    if len({b.name for b in blocks}) != len(blocks):
        raise ValueError("two columns of one name")
    return Header(path, kind, version, meta, tuple(blocks), size)


def plausible(nbytes: int, stored: int) -> bool:
    """Guard against decompression bombs: real maps stay below 20 : 1."""
    return nbytes <= (1 << 25) + (stored << 8)


def damaged(path: Path_, how: str) -> MapError:
    """What is raised where a file is not as it was written."""
    return MapError(f"{path} is damaged: {how}. Copy it again, or build the map again.")


def opened(path: Path_) -> BinaryIO:
    """Map file, open for reading; `InputError` where there is none, or it is no plain file."""
    try:
        # Without O_NONBLOCK, opening a pipe would wait for its other end.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except FileNotFoundError as error:
        builders = {
            ".scene": "scene build", ".library": "library build", ".vectors": "city embed",
            ".run": "scene localize --record",
        }  # fmt: skip
        builder = builders.get(Path(path).suffix, "city build")
        raise InputError(f"{path} does not exist; build it with `placegraph {builder}`.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read: {_why(error)}.") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InputError(f"{path} is not a plain file; name the map file itself.")
    return os.fdopen(descriptor, "rb")


def _why(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
