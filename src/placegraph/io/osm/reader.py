"""Blocks of PBF to elements: nodes as points, ways as lines and areas, relations as areas."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from contextlib import closing
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from placegraph.core.mapfile import gather_spans
from placegraph.core.mapfile import offsets_of as starts_of
from placegraph.errors import InputError
from placegraph.io.osm import pbf
from placegraph.io.osm.osm import (
    AREA,
    LINE,
    NODE,
    POINT,
    RELATION,
    STEPS,
    WAY,
    LeftOut,
    OsmColumns,
    is_area,
)
from placegraph.io.osm.osm_kernels import way_points
from placegraph.io.osm.osm_process import Assembler
from placegraph.io.osm.pbf import NONE, Block, NodeIndex, Rows

Numbers = NDArray[np.int64]
Steps = NDArray[np.int32]

SORTED = b"Sort.Type_then_ID"
LOST = np.int32(2**31 - 1)
"""Longitude of a node of which the position is not known."""
AREAS = (b"multipolygon", b"boundary")
"""Types of relations that are areas."""
POSITIONLESS = "ways without positions"
LARGEST_ID = 1 << 60
"""No number of a node is larger, nor below as much: differences are numbers of 64 bits, too."""


class Reader:
    """Reads one file once: `file` in PBF, which stands for `path`."""

    def __init__(self, file: BinaryIO, path: Path, keys: Iterable[str], left_out: LeftOut) -> None:
        self.file, self.path, self.left_out = file, path, left_out
        self.keys = {key.encode() for key in keys}
        self.assembler = Assembler(path)
        self.members = NONE
        """Ids of ways that are wanted for areas, ascending."""
        self.ways: list[tuple[Numbers, Numbers, Steps]] = []
        """Ids, starts and points of the ways read so far; `LOST` where a position is unknown."""
        self.last: dict[int, tuple[int, int]] = {}  # id and version of the last node, and way
        self.late = False  # whether there is a node behind a way

    def columns(self, index: Path | None) -> Iterator[OsmColumns]:
        """Yield elements block by block, relations last; blocks that were read before are skipped."""
        head, *blobs = list(pbf.list_blobs(self.file)) or [pbf.Blob(b"", 0, 0)]
        needs, says = pbf.read_features(self.file, head)
        if b"HistoricalInformation" in needs:
            raise self._several_times()
        blobs = [blob for blob in blobs if blob.kind == b"OSMData"]
        relations, passed = self._plan(blobs, ordered=SORTED in says), self.left_out.read
        work = [(blob, self._read) for blob in blobs] + [(blob, self._areas) for blob in relations]
        with closing(NodeIndex(index)) as nodes, closing(self.assembler):
            for n, (blob, read) in enumerate(work, 1):
                before, block = self.left_out.counts.copy(), Block(pbf.inflate(self.file, blob))
                if pbf.RELATIONS in block.holds and blob not in relations:
                    raise self._unordered("is not sorted as its header says")
                found = read(block, nodes)
                if n <= passed:
                    self.left_out.counts = before
                    continue
                self.left_out.read = n
                if any(len(columns.tags) for columns in found):
                    yield found[0] if len(found) == 1 else _join_columns(found)
        if self.late and self.left_out.counts[POSITIONLESS]:
            raise self._unordered("lists nodes after the ways that need them")

    def _plan(self, blobs: list[pbf.Blob], *, ordered: bool) -> dict[pbf.Blob, None]:
        """Find the blobs of relations, the last ones of a sorted file, and note the ways they need."""
        found, members = [], [self.members]
        for blob in reversed(blobs):
            block = Block(pbf.inflate(self.file, blob))
            if pbf.RELATIONS in block.holds:
                found.append(blob)
                rows = block.relations()
                members += [_members(rows, row) for row in self._areas_among(block, rows)]
            elif ordered and block.holds:
                break
        self.members = np.unique(np.concatenate(members))
        return dict.fromkeys(found[::-1])

    def _read(self, block: Block, nodes: NodeIndex) -> list[OsmColumns]:
        """Return the nodeIndex and ways of a block."""
        found = []
        if block.holds & {pbf.NODES, pbf.DENSE}:
            found.append(self._points(block, nodes))
        if pbf.WAYS in block.holds:
            found.append(self._lines(block, nodes))
        return found

    def _points(self, block: Block, nodes: NodeIndex) -> OsmColumns:
        rows = block.nodes()
        self._one_time(pbf.NODES, rows)
        if len(wrong := rows.ids[(rows.ids < -LARGEST_ID) | (rows.ids > LARGEST_ID)]):
            raise pbf.DamagedError(f"{wrong[0]} is not a node id")
        self.late |= pbf.WAYS in self.last
        near = (rows.steps >= -pbf.MAX_COORDINATE) & (rows.steps <= pbf.MAX_COORDINATE)
        there: NDArray[np.bool_] = np.all(near, axis=1)
        nodes.add(rows.ids[there], rows.steps[there].astype(np.int32))
        hits = self._wanted(block, rows)
        self._count("nodes without a position", int((~there[hits]).sum()))
        hits = hits[there[hits]]
        each = np.arange(len(hits) + 1)
        kind = np.full(len(hits), POINT, np.uint8)
        steps, tags = rows.steps[hits].astype(np.int32), _tags(block, rows, hits)
        return OsmColumns(_like(kind, NODE), rows.ids[hits], kind, each, each, steps, tags)

    def _lines(self, block: Block, nodes: NodeIndex) -> OsmColumns:
        rows = block.ways()
        self._one_time(pbf.WAYS, rows)
        hits, ((bounds, refs),) = self._wanted(block, rows), rows.lists
        if len(mine := np.flatnonzero(_find_ids(rows.ids, self.members))):
            starts, at = gather_spans(bounds, mine)
            steps, known = nodes.find(refs[at])
            steps[~known, 0] = LOST
            self.ways.append((rows.ids[mine], starts, steps))
        starts, at = gather_spans(bounds, hits)
        starts, steps, lacks = way_points(starts, *nodes.find(refs[at]))
        counts = np.diff(starts)
        self._count(POSITIONLESS, int((counts < 2).sum()))
        self._count("ways cut where members are missing", int((lacks & (counts >= 2)).sum()))
        there = np.flatnonzero(counts >= 2)
        hits, (starts, at) = hits[there], gather_spans(starts, there)
        steps, tags = steps[at], _tags(block, rows, hits)
        closed = (steps[starts[:-1]] == steps[starts[1:] - 1]).all(axis=1) & (np.diff(starts) >= 4)
        areas = {i: is_area(t) for i, t in {id(t): t for t in tags}.items()}
        kind = np.where(
            closed & np.array([areas[id(t)] for t in tags], np.bool_), AREA, LINE
        ).astype(np.uint8)
        each = np.arange(len(hits) + 1)
        return OsmColumns(_like(kind, WAY), rows.ids[hits], kind, each, starts, steps, tags)

    def _areas(self, block: Block, _nodes: NodeIndex) -> list[OsmColumns]:
        """Return the areas of the relations of a block."""
        rows = block.relations()
        hits = self._areas_among(block, rows)
        tags = dict(zip(rows.ids[hits].tolist(), _tags(block, rows, hits), strict=True))
        ids, parts, said = [], [], []
        if any(_find_ids(_members(rows, row), self.outlines[0]).any() for row in hits):
            for identity, wkb in self.assembler.areas(self._small(block, rows, hits)):
                if identity not in tags:  # osmium doubles it, and halves what is left of 64 bits
                    continue
                ids.append(identity)
                parts.append(_rings(wkb))
                said.append({key: value for key, value in tags[identity].items() if key != "type"})
        wanted = {i for i in tags if tags[i].get("type") == "multipolygon"}
        self._count("multipolygons with missing or crossing members", len(wanted - set(ids)))
        if not ids:
            return []
        flat = [ring for rings in parts for ring in rings]
        kind = np.full(len(ids), AREA, np.uint8)
        return [OsmColumns(
            _like(kind, RELATION), np.array(ids, np.int64), kind, starts_of([len(p) for p in parts]),
            starts_of([len(r) for r in flat]), np.rint(np.concatenate(flat) * STEPS).astype(np.int32),
            said,
        )]  # fmt: skip

    def _small(self, block: Block, rows: Rows, hits: Numbers) -> bytes:
        """Return a file of these relations, their ways, and the nodes of these."""
        ids, order, starts, steps = self.outlines
        needed = np.unique(np.concatenate([_members(rows, row) for row in hits]))
        needed = needed[_find_ids(needed, ids)]
        mine = order[np.searchsorted(ids, needed)]
        bounds, at = gather_spans(starts, mine)
        known = steps[at, 0] != LOST
        return pbf.encode_pbf(needed, bounds, steps[at], known, block, rows.messages[hits])

    @cached_property
    def outlines(self) -> tuple[Numbers, Numbers, Numbers, Steps]:
        """Ids of all of `ways`, ascending, and their rows; starts and points by row. `ways` are let go."""
        ids = np.concatenate([NONE, *(way[0] for way in self.ways)])
        starts = starts_of(np.concatenate([NONE, *(np.diff(way[1]) for way in self.ways)]))
        steps, at = np.empty((starts[-1], 2), np.int32), int(starts[-1])
        while self.ways:  # one after the other: all of them twice would be too much
            points = self.ways.pop()[2]
            steps[at - len(points) : at] = points
            at -= len(points)
        order = np.argsort(ids, kind="stable")
        return ids[order], order, starts, steps

    def _wanted(self, block: Block, rows: Rows) -> Numbers:
        """Return the rows that have one of the keys."""
        keys = np.array([string in self.keys for string in block.strings], np.bool_)
        owner = np.repeat(np.arange(len(rows.ids)), np.diff(rows.tag_starts) // 2)
        return np.unique(owner[keys[rows.tags[::2]]])

    def _areas_among(self, block: Block, rows: Rows) -> Numbers:
        """Return the wanted relations of a type whose areas are assembled."""
        hits = self._wanted(block, rows)
        types = [block.strings.index(b"type")] if b"type" in block.strings else []
        kinds = [n for n, string in enumerate(block.strings) if string in AREAS]
        typed = np.isin(rows.tags[::2], types) & np.isin(rows.tags[1::2], kinds)
        owner = np.repeat(np.arange(len(rows.ids)), np.diff(rows.tag_starts) // 2)
        return np.intersect1d(hits, owner[typed])

    def _one_time(self, kind: int, rows: Rows) -> None:
        """Raise `InputError` where one thing follows another version of it."""
        ids, versions = rows.ids, rows.versions
        if kind in self.last:
            number, version = self.last[kind]
            ids, versions = np.append(number, ids), np.append(version, versions)
        if ((ids[1:] == ids[:-1]) & (versions[1:] != versions[:-1])).any():
            raise self._several_times()
        if len(ids):
            self.last[kind] = int(ids[-1]), int(versions[-1])

    def _unordered(self, why: str) -> InputError:
        return InputError(f"{self.path} {why}; sort it with `osmium sort`.")

    def _several_times(self) -> InputError:
        return InputError(
            f"{self.path} contains the history of objects; extract one point in time, for "
            "instance with `osmium time-filter`."
        )

    def _count(self, reason: str, amount: int) -> None:
        if amount:
            self.left_out.counts[reason] += amount


def _find_ids(ids: Numbers, ascending: Numbers) -> NDArray[np.bool_]:
    """Return which ids are among known ones, which ascend."""
    at = np.searchsorted(ascending, ids)
    is_known = at < len(ascending)
    is_known[is_known] = ascending[at[is_known]] == ids[is_known]
    return is_known


def _members(rows: Rows, row: int) -> Numbers:
    """Return the ids of the ways that are members of a relation."""
    _, (starts, ids), (_, kinds) = rows.lists
    mine = slice(starts[row], starts[row + 1])
    return ids[mine][kinds[mine] == WAY]


def _tags(block: Block, rows: Rows, hits: Numbers) -> list[dict[str, str]]:
    """Return the tags of some rows; those of the same ones share them."""
    starts, at = gather_spans(rows.tag_starts, hits)
    pairs = rows.tags[at].astype("<i4")
    data, strings = pairs.tobytes(), block.strings
    texts: dict[int, str] = {i: str(strings[i], "utf-8") for i in np.unique(pairs).tolist()}
    known: dict[bytes, dict[str, str]] = {}
    found = []
    for a, b in pairwise(starts.tolist()):
        key = data[4 * a : 4 * b]
        tags = known.get(key)
        if tags is None:
            said = [texts[i] for i in pairs[a:b].tolist()]
            tags = known[key] = dict(zip(said[::2], said[1::2], strict=True))
        found.append(tags)
    return found


def _join_columns(tables: list[OsmColumns]) -> OsmColumns:
    """Return the nodeIndex and ways of a block, which may hold both."""
    lengths = [
        [np.diff(getattr(t, name)) for t in tables] for name in ("part_starts", "point_starts")
    ]
    flat = [np.concatenate([t[k] for t in tables]) for k in (0, 1, 2, 5)]
    parts, points = (starts_of(np.concatenate(each)) for each in lengths)
    tags = [tags for table in tables for tags in table.tags]
    return OsmColumns(flat[0], flat[1], flat[2], parts, points, flat[3], tags)


def _like(kind: NDArray[np.uint8], value: int) -> NDArray[np.uint8]:
    return np.full(len(kind), value, np.uint8)


def _rings(wkb: bytes) -> list[NDArray[np.float64]]:
    """Return the rings, outer and inner alike, of a little-endian WKB multipolygon."""
    rings, at = [], 9
    (polygons,) = struct.unpack_from("<I", wkb, 5)
    for _ in range(polygons):
        (n_rings,) = struct.unpack_from("<I", wkb, at + 5)
        at += 9
        for _ in range(n_rings):
            (n,) = struct.unpack_from("<I", wkb, at)
            rings.append(np.frombuffer(wkb, "<f8", 2 * n, at + 4).reshape(-1, 2))
            at += 4 + 16 * n
    return rings
