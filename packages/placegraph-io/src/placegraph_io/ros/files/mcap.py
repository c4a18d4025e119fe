"""The index of an MCAP file (https://mcap.dev/spec): its own, or, where it is cut off, one made here.

Libraries read whole chunks; of a bag of gigabytes that is all of it, for a few transforms.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from struct import unpack_from
from typing import NamedTuple

import numpy as np

from placegraph.errors import InputError
from placegraph_io.ros.files.packed import MOST
from placegraph_io.ros.files.storage import Chunk, File, Part

MAGIC = b"\x89MCAP0\r\n"
_FOOTER = 37
_SCHEMA, _CHANNEL, MESSAGE, CHUNK, _INDEX, _CHUNK_INDEX = 3, 4, 5, 6, 7, 8
_FEW = 1 << 20  # bytes of a schema or channel
_LIMIT = 1 << 28  # of the summary of a file


class Cut(Exception):  # noqa: N818  # no error of the user's
    """The file has no whole index."""


class _Channel(NamedTuple):
    topic: str
    type: str
    encoding: str


class Channels:
    """What is told of topics and their types."""

    def __init__(self) -> None:
        self.schemas: dict[int, str] = {}
        self.channels: dict[int, _Channel] = {}

    def told(self, op: int, data: bytes) -> None:
        """Take in a record of a schema or of a channel; one that is damaged is none."""
        with suppress(struct.error):
            if op == _SCHEMA:
                (number,) = unpack_from("<H", data)
                self.schemas[number] = _text(data, 2)[0]
            elif op == _CHANNEL:
                number, schema = unpack_from("<HH", data)
                topic, at = _text(data, 4)
                encoding, _ = _text(data, at)
                self.channels[number] = _Channel(topic, self.schemas.get(schema, ""), encoding)


class _Index(Channels):
    """What is found of a file: its channels, and where their messages lie."""

    def __init__(self, file: File) -> None:
        super().__init__()
        self.file = file
        self.chunks: list[Chunk] = []
        self.found: dict[int, list[tuple[int, np.ndarray]]] = defaultdict(list)

    def walk(self, chunk: Chunk) -> bool:
        """Index the records of a chunk one by one; whether it is whole."""
        row, rows, whole = len(self.chunks), defaultdict(list), True
        self.chunks.append(chunk)
        at = 0
        while head := chunk.peek(at, 31):
            if len(head) < 9:
                whole = False
                break
            op, length = unpack_from("<BQ", head)
            if length > MOST or not (length == 0 or chunk.peek(at + 8 + length, 1)):
                whole = False
                break
            if op == MESSAGE and length >= 22:
                channel, _, time = unpack_from("<HIQ", head, 9)
                rows[channel].append((time, at))
            elif op in {_SCHEMA, _CHANNEL}:
                self.told(op, chunk.peek(at + 9, min(length, _FEW)))
            at += 9 + length
        for channel, found in rows.items():
            self.found[channel].append((row, np.array(found, np.uint64)))
        return whole

    def parts(self) -> Iterator[Part]:
        """Messages by channel."""
        for number, found in self.found.items():
            channel = self.channels[number]
            rows = np.concatenate([pairs for _, pairs in found]).astype(np.int64)
            which = np.repeat([row for row, _ in found], [len(pairs) for _, pairs in found])
            yield Part(*channel, rows[:, 0], self.chunks, which, rows[:, 1])


def read_mcap(path: Path, notes: list[str]) -> list[Part]:
    """Messages of a file by topic; `notes` is told where its index is missing.

    Raises `InputError` where it is no MCAP or holds nothing that can be read.
    """
    file = File(path)
    if file.read(0, 8) != MAGIC:
        raise InputError(
            f"{path} is no MCAP file, or its beginning is lost; record or copy it again."
        )
    try:
        index = _listed(file)
    except (Cut, struct.error, ValueError) as error:
        index = _scanned(file)
        notes.append(
            f"{path.name}: {error if isinstance(error, Cut) else 'its index is damaged'}; it is read "
            "as far as it goes. `mcap recover` makes it whole."
        )
    if not index.found:
        raise InputError(f"{path} holds no message; record again.")
    return list(index.parts())


def is_whole(path: Path) -> bool:
    """Whether an MCAP has its end; else it was cut off, or is still being written."""
    file = File(path)
    return file.read(max(file.size - len(MAGIC), 1), len(MAGIC)) == MAGIC


def _listed(file: File) -> _Index:
    """By the summary at the end, and the index behind every chunk."""
    size = file.size
    end = file.read(max(size - _FOOTER, 0), _FOOTER)
    if end[-8:] != MAGIC or end[:1] != b"\x02":
        raise Cut("the file was cut off, for it has no end")
    (start,) = unpack_from("<Q", end, 9)
    if not 0 < start < size or size - start > _LIMIT:
        raise Cut("it was written without an index")
    summary = file.read(start, size - start - _FOOTER)
    index = _Index(file)
    for op, at, length in records(summary):
        if op in {_SCHEMA, _CHANNEL}:
            index.told(op, summary[at : at + length])
        elif op == _CHUNK_INDEX:
            _chunk(index, summary, at)
    if set(index.found) - set(index.channels) or not index.found:
        raise Cut("it was written without an index")
    return index


def _chunk(index: _Index, summary: bytes, at: int) -> None:
    """Take in a record of a chunk, and what stands behind it on its messages."""
    _, _, start, length, entries = unpack_from("<QQQQI", summary, at)
    at += 36 + entries
    (behind,) = unpack_from("<Q", summary, at)
    compression, at = _text(summary, at + 8)
    (packed,) = unpack_from("<Q", summary, at)
    head = 9 + 28 + 4 + len(compression) + 8
    chunk = Chunk(index.file, start + head, packed, compression)
    if not entries or not behind:
        index.walk(chunk)
        return
    row = len(index.chunks)
    index.chunks.append(chunk)
    said = index.file.read(start + length, min(behind, _LIMIT))
    for op, where, _ in records(said):
        if op == _INDEX:
            channel, count = unpack_from("<HI", said, where)
            if count:
                pairs = np.frombuffer(said, "<u8", count // 8, where + 6).reshape(-1, 2)
                index.found[channel].append((row, pairs))


def _scanned(file: File) -> _Index:
    """By all records from the first, until the file ends."""
    index, size, at = _Index(file), file.size, len(MAGIC)
    loose = False
    while at + 9 <= size:
        head = file.read(at, 80)
        op, length = unpack_from("<BQ", head)
        if op == CHUNK and len(head) >= 41:
            (name,) = unpack_from("<I", head, 37)
            if name > 16:
                break
            compression = head[41 : 41 + name].decode("ascii", "replace")
            start = at + 9 + 28 + 4 + name + 8
            whole = at + 9 + length <= size
            if whole or not compression:  # of a packed chunk that is cut, nothing can be said
                index.walk(Chunk(file, start, min(at + 9 + length, size) - start, compression))
        elif op in {_SCHEMA, _CHANNEL} and length <= _FEW:
            index.told(op, file.read(at + 9, length))
        loose |= op == MESSAGE
        at += 9 + length
    if loose:  # messages outside of chunks
        index.walk(Chunk(file, len(MAGIC), size - len(MAGIC)))
    known = {n: found for n, found in index.found.items() if n in index.channels}
    index.found.clear()
    index.found.update(known)
    return index


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Kind, start and length of each record of some bytes."""
    at = 0
    while at + 9 <= len(data):
        op, length = unpack_from("<BQ", data, at)
        at += 9
        if at + length > len(data):
            raise Cut("its index is damaged")
        yield op, at, length
        at += length


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Text with its length before it, and what comes after."""
    (length,) = unpack_from("<I", data, at)
    return data[at + 4 : at + 4 + length].decode(errors="replace"), at + 4 + length
