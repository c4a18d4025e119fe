"""Map files: one file a map, versioned, checksummed, replaced atomically, written by one at a time.

Layout: `docs/formats.md`. A reader believes nothing it has not checked; there is no pickle.
"""

from __future__ import annotations

import hashlib
import json
import mmap
import os
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from placegraph.core import columns, files, locks
from placegraph.core.columns import pack_strings, unpack_strings
from placegraph.core.header import (
    CONTAINER_VERSION,
    DIGEST,
    MAGIC,
    MOST,
    PREFIX,
    Block,
    Header,
    Path_,
    damaged,
    opened,
    plausible,
    read_head,
    read_header,
)
from placegraph.errors import MapError, OptionError

__all__ = [
    "Block",
    "Header",
    "MapFile",
    "pack_strings",
    "read_header",
    "read_map",
    "sound",
    "unpack_strings",
    "write_map",
    "writing",
]

SENSELESS = (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, RecursionError)
"""What is raised where checksums fit and contents do not, as in a forged file."""

Write = Callable[..., None]
PAGE = 1 << 16
"""Columns to be read where they lie are stored as they are, from this size on [bytes]."""
_WORD = 64
"""Blocks begin at a multiple of so many bytes, where some are read where they lie."""
CHUNK = 1 << 20  # bytes of a file that are hashed at once


@dataclass(frozen=True, slots=True)
class MapFile:
    """A map file, read and checked; arrays are read-only."""

    header: Header
    arrays: dict[str, NDArray[Any]]
    watch: files.Watch | None = None  # of a file that arrays are windows on

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

    def strings(self, name: str, most: int | None = None) -> tuple[str, ...]:
        """Column `name` as written by `pack_strings`; `MapError` where it is not, or of more than `most`."""
        blob = self.array(name, "|u1")
        try:
            return unpack_strings(blob, most)
        except MapError as error:
            raise MapError(f"{self.header.path}: column {name!r}: {error}") from error


def write_map(
    path: Path_,
    kind: str,
    version: int,
    meta: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    mapped: Collection[str] = (),
    *,
    quick: bool = False,
) -> None:
    """Write a map file in one go; see `writing`."""
    with writing(path) as write:
        write(kind, version, meta, arrays, mapped, quick)


