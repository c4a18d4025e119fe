"""Areas of multipolygon relations, assembled by osmium in a process that may die of it.

Osmium assembles them in C++, and some damaged files end the process there. Run as a file, so it imports
nothing of placegraph and starts in a sixth of a second. It answers small files of relations, their ways and
their nodes, each behind its length, by the ids of areas and their outlines as WKB, behind the length of all.
"""

from __future__ import annotations

import signal
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

_LENGTH, _AREA = struct.Struct("<Q"), struct.Struct("<qI")


def assembled(pbf: bytes) -> bytes:
    """Ids and outlines of the areas of a small file; what has none is left out."""
    import osmium

    factory, found = osmium.geom.WKBFactory(), []
    relations = osmium.filter.EntityFilter(osmium.osm.AREA)
    file = osmium.FileProcessor(osmium.io.FileBuffer(pbf, "pbf"))
    areas: Iterator[Any] = iter(file.with_areas().with_filter(relations))
    for area in areas:
        with suppress(RuntimeError, osmium.InvalidLocationError):
            wkb = bytes.fromhex(factory.create_multipolygon(area))
            found.append(_AREA.pack(area.orig_id(), len(wkb)) + wkb)
    return b"".join(found)


class Assembler:
    """The process, started when it is first asked; where none can be, as in a sandbox, this one does it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._process: subprocess.Popen[bytes] | None = None
        self._alone = False

    def areas(self, pbf: bytes) -> Iterator[tuple[int, bytes]]:
        """Ids of relations, and their areas as WKB; `InputError` where the process dies of it."""
        told = self._told(pbf)
        at = 0
        while at < len(told):
            identity, n = _AREA.unpack_from(told, at)
            at += _AREA.size
            yield identity, told[at : at + n]
            at += n

    def _told(self, pbf: bytes) -> bytes:
        if self._process is None and not self._alone:
            command, pipe = [sys.executable, "-P", __file__], subprocess.PIPE
            try:
                self._process = subprocess.Popen(  # noqa: S603  # our own interpreter and file
                    command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL
                )
            except OSError:
                self._alone = True
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            return assembled(pbf)
        with suppress(BrokenPipeError):
            process.stdin.write(_LENGTH.pack(len(pbf)) + pbf)
            process.stdin.flush()
        told = _message(process.stdout)
        if told is None:
            from placegraph.errors import InputError

            died = process.wait()
            why = f", by {signal.strsignal(-died)}" if died < 0 else ""
            raise InputError(
                f"{self.path} is damaged: assembling its areas ends osmium{why}. Download or export it "
                "again."
            )
        return told

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            with suppress(BrokenPipeError, ValueError):
                self._process.communicate()


def _message(file: IO[bytes]) -> bytes | None:
    head = file.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (size,) = _LENGTH.unpack(head)
    data = file.read(size)
    return data if len(data) == size else None


if __name__ == "__main__":
    while (asked := _message(sys.stdin.buffer)) is not None:
        answer = assembled(asked)
        sys.stdout.buffer.write(_LENGTH.pack(len(answer)) + answer)
        sys.stdout.buffer.flush()
