"""Bags of ROS (MCAP, rosbag2's SQLite, rosbag1): an index in memory, messages read on demand.

A message has a store (a chunk of an MCAP or a rosbag1, or a database) and an offset in it. Only the
message itself is read from an uncompressed chunk. `rosbags` reads whole chunks without a limit and refuses
truncated files, so MCAP and databases are read here (transforms of a bag of 270 MB: 0.01 s instead of
0.16 s; compressed: 0.2 s instead of 1.0 s).
"""

from __future__ import annotations

import bz2
import os
import re
import sqlite3
import struct
import weakref
from collections import OrderedDict, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from struct import unpack_from
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.errors import InputError, MissingExtraError
from placegraph_io.storage import LARGEST_MESSAGE, CompressedBytes, Database

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader

_HEAD = 160  # most bytes of a message's header: 31 in MCAP, variable in rosbag1
_SMALL = 1024  # bytes of a message that are read together with its header
_CACHED_CHUNKS = 2  # unpacked chunks of a file: colour and depth of a moment mostly lie in one


class MessageStore(Protocol):
    """Store of messages."""

    @property
    def path(self) -> Path:
        """Path of the file."""

    def read(self, offset: int, most: int | None = None) -> bytes:
        """Read a message, all or the first `most` bytes; `InputError` where the offset is wrong."""


class File:
    """A file for random access from any thread, opened on first use; pickled by its path."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._handle: int | None = None
        self._lock = Lock()
        self._unpacked: OrderedDict[int, CompressedBytes] = OrderedDict()

    def __reduce__(self) -> tuple[type[File], tuple[Path]]:
        return File, (self.path,)

    def read(self, start: int, count: int) -> bytes:
        """Return at most `count` bytes from `start`, fewer at the end of the file."""
        if not (0 <= start < 1 << 62 and count > 0):
            return b""
        if self._handle is None:
            with self._lock:
                if self._handle is None:
                    try:
                        handle = os.open(check_regular(self.path), os.O_RDONLY)
                    except OSError as error:
                        raise InputError(
                            f"{self.path} cannot be read: {error.strerror}."
                        ) from error
                    weakref.finalize(self, os.close, handle)
                    self._handle = handle
        return os.pread(self._handle, count, start)

    @property
    def size(self) -> int:
        """Size [bytes]."""
        return self.path.stat().st_size

    def unpack_chunk(self, chunk: Chunk, offset: int, count: int) -> bytes:
        """Return at most `count` bytes of a compressed chunk; the last chunks are cached."""
        with self._lock:
            packed = self._unpacked.pop(chunk.start, None)
        if packed is None:
            name = f"{self.path}, the chunk at byte {chunk.start},"
            data = self.read(chunk.start, min(chunk.size, LARGEST_MESSAGE))
            packed = CompressedBytes(data, chunk.compression, name)
        content = packed.read(offset, count)
        with self._lock:
            self._unpacked[chunk.start] = packed
            while len(self._unpacked) > _CACHED_CHUNKS:
                self._unpacked.popitem(last=False)
        return content


@dataclass(frozen=True, slots=True)
class Chunk:
    """Chunk of records of an MCAP or a rosbag1, compressed or not."""

    file: File
    start: int
    size: int  # Bytes in the file
    compression: str = ""
    rosbag1: bool = False

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self.file.path

    def peek(self, offset: int, count: int) -> bytes:
        """Return `count` bytes of the unpacked chunk, fewer at its end."""
        if self.compression:
            return self.file.unpack_chunk(self, offset, count)
        return self.file.read(self.start + offset, max(0, min(count, self.size - offset)))

    def read(self, offset: int, most: int | None = None) -> bytes:
        """Read the message at an offset of the unpacked chunk."""
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
        if not 0 <= length < LARGEST_MESSAGE:
            raise self._broken(offset)
        count = length if most is None else min(length, most)
        enough = len(head) >= skip + count
        data = head[skip : skip + count] if enough else self.peek(offset + skip, count)
        if len(data) != count:
            raise self._broken(offset)
        return data

    def _broken(self, offset: int) -> InputError:
        return InputError(
            f"{self.path}: the index points to byte {offset} of the chunk at {self.start}, where "
            "no message begins; the bag is damaged: copy it again, or rebuild its index."
        )


class Messages(Database):
    """A rosbag2 database (.db3), whose messages are rows."""

    def __init__(self, path: Path, *, packed: bool = False) -> None:
        """Open it for reading; `packed`: each message is compressed by zstd."""
        super().__init__(path)
        self.packed = packed

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(Messages, packed=self.packed), (self.path,)

    def read(self, offset: int, most: int | None = None) -> bytes:
        """Read the message of a row; the offset is the row's id."""
        name = f"{self.path}: message {offset}"
        data = self.blob(("messages", "data", offset), name, None if self.packed else most)
        if self.packed:
            limit = LARGEST_MESSAGE if most is None else most
            return CompressedBytes(data, "zstd", f"{self.path}, message {offset},").read(0, limit)
        return data


