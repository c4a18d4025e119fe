"""Bags of ROS, whose messages are found by an index and read on demand: MCAP, rosbag2's SQLite, rosbag1.

A message has a store (a chunk of an MCAP or of a rosbag1, or a database) and an offset in it. Of a chunk
that is not compressed only the message itself is read, and of others no more than a bag may unpack.
`rosbags` reads whole chunks, knows no limit, and refuses files that are cut off; for MCAP and databases
its reader is therefore not used (transforms of a bag of 270 MB: .16 s, here .01 s; packed: 1.0 and .2
s).
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

_HEAD = 160
"""Bytes before a message, at most: of MCAP 31, of rosbag1 fields of its own."""
_SMALL = 1024
"""Bytes of a message that are read at once with what stands before it."""
_KEPT = 2  # unpacked chunks of a file: colour and depth of a moment mostly lie in one


class MessageStore(Protocol):
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
        self._unpacked: OrderedDict[int, CompressedBytes] = OrderedDict()

    def __reduce__(self) -> tuple[type[File], tuple[Path]]:
        return File, (self.path,)

    def read(self, start: int, count: int) -> bytes:
        """Return at most `count` bytes from `start`: fewer where the file ends, wherever that would be."""
        if not (0 <= start < 1 << 62 and count > 0):
            return b""
        if self._handle is None:
            with self._lock:
                if self._handle is None:
                    try:
                        handle = os.open(
                            check_regular(self.path), os.O_RDONLY | getattr(os, "O_CLOEXEC", 0)
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
        """Return at most `count` bytes of a compressed part; the last ones are kept as far as unpacked."""
        with self._lock:
            packed = self._unpacked.pop(chunk.start, None)
        if packed is None:
            name = f"{self.path}, the chunk at byte {chunk.start},"
            data = self.read(chunk.start, min(chunk.size, LARGEST_MESSAGE))
            packed = CompressedBytes(data, chunk.compression, name)
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
        """Return the bytes of the unpacked chunk; fewer where it ends."""
        if self.compression:
            return self.file.unpacked(self, offset, count)
        return self.file.read(self.start + offset, max(0, min(count, self.size - offset)))

    def read(self, offset: int, most: int | None = None) -> bytes:
        """As `MessageStore.read`."""
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
        return partial(Messages, packed=self.packed), (self.path,)

    def read(self, offset: int, most: int | None = None) -> bytes:
        """As `MessageStore.read`; the offset is the row's id."""
        name = f"{self.path}: message {offset}"
        data = self.blob(("messages", "data", offset), name, None if self.packed else most)
        if self.packed:
            whole = LARGEST_MESSAGE if most is None else most
            return CompressedBytes(data, "zstd", f"{self.path}, message {offset},").read(0, whole)
        return data


