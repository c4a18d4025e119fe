"""Map files: a header in JSON and compressed columns, replaced atomically (`docs/formats.md`)."""

from __future__ import annotations

import hashlib
import json
import lzma
import mmap
import os
import stat
import struct
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from functools import partial
from math import prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import (
    FileWatch,
    check_target,
    lock_file,
    replace_file,
    resolve_path,
    write_error,
)
from placegraph.errors import InputError, MapError, OptionError

MAGIC = b"\x89PGMAP\r\n"
"""First eight bytes; a transfer as text, or through seven bits, damages them."""
CONTAINER_VERSION = 1
"""Version of the layout; the columns of each kind of map have their own version."""

PREFIX = struct.Struct("<8sIII")
"""Magic, container version, header length, header crc32."""
DIGEST_SIZE = hashlib.sha256().digest_size
"""Bytes of the checksum at the end."""
MAX_HEADER = 1 << 24
"""Largest header [bytes]."""

Path_ = str | os.PathLike[str]


@dataclass(frozen=True, slots=True)
class Block:
    """One entry of a map file's table of arrays."""

    name: str
    dtype: str
    """One of `DTYPES`."""
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
    """Checksum of the bytes as stored."""

    @property
    def nbytes(self) -> int:
        """Size of the decompressed array [bytes]."""
        return prod(self.shape) * np.dtype(self.dtype).itemsize


@dataclass(frozen=True, slots=True)
class Header:
    """Header of a map file: its kind, version, metadata and table of columns."""

    path: Path
    kind: str
    """``city`` or ``scene``."""
    version: int
    """Version of the kind's columns."""
    meta: dict[str, Any]
    blocks: tuple[Block, ...]
    file_size: int
    """Size of the whole file [bytes]."""


def read_header(path: Path_) -> Header:
    """Read and check the header of a map file of any kind and version.

    Raises `InputError` and `MapError` as `read_map` does.
    """
    with open_file(path) as file:
        return read_head(file, Path(path))


def read_head(file: BinaryIO, path: Path) -> Header:
    """Read an open map file up to the end of its header."""
    size = os.fstat(file.fileno()).st_size
    prefix = file.read(PREFIX.size)
    if not prefix:
        raise InputError(f"{path} is empty; build the map again.")
    if not prefix.startswith(MAGIC[: len(prefix)]):
        raise MapError(
            f"{path} is not a placegraph map; build one from OpenStreetMap with `placegraph "
            "city build`, or from a 3D file with `placegraph scene build`."
        )
    if len(prefix) < PREFIX.size:
        raise damage_error(path, "it ends inside the header")
    _, container, length, crc = PREFIX.unpack(prefix)
    if container > CONTAINER_VERSION:
        raise MapError(
            f"{path} has file layout {container}, but this placegraph reads up to "
            f"{CONTAINER_VERSION}; update placegraph, or build the map again with this "
            "version."
        )
    if length > min(MAX_HEADER, size):
        raise damage_error(path, "it ends inside the header")
    text = file.read(length)
    if len(text) != length or zlib.crc32(text) != crc:
        raise damage_error(path, "its header does not match its checksum")
    try:
        header = _parse_header(json.loads(text), path, size)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise damage_error(path, f"its header cannot be parsed ({error!r})") from error
    stored = sum(b.length for b in header.blocks)
    if PREFIX.size + length + stored + DIGEST_SIZE != size:
        raise damage_error(path, f"it has {size} bytes, unlike the size in its header")
    if not is_plausible_size(sum(b.nbytes for b in header.blocks), stored):
        raise damage_error(path, "its header declares more data than the file has")
    return header


def _parse_header(content: dict[str, Any], path: Path, size: int) -> Header:
    """Return the header; KeyError, TypeError or ValueError where the JSON is none."""
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
            and block.dtype in DTYPES
            and block.codec in CODECS
            and block.filter in FILTERS
            and block.shape
            and all(type(n) is int and 0 <= n < 1 << 48 for n in numbers)
            and block.offset == offset
        ):
            raise ValueError(block)
        blocks.append(block)
        offset += block.length
    if len({b.name for b in blocks}) != len(blocks):
        raise ValueError("two columns have the same name")
    return Header(path, kind, version, meta, tuple(blocks), size)


