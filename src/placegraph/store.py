"""Map files: one file a map, versioned, checksummed, replaced atomically, written by one at a time.

Layout: `docs/formats.md`. A reader believes nothing it has not checked; there is no pickle.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph import columns, files, locks
from placegraph.columns import pack_strings, unpack_strings
from placegraph.errors import MapError, OptionError
from placegraph.header import (
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

if TYPE_CHECKING:
    from collections.abc import Iterator

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

Write = Callable[[str, int, Mapping[str, Any], Mapping[str, NDArray[Any]]], None]


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
        start = file.tell()
        file.seek(0)
        data = memoryview(file.read())
    body, digest = data[:-DIGEST], data[-DIGEST:]
    intact = len(data) == header.file_size and hashlib.sha256(body).digest() == digest
    # The blocks' own checksums come first: they name the damaged column.
    arrays = {b.name: _decode(b, body[start + b.offset :], path) for b in header.blocks}
    if not intact:
        raise damaged(path, "its checksum does not fit its contents")
    return MapFile(header, arrays)


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
    prefix = PREFIX.pack(MAGIC, CONTAINER_VERSION, len(text), zlib.crc32(text))
    blocks = [block for _, _, block in packed]
    if len(text) > MOST or not plausible(sum(a.nbytes for a in plain.values()), offset):
        raise OptionError("A map's metadata, or its arrays, are larger than a reader accepts.")
    return prefix + text, blocks


# --- reading ---


def _decode(block: Block, data: memoryview, path: Path_) -> NDArray[Any]:
    """Array of a block; `data` starts where the block does."""
    stored = data[: block.length]
    if zlib.crc32(stored) != block.crc32:
        raise damaged(path, f"column {block.name!r} does not fit its checksum")
    try:
        return columns.unpack(block.codec, block.filter, stored, block.dtype, block.shape)
    except ValueError as error:
        raise damaged(path, f"column {block.name!r} {error}") from error