class Message(NamedTuple):
    """One message, not yet read."""

    place: MessageStore
    offset: int

    def read(self) -> bytes:
        """Return its bytes."""
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
    places: tuple[MessageStore, ...]
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
    """Return the messages of several topics, each of its rows (None: all) whole or its first bytes.

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


class TopicPart(NamedTuple):
    """Messages of one topic in one file."""

    name: str
    type: str
    encoding: str
    times: NDArray[np.int64]
    places: Sequence[MessageStore]
    which: NDArray[np.int64]
    offsets: NDArray[np.int64]


def join_parts(parts: Sequence[TopicPart]) -> Iterator[Topic]:
    """Yield the topics of the parts of all files of a bag; of types that share a name, the most frequent."""
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


class MissingIndexError(Exception):  # no error of the user's
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

    def add_record(self, op: int, data: bytes) -> None:
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
    """Return the messages of a file by topic; `notes` is told where its index is missing.

    Raises `InputError` where it is no MCAP or holds nothing that can be read.
    """
    file = File(path)
    if file.read(0, 8) != MAGIC:
        raise InputError(
            f"{path} is no MCAP file, or its beginning is lost; record or copy it again."
        )
    try:
        index = _listed(file)
    except (MissingIndexError, struct.error, ValueError) as error:
        index = _scanned(file)
        why = error if isinstance(error, MissingIndexError) else "its index is damaged"
        notes.append(
            f"{path.name}: {why}; it is read as far as it goes. `mcap recover` makes it whole."
        )
    if not index.found:
        raise InputError(f"{path} holds no message; record again.")
    return list(index.parts())


def is_whole(path: Path) -> bool:
    """Return whether an MCAP has its end; else it was cut off, or is still being written."""
    file = File(path)
    return file.read(max(file.size - len(MAGIC), 1), len(MAGIC)) == MAGIC


def _listed(file: File) -> _Index:
    """By the summary at the end, and the index behind every chunk."""
    size = file.size
    end = file.read(max(size - _FOOTER, 0), _FOOTER)
    if end[-8:] != MAGIC or end[:1] != b"\x02":
        raise MissingIndexError("the file was cut off, for it has no end")
    (start,) = unpack_from("<Q", end, 9)
    if not 0 < start < size or size - start > _LIMIT:
        raise MissingIndexError("it was written without an index")
    summary = file.read(start, size - start - _FOOTER)
    index = _Index(file)
    for op, at, length in records(summary):
        if op in {_SCHEMA, _CHANNEL}:
            index.add_record(op, summary[at : at + length])
        elif op == _CHUNK_INDEX:
            _chunk(index, summary, at)
    if set(index.found) - set(index.channels) or not index.found:
        raise MissingIndexError("it was written without an index")
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
            index.add_record(op, file.read(at + 9, length))
        loose |= op == MESSAGE
        at += 9 + length
    if loose:  # messages outside of chunks
        index.walk(Chunk(file, len(MAGIC), size - len(MAGIC)))
    known = {n: found for n, found in index.found.items() if n in index.channels}
    index.found.clear()
    index.found.update(known)
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
    """Return the text with its length before it, and what comes after."""
    (length,) = unpack_from("<I", data, at)
    return data[at + 4 : at + 4 + length].decode(errors="replace"), at + 4 + length


ENDINGS = (".mcap", ".db3", ".bag")
_OF_FOLDERS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


@dataclass(frozen=True, slots=True, eq=False)
class Bag:
    """What lies in a bag."""

    path: Path
    topics: dict[str, Topic]
    """By name, in order of their names."""
    notes: tuple[str, ...]
    """What was found out while its index was read, in sentences."""

    def of_type(self, *types: str) -> list[Topic]:
        """Return the topics of some types that hold messages which can be read, such as `sensor_msgs/Imu`."""
        return [
            t
            for t in self.topics.values()
            if t.short in types and len(t) and t.encoding in {"cdr", "ros1"}
        ]


def looks_like_bag(path: Path) -> bool:
    """Return whether a path bears the name of a bag: .mcap, .db3, .bag, or a folder with such files."""
    if path.is_dir():
        return any(p.name.lower().endswith(_OF_FOLDERS) for p in path.iterdir())
    return path.suffix.lower() in ENDINGS


def open_bag(path: Path) -> Bag:
    """Read the index of a bag; its messages stay where they are.

    Raises
    ------
    InputError
        It is no bag, is damaged beyond reading, or holds no message.
    MissingExtraError
        `rosbags` is not installed.

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
                f"{name} holds messages of {' and '.join(kinds)}; the most frequent count."
            )
    topics = {topic.name: topic for topic in sorted(join_parts(renamed), key=lambda t: t.name)}
    return Bag(path, topics, tuple(notes))


def ros2_type(name: str) -> str:
    """Return the type as ROS 2 names it; ROS 1 leaves out `msg`."""
    package, _, rest = name.partition("/")
    return name if rest.startswith("msg/") or not rest else f"{package}/msg/{rest}"