class Message(NamedTuple):
    """Reference to one message in a store."""

    place: MessageStore
    offset: int

    def read(self) -> bytes:
        """Return the bytes of the message."""
        return self.place.read(self.offset)


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """Messages of one name and type, in the order of their recording."""

    name: str
    type: str  # As ROS 2 names it: `sensor_msgs/msg/Image`
    encoding: str  # `cdr` (ROS 2) or `ros1`; others are not read
    times: NDArray[np.int64]  # (N,) ascending [ns]
    places: tuple[MessageStore, ...]
    which: NDArray[np.int64]  # (N,) row of `places`
    offsets: NDArray[np.int64]  # (N,) offsets in the places

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, row: int) -> Message:
        return Message(self.places[self.which[row]], int(self.offsets[row]))

    @property
    def short(self) -> str:
        """Type without `msg`: `sensor_msgs/Image`."""
        return self.type.replace("/msg/", "/")


def read_messages(
    wanted: Sequence[tuple[Topic, NDArray[np.intp] | None, int | None]],
) -> list[list[bytes]]:
    """Read messages of several topics: topic, rows (None: all) and number of first bytes (None: all).

    They are read in the order of the file, so that every chunk is unpacked once.
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


class TopicPart(NamedTuple):
    """Messages of one topic in one file."""

    name: str
    type: str
    encoding: str
    times: NDArray[np.int64]
    places: Sequence[MessageStore]
    which: NDArray[np.int64]
    offsets: NDArray[np.int64]


def merge_parts(parts: Sequence[TopicPart]) -> Iterator[Topic]:
    """Merge the parts of all files into topics; of types that share a name, the most frequent is used."""
    names: dict[str, dict[tuple[str, str], list[TopicPart]]] = {}
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


MAGIC = b"\x89MCAP0\r\n"
_FOOTER = 37
_SCHEMA, _CHANNEL, MESSAGE, CHUNK, _INDEX, _CHUNK_INDEX = 3, 4, 5, 6, 7, 8
_FEW = 1 << 20  # bytes of a schema or channel
_LIMIT = 1 << 28  # of the summary of a file


class MissingIndexError(Exception):
    """The file has no complete index."""


class _Channel(NamedTuple):
    topic: str
    type: str
    encoding: str


class Channels:
    """Schemas and channels of an MCAP."""

    def __init__(self) -> None:
        self.schemas: dict[int, str] = {}
        self.channels: dict[int, _Channel] = {}

    def add_record(self, op: int, data: bytes) -> None:
        """Add a record of a schema or a channel; damaged records are ignored."""
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
    """Index of an MCAP: channels, chunks and offsets of messages."""

    def __init__(self, file: File) -> None:
        super().__init__()
        self.file = file
        self.chunks: list[Chunk] = []
        self.found: dict[int, list[tuple[int, np.ndarray]]] = defaultdict(list)

    def walk(self, chunk: Chunk) -> bool:
        """Index the records of a chunk one by one; return whether it is complete."""
        row, rows, whole = len(self.chunks), defaultdict(list), True
        self.chunks.append(chunk)
        at = 0
        while head := chunk.peek(at, 31):
            if len(head) < 9:
                whole = False
                break
            op, length = unpack_from("<BQ", head)
            if length > LARGEST_MESSAGE or not (length == 0 or chunk.peek(at + 8 + length, 1)):
                whole = False
                break
            if op == MESSAGE and length >= 22:
                channel, _, time = unpack_from("<HIQ", head, 9)
                rows[channel].append((time, at))
            elif op in {_SCHEMA, _CHANNEL}:
                self.add_record(op, chunk.peek(at + 9, min(length, _FEW)))
            at += 9 + length
        for channel, found in rows.items():
            self.found[channel].append((row, np.array(found, np.uint64)))
        return whole

    def parts(self) -> Iterator[TopicPart]:
        """Yield the messages by channel."""
        for number, found in self.found.items():
            channel = self.channels[number]
            rows = np.concatenate([pairs for _, pairs in found]).astype(np.int64)
            which = np.repeat([row for row, _ in found], [len(pairs) for _, pairs in found])
            yield TopicPart(*channel, rows[:, 0], self.chunks, which, rows[:, 1])


def read_mcap(path: Path, notes: list[str]) -> list[TopicPart]:
    """Index the messages of a file by topic; a missing index is added to `notes`.

    Raises `InputError` where the file is no MCAP or holds no message.
    """
    file = File(path)
    if file.read(0, 8) != MAGIC:
        raise InputError(f"{path} does not begin as an MCAP file; record or copy it again.")
    try:
        index = _read_index(file)
    except (MissingIndexError, struct.error, ValueError) as error:
        index = _scan_records(file)
        why = error if isinstance(error, MissingIndexError) else "its index is damaged"
        notes.append(
            f"{path.name}: {why}; only the part before the damage is read. Repair it with `mcap "
            "recover`."
        )
    if not index.found:
        raise InputError(f"{path} contains no message; record again.")
    return list(index.parts())


def is_complete(path: Path) -> bool:
    """Return whether an MCAP has its end; else it was truncated or is still being written."""
    file = File(path)
    return file.read(max(file.size - len(MAGIC), 1), len(MAGIC)) == MAGIC


def _read_index(file: File) -> _Index:
    """Read the summary at the end, and the index behind every chunk."""
    size = file.size
    end = file.read(max(size - _FOOTER, 0), _FOOTER)
    if end[-8:] != MAGIC or end[:1] != b"\x02":
        raise MissingIndexError("the file has no end marker, so it was truncated")
    (start,) = unpack_from("<Q", end, 9)
    if not 0 < start < size or size - start > _LIMIT:
        raise MissingIndexError("it was written without an index")
    summary = file.read(start, size - start - _FOOTER)
    index = _Index(file)
    for op, at, length in records(summary):
        if op in {_SCHEMA, _CHANNEL}:
            index.add_record(op, summary[at : at + length])
        elif op == _CHUNK_INDEX:
            _index_chunk(index, summary, at)
    if set(index.found) - set(index.channels) or not index.found:
        raise MissingIndexError("it was written without an index")
    return index


def _index_chunk(index: _Index, summary: bytes, at: int) -> None:
    """Add a chunk of the summary, with the message index behind it."""
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
    data = index.file.read(start + length, min(behind, _LIMIT))
    for op, where, _ in records(data):
        if op == _INDEX:
            channel, count = unpack_from("<HI", data, where)
            if count:
                pairs = np.frombuffer(data, "<u8", count // 8, where + 6).reshape(-1, 2)
                index.found[channel].append((row, pairs))


def _scan_records(file: File) -> _Index:
    """Index all records from the first to the end of the file."""
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
            if whole or not compression:  # truncated compressed chunks are skipped
                index.walk(Chunk(file, start, min(at + 9 + length, size) - start, compression))
        elif op in {_SCHEMA, _CHANNEL} and length <= _FEW:
            index.add_record(op, file.read(at + 9, length))
        loose |= op == MESSAGE
        at += 9 + length
    if loose:  # messages outside of chunks
        index.walk(Chunk(file, len(MAGIC), size - len(MAGIC)))
    for number in index.found.keys() - index.channels.keys():
        del index.found[number]
    return index


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield the kind, start and length of each record of some bytes."""
    at = 0
    while at + 9 <= len(data):
        op, length = unpack_from("<BQ", data, at)
        at += 9
        if at + length > len(data):
            raise MissingIndexError("its index is damaged")
        yield op, at, length
        at += length


