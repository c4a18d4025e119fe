"""Osmium in processes of its own: damaged files may end a process in C++, and then end only these.

`convert` writes any form of OpenStreetMap data as PBF, `Assembler` assembles areas of multipolygon
relations. Run as a file, this module imports nothing of placegraph and starts in a sixth of a second.
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


def convert(source: str, form: str, made: str) -> None:
    """Write a file of osmium's format `form` as PBF; raise `ValueError`, `RuntimeError`: it is none."""
    import osmium

    writer = osmium.WriteHandler(made)
    try:
        osmium.apply(osmium.io.Reader(osmium.io.File(source, form)), writer)
    except osmium.InvalidLocationError as error:  # is none of Python's own
        raise ValueError(str(error)) from error
    finally:
        writer.close()


def assemble(pbf: bytes) -> bytes:
    """Return ids and outlines (WKB) of the areas of a small file; relations without an area are left out."""
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
    """Process that assembles areas, started at its first use; where none can be, this process does it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._process: subprocess.Popen[bytes] | None = None
        self._is_refused = False

    def areas(self, pbf: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield ids of relations and their areas as WKB; raise `InputError` where the process dies of it."""
        answer, at = self._ask(pbf), 0
        while at < len(answer):
            identity, n = _AREA.unpack_from(answer, at)
            at += _AREA.size
            yield identity, answer[at : at + n]
            at += n

    def _ask(self, pbf: bytes) -> bytes:
        if self._process is None and not self._is_refused:
            command, pipe = [sys.executable, "-P", __file__, "areas"], subprocess.PIPE
            try:
                self._process = subprocess.Popen(  # noqa: S603  # our own interpreter and file
                    command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL
                )
            except OSError:  # as in a sandbox
                self._is_refused = True
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            return assemble(pbf)
        with suppress(BrokenPipeError):
            process.stdin.write(_LENGTH.pack(len(pbf)) + pbf)
            process.stdin.flush()
        answer = _read_message(process.stdout)
        if answer is None:
            from placegraph.errors import InputError

            died = process.wait()
            why = f", by {signal.strsignal(-died)}" if died < 0 else ""
            raise InputError(
                f"{self.path} is damaged: osmium crashed while assembling its areas{why}. "
                "Download or export it again."
            )
        return answer

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            with suppress(BrokenPipeError, ValueError):
                self._process.communicate()


def _read_message(file: IO[bytes]) -> bytes | None:
    """Read bytes behind their length; None where the stream has ended."""
    head = file.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (size,) = _LENGTH.unpack(head)
    data = file.read(size)
    return data if len(data) == size else None


if __name__ == "__main__":
    if sys.argv[1] == "convert":
        try:
            convert(*sys.argv[2:])
        except (OSError, RuntimeError, ValueError) as error:
            sys.exit(str(error))
    else:
        while (asked := _read_message(sys.stdin.buffer)) is not None:
            answer = assemble(asked)
            sys.stdout.buffer.write(_LENGTH.pack(len(answer)) + answer)
            sys.stdout.buffer.flush()
