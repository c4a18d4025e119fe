"""Blocks of an `.osm.pbf` file as columns, and positions of its nodes by id.

A file is a row of blobs, each with a head; a blob holds a block of strings and of groups of nodes, ways
or relations, compressed by zlib. `DamagedError` says what is wrong with one: no length is trusted.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator
from contextlib import closing, suppress
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import write_error
from placegraph.core.mapfile import offsets_of
from placegraph.io.osm import osm_kernels as kernels

Numbers = NDArray[np.int64]
Steps = NDArray[np.int32]

HEAD_MOST, BLOB_MOST = 64 << 10, 32 << 20
"""Bytes of a blob's head, and of what a blob holds, by the format's own rules."""
KNOWN = {b"OsmSchema-V0.6", b"DenseNodes", b"HistoricalInformation"}
"""Features without which a file cannot be understood."""
MAX_COORDINATE = np.array([1_800_000_000, 900_000_000])
"""Longitudes and latitudes reach so far, in steps of 1e-7 degrees."""
NODES_A_BLOCK = 1 << 18
"""Nodes of a block that is written, or of its ways, about."""
MAX_FIELDS = 1 << 21
"""Fields of one message: a block has thousands of strings, and 32 MiB room for 16 million."""
NONE = np.zeros(0, np.int64)
NODES, DENSE, WAYS, RELATIONS = 1, 2, 3, 4
"""Fields of a group."""


class DamagedError(ValueError):
    """Bytes that are no PBF, and why."""


class Blob(NamedTuple):
    """Position of a blob in its file."""

    kind: bytes
    begins: int
    length: int


class Rows(NamedTuple):
    """Nodes, ways or relations of a block; `offsets_of` (N + 1,) bound what each has of a list."""

    ids: Numbers
    versions: Numbers
    tag_starts: Numbers
    tags: Numbers
    """Strings of keys and values by turns."""
    lists: tuple[tuple[Numbers, Numbers], ...] = ()
    """Starts and entries: of ways ids of nodes; of relations roles, ids and kinds of members."""
    messages: Numbers = NONE.reshape(0, 2)
    """(N, 2) where each message begins in the block, and how long it is."""
    steps: Numbers = NONE.reshape(0, 2)
    """(N, 2) of nodes longitude and latitude, in steps of 1e-7 degrees, wherever that is."""


def list_blobs(file: BinaryIO) -> Iterator[Blob]:
    """Yield all blobs of a file; raises `DamagedError` where it ends within one."""
    size, at = file.seek(0, 2), 0
    while at < size:
        file.seek(at)
        head = file.read(4)
        (length,) = struct.unpack(">I", head) if len(head) == 4 else (HEAD_MOST + 1,)
        if length > HEAD_MOST:
            raise DamagedError("a blob is missing")
        said = np.frombuffer(file.read(length), np.uint8)
        kind, blob = b"", -1
        for number, value, begins in _fields(said):
            if number == 1:
                kind = said[begins : begins + value].tobytes()
            elif number == -3:
                blob = value
        at += 4 + length + blob
        if len(said) < length or not 0 <= blob <= BLOB_MOST or at > size:
            raise DamagedError("it ends within a blob")
        yield Blob(kind, at - blob, blob)


def read_features(file: BinaryIO, blob: Blob) -> tuple[set[bytes], set[bytes]]:
    """Return the features that the head of a file requires, and its other properties."""
    if blob.kind != b"OSMHeader":
        raise DamagedError("it does not begin with a header")
    data = inflate(file, blob)
    said: tuple[set[bytes], set[bytes]] = set(), set()
    for number, value, begins in _fields(data):
        if number in (4, 5):
            said[number - 4].add(data[begins : begins + value].tobytes())
    if unknown := said[0] - KNOWN:
        raise DamagedError(
            f"it needs the unknown feature {min(unknown).decode(errors='replace')!r}"
        )
    return said


def inflate(file: BinaryIO, blob: Blob) -> NDArray[np.uint8]:
    """Return the bytes of what a blob holds."""
    file.seek(blob.begins)
    data = np.frombuffer(file.read(blob.length), np.uint8)
    parts, size = {}, -1
    for number, value, begins in _fields(data):
        if number == -2:
            size = value
        elif number > 0:
            parts[number] = data[begins : begins + value]
    if 1 in parts:
        return parts[1]
    if 3 not in parts:
        raise DamagedError("it is not compressed by zlib; convert it with `osmium cat`")
    if not 0 <= size <= BLOB_MOST:
        raise DamagedError(f"a blob declares {size} bytes")
    unpacker = zlib.decompressobj()
    try:
        made = unpacker.decompress(parts[3].data, size + 1)
    except zlib.error as error:
        raise DamagedError(str(error)) from error
    if len(made) != size or not unpacker.eof:
        raise DamagedError("a blob does not match its declared contents")
    return np.frombuffer(made, np.uint8)


def _fields(data: NDArray[np.uint8], at: int = 0, end: int | None = None) -> list[list[int]]:
    found, good = kernels.read_fields(data, at, len(data) if end is None else end)
    if not good or len(found) > MAX_FIELDS:
        raise DamagedError(f"a message is cut off, or of more than {MAX_FIELDS} fields")
    rows: list[list[int]] = found.tolist()
    return rows


class Block:
    """Content of a blob of a file."""

    def __init__(self, data: NDArray[np.uint8]) -> None:
        self.data = data
        self.granularity, self.south, self.west = 100, 0, 0
        self.table = (0, 0)
        """First and last position of the table of strings."""
        self.groups: list[tuple[int, int]] = []
        for number, value, at in _fields(data):
            if number == 1:
                self.table = (at, at + value)
            elif number == 2:
                self.groups.append((at, at + value))
            elif number == -17:
                self.granularity = value
            elif number == -19:
                self.south = value
            elif number == -20:
                self.west = value

    @cached_property
    def strings(self) -> list[bytes]:
        """Its table of strings."""
        data = self.data.tobytes()
        return [
            data[at : at + n] for number, n, at in _fields(self.data, *self.table) if number == 1
        ]

    @cached_property
    def holds(self) -> frozenset[int]:
        """Fields of its groups: `NODES`, `DENSE` ones, `WAYS` or `RELATIONS`."""
        kinds = [np.abs(kernels.read_fields(self.data, *group)[0][:, 0]) for group in self.groups]
        return frozenset(np.unique(np.concatenate(kinds)).tolist()) if kinds else frozenset()

    def nodes(self) -> Rows:
        """Return its nodes."""
        made = [self._dense(at, at + n) for group in self.groups if DENSE in self.holds
                for number, n, at in _fields(self.data, *group) if number == DENSE and n]  # fmt: skip
        if NODES in self.holds:
            rows, lists = self._elements(NODES)
            (lat_starts, lat), (lon_starts, lon), _ = lists
            if (np.diff(lat_starts) != 1).any() or (np.diff(lon_starts) != 1).any():
                raise DamagedError("a node has no position")
            ids = kernels.decode_zigzags(rows.ids)
            at = self._steps(kernels.decode_zigzags(lon), kernels.decode_zigzags(lat))
            made.append(rows._replace(ids=ids, steps=at))
        if len(made) < 2:
            return made[0] if made else Rows(NONE, NONE, offsets_of([]), NONE)
        ids, versions, steps = (
            np.concatenate([getattr(rows, name) for rows in made])
            for name in ("ids", "versions", "steps")
        )
        counts = np.concatenate([np.diff(rows.tag_starts) for rows in made])
        tags = np.concatenate([rows.tags for rows in made])
        return Rows(ids, versions, offsets_of(counts), tags, steps=steps)

    def ways(self) -> Rows:
        """Return its ways, with the ids of their nodes."""
        rows, lists = self._elements(WAYS)
        starts, refs = lists[0]
        return rows._replace(lists=((starts, kernels.decode_differences(starts, refs)),))

    def relations(self) -> Rows:
        """Return relations, with roles, ids and kinds (`NODE`, `WAY`, `RELATION`) of their members."""
        rows, (roles, ids, kinds) = self._elements(RELATIONS)
        if not (np.array_equal(roles[0], ids[0]) and np.array_equal(ids[0], kinds[0])):
            raise DamagedError("members of a relation are incomplete")
        if _outside(roles[1], len(self.strings)) or _outside(kinds[1], 3):
            raise DamagedError("a member of a relation is invalid")
        return rows._replace(lists=(roles, (ids[0], kernels.decode_differences(*ids)), kinds))

    def _dense(self, at: int, end: int) -> Rows:
        ids, versions, lat, lon, tags, good = kernels.read_dense_nodes(self.data, at, end)
        if good:
            starts, pairs, good = kernels.read_dense_tags(tags, len(ids), len(self.strings))
        if not good:
            raise DamagedError("dense nodes contradict each other")
        return Rows(ids, versions, starts, pairs, steps=self._steps(lon, lat))

    def _elements(self, kind: int) -> tuple[Rows, list[tuple[Numbers, Numbers]]]:
        groups = np.array(self.groups, np.int64).reshape(-1, 2)
        head, starts, entries, good = kernels.read_elements(
            self.data, groups, kind, len(self.strings)
        )
        if not good:
            raise DamagedError(
                f"{'ways' if kind == WAYS else 'elements'} of a block contradict each other"
            )
        bounds = np.ascontiguousarray(starts.T)
        lists = [(bounds[k], entries[k, : bounds[k, -1]]) for k in range(4)]
        return Rows(head[:, 0], head[:, 1], *lists[0], messages=head[:, 2:]), lists[1:]

    def _steps(self, longitudes: Numbers, latitudes: Numbers) -> Numbers:
        """Return the positions in steps of 1e-7 degrees, cut off as osmium cuts them."""
        found = np.stack([longitudes, latitudes], 1)
        if (self.granularity, self.south, self.west) == (100, 0, 0):
            return found
        fine = found * self.granularity + (self.west, self.south)
        made: Numbers = np.where(fine < 0, -(-fine // 100), fine // 100)
        return made


def _outside(values: Numbers, end: int) -> bool:
    return bool(len(values)) and not 0 <= values.min() <= values.max() < end


def encode_pbf(
    ids: Numbers, starts: Numbers, steps: NDArray[np.int32], is_known: NDArray[np.bool_],
    block: Block, messages: Numbers,
) -> bytes:  # fmt: skip
    """Write a file of ways, their known points as nodes of their own, and relations of a block."""
    blobs, numbers = [], 1 + np.arange(len(steps))
    for at in range(0, len(steps), NODES_A_BLOCK):
        rows = at + np.flatnonzero(is_known[at : at + NODES_A_BLOCK])
        lon, lat = (differences(steps[rows, axis].astype(np.int64)) for axis in (0, 1))
        dense = text(1, differences(numbers[rows])) + text(8, lat) + text(9, lon)
        blobs.append(text(1, text(1, b"")) + text(2, text(2, dense)))
    ways: list[bytes] = []
    first = 0
    for identity, a, b in zip(ids.tolist(), starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        refs = differences(numbers[a : min(a + 1, b)]) + b"\2" * (b - a - 1)
        ways.append(text(3, b"\x08" + number(identity % 2**64) + text(8, refs)))
        if b - first + len(ways) >= NODES_A_BLOCK:
            blobs.append(text(1, text(1, b"")) + text(2, b"".join(ways)))
            ways, first = [], b
    blobs.append(text(1, text(1, b"")) + text(2, b"".join(ways)))
    data = block.data.tobytes()
    relations = b"".join(text(4, data[at : at + n]) for at, n in messages.tolist())
    blobs.append(text(1, data[slice(*block.table)]) + text(2, relations))
    head = text(4, b"OsmSchema-V0.6") + text(4, b"DenseNodes")
    return encode_blob(b"OSMHeader", head) + b"".join(encode_blob(b"OSMData", b) for b in blobs)


def encode_blob(kind: bytes, data: bytes) -> bytes:
    """Return a blob as it stands in a file, not compressed."""
    blob = text(1, data)
    head = text(1, kind) + b"\x18" + number(len(blob))
    return struct.pack(">I", len(head)) + head + blob


def text(field: int, data: bytes) -> bytes:
    """Return a field of so many bytes."""
    return number(field << 3 | 2) + number(len(data)) + data


def number(value: int) -> bytes:
    """Return a whole number from 0 on."""
    made = bytearray()
    while value > 0x7F:
        made.append(value & 0x7F | 0x80)
        value >>= 7
    made.append(value)
    return bytes(made)


def differences(values: Numbers) -> bytes:
    """Return the whole numbers as differences (zigzag), packed."""
    steps = np.diff(values, prepend=0)
    made: bytes = kernels.encode_varints((steps << 1) ^ (steps >> 63)).tobytes()
    return made


WIDE = 1 << 32
"""Ids of a chunk are less than this apart."""
TOUCHED = 256 << 20
"""Bytes of a file that are looked at until the system may have their memory back, about."""
SORTED_AT_ONCE = 1 << 22
"""Nodes in no order that are sorted in memory at once: some 50 bytes each."""
SAMPLE = 256
"""Interval of nodes that are sampled, to find where the others of their chunk may be split."""


class NodeIndex:
    """Positions of nodes, 12 bytes each, in `index` where that is named; it is made, and removed by `close`.

    They stand in chunks by rising id: `first` (C,) ids, `bounds` (C + 1,) of nodes, and of each chunk in
    `words` how far ids lie behind the first, and then longitudes and latitudes by turns. What is added
    in no order is sorted `at_once` nodes at a time, and such runs are merged before any is looked for.
    """

    def __init__(self, index: Path | None = None, at_once: int = SORTED_AT_ONCE) -> None:
        self.index, self.at_once = index, at_once
        self.first: list[int] = []
        self.last: list[int] = []
        self.counts: list[int] = []
        self.words: list[Steps] = []
        self.file: BinaryIO | None = None
        self._ready: tuple[Numbers, Numbers, Steps] | None = None
        self._map: mmap.mmap | None = None
        self._looked = 0
        self._run: list[tuple[Numbers, Steps]] = []  # what waits to be sorted

    def add(self, ids: Numbers, steps: Steps) -> None:
        """Add nodes (N,) at steps (N, 2); `MapError` where there is no room for them."""
        self._ready = None
        rising = bool((np.diff(ids) > 0).all())
        if rising and not self._run and not (len(ids) and self.last and ids[0] <= self.last[-1]):
            self.put(ids, steps)
            return
        self._run.append((ids, steps))
        if sum(len(some) for some, _ in self._run) >= self.at_once:
            self._end_run()

    def _end_run(self) -> None:
        """Sort what waits, and put it down."""
        if self._run:
            ids, steps = (np.concatenate(column) for column in zip(*self._run, strict=True))
            self._run = []
            self.put(*_is_sorted(ids, steps))

    def put(self, ids: Numbers, steps: Steps) -> None:
        """Put down nodes whose ids rise."""
        while len(ids):
            n = (
                int(np.searchsorted(ids, int(ids[0]) + WIDE))
                if int(ids[-1]) - int(ids[0]) >= WIDE
                else len(ids)
            )
            offsets = (ids[:n] - ids[0]).astype(np.uint32).view(np.int32)
            self.first.append(int(ids[0]))
            self.last.append(int(ids[n - 1]))
            self.counts.append(n)
            self._write(np.concatenate([offsets, steps[:n].reshape(-1)]))
            ids, steps = ids[n:], steps[n:]

    def find(self, ids: Numbers) -> tuple[Steps, NDArray[np.bool_]]:
        """Return the positions (K, 2) of nodes by id in steps of 1e-7 degrees, and which are known."""
        first, bounds, words = self._ready or self._merge_runs()
        found: tuple[Steps, NDArray[np.bool_]] = kernels.look_up_nodes(first, bounds, words, ids)
        self._looked += 64 * len(ids)
        if self._map is not None and self._looked > TOUCHED:
            self._map.madvise(mmap.MADV_DONTNEED)
            self._looked = 0
        return found

    def close(self) -> None:
        """Delete the file."""
        self._ready = self._map = None
        with suppress(OSError):  # what was not written yet
            if self.file is not None:
                self.file.close()
        with suppress(OSError):
            if self.index is not None:
                self.index.unlink(missing_ok=True)

    def _write(self, words: Steps) -> None:
        if self.index is None:
            self.words.append(words)
            return
        try:
            if self.file is None:
                self.index.unlink(missing_ok=True)
                self.file = self.index.open("xb+")
            self.file.write(words.data)
        except OSError as error:
            raise write_error(self.index, error) from error

    def _merge_runs(self) -> tuple[Numbers, Numbers, Steps]:
        self._end_run()
        if any(a >= b for a, b in zip(self.last, self.first[1:], strict=False)):
            self._merge()
        bounds = np.concatenate(([0], np.cumsum(self.counts, dtype=np.int64)))
        self._ready = np.array(self.first, np.int64), bounds, self.all_words()
        return self._ready

    def all_words(self) -> Steps:
        """Return the words (n,) int32 that were written so far."""
        if self.file is not None and self.index is not None:
            try:
                self.file.flush()
            except OSError as error:
                raise write_error(self.index, error) from error
            self._map = mmap.mmap(self.file.fileno(), 0, access=mmap.ACCESS_READ)
            return np.frombuffer(self._map, np.int32)
        self.words = [np.concatenate(self.words)] if self.words else []
        return self.words[0] if self.words else np.zeros(0, np.int32)

    def _merge(self) -> None:
        """Write chunks that overlap anew, in order: of all of them what lies between two ids, and so on."""
        first, counts = np.array(self.first, np.int64), np.array(self.counts, np.int64)
        bounds, words = np.concatenate(([0], np.cumsum(counts))), self.all_words()
        some = np.sort(kernels.sample_ids(first, bounds, words, SAMPLE))
        cuts = np.unique(some[:: max(1, self.at_once // SAMPLE)])
        beside = None if self.index is None else self.index.with_name(f"{self.index.name}.sorted")
        with closing(NodeIndex(beside)) as made:
            for low, high in zip(cuts, np.append(cuts[1:], max(self.last) + 1), strict=True):
                made.put(*_is_sorted(*kernels.nodes_between(first, bounds, words, low, high)))
                if self._map is not None:
                    self._map.madvise(mmap.MADV_DONTNEED)
            del words
            made.all_words()
            self.close()
            self.first, self.last, self.counts = made.first, made.last, made.counts
            self.words, self.file, made.file = made.words, made.file, None
            if self.index is not None and made.index is not None:
                made.index.rename(self.index)


def _is_sorted(ids: Numbers, steps: Steps) -> tuple[Numbers, Steps]:
    """Return the nodes by rising id; of one id the last."""
    order = np.argsort(ids, kind="stable")
    order = order[np.append(np.diff(ids[order]) > 0, True)]
    return ids[order], steps[order]
