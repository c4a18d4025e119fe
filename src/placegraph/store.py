"""Map files: one file a map, versioned, checksummed, replaced atomically, written by one at a time.

Layout: `docs/formats.md`. A reader believes nothing it has not checked; there is no pickle.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
import struct
import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from placegraph import columns, files, locks
from placegraph.columns import pack_strings, unpack_strings
from placegraph.errors import InputError, MapError, OptionError

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = [
    "Block",
    "Header",
    "MapFile",
    "pack_strings",
    "read_header",
    "read_map",
    "unpack_strings",
    "write_map",
    "writing",
]

MAGIC = b"\x89PGMAP\r\n"
"""First eight bytes; a transfer as text, or through seven bits, damages them."""
CONTAINER_VERSION = 1
"""Version of the layout itself; what the columns mean has its own, per kind."""

_PREFIX = struct.Struct("<8sIII")  # magic, container version, header length, header crc32
_DIGEST = hashlib.sha256().digest_size
_MAX_HEADER = 1 << 24

Path_ = str | os.PathLike[str]
Write = Callable[[str, int, Mapping[str, Any], Mapping[str, NDArray[Any]]], None]


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


@dataclass(frozen=True, slots=True)
class MapFile:
    """A map file, read and checked; arrays are read-only."""

    header: Header
    arrays: dict[str, NDArray[Any]]

    @property
    def meta(self) -> dict[str, Any]:
        """Metadata as JSON gave them back: tuples have become lists."""
        return self.header.meta

    def array(self, name: str, dtype: str, ndim: int = 1) -> NDArray[Any]:
        """Column `name`; `MapError` where its dtype (such as ``"<i4"``) or dimensions differ."""
        found = self.arrays.get(name)
        if found is None or found.dtype != np.dtype(dtype) or found.ndim != ndim:
            what = "is missing" if found is None else f"is {found.dtype} {found.shape}"
            raise MapError(
                f"{self.header.path}: column {name!r} {what}; expected {ndim}-d {np.dtype(dtype)}. "
                "Build the map again."
            )
        return found

    def strings(self, name: str) -> tuple[str, ...]:
        """Column `name` as written by `pack_strings`; `MapError` where it is not."""
        blob = self.array(name, "|u1")
        try:
            return unpack_strings(blob)
        except MapError as error:
            raise MapError(f"{self.header.path}: column {name!r}: {error}") from error


def write_map(
    path: Path_,
    kind: str,
    version: int,
    meta: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
) -> None:
    """Write a map file in one go; see `writing`."""
    with writing(path) as write:
        write(kind, version, meta, arrays)


@contextmanager
def writing(path: Path_) -> Iterator[Write]:
    """Lock `path` and hand out the function that writes it, once.

    Take it before a long build: an unwritable folder or a second writer is then refused at once.
    The old file stays untouched until the new one is complete on disk.

    Raises
    ------
    MapLockedError
        Another process, or another thread, is writing this file.
    MapError
        The file cannot be written.
    OptionError
        Metadata are not JSON, or an array is not plain numbers.

    """
    target = files.real_path(path)
    files.check_plain(target)

    def write(
        kind: str, version: int, meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
    ) -> None:
        head, blocks = _encode(kind, version, meta, arrays)
        digest = hashlib.sha256()
        for chunk in (head, *blocks):
            digest.update(chunk)
        try:
            files.replace_file(target, (head, *blocks, digest.digest()))
        except OSError as error:
            raise files.cannot_write(target, error) from error

    with ExitStack() as stack:
        try:
            stack.enter_context(locks.exclusive(target))
        except OSError as error:
            raise files.cannot_write(target, error) from error
        yield write


def read_map(path: Path_, kind: str, max_version: int) -> MapFile:
    """Read a map file and check all of it.

    Raises
    ------
    InputError
        The file is missing, empty, a folder, or may not be read.
    MapError
        It is foreign, truncated, damaged, of another kind, or of a newer version.

    """
    with _open(path) as file:
        header = _read_header(file, Path(path))
        if header.kind != kind:
            raise MapError(
                f"{path} is a {header.kind} map, not a {kind} map; open it with `open_map`."
            )
        if header.version > max_version:
            raise MapError(
                f"{path} is a {kind} map of version {header.version}, this placegraph reads up to "
                f"{max_version}; update placegraph, or build the map again with this one."
            )
        start = file.tell()
        file.seek(0)
        data = memoryview(file.read())
    body, digest = data[:-_DIGEST], data[-_DIGEST:]
    intact = len(data) == header.file_size and hashlib.sha256(body).digest() == digest
    # The blocks' own checksums come first: they name the damaged column.
    arrays = {b.name: _decode(b, body[start + b.offset :], path) for b in header.blocks}
    if not intact:
        raise _damaged(path, "its checksum does not fit its contents")
    return MapFile(header, arrays)


def read_header(path: Path_) -> Header:
    """Head of a map file of any kind and version, checked; the columns are not read.

    Raises `InputError` and `MapError` as `read_map` does.
    """
    with _open(path) as file:
        return _read_header(file, Path(path))


# --- writing ---


def _encode(
    kind: str, version: int, meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]
) -> tuple[bytes, list[bytes]]:
    """Prefix and header, and the blocks. zlib and lzma work outside the interpreter's lock."""
    plain = {name: columns.plain(name, a) for name, a in arrays.items()}
    with ThreadPoolExecutor(2) as pool:
        packed = list(pool.map(columns.pack, plain.values()))
    table, offset = [], 0
    for (name, array), (codec, filter_, block) in zip(plain.items(), packed, strict=True):
        crc = zlib.crc32(block)
        entry = Block(name, array.dtype.str, array.shape, codec, filter_, offset, len(block), crc)
        table.append(asdict(entry))
        offset += len(block)
    content = {"kind": kind, "version": version, "meta": dict(meta), "arrays": table}
    try:
        text = json.dumps(
            content, ensure_ascii=False, allow_nan=False, sort_keys=True, separators=(",", ":")
        ).encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise OptionError(f"A map's metadata must be plain finite JSON: {error}.") from error
    prefix = _PREFIX.pack(MAGIC, CONTAINER_VERSION, len(text), zlib.crc32(text))
    blocks = [block for _, _, block in packed]
    if len(text) > _MAX_HEADER or not _plausible(sum(a.nbytes for a in plain.values()), offset):
        raise OptionError("A map's metadata, or its arrays, are larger than a reader accepts.")
    return prefix + text, blocks