def is_plausible_size(nbytes: int, stored: int) -> bool:
    """Return whether arrays of `nbytes` may fit in `stored` bytes: maps stay below 20 : 1."""
    return nbytes <= (1 << 25) + (stored << 8)


def damage_error(path: Path_, fault: str) -> MapError:
    """Return the error for a file that differs from what was written."""
    return MapError(f"{path} is damaged: {fault}. Copy it again, or build the map again.")


def open_file(path: Path_) -> BinaryIO:
    """Open a map file for reading; `InputError` where it is missing or no plain file."""
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
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise InputError(f"{path} is not a regular file; give the map file.")
    return os.fdopen(descriptor, "rb")


DTYPES = frozenset(
    {"|b1", "|i1", "<i2", "<i4", "<i8", "|u1", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8"}
)
"""Types of columns."""
CODECS = frozenset({"raw", "zlib", "lzma"})
FILTERS = frozenset({"none", "shuffle", "delta"})
"""``shuffle`` groups the bytes of words by significance; ``delta`` takes differences before."""

_LZMA = ({"id": lzma.FILTER_LZMA2, "preset": 6},)
_SAMPLE = 1 << 16
"""Bytes of a column that decide its filter."""


def to_plain_array(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Return an array in C order and little-endian; `OptionError` where it is not plain numbers."""
    array = np.asarray(array)
    dtype = array.dtype.newbyteorder("<")
    if dtype.str not in DTYPES or array.ndim == 0:
        raise OptionError(
            f"Column {name!r} is {array.dtype} with {array.ndim} dimensions; columns must "
            "be numeric arrays (use `pack_strings` for text, metadata for single values)."
        )
    return np.ascontiguousarray(array, dtype)


def compress_array(
    array: NDArray[Any], *, raw: bool = False
) -> tuple[str, str, bytes | memoryview]:
    """Return codec, filter and block of a plain array, mostly outside the interpreter's lock.

    `raw` stores the array as it is. A sample chooses the filter. LZMA, which older files have, saves
    4 % of a city's columns and 4 to 9 % of a scene's, and takes ten times as long.
    """
    if raw:
        return "raw", "none", array.data.cast("B")
    sample = array[: 1 + _SAMPLE * len(array) // max(1, array.nbytes)]
    chosen, least = "none", len(zlib.compress(sample.data, 1))
    for name in ("shuffle", "delta") if array.size else ():
        # The fastest level ranks the filters as the thorough ones do, at a fraction of the time.
        size = len(zlib.compress(_apply_filter(name, sample), 1))
        chosen, least = min((chosen, least), (name, size), key=lambda form: form[1])
    filtered = _apply_filter(chosen, array)
    block = zlib.compress(filtered, 4)
    return (
        ("zlib", chosen, block) if len(block) < array.nbytes else ("raw", "none", array.tobytes())
    )


def _apply_filter(name: str, array: NDArray[Any]) -> bytes:
    if name == "none":
        return array.tobytes()
    words = array.view(f"<u{array.itemsize}").reshape(len(array), -1)
    words = _delta(words) if name == "delta" else words
    return words.view(np.uint8).T.tobytes()  # first bytes of all rows, then second bytes, and so on


def decompress_array(
    codec: str, filter_: str, block: memoryview, dtype: str, shape: tuple[int, ...]
) -> NDArray[Any]:
    """Undo `compress_array`; the array is read-only.

    Raises `ValueError` where the block does not hold exactly this array. Memory stays within twice the
    array's size, whatever the block holds.
    """
    kind = np.dtype(dtype)
    nbytes = prod(shape) * kind.itemsize
    raw = _decompress(codec, block, nbytes)
    if len(raw) != nbytes:
        raise ValueError("does not have the length given in its header")
    if filter_ == "none" or not raw:
        array = np.frombuffer(raw, kind).reshape(shape)
    else:
        columns = np.frombuffer(raw, np.uint8).reshape(-1, shape[0])
        words = np.array(columns.T, order="C").view(f"<u{kind.itemsize}")
        words = _undelta(words) if filter_ == "delta" else words
        array = words.view(kind).reshape(shape)
    if kind == np.bool_ and np.any(array.view(np.uint8) > 1):
        raise ValueError("contains values other than true and false")
    array.flags.writeable = False
    return array


def pack_strings(strings: Sequence[str]) -> NDArray[np.uint8]:
    """Return strings as one column of UTF-8: each follows a separator, a character none of them holds."""
    used = set("".join(strings))
    separator = next(c for c in map(chr, range(0xD800)) if c not in used)
    try:
        blob = "".join(separator + s for s in strings).encode()
    except UnicodeEncodeError as error:
        raise OptionError(f"{error.object[:80]!r} is not Unicode text: {error.reason}.") from error
    return np.frombuffer(blob, np.uint8)


def unpack_strings(blob: NDArray[np.uint8], max_count: int | None = None) -> tuple[str, ...]:
    """Undo `pack_strings`; `MapError` where it is not UTF-8, or more than `max_count` strings."""
    try:
        text = blob.tobytes().decode()
    except UnicodeDecodeError as error:
        raise MapError(f"Text is not UTF-8 ({error.reason}); build the map again.") from error
    if max_count is not None and text and text.count(text[0]) > max_count:
        raise MapError(f"The column holds more than {max_count:,} texts; build the map again.")
    return tuple(text[1:].split(text[0])) if text else ()


def _delta(words: NDArray[Any]) -> NDArray[Any]:
    """Return differences along axis 0, modulo the word, zigzag-coded."""
    step = words.copy()
    step[1:] -= words[:-1]
    sign = step.view(f"<i{words.itemsize}") >> (8 * words.itemsize - 1)
    step <<= 1
    step ^= sign.view(words.dtype)
    return step


def _undelta(step: NDArray[Any]) -> NDArray[Any]:
    sign = step & 1
    np.negative(sign, out=sign)
    step >>= 1
    step ^= sign
    return np.cumsum(step, axis=0, dtype=step.dtype, out=step)


def _decompress(codec: str, block: memoryview, nbytes: int) -> bytes | memoryview:
    """Return at most `nbytes` + 1 bytes; none where the block is broken."""
    try:
        if codec == "zlib":
            return zlib.decompressobj().decompress(block, nbytes + 1)
        if codec == "lzma":
            decoder = lzma.LZMADecompressor(lzma.FORMAT_RAW, filters=_LZMA)
            return decoder.decompress(block, nbytes + 1)
    except (zlib.error, lzma.LZMAError, EOFError):
        return b""
    return block


def offsets_of(lengths: Sequence[int] | NDArray[np.integer]) -> NDArray[np.int64]:
    """Return the offsets (N + 1,) of adjacent entries of these lengths (N,)."""
    return np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))


def gather_spans(
    offsets: NDArray[np.int64], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return new offsets (K + 1,) of the spans of `rows` (K,), and the indices of their entries."""
    lengths = offsets[rows + 1] - offsets[rows]
    gathered = offsets_of(lengths)
    return gathered, np.repeat(offsets[rows] - gathered[:-1], lengths) + np.arange(gathered[-1])


CONTENT_ERRORS = (
    LookupError,
    TypeError,
    ValueError,
    ArithmeticError,
    AttributeError,
    RecursionError,
)
"""Errors that contents of forged files raise although checksums fit."""

Write = Callable[..., None]
ALIGNMENT = 1 << 16
"""Smallest column that is memory-mapped, and stored raw for it [bytes]."""
_WORD = 64
"""Alignment of the first block of a file with memory-mapped columns [bytes]."""
CHUNK = 1 << 20  # bytes of a file that are hashed at once


@dataclass(frozen=True, slots=True)
class MapFile:
    """A map file, read and checked; arrays are read-only."""

    header: Header
    arrays: dict[str, NDArray[Any]]
    watch: FileWatch | None = None
    """Watch over the file that arrays are mapped from; None: all are in memory."""

    @property
    def meta(self) -> dict[str, Any]:
        """Metadata; JSON turns tuples into lists."""
        return self.header.meta

    def array(self, name: str, dtype: str, ndim: int = 1) -> NDArray[Any]:
        """Return column `name`; `MapError` where its dtype (such as ``"<i4"``) or dimensions differ."""
        found = self.arrays.get(name)
        if found is None or found.dtype != np.dtype(dtype) or found.ndim != ndim:
            what = "is missing" if found is None else f"is {found.dtype} {found.shape}"
            raise MapError(
                f"{self.header.path}: column {name!r} {what}; expected {ndim}-d {np.dtype(dtype)}. "
                "Build the map again."
            )
        return found

    def strings(self, name: str, max_count: int | None = None) -> tuple[str, ...]:
        """Return column `name` of `pack_strings`; `MapError` as `unpack_strings` raises."""
        blob = self.array(name, "|u1")
        try:
            return unpack_strings(blob, max_count)
        except MapError as error:
            raise MapError(f"{self.header.path}: column {name!r}: {error}") from error


def write_map(
    path: Path_,
    kind: str,
    version: int,
    meta: Mapping[str, Any],
    arrays: Mapping[str, NDArray[Any]],
    mapped: Collection[str] = (),
) -> None:
    """Write a map file in one go; see `map_writer`."""
    with map_writer(path) as write:
        write(kind, version, meta, arrays, mapped)


@contextmanager
def map_writer(path: Path_) -> Iterator[Write]:
    """Lock `path` and yield the function that writes it once, with the arguments of `write_map`.

    `mapped` names the columns that readers map into memory (`read_map`); they are stored raw.

    Take it before a long build: an unwritable folder or a second writer is then refused at once.
    The old file stays untouched until the new one is complete on disk.

    Raises `MapLockedError`: another process, or another thread, is writing this file; `MapError`:
    the file cannot be written; `OptionError`: metadata are not JSON, or an array is not plain
    numbers.
    """
    target = resolve_path(path)
    check_target(target)

    def write(
        kind: str,
        version: int,
        meta: Mapping[str, Any],
        arrays: Mapping[str, NDArray[Any]],
        mapped: Collection[str] = (),
    ) -> None:
        head, blocks = _encode(kind, version, meta, arrays, mapped)
        digest = hashlib.sha256()
        for chunk in (head, *blocks):
            digest.update(chunk)
        try:
            replace_file(target, (head, *blocks, digest.digest()))
        except OSError as error:
            raise write_error(target, error) from error

    with ExitStack() as stack:
        try:
            stack.enter_context(lock_file(target))
        except OSError as error:
            raise write_error(target, error) from error
        yield write


def read_map(
    path: Path_, kind: str, max_version: int, mapped: Collection[str] = (), min_mapped: int = 0,
    skipped: Collection[str] = (),
) -> MapFile:  # fmt: skip
    """Read a map file and check all of it; columns named in `skipped` are left out.

    Raw columns named in `mapped` are memory-mapped, if they have `min_mapped` bytes together; they hold
    two file descriptors. Shortening the file in place would then end this process: ask
    `MapFile.watch` before reading.

    Raises `InputError`: the file is missing, empty, a folder, or may not be read; `MapError`: it is
    foreign, truncated, damaged, of another kind, or of a newer version.
    """
    with open_file(path) as file:
        header = read_head(file, Path(path))
        if header.kind != kind:
            opened = header.kind in ("city", "scene", "library")
            remedy = (
                f"use `placegraph {header.kind}`, or `pg.open_map` in Python"
                if opened
                else f"give a {kind} map"
            )
            raise MapError(f"{path} is a {header.kind} map, not a {kind} map; {remedy}.")
        if header.version > max_version:
            raise MapError(
                f"{path} is a {kind} map of version {header.version}, but this placegraph "
                f"reads up to {max_version}; update placegraph, or build the map again with "
                "this version."
            )
        start, watch = file.tell(), FileWatch(file, path) if mapped else None
        blocks = [b for b in header.blocks if b.name not in skipped]
        windows = [b for b in blocks if b.name in mapped and is_mappable(b, start)]
        windows = windows if sum(b.length for b in windows) >= min_mapped else []
        others = sorted((b for b in blocks if b not in windows), key=lambda b: -b.length)
        with ThreadPoolExecutor(2) as pool:
            apply: Any = pool.map if header.file_size > CHUNK else map
            hashed = apply(_has_valid_digest, [file], [header.file_size])
            # The blocks' own checksums come first: they name the damaged column.
            decoded = apply(partial(read_block, file, start, path), others)
            arrays = dict(zip(others, decoded, strict=True))
            (is_intact,) = hashed
        arrays |= map_blocks(file, windows, start) if windows else {}
        if not is_intact:
            for b in windows:
                read_block(file, start, path, b)
            raise damage_error(path, "its contents do not match its checksum")
    return MapFile(header, {b.name: arrays[b] for b in blocks}, watch if windows else None)


@contextmanager
def check_contents(path: Path_, remedy: str) -> Iterator[None]:
    """Raise `MapError` where the columns that the body combines contradict each other."""
    try:
        yield
    except CONTENT_ERRORS as error:
        why = f"{type(error).__name__}: {error}" if isinstance(error, LookupError) else error
        raise MapError(f"{path}: its columns contradict each other ({why}). {remedy}") from error


def _encode(
    kind: str, version: int, meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]],
    mapped: Collection[str],
) -> tuple[bytes, list[bytes | memoryview]]:  # fmt: skip
    """Return prefix and header, and the blocks."""
    columns = {name: to_plain_array(name, a) for name, a in arrays.items()}
    large = {name for name, a in columns.items() if name in mapped and a.nbytes >= ALIGNMENT}
    # the widest words first: none then begins within a word
    columns = dict(sorted(columns.items(), key=lambda c: -c[1].itemsize if c[0] in large else 0))
    with ThreadPoolExecutor(2) as pool:
        packed = list(pool.map(lambda c: compress_array(c[1], raw=c[0] in large), columns.items()))
    table, offset = [], 0
    for (name, array), (codec, filter_, block) in zip(columns.items(), packed, strict=True):
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
        raise OptionError(
            f"The map's metadata must be JSON with finite numbers: {error}."
        ) from error
    text += b" " * (-(PREFIX.size + len(text)) % _WORD if large else 0)
    prefix = PREFIX.pack(MAGIC, CONTAINER_VERSION, len(text), zlib.crc32(text))
    blocks = [block for _, _, block in packed]
    if len(text) > MAX_HEADER or not is_plausible_size(
        sum(a.nbytes for a in columns.values()), offset
    ):
        raise OptionError("The map's metadata or arrays are larger than the format allows.")
    return prefix + text, blocks


