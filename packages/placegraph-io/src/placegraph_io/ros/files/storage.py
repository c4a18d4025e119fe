"""Messages of a bag where they lie: found by an index, and read one by one when they are asked for.

A message has a place: a `Block` (a chunk of an MCAP or of a rosbag1, or a database) and an offset in
it. Of a block that is not compressed nothing but the message itself is read.
"""

from __future__ import annotations

import os
import struct
import weakref
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from struct import unpack_from
from threading import Lock
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular
from placegraph.errors import InputError
from placegraph_io.database import Database
from placegraph_io.ros.files.packed import MOST, Packed

_HEAD = 160
"""Bytes before a message, at most: of MCAP 31, of rosbag1 fields of its own."""
_SMALL = 1024
"""Bytes of a message that are read at once with what stands before it."""
_KEPT = 2  # unpacked chunks of a file: colour and depth of a moment mostly lie in one


class Place(Protocol):
    """What messages lie in."""

    @property
    def path(self) -> Path:
        """File."""

    def read(self, offset: int, most: int | None = None) -> bytes:
        """Bytes of the message at an offset, all or the first `most`; `InputError`: none lies there."""


class File:
    """A file that is read at any place, by any thread; opened when first asked, and again elsewhere."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handle: int | None = None
        self._lock = Lock()
        self._unpacked: OrderedDict[int, Packed] = OrderedDict()

    def __reduce__(self) -> tuple[type[File], tuple[Path]]:
        return File, (self.path,)

    def read(self, start: int, count: int) -> bytes:
        """At most `count` bytes from `start`: fewer where the file ends, wherever that would be."""
        if not (0 <= start < 1 << 62 and count > 0):
            return b""
        if self._handle is None:
            with self._lock:
                if self._handle is None:
                    try:
                        handle = os.open(
                            regular(self.path), os.O_RDONLY | getattr(os, "O_CLOEXEC", 0)
                        )
                    except OSError as error:
                        raise InputError(
                            f"{self.path} cannot be read: {error.strerror}."
                        ) from error
                    weakref.finalize(self, os.close, handle)
                    self._handle = handle
        return os.pread(self._handle, count, start)

    @property
    def size(self) -> int:
        """Bytes."""
        return self.path.stat().st_size

    def unpacked(self, chunk: Chunk, offset: int, count: int) -> bytes:
        """At most `count` bytes of a compressed part; the last ones are kept as far as unpacked."""
        with self._lock:
            packed = self._unpacked.pop(chunk.start, None)
        if packed is None:
            name = f"{self.path}, the chunk at byte {chunk.start},"
            data = self.read(chunk.start, min(chunk.size, MOST))
            packed = Packed(data, chunk.compression, name)
        content = packed.read(offset, count)
        with self._lock:
            self._unpacked[chunk.start] = packed
            while len(self._unpacked) > _KEPT:
                self._unpacked.popitem(last=False)
        return content


@dataclass(frozen=True, slots=True)
class Chunk:
    """A part of an MCAP or of a rosbag1 that holds records, packed or not."""

    file: File
    start: int
    size: int
    """Bytes in the file."""
    compression: str = ""
    rosbag1: bool = False

    @property
    def path(self) -> Path:
        """File."""
        return self.file.path

    def peek(self, offset: int, count: int) -> bytes:
        """Bytes of the unpacked chunk; fewer where it ends."""
        if self.compression:
            return self.file.unpacked(self, offset, count)
        return self.file.read(self.start + offset, max(0, min(count, self.size - offset)))

    def read(self, offset: int, most: int | None = None) -> bytes:
        """As `Place.read`."""
        head = self.peek(offset, _HEAD + min(most or _SMALL, _SMALL))
        try:
            if self.rosbag1:
                (fields,) = unpack_from("<I", head)
                skip = 8 + fields
                (length,) = unpack_from("<I", head, skip - 4)
            else:
                op, length = unpack_from("<BQ", head)
                skip, length = 31, length - 22 if op == 5 else -1
        except struct.error as error:
            raise self._broken(offset) from error
        if not 0 <= length < MOST:
            raise self._broken(offset)
        count = length if most is None else min(length, most)
        enough = len(head) >= skip + count
        data = head[skip : skip + count] if enough else self.peek(offset + skip, count)
        if len(data) != count:
            raise self._broken(offset)
        return data

    def _broken(self, offset: int) -> InputError:
        return InputError(
            f"{self.path}: no message lies at byte {offset} of the chunk at {self.start}, where the "
            "index says so; the bag is damaged: copy it again, or make its index anew."
        )


class Messages(Database):
    """A rosbag2 database (.db3), whose messages are rows."""

    def __init__(self, path: Path, *, packed: bool = False) -> None:
        """Open it for reading; `packed`: each message is compressed by zstd."""
        super().__init__(path)
        self.packed = packed

    def __reduce__(self) -> tuple[Any, ...]:
        return _messages, (self.path, self.packed)

    def read(self, offset: int, most: int | None = None) -> bytes:
        """As `Place.read`; the offset is the row's id."""
        name = f"{self.path}: message {offset}"
        data = self.blob(("messages", "data", offset), name, None if self.packed else most)
        if self.packed:
            whole = MOST if most is None else most
            return Packed(data, "zstd", f"{self.path}, message {offset},").read(0, whole)
        return data


