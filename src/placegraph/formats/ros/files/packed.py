"""Compressed parts of bags, unpacked no further than a bag may have them."""

from __future__ import annotations

import bz2
import sys
from typing import Any

from placegraph.errors import InputError

MOST = 1 << 30
"""Bytes of a message or of an unpacked chunk beyond which a number is not believed."""


def inflated(data: bytes, compression: str, name: str) -> bytes:
    """Content of compressed bytes; `InputError`, which begins with `name`: damaged, or too large."""
    unpacker = _unpacker(compression, name)
    try:
        content: bytes = unpacker.decompress(data, MOST)
    except Exception as error:  # each library has its own, without a common root
        raise InputError(f"{name} is damaged ({error}); copy the bag again.") from error
    if len(content) >= MOST:
        raise InputError(f"{name} would unpack to more than {MOST:,} bytes; it is refused.")
    return content


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