def _has_valid_digest(file: BinaryIO, size: int) -> bool:
    """Return whether the file ends with the checksum of the bytes before."""
    digest, end = hashlib.sha256(), size - DIGEST_SIZE
    for at in range(0, end, CHUNK):
        digest.update(_bytes(file, at, min(CHUNK, end - at)))
    return _bytes(file, end, DIGEST_SIZE + 1) == digest.digest()


def _bytes(file: BinaryIO, at: int, length: int) -> memoryview:
    """Read bytes of a file, in any thread; fewer where it ends before."""
    found = bytearray()
    while len(found) < length and (
        more := os.pread(file.fileno(), length - len(found), at + len(found))
    ):
        if len(more) == length:
            return memoryview(more)
        found += more
    return memoryview(found)


def is_mappable(block: Block, start: int) -> bool:
    """Return whether a block can be memory-mapped: it is stored raw and aligned."""
    aligned = (start + block.offset) % np.dtype(block.dtype).itemsize == 0
    whole = block.length == block.nbytes > 0
    return block.codec == "raw" and block.filter == "none" and aligned and whole


def map_blocks(file: BinaryIO, blocks: Iterable[Block], start: int) -> dict[Block, NDArray[Any]]:
    """Return the arrays of blocks in one memory map of the file, which holds a descriptor."""
    view = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    return {b: np.ndarray(b.shape, np.dtype(b.dtype), view, start + b.offset) for b in blocks}


def read_block(file: BinaryIO, start: int, path: Path_, block: Block) -> NDArray[Any]:
    """Read and check the array of a block of a file whose blocks begin at `start`."""
    stored = _bytes(file, start + block.offset, block.length)
    if zlib.crc32(stored) != block.crc32:
        raise damage_error(path, f"column {block.name!r} does not match its checksum")
    try:
        return decompress_array(block.codec, block.filter, stored, block.dtype, block.shape)
    except ValueError as error:
        raise damage_error(path, f"column {block.name!r} {error}") from error