def _text(data: bytes, at: int) -> tuple[str, int]:
    """Return the text at an offset, and the offset behind it."""
    (length,) = unpack_from("<I", data, at)
    return data[at + 4 : at + 4 + length].decode(errors="replace"), at + 4 + length


ENDINGS = (".mcap", ".db3", ".bag")
_OF_FOLDERS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


@dataclass(frozen=True, slots=True, eq=False)
class Bag:
    """Topics of a bag."""

    path: Path
    topics: dict[str, Topic]  # By name, in alphabetical order
    notes: tuple[str, ...]  # Sentences about problems of the index

    def of_type(self, *types: str) -> list[Topic]:
        """Return the topics of some types, such as `sensor_msgs/Imu`, with readable messages."""
        return [
            t
            for t in self.topics.values()
            if t.short in types and len(t) and t.encoding in {"cdr", "ros1"}
        ]


def is_bag(path: Path) -> bool:
    """Return whether a path is named like a bag: .mcap, .db3, .bag, or a folder with such files."""
    if path.is_dir():
        return any(p.name.lower().endswith(_OF_FOLDERS) for p in path.iterdir())
    return path.suffix.lower() in ENDINGS


def open_bag(path: Path) -> Bag:
    """Read the index of a bag, not its messages.

    Raises `InputError`: it is no bag, is damaged beyond reading, or holds no message;
    `MissingExtraError`: `rosbags` is not installed.
    """
    try:
        import rosbags  # noqa: F401  # decodes what the index leads to
    except ImportError as error:
        raise MissingExtraError(
            f'{path} is a bag, which needs the extra `ros`: pip install "placegraph[ros]".'
        ) from error
    notes: list[str] = []
    files, packed = _files(path, notes)
    parts = []
    for file in files:
        ending = file.suffix.lower()
        if ending == ".mcap":
            parts += read_mcap(file, notes)
        elif ending == ".db3":
            parts += read_database(file, notes, packed=packed)
        else:
            parts += read_rosbag1(file)
    renamed = [part._replace(type=ros2_type(part.type)) for part in parts]
    for name in {part.name for part in renamed}:
        kinds = sorted({part.type for part in renamed if part.name == name and len(part.times)})
        if len(kinds) > 1:
            notes.append(
                f"{name} has messages of {' and '.join(kinds)}; only the most frequent are used."
            )
    topics = {topic.name: topic for topic in sorted(merge_parts(renamed), key=lambda t: t.name)}
    return Bag(path, topics, tuple(notes))


