"""Depth images packed by RVL (A. D. Wilson, "Fast Lossless Depth Image Compression", 2017)."""

from __future__ import annotations

from struct import unpack

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError

_MOST = 1 << 24  # pixels; no sensor of depth has as many, and a few bytes could claim any number
_LONGEST = 10  # nibbles of three bits that a number of 30 bits has


def rvl_size(data: bytes) -> tuple[int, int]:
    """Width and height [px], which stand before the pixels as those who pack by RVL write them."""
    width, height = unpack("<II", data[:8].ljust(8, b"\0"))
    return width, height


def rvl_image(data: bytes, name: str) -> NDArray[np.uint16]:
    """Image (h, w) uint16: width and height as uint32, little-endian, and the pixels' stream.

    Raises `InputError`, which begins with `name`, where the stream does not make up the image.
    """
    width, height = rvl_size(data)
    if not 0 < width * height <= _MOST:
        raise InputError(f"{name} says it has {width} x {height} pixels; record that image again.")
    if len(data) - 8 > 3 * width * height + 16:  # the worst that packing can do
        raise InputError(f"{name}: {len(data):,} bytes are too many for {width} x {height} pixels.")
    pixels = _pixels(_numbers(data[8:]), width * height)
    if pixels is None:
        raise InputError(f"{name} ends before its {width} x {height} pixels; copy the file again.")
    return pixels.reshape(height, width)


def _numbers(data: bytes) -> NDArray[np.int64]:
    """Whole numbers of a stream of nibbles, three bits each, low ones first; 8: more follow."""
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