def _files(path: Path, notes: list[str]) -> tuple[list[Path], bool]:
    """Return the files of a bag in order, and whether every message is compressed by itself."""
    if not path.is_dir():
        return [path], False
    metadata = path / "metadata.yaml"
    if metadata.is_file():
        said = _metadata(metadata)
        names = said.get("relative_file_paths")
        if not (isinstance(names, list) and names and all(isinstance(n, str) for n in names)):
            raise InputError(
                f"{metadata}: relative_file_paths is no list of files; run `ros2 bag reindex`."
            )
        files = [path / name.replace("\\", "/").rpartition("/")[2] for name in names]
        return [_unpacked(f) for f in files], str(said.get("compression_mode")).lower() == "message"
    found = sorted(
        (p for p in path.iterdir() if p.name.lower().endswith(_OF_FOLDERS)), key=_by_number
    )
    stems = {re.sub(r"_\d+$", "", p.name.partition(".")[0]) for p in found}
    if len(stems) > 1 or not found:
        raise InputError(
            f"{path} has no metadata.yaml, and holds {' and '.join(sorted(stems)) or 'no file'}; name "
            "the file of one bag."
        )
    notes.append(
        f"{path.name} has no metadata.yaml; its files are taken in the order of their names."
    )
    return [_unpacked(f) for f in found], False


def _by_number(path: Path) -> tuple[int, str]:
    number = re.search(r"_(\d{1,9})\.", path.name)
    return int(number[1]) if number else 0, path.name


def _unpacked(file: Path) -> Path:
    """Return the file itself, or what was unpacked of it beside it."""
    if file.suffix == ".zstd":
        if not file.with_suffix("").is_file():
            raise InputError(f"{file} is compressed as a whole; unpack it once: `zstd -d {file}`.")
        return file.with_suffix("")
    if not os.path.isfile(file):  # noqa: PTH113 - False of names that are too long, too
        raise InputError(
            f"{file} does not exist, but metadata.yaml lists it; copy the whole folder."
        )
    return file


def _metadata(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        content = YAML(typ="safe").load(path.read_text("utf-8"))
        said = content["rosbag2_bagfile_information"]
    except (YAMLError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({error}); run `ros2 bag reindex`.") from error
    if not isinstance(said, dict):
        raise InputError(f"{path} is damaged; run `ros2 bag reindex`.")
    return said


def read_database(path: Path, notes: list[str], *, packed: bool = False) -> list[TopicPart]:
    """Return the messages of a database by topic; `packed`: each is compressed by zstd.

    Where it is damaged it is read as far as it goes, of which `notes` is told. Raises `InputError`
    where it is no such database, or holds no message.
    """
    base = Messages(path, packed=packed)
    try:
        topics = base.select("id, name, type, serialization_format", "topics").fetchall()
    except (sqlite3.Error, ValueError) as error:
        raise InputError(f"{path} is no rosbag2 database ({error}); copy the bag again.") from error
    rows: list[tuple[int, int, int]] = []
    whole = "WHERE typeof(topic_id) || typeof(timestamp) || typeof(id) = 'integerintegerinteger'"
    try:
        rows.extend(base.select("topic_id, timestamp, id", "messages", whole))
    except (sqlite3.Error, ValueError) as error:
        notes.append(
            f"{path.name}: the database is damaged ({error}); it is read as far as it goes."
        )
    if not rows:
        raise InputError(f"{path} holds no message; record again.")
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
    """Return the messages of a bag by topic; `InputError` where it is damaged, or was not closed."""
    from rosbags.rosbag1 import Reader

    check_regular(path)
    try:
        with Reader(path) as reader:
            parts = _parts(path, reader)
    except Exception as error:  # at damaged bytes it raises whatever they lead to, assertions too
        why = str(error) or "its index is damaged"
        raise InputError(
            f"{path} cannot be read as a bag of ROS 1 ({why}); `rosbag reindex` mends one that was not "
            "closed, else copy it again."
        ) from error
    if not any(len(part.times) for part in parts):
        raise InputError(f"{path} holds no message; record again.")
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