def ros2_type(name: str) -> str:
    """Return the name of a type in ROS 2; ROS 1 omits `msg`."""
    package, _, rest = name.partition("/")
    return name if rest.startswith("msg/") or not rest else f"{package}/msg/{rest}"


def _files(path: Path, notes: list[str]) -> tuple[list[Path], bool]:
    """Return the files of a bag in order, and whether every message is compressed by itself."""
    if not path.is_dir():
        return [path], False
    metadata = path / "metadata.yaml"
    if metadata.is_file():
        content = _metadata(metadata)
        names = content.get("relative_file_paths")
        if not (isinstance(names, list) and names and all(isinstance(n, str) for n in names)):
            raise InputError(
                f"{metadata}: relative_file_paths is not a list of files; run `ros2 bag reindex`."
            )
        files = [path / name.replace("\\", "/").rpartition("/")[2] for name in names]
        return [_unpacked(f) for f in files], str(
            content.get("compression_mode")
        ).lower() == "message"
    found = sorted(
        (p for p in path.iterdir() if p.name.lower().endswith(_OF_FOLDERS)), key=_by_number
    )
    stems = {re.sub(r"_\d+$", "", p.name.partition(".")[0]) for p in found}
    if len(stems) > 1 or not found:
        what = f"several bags ({', '.join(sorted(stems))})" if stems else "no .mcap or .db3 file"
        raise InputError(
            f"{path} has no metadata.yaml and contains {what}; give the file of one bag."
        )
    notes.append(
        f"{path.name} has no metadata.yaml; its files are read in the order of their names."
    )
    return [_unpacked(f) for f in found], False