@contextmanager
def writing(path: Path_) -> Iterator[Write]:
    """Lock `path` and hand out the function that writes it, once.

    Its last arguments name the columns that are to be read where they lie (`read_map`), stored as they
    are at the head of the file, each at a multiple of its word; and spare time, not bytes (`pack`).

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
        kind: str,
        version: int,
        meta: Mapping[str, Any],
        arrays: Mapping[str, NDArray[Any]],
        mapped: Collection[str] = (),
        quick: bool = False,
    ) -> None:
        head, blocks = _encode(kind, version, meta, arrays, mapped, quick)
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


def read_map(
    path: Path_, kind: str, max_version: int, mapped: Collection[str] = (), least: int = 0
) -> MapFile:
    """Read a map file and check all of it.

    Columns of the names `mapped` that are stored as they are are windows on the file, by two descriptors,
    where they have `least` bytes together. Whoever shortens it, instead of replacing it, ends who looks
    at them: `watch` tells before.

    Raises
    ------
    InputError
        The file is missing, empty, a folder, or may not be read.
    MapError
        It is foreign, truncated, damaged, of another kind, or of a newer version.

    """
    with opened(path) as file:
        header = read_head(file, Path(path))
        if header.kind != kind:
            raise MapError(
                f"{path} is a {header.kind} map, not a {kind} map; open it with `open_map`."
            )
        if header.version > max_version:
            raise MapError(
                f"{path} is a {kind} map of version {header.version}, this placegraph reads up to "
                f"{max_version}; update placegraph, or build the map again with this one."
            )
        start, watch = file.tell(), files.Watch(file, path) if mapped else None
        lying = [b for b in header.blocks if b.name in mapped and lies_there(b, start)]
        lying = lying if sum(b.length for b in lying) >= least else []
        plain = sorted((b for b in header.blocks if b not in lying), key=lambda b: -b.length)
        with ThreadPoolExecutor(2) as pool:
            hashed = pool.submit(_intact, file, header.file_size)
            # The blocks' own checksums come first: they name the damaged column.
            decoded = pool.map(partial(read_block, file, start, path), plain)
            found = dict(zip(plain, decoded, strict=True))
            intact = hashed.result()
        found |= windows(file, lying, start) if lying else {}
        if not intact:
            for b in lying:
                read_block(file, start, path, b)
            raise damaged(path, "its checksum does not fit its contents")
    return MapFile(header, {b.name: found[b] for b in header.blocks}, watch if lying else None)


@contextmanager
def sound(path: Path_, mend: str) -> Iterator[None]:
    """Within it, columns are put together: `MapError` where they contradict each other."""
    try:
        yield
    except SENSELESS as error:
        why = f"{type(error).__name__}: {error}" if isinstance(error, LookupError) else error
        raise MapError(f"{path}: its columns contradict each other ({why}). {mend}") from error


# --- writing ---


def _encode(
    kind: str, version: int, meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]],
    mapped: Collection[str], quick: bool,
) -> tuple[bytes, list[bytes | memoryview]]:  # fmt: skip
    """Prefix and header, and the blocks. zlib and lzma work outside the interpreter's lock."""
    plain = {name: columns.plain(name, a) for name, a in arrays.items()}
    large = {name for name, a in plain.items() if name in mapped and a.nbytes >= PAGE}
    # the widest words first: none then begins within a word
    plain = dict(sorted(plain.items(), key=lambda c: -c[1].itemsize if c[0] in large else 0))
    with ThreadPoolExecutor(2) as pool:
        pack = partial(columns.pack, quick=quick)
        packed = list(pool.map(lambda c: pack(c[1], as_it_is=c[0] in large), plain.items()))
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
    text += b" " * (-(PREFIX.size + len(text)) % _WORD if large else 0)
    prefix = PREFIX.pack(MAGIC, CONTAINER_VERSION, len(text), zlib.crc32(text))
    blocks = [block for _, _, block in packed]
    if len(text) > MOST or not plausible(sum(a.nbytes for a in plain.values()), offset):
        raise OptionError("A map's metadata, or its arrays, are larger than a reader accepts.")
    return prefix + text, blocks


# --- reading ---


def _intact(file: BinaryIO, size: int) -> bool:
    """Whether the file ends with the checksum of what stands before it."""
    digest, end = hashlib.sha256(), size - DIGEST
    for at in range(0, end, CHUNK):
        digest.update(_bytes(file, at, min(CHUNK, end - at)))
    return _bytes(file, end, DIGEST + 1) == digest.digest()


def _bytes(file: BinaryIO, at: int, length: int) -> memoryview:
    """Bytes of a file, by two threads at once; fewer where it ends before."""
    found = bytearray()
    while len(found) < length and (
        more := os.pread(file.fileno(), length - len(found), at + len(found))
    ):
        if len(more) == length:
            return memoryview(more)
        found += more
    return memoryview(found)


def lies_there(block: Block, start: int) -> bool:
    """Whether a block can be read where it lies: stored as it is, and not beginning within a word."""
    aligned = (start + block.offset) % np.dtype(block.dtype).itemsize == 0
    whole = block.length == block.nbytes > 0
    return block.codec == "raw" and block.filter == "none" and aligned and whole


def windows(file: BinaryIO, blocks: Iterable[Block], start: int) -> dict[Block, NDArray[Any]]:
    """Arrays of blocks, as windows on one map of the file: each map holds a descriptor."""
    view = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    return {b: np.ndarray(b.shape, np.dtype(b.dtype), view, start + b.offset) for b in blocks}


def read_block(file: BinaryIO, start: int, path: Path_, block: Block) -> NDArray[Any]:
    """Array of a block of a file whose blocks begin at `start`."""
    stored = _bytes(file, start + block.offset, block.length)
    if zlib.crc32(stored) != block.crc32:
        raise damaged(path, f"column {block.name!r} does not fit its checksum")
    try:
        return columns.unpack(block.codec, block.filter, stored, block.dtype, block.shape)
    except ValueError as error:
        raise damaged(path, f"column {block.name!r} {error}") from error