def _messages(path: Path, packed: bool) -> Messages:
    return Messages(path, packed=packed)


class Message(NamedTuple):
    """One message, not yet read."""

    place: Place
    offset: int

    def read(self) -> bytes:
        """Its bytes."""
        return self.place.read(self.offset)


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """Messages of one name and type, by the time at which they were recorded."""

    name: str
    type: str
    """As ROS 2 names it: `sensor_msgs/msg/Image`."""
    encoding: str
    """`cdr` (ROS 2), `ros1`, or something else, which is not read."""
    times: NDArray[np.int64]
    """(N,) ascending [ns]."""
    places: tuple[Place, ...]
    which: NDArray[np.int64]
    """(N,) row of `places`."""
    offsets: NDArray[np.int64]
    """(N,) of the message in its place."""

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, row: int) -> Message:
        return Message(self.places[self.which[row]], int(self.offsets[row]))

    @property
    def short(self) -> str:
        """Its type as people say it: `sensor_msgs/Image`."""
        return self.type.replace("/msg/", "/")


def read_all(
    wanted: Sequence[tuple[Topic, NDArray[np.intp] | None, int | None]],
) -> list[list[bytes]]:
    """Messages of several topics, each of its rows (None: all) whole or its first bytes.

    They are read in the order in which they lie, so that every chunk is unpacked once.
    """
    out: list[list[bytes]] = []
    todo: list[tuple[str, int, int, int, int]] = []
    for n, (topic, rows, _) in enumerate(wanted):
        chosen = np.arange(len(topic)) if rows is None else rows
        out.append([b""] * len(chosen))
        starts = [(str(p.path), p.start if isinstance(p, Chunk) else 0) for p in topic.places]
        todo.extend(
            (*starts[topic.which[row]], int(topic.offsets[row]), n, i)
            for i, row in enumerate(chosen)
        )
    for *_, n, i in sorted(todo):
        topic, rows, most = wanted[n]
        message = topic[i if rows is None else int(rows[i])]
        out[n][i] = message.place.read(message.offset, most)
    return out


class Part(NamedTuple):
    """Messages of one topic in one file."""

    name: str
    type: str
    encoding: str
    times: NDArray[np.int64]
    places: Sequence[Place]
    which: NDArray[np.int64]
    offsets: NDArray[np.int64]


def joined(parts: Sequence[Part]) -> Iterator[Topic]:
    """Topics of the parts of all files of a bag; of types that share a name, the most frequent."""
    names: dict[str, dict[tuple[str, str], list[Part]]] = {}
    for part in parts:
        names.setdefault(part.name, {}).setdefault((part.type, part.encoding), []).append(part)
    for name, kinds in names.items():
        (kind, encoding), held = max(kinds.items(), key=lambda k: sum(len(p.times) for p in k[1]))
        times = np.concatenate([p.times for p in held])
        order = np.argsort(times, kind="stable")
        before = np.cumsum([0, *(len(p.places) for p in held)])
        which = np.concatenate([p.which + n for p, n in zip(held, before[:-1], strict=True)])
        yield Topic(
            name=name, type=kind, encoding=encoding, times=times[order],
            places=tuple(place for p in held for place in p.places), which=which[order],
            offsets=np.concatenate([p.offsets for p in held])[order],
        )  # fmt: skip