def _by_number(path: Path) -> tuple[int, str]:
    number = re.search(r"_(\d{1,9})\.", path.name)
    return int(number[1]) if number else 0, path.name


def _unpacked(file: Path) -> Path:
    """Return a file, or the unpacked one beside it."""
    if file.suffix == ".zstd":
        if not file.with_suffix("").is_file():
            raise InputError(f"{file} is compressed; unpack it: `zstd -d {file}`.")
        return file.with_suffix("")
    if not os.path.isfile(file):  # noqa: PTH113  # False for names that are too long
        raise InputError(
            f"{file} does not exist, but metadata.yaml lists it; copy the whole folder."
        )
    return file


def _metadata(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        content = YAML(typ="safe").load(path.read_text("utf-8"))
        metadata = content["rosbag2_bagfile_information"]
    except (YAMLError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({error}); run `ros2 bag reindex`.") from error
    if not isinstance(metadata, dict):
        raise InputError(f"{path} is damaged; run `ros2 bag reindex`.")
    return metadata


def read_database(path: Path, notes: list[str], *, packed: bool = False) -> list[TopicPart]:
    """Index the messages of a database by topic; `packed`: each is compressed by zstd.

    A damaged database is read as far as possible, which is added to `notes`. Raises `InputError` where
    the file is no rosbag2 database, or holds no message.
    """
    base = Messages(path, packed=packed)
    try:
        topics = base.select("id, name, type, serialization_format", "topics").fetchall()
    except (sqlite3.Error, ValueError) as error:
        raise InputError(
            f"{path} is not a rosbag2 database ({error}); copy the bag again."
        ) from error
    rows: list[tuple[int, int, int]] = []
    valid = "WHERE typeof(topic_id) || typeof(timestamp) || typeof(id) = 'integerintegerinteger'"
    try:
        rows.extend(base.select("topic_id, timestamp, id", "messages", valid))
    except (sqlite3.Error, ValueError) as error:
        notes.append(
            f"{path.name}: the database is damaged ({error}); it is read as far as possible."
        )
    if not rows:
        raise InputError(f"{path} contains no message; record again.")
    table = np.array(rows, np.int64)
    parts = []
    for number, name, kind, encoding in topics:
        mine = table[table[:, 0] == number]
        zeros = np.zeros(len(mine), np.int64)
        parts.append(
            TopicPart(str(name), str(kind), str(encoding), mine[:, 1], (base,), zeros, mine[:, 2])
        )
    return parts


def read_rosbag1(path: Path) -> list[TopicPart]:
    """Index the messages of a rosbag1 by topic; `InputError` where it is damaged or was not closed."""
    from rosbags.rosbag1 import Reader

    check_regular(path)
    try:
        with Reader(path) as reader:
            parts = _parts(path, reader)
    except Exception as error:  # damaged bytes raise anything, also assertions
        if path.suffix.lower() != ".bag":
            raise InputError(
                f"{path} is not a bag; give an .mcap, .db3 or .bag file, or a folder of rosbag2."
            ) from error
        why = str(error) or "its index is damaged"
        raise InputError(
            f"{path} is a damaged ROS 1 bag ({why}); run `rosbag reindex` if the recording was not "
            "closed properly, else copy the bag again."
        ) from error
    if not any(len(part.times) for part in parts):
        raise InputError(f"{path} contains no message; record again.")
    return parts


def _parts(path: Path, reader: Reader) -> list[TopicPart]:
    from lz4.frame import decompress as lz4

    file, packings = File(path), {bz2.decompress: "bz2", lz4: "lz4"}
    chunks = tuple(
        Chunk(file, c.datapos, c.datasize, packings.get(c.decompressor, ""), rosbag1=True)
        for c in reader.chunks.values()
    )
    row_of = {pos: row for row, pos in enumerate(reader.chunks)}
    parts = []
    for connection in reader.connections:
        index = reader.indexes[connection.id]
        rows = np.array([(e.time, row_of[e.chunk_pos], e.offset) for e in index], np.int64)
        times, which, offsets = rows.reshape(-1, 3).T
        name, kind = connection.topic, connection.msgtype
        parts.append(TopicPart(name, kind, "ros1", times, chunks, which, offsets))
    return parts
