"""Things put aside on disk by tile, until the tile's turn comes.

A file is a row of frames. Each has a head, and then, little-endian: types and kinds (a byte each), ids
(8), how many parts each thing and how many points each part has (4), longitudes and latitudes in
steps of 1e-7 degrees (4 each), and the texts in UTF-8, all squeezed by zlib. The files live until
their tile is built.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from placegraph.core.mapfile import starts
from placegraph.errors import MapError
from placegraph.outdoor.map.extract import THING, Things

HEAD = struct.Struct("<4sQIIII")
"""Magic, bytes that follow, crc32 of these and of the numbers behind it: things, parts, points."""
_SIZES = struct.Struct("<III")
MAGIC = b"PGS2"
ROOM = 64 << 20
"""Bytes that wait in memory until they are written."""


def packed(things: Things) -> bytes:
    """A frame of things."""
    columns = (
        things.osm_type, things.kind, things.osm_id.astype("<i8"),
        np.diff(things.part_starts).astype("<u4"), np.diff(things.point_starts).astype("<u4"),
        things.steps.astype("<i4"),
    )  # fmt: skip
    data = b"".join([c.tobytes() for c in columns] + [THING.join(things.texts).encode()])
    data = zlib.compress(data, 1)
    sizes = len(things), len(things.point_starts) - 1, len(things.steps)
    return HEAD.pack(MAGIC, len(data), _crc(data, *sizes), *sizes) + data


def _crc(data: bytes, *sizes: int) -> int:
    return zlib.crc32(data, zlib.crc32(_SIZES.pack(*sizes)))


def _unpacked(data: bytes, n: int, parts: int, points: int) -> Things:
    data, at, columns = zlib.decompress(data), 0, []
    for dtype, count in (
        ("u1", n),
        ("u1", n),
        ("<i8", n),
        ("<u4", n),
        ("<u4", parts),
        ("<i4", 2 * points),
    ):
        columns.append(np.frombuffer(data, dtype, count, at))
        at += columns[-1].nbytes
    osm_type, kind, osm_id, n_parts, n_points, steps = columns
    texts = str(data[at:], "utf-8").split(THING)
    return Things(
        osm_type, osm_id, kind, starts(n_parts), starts(n_points), steps.reshape(-1, 2), texts
    )


class Spills:
    """Files of a folder, ``KEY.things``, to which frames are added in any order.

    `sizes` are those of a folder that was begun before: what its files hold beyond, or besides, was
    not finished, and is taken away. Raises `MapError` where the disk is full.
    """

    def __init__(self, folder: Path, sizes: Mapping[str, int] | None = None) -> None:
        self.folder = folder
        self.sizes = dict(sizes or {})
        """Bytes of each file so far, by key."""
        for path in folder.glob("*.things"):
            if path.stem in self.sizes:
                os.truncate(path, self.sizes[path.stem])
            else:
                path.unlink()
        self._waiting: dict[str, list[bytes]] = {}
        self._bytes = 0

    @property
    def full(self) -> bool:
        """Whether it is time to `flush`."""
        return self._bytes > ROOM // 2

    def add(self, key: str, things: Things) -> None:
        """Put things to a tile's."""
        frame = packed(things)
        self._waiting.setdefault(key, []).append(frame)
        self._bytes += len(frame)
        if self._bytes > ROOM:
            self.flush()

    def flush(self) -> None:
        """Write what waits in memory."""
        for key, frames in self._waiting.items():
            path = self.folder / f"{key}.things"
            try:
                with path.open("ab") as file:
                    file.writelines(frames)
            except OSError as error:
                raise no_room(path, error) from error
            self.sizes[key] = self.sizes.get(key, 0) + sum(map(len, frames))
        self._waiting, self._bytes = {}, 0


def things_of(path: Path, size: int) -> list[Things]:
    """Frames of a file of so many bytes; raises `MapError` where it was damaged."""
    mend = f"{path} is damaged; remove the folder {path.parent.parent} and build again."
    found = []
    try:
        with path.open("rb") as file:
            while head := file.read(HEAD.size):
                if len(head) < HEAD.size:
                    raise MapError(mend)
                magic, length, crc, *sizes = HEAD.unpack(head)
                size -= HEAD.size + length
                if magic != MAGIC or size < 0:
                    raise MapError(mend)
                data = file.read(length)
                if _crc(data, *sizes) != crc:
                    raise MapError(mend)
                found.append(_unpacked(data, *sizes))
    except OSError as error:
        raise MapError(f"{mend[:-1]} ({error.strerror}).") from error
    if size:
        raise MapError(mend)
    return found


def no_room(path: Path, error: OSError) -> MapError:
    """What is raised where a build cannot go on writing."""
    return MapError(
        f"{path} cannot be written: {error.strerror or error}. Make room, or mend what is in the "
        "way; the same command then goes on where it stopped."
    )
