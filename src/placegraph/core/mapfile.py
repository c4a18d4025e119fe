"""Map files: a header in JSON and compressed columns, written whole or not at all, read lazily.

docs/formats.md describes the layout.
"""

from __future__ import annotations

import hashlib
import itertools
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
from typing import Any, BinaryIO, overload
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from placegraph.core import files
from placegraph.core import files as locks
from placegraph.errors import InputError, MapError, OptionError

MAGIC = b"\x89PGMAP\r\n"
"""First eight bytes; a transfer as text, or through seven bits, damages them."""
CONTAINER_VERSION = 1
"""Version of the layout itself; what the columns mean has its own, per kind."""

PREFIX = struct.Struct("<8sIII")
"""Magic, container version, header length, header crc32."""
DIGEST_SIZE = hashlib.sha256().digest_size
"""Bytes of the checksum at the end."""
MAX_HEADER = 1 << 24
"""Bytes of a header."""

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
    with open_file(path) as file:
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
        raise damage_error(path, "it ends within the header")
    _, container, length, crc = PREFIX.unpack(prefix)
    if container > CONTAINER_VERSION:
        raise MapError(
            f"{path} has file layout {container}, this placegraph reads up to {CONTAINER_VERSION}; "
            "update placegraph, or build the map again with this one."
        )
    if length > min(MAX_HEADER, size):
        raise damage_error(path, "it ends within the header")
    text = file.read(length)
    if len(text) != length or zlib.crc32(text) != crc:
        raise damage_error(path, "its header does not fit its checksum")
    try:
        header = _parse_header(json.loads(text), path, size)
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise damage_error(path, f"its header is not understood ({error!r})") from error
    stored = sum(b.length for b in header.blocks)
    if PREFIX.size + length + stored + DIGEST_SIZE != size:
        raise damage_error(path, f"it has {size} bytes, which is not what its header announces")
    if not is_plausible_size(sum(b.nbytes for b in header.blocks), stored):
        raise damage_error(path, "its header announces more data than so short a file can hold")
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
        raise ValueError("two columns of one name")
    return Header(path, kind, version, meta, tuple(blocks), size)


def is_plausible_size(nbytes: int, stored: int) -> bool:
    """Guard against decompression bombs: real maps stay below 20 : 1."""
    return nbytes <= (1 << 25) + (stored << 8)


def damage_error(path: Path_, how: str) -> MapError:
    """What is raised where a file is not as it was written."""
    return MapError(f"{path} is damaged: {how}. Copy it again, or build the map again.")


def open_file(path: Path_) -> BinaryIO:
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


DTYPES = frozenset(
    {"|b1", "|i1", "<i2", "<i4", "<i8", "|u1", "<u2", "<u4", "<u8", "<f2", "<f4", "<f8"}
)
"""What a column may be."""
CODECS = frozenset({"raw", "zlib", "lzma"})
FILTERS = frozenset({"none", "shuffle", "delta"})
"""``shuffle`` groups the bytes of words by significance; ``delta`` takes differences before."""

_LZMA = ({"id": lzma.FILTER_LZMA2, "preset": 6},)
_LZMA_LIMIT = 1 << 20  # longer columns are coordinates: LZMA saves 5 % there and opens 7 x slower
_LZMA_GAIN = 0.95
_SAMPLE = 1 << 16
"""Bytes of a column by which a filter is chosen where time is short."""


