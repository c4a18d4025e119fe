"""Compressed parts of bags, unpacked no further than a bag may have them."""

from __future__ import annotations

import bz2
import sys
from typing import Any

from placegraph.errors import InputError

MOST = 1 << 30
"""Bytes of a message or of an unpacked chunk beyond which a number is not believed."""
_STEP = 1 << 18  # bytes at once: little more than is read, and none of it copied in vain


class Packed:
    """Compressed bytes, unpacked from their beginning as far as somebody reads."""

    def __init__(self, data: bytes, compression: str, name: str) -> None:
        """`name` is what the parts are called in messages: "walk.mcap, the chunk at byte 8,"."""
        self._unpacker = _unpacker(compression, name)
        self._left, self._content, self._name = data, bytearray(), name

    def read(self, offset: int, count: int) -> bytes:
        """At most `count` bytes: fewer where they end. `InputError`: damaged, or beyond `MOST`."""
        if offset + count > MOST:
            raise InputError(
                f"{self._name} would unpack to more than {MOST:,} bytes; it is refused."
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