# --- reading ---


def _read_header(file: BinaryIO, path: Path) -> Header:
    """Read up to the end of the header; the file stands there afterwards."""
    size = os.fstat(file.fileno()).st_size
    prefix = file.read(_PREFIX.size)
    if not prefix:
        raise InputError(f"{path} is empty; build the map again.")
    if not prefix.startswith(MAGIC[: len(prefix)]):
        raise MapError(
            f"{path} is not a placegraph map; `placegraph city build` makes one from OpenStreetMap, "
            "`placegraph scene build` one from a 3D file."
        )
    if len(prefix) < _PREFIX.size:
        raise _damaged(path, "it ends within the header")
    _, container, length, crc = _PREFIX.unpack(prefix)
    if container > CONTAINER_VERSION:
        raise MapError(
            f"{path} has file layout {container}, this placegraph reads up to {CONTAINER_VERSION}; "
            "update placegraph, or build the map again with this one."
        )
    if length > min(_MAX_HEADER, size):
        raise _damaged(path, "it ends within the header")
    text = file.read(length)
    if len(text) != length or zlib.crc32(text) != crc:
        raise _damaged(path, "its header does not fit its checksum")
    try:
        header = _parse_header(json.loads(text), path, size)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise _damaged(path, f"its header is not understood ({error!r})") from error
    stored = sum(b.length for b in header.blocks)
    if _PREFIX.size + length + stored + _DIGEST != size:
        raise _damaged(path, f"it has {size} bytes, which is not what its header announces")
    if not _plausible(sum(b.nbytes for b in header.blocks), stored):
        raise _damaged(path, "its header announces more data than so short a file can hold")
    return header


def _parse_header(content: dict[str, Any], path: Path, size: int) -> Header:
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


def _plausible(nbytes: int, stored: int) -> bool:
    """Guard against decompression bombs: real maps stay below 20 : 1."""
    return nbytes <= (1 << 28) + (stored << 8)


def _decode(block: Block, data: memoryview, path: Path_) -> NDArray[Any]:
    """Array of a block; `data` starts where the block does."""
    stored = data[: block.length]
    if zlib.crc32(stored) != block.crc32:
        raise _damaged(path, f"column {block.name!r} does not fit its checksum")
    try:
        return columns.unpack(block.codec, block.filter, stored, block.dtype, block.shape)
    except ValueError as error:
        raise _damaged(path, f"column {block.name!r} {error}") from error


def _damaged(path: Path_, how: str) -> MapError:
    return MapError(f"{path} is damaged: {how}. Copy it again, or build the map again.")


# --- files ---


def _open(path: Path_) -> BinaryIO:
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
