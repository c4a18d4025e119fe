"""Columns as bytes: arrays of plain numbers, and text, made small and quick to open.

A filter brings like next to like, a codec squeezes; per column whichever pair is best is kept.
The choice and the figures behind it: `docs/formats.md`.
"""

from __future__ import annotations

import lzma
import zlib
from collections.abc import Sequence
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import MapError, OptionError

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


def plain(name: str, array: NDArray[Any]) -> NDArray[Any]:
    """Array in C order and little-endian; `OptionError` where it is not plain numbers."""
    array = np.asarray(array)
    dtype = array.dtype.newbyteorder("<")
    if dtype.str not in DTYPES or array.ndim == 0:
        raise OptionError(
            f"Column {name!r} is {array.dtype} with {array.ndim} dimensions; a map holds arrays "
            "of plain numbers (text: `pack_strings`; single values: metadata)."
        )
    return np.ascontiguousarray(array, dtype)


def pack(
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


def unpack(
    codec: str, filter_: str, block: memoryview, dtype: str, shape: tuple[int, ...]
) -> NDArray[Any]:
    """Undo `pack`; the array is read-only.

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


def starts(lengths: Sequence[int] | NDArray[np.integer]) -> NDArray[np.int64]:
    """Bounds (N + 1,) of entries of these lengths (N,)."""
    return np.concatenate(([0], np.cumsum(lengths, dtype=np.int64)))


def spans(
    bounds: NDArray[np.int64], rows: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Bounds (K + 1,) of the entries of `rows` (K,) set side by side, and which entries they are."""
    lengths = bounds[rows + 1] - bounds[rows]
    made = starts(lengths)
    return made, np.repeat(bounds[rows] - made[:-1], lengths) + np.arange(made[-1])