def to_plain_array(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Array in C order and little-endian; `OptionError` where it is not plain numbers."""
    array = np.asarray(array)
    dtype = array.dtype.newbyteorder("<")
    if dtype.str not in DTYPES or array.ndim == 0:
        raise OptionError(
            f"Column {name!r} is {array.dtype} with {array.ndim} dimensions; a map holds arrays "
            "of plain numbers (text: `pack_strings`; single values: metadata)."
        )
    return np.ascontiguousarray(array, dtype)


def compress_array(
    array: NDArray[Any], *, as_it_is: bool = False, quick: bool = False
) -> tuple[str, str, bytes | memoryview]:
    """Codec, filter and block of a plain array. Spends its time outside the interpreter's lock.

    `quick` does without LZMA, and chooses by a sample: maps of cities become a little larger, much sooner.
    """
    if as_it_is:
        return "raw", "none", array.data.cast("B")
    some = array[: 1 + _SAMPLE * len(array) // max(1, array.nbytes)] if quick else array
    chosen, least = "none", len(zlib.compress(some.data, 1))
    for name in ("shuffle", "delta") if array.size else ():
        # The fastest level ranks the filters as the thorough ones do, at a fraction of the time.
        size = len(zlib.compress(_filtered(name, some), 1))
        chosen, least = min((chosen, least), (name, size), key=lambda form: form[1])
    raw = _filtered(chosen, array)
    best = ("zlib", chosen, zlib.compress(raw, 1 if quick else 6))
    if len(raw) <= _LZMA_LIMIT and not quick:
        block = lzma.compress(raw, lzma.FORMAT_RAW, filters=_LZMA)
        if len(block) < _LZMA_GAIN * len(best[2]):
            best = ("lzma", chosen, block)
    return best if len(best[2]) < array.nbytes else ("raw", "none", array.tobytes())


def _filtered(name: str, array: NDArray[Any]) -> bytes:
    if name == "none":
        return array.tobytes()
    words = _words(array)
    return _shuffle(_delta(words) if name == "delta" else words)


def decompress_array(
    codec: str, filter_: str, block: memoryview, dtype: str, shape: tuple[int, ...]
) -> NDArray[Any]:
    """Undo `compress_array`; the array is read-only.

    Raises `ValueError` where the block does not hold exactly such an array; memory stays within
    twice the array's size whatever the block would like to become.
    """
    kind = np.dtype(dtype)
    nbytes = prod(shape) * kind.itemsize
    raw = _decompress(codec, block, nbytes)
    if len(raw) != nbytes:
        raise ValueError("is not as long as its header says")
    if filter_ == "none" or not raw:
        array = np.frombuffer(raw, kind).reshape(shape)
    else:
        columns = np.frombuffer(raw, np.uint8).reshape(-1, shape[0])
        words = np.array(columns.T, order="C").view(f"<u{kind.itemsize}")
        words = _undelta(words) if filter_ == "delta" else words
        array = words.view(kind).reshape(shape)
    if kind == np.bool_ and np.any(array.view(np.uint8) > 1):
        raise ValueError("holds values that are neither true nor false")
    array.flags.writeable = False
    return array


def pack_strings(strings: Sequence[str]) -> NDArray[np.uint8]:
    """Strings as one column of UTF-8: each follows a separator, a character none of them holds."""
    used = set("".join(strings))
    separator = next(c for c in map(chr, range(0xD800)) if c not in used)
    try:
        blob = "".join(separator + s for s in strings).encode()
    except UnicodeEncodeError as error:
        raise OptionError(f"{error.object[:80]!r} is not Unicode text: {error.reason}.") from error
    return np.frombuffer(blob, np.uint8)


def unpack_strings(blob: NDArray[np.uint8], most: int | None = None) -> tuple[str, ...]:
    """Undo `pack_strings`; `MapError` where the bytes are not UTF-8, or more than `most` strings."""
    try:
        text = blob.tobytes().decode()
    except UnicodeDecodeError as error:
        raise MapError(f"Text is not UTF-8 ({error.reason}); build the map again.") from error
    if most is not None and text and text.count(text[0]) > most:
        raise MapError(f"It holds more than {most:,} texts; build the map again.")
    return tuple(text[1:].split(text[0])) if text else ()


def _words(array: NDArray[Any]) -> NDArray[Any]:
    """Bits of the array as unsigned integers (rows, values of a row)."""
    return array.view(f"<u{array.itemsize}").reshape(len(array), -1)


def _delta(words: NDArray[Any]) -> NDArray[Any]:
    """Differences along axis 0, modulo the word; small ones of either sign as small integers."""
    step = words.copy()
    step[1:] -= words[:-1]
    sign = step.view(f"<i{words.itemsize}") >> (8 * words.itemsize - 1)
    step <<= 1
    step ^= sign.view(words.dtype)
    return step


def _undelta(step: NDArray[Any]) -> NDArray[Any]:
    """Undo `_delta`, in place."""
    sign = step & 1
    np.negative(sign, out=sign)
    step >>= 1
    step ^= sign
    return np.cumsum(step, axis=0, dtype=step.dtype, out=step)


def _shuffle(words: NDArray[Any]) -> bytes:
    """First bytes of all rows, then second bytes, and so on: like stands next to like."""
    return words.view(np.uint8).T.tobytes()


def _decompress(codec: str, block: memoryview, nbytes: int) -> bytes | memoryview:
    """At most `nbytes` + 1 bytes; nothing where the block is broken."""
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
    """Bounds (N + 1,) of entries of these lengths (N,)."""
    return np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))


def gather_spans(
    bounds: NDArray[np.int64], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Bounds (K + 1,) of the entries of `rows` (K,) set side by side, and which entries they are."""
    lengths = bounds[rows + 1] - bounds[rows]
    made = offsets_of(lengths)
    return made, np.repeat(bounds[rows] - made[:-1], lengths) + np.arange(made[-1])


CONTENT_ERRORS = (
    LookupError,
    TypeError,
    ValueError,
    ArithmeticError,
    AttributeError,
    RecursionError,
)
"""What is raised where checksums fit and contents do not, as in a forged file."""

Write = Callable[..., None]
ALIGNMENT = 1 << 16
"""Columns to be read where they lie are stored as they are, from this size on [bytes]."""
_WORD = 64
"""Blocks begin at a multiple of so many bytes, where some are read where they lie."""
CHUNK = 1 << 20  # bytes of a file that are hashed at once


@dataclass(frozen=True, slots=True)
class MapFile:
    """A map file, read and checked; arrays are read-only."""

    header: Header
    arrays: dict[str, NDArray[Any]]
    watch: files.FileWatch | None = None  # of a file that arrays are windows on

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
    """Write a map file in one go; see `map_writer`."""
    with map_writer(path) as write:
        write(kind, version, meta, arrays, mapped, quick)


@contextmanager
def map_writer(path: Path_) -> Iterator[Write]:
    """Lock `path` and hand out the function that writes it, once.

    Its last arguments name the columns that are to be read where they lie (`read_map`), stored as they
    are at the head of the file, each at a multiple of its word; and spare time, not bytes (`compress_array`).

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
    target = files.resolve_path(path)
    files.check_target(target)

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
            raise files.write_error(target, error) from error

    with ExitStack() as stack:
        try:
            stack.enter_context(locks.lock_file(target))
        except OSError as error:
            raise files.write_error(target, error) from error
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
    with open_file(path) as file:
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
        start, watch = file.tell(), files.FileWatch(file, path) if mapped else None
        lying = [b for b in header.blocks if b.name in mapped and is_mappable(b, start)]
        lying = lying if sum(b.length for b in lying) >= least else []
        plain = sorted((b for b in header.blocks if b not in lying), key=lambda b: -b.length)
        with ThreadPoolExecutor(2) as pool:
            hashed = pool.submit(_has_valid_digest, file, header.file_size)
            # The blocks' own checksums come first: they name the damaged column.
            decoded = pool.map(partial(read_block, file, start, path), plain)
            found = dict(zip(plain, decoded, strict=True))
            intact = hashed.result()
        found |= map_blocks(file, lying, start) if lying else {}
        if not intact:
            for b in lying:
                read_block(file, start, path, b)
            raise damage_error(path, "its checksum does not fit its contents")
    return MapFile(header, {b.name: found[b] for b in header.blocks}, watch if lying else None)


@contextmanager
def check_contents(path: Path_, mend: str) -> Iterator[None]:
    """Within it, columns are put together: `MapError` where they contradict each other."""
    try:
        yield
    except CONTENT_ERRORS as error:
        why = f"{type(error).__name__}: {error}" if isinstance(error, LookupError) else error
        raise MapError(f"{path}: its columns contradict each other ({why}). {mend}") from error


# --- writing ---


def _encode(
    kind: str, version: int, meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]],
    mapped: Collection[str], quick: bool,
) -> tuple[bytes, list[bytes | memoryview]]:  # fmt: skip
    """Prefix and header, and the blocks. zlib and lzma work outside the interpreter's lock."""
    columns = {name: to_plain_array(name, a) for name, a in arrays.items()}
    large = {name for name, a in columns.items() if name in mapped and a.nbytes >= ALIGNMENT}
    # the widest words first: none then begins within a word
    columns = dict(sorted(columns.items(), key=lambda c: -c[1].itemsize if c[0] in large else 0))
    with ThreadPoolExecutor(2) as pool:
        compress = partial(compress_array, quick=quick)
        packed = list(pool.map(lambda c: compress(c[1], as_it_is=c[0] in large), columns.items()))
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
        raise OptionError(f"A map's metadata must be plain finite JSON: {error}.") from error
    text += b" " * (-(PREFIX.size + len(text)) % _WORD if large else 0)
    prefix = PREFIX.pack(MAGIC, CONTAINER_VERSION, len(text), zlib.crc32(text))
    blocks = [block for _, _, block in packed]
    if len(text) > MAX_HEADER or not is_plausible_size(
        sum(a.nbytes for a in columns.values()), offset
    ):
        raise OptionError("A map's metadata, or its arrays, are larger than a reader accepts.")
    return prefix + text, blocks


# --- reading ---


def _has_valid_digest(file: BinaryIO, size: int) -> bool:
    """Whether the file ends with the checksum of what stands before it."""
    digest, end = hashlib.sha256(), size - DIGEST_SIZE
    for at in range(0, end, CHUNK):
        digest.update(_bytes(file, at, min(CHUNK, end - at)))
    return _bytes(file, end, DIGEST_SIZE + 1) == digest.digest()


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


def is_mappable(block: Block, start: int) -> bool:
    """Whether a block can be read where it lies: stored as it is, and not beginning within a word."""
    aligned = (start + block.offset) % np.dtype(block.dtype).itemsize == 0
    whole = block.length == block.nbytes > 0
    return block.codec == "raw" and block.filter == "none" and aligned and whole


def map_blocks(file: BinaryIO, blocks: Iterable[Block], start: int) -> dict[Block, NDArray[Any]]:
    """Arrays of blocks, as windows on one map of the file: each map holds a descriptor."""
    view = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    return {b: np.ndarray(b.shape, np.dtype(b.dtype), view, start + b.offset) for b in blocks}


def read_block(file: BinaryIO, start: int, path: Path_, block: Block) -> NDArray[Any]:
    """Array of a block of a file whose blocks begin at `start`."""
    stored = _bytes(file, start + block.offset, block.length)
    if zlib.crc32(stored) != block.crc32:
        raise damage_error(path, f"column {block.name!r} does not fit its checksum")
    try:
        return decompress_array(block.codec, block.filter, stored, block.dtype, block.shape)
    except ValueError as error:
        raise damage_error(path, f"column {block.name!r} {error}") from error


PAGE = 4096
"""Bytes that have a checksum of their own."""
OFFSETS = "starts"
"""Type of columns that `narrow_offsets` makes: of 32 or 64 bits."""
PAGE_CHECKSUMS = "pages"
"""Column of these checksums: of all that are read in pages, in the order of their names."""


def add_page_checksums(
    arrays: Mapping[str, NDArray[Any]], paged: Collection[str]
) -> dict[str, NDArray[Any]]:
    """Arrays of a map file, with the checksums of those that are to be read in pages."""
    columns = {name: to_plain_array(name, a) for name, a in arrays.items()}
    sums = [
        crc32(block[at : at + PAGE])
        for name in sorted(paged)
        for block in (columns[name].reshape(-1).view(np.uint8).data,)
        for at in range(0, len(block), PAGE)
    ]
    return {**columns, PAGE_CHECKSUMS: np.array(sums, np.uint32)}


@dataclass(frozen=True, eq=False)
class PagedColumn:
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
            raise damage_error(self.path, f"column {self.name!r} does not fit its checksum")
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
class PagedTexts(Sequence[str]):
    """Strings of a file: where each begins, and the bytes of all."""

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
        """One string, or some; `MapError` where the file is damaged."""
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
            return [blob[a:b].decode() for a, b in itertools.pairwise(cuts)]
        except UnicodeDecodeError as error:
            raise damage_error(
                self.text.path, f"column {self.text.name!r} is no text: {error.reason}"
            ) from error


def read_offsets(starts: PagedColumn, first: int, last: int, size: int) -> list[int]:
    """Where stretches of a column of this size begin, and the last ends; `MapError` where they cannot."""
    ends: list[int] = starts[first : last + 1].tolist()
    if any(a > b for a, b in itertools.pairwise(ends)) or ends[-1] > size:
        raise damage_error(starts.path, f"column {starts.name!r} points beyond what it is of")
    return ends


def pack_texts(texts: Sequence[str]) -> tuple[NDArray[np.unsignedinteger[Any]], NDArray[np.uint8]]:
    """Columns of `PagedTexts`."""
    parts = [text.encode() for text in texts]
    return narrow_offsets([len(part) for part in parts]), np.frombuffer(b"".join(parts), np.uint8)


def narrow_offsets(
    sizes: Sequence[int] | NDArray[np.integer[Any]],
) -> NDArray[np.unsignedinteger[Any]]:
    """Where stretches begin, and the last ends (N + 1,); in 32 bits where these do."""
    ends = np.concatenate(([0], np.cumsum(sizes, dtype=np.int64)))
    return ends.astype(np.uint32 if ends[-1] < 1 << 32 else np.uint64)


def open_pages(
    path: Path, kind: str, version: int, paged: Mapping[str, str], mend: str
) -> tuple[MapFile, dict[str, PagedColumn]]:
    """A map file with its other columns, and those of `paged` (names and types) to be read in pages.

    Raises
    ------
    InputError
        The file is missing, empty, a folder, or may not be read.
    MapError
        Its head or another column is damaged; it is of another kind or version.

    """
    with open_file(path) as file:
        header, start = read_head(file, path), file.tell()
        if (header.kind, header.version) != (kind, version):
            raise MapError(
                f"{path} is a {header.kind} map of version {header.version}, and not a {kind} map of "
                f"version {version}. {mend}"
            )
        lie = [
            b for b in header.blocks if b.name in (*paged, PAGE_CHECKSUMS) and is_mappable(b, start)
        ]
        watch = files.FileWatch(file, path)
        arrays = {b.name: read_block(file, start, path, b) for b in header.blocks if b not in lie}
        arrays |= {b.name: a for b, a in map_blocks(file, lie, start).items()} if lie else {}
    made = MapFile(header, arrays, watch)
    sums, found, at = made.array(PAGE_CHECKSUMS, "<u4"), {}, 0
    mapped = {b.name for b in lie}
    for name in sorted(paged):
        values = _column(made, name, paged[name])
        n = -(-values.nbytes // PAGE)
        good = bytearray(n) if name in mapped else bytearray(b"\1" * n)
        found[name] = PagedColumn(path, name, values, sums[at : at + n], good)
        at += n
    if at != len(sums):
        raise damage_error(path, f"it has {len(sums)} checksums of {at} pages")
    return made, found


def _column(file: MapFile, name: str, dtype: str) -> NDArray[Any]:
    """Column of a type."""
    held = file.arrays.get(name)
    short = dtype == OFFSETS and held is not None and held.dtype == np.uint32
    return file.array(name, "<u4" if short else "<u8" if dtype == OFFSETS else dtype)
