"""Frames of one size, packed into one raw deflate stream, read by number."""

from __future__ import annotations

import zlib
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple

from placegraph.errors import InputError
from placegraph.files import regular

if TYPE_CHECKING:
    from pathlib import Path

_PART = 1 << 16  # bytes of the file at once
_MARKED = 100  # frames between places from which reading can go on, each some 50 kB of memory


class _Mark(NamedTuple):
    """Where a frame begins."""

    unpacker: Any
    """With what it was given and has not unpacked."""
    offset: int
    """Of the file, behind that."""


class Deflated:
    """Frames of `size` bytes each; in order is fastest. Opened again where it is sent to."""

    def __init__(self, path: Path, size: int) -> None:
        self.path, self.size = path, size
        self._lock = Lock()
        self._marks = {0: _Mark(zlib.decompressobj(-zlib.MAX_WBITS), 0)}
        self._at, self._number = self._marks[0], 0

    def __reduce__(self) -> tuple[type[Deflated], tuple[Path, int]]:
        return Deflated, (self.path, self.size)

    def read(self, number: int) -> bytes:
        """Bytes of a frame; `InputError` where the stream ends before it or is damaged."""
        with self._lock:
            nearest = max(n for n in self._marks if n <= number)
            if not nearest <= self._number <= number:
                self._at, self._number = self._marks[nearest], nearest
            try:
                with regular(self.path).open("rb") as file:
                    return self._forward(file, number)
            except (OSError, zlib.error) as error:
                raise InputError(f"{self.path} cannot be read ({error}); copy it again.") from error

    def _forward(self, file: Any, number: int) -> bytes:  # noqa: ANN401  # a file
        unpacker = self._at.unpacker.copy()
        file.seek(self._at.offset)
        frame = b""
        while self._number <= number:
            parts, missing = [], self.size
            while missing:
                packed = unpacker.unconsumed_tail or file.read(_PART)
                parts.append(unpacker.decompress(packed, missing))
                missing -= len(parts[-1])
                if unpacker.eof or not (packed or parts[-1]):
                    break
            if missing:
                raise InputError(f"{self.path} ends before frame {number}; copy it again.")
            frame = b"".join(parts)
            self._number += 1
            self._at = _Mark(unpacker.copy(), file.tell())
            if self._number % _MARKED == 0:
                self._marks[self._number] = self._at
        return frame
