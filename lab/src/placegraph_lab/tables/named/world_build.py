"""An extract as large as a country: copies of extracts side by side, written as fast as zlib goes.

Blocks of an extract are encoded once, in a few versions whose tags are exchanged. A copy is one of
them with its place in the block's head, its ids written into the gaps that were left for them, and
its names exchanged among each other, so that no two copies read alike.
"""

from __future__ import annotations

import os
import shutil
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Event, Thread
from typing import Annotated, Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph_lab.tables.outdoor.extracts import EXTRACTS
from placegraph_lab.tables.outdoor.tiling import GAP, Extract, Tags, shifts_of, shuffled
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, number, option, parts, table

VERSIONS = 2  # of an extract
BLOCK = 8000  # elements of a block, as other writers have it
_ID = 7  # bytes of an id: 49 bits, whether they are needed or not
NAMES = frozenset({"name", "addr:street", "addr:housenumber", "brand", "operator", "name:en"})


def country(paths: Sequence[Path], out: Path, copies: int, seed: int) -> int:
    """Write copies of extracts in turn, side by side, as one extract of any size; how many nodes.

    Memory holds `VERSIONS` of each extract. What lies far from the middle 98 % of its nodes is left out.
    """
    rng = np.random.default_rng(seed)
    versions = [_Version.of(path, n, rng) for n in range(VERSIONS) for path in paths]
    shifts = shifts_of(np.max([v.size for v in versions], axis=0) + GAP, copies)
    shifts += (10.0, 48.0) - shifts.mean(axis=0)
    turns = [versions[k % len(versions)] for k in range(copies)]
    firsts = np.cumsum([0, *(v.ids for v in turns)])[:-1]
    with out.open("wb") as file:
        head = b"".join(_text(4, f) for f in (b"OsmSchema-V0.6", b"DenseNodes"))
        file.write(_blob(b"OSMHeader", head + _text(5, b"Sort.Type_then_ID")))
        for kind in range(3):
            for version, first, shift in zip(turns, firsts.tolist(), shifts, strict=True):
                for block in version.blocks[kind]:
                    file.write(_blob(b"OSMData", block.placed(first, shift - version.low, rng)))
    return sum(v.nodes for v in turns)


@dataclass(frozen=True)
class _Block:
    """Elements of one kind, encoded but for their ids and their place."""

    group: bytes
    strings: list[bytes]
    names: NDArray[np.int64]  # rows of `strings` that are names
    gaps: NDArray[np.int64]  # where in `group` ids stand
    ids: NDArray[np.int64]  # ... in the copy whose ids begin at 0 ...
    signed: NDArray[np.bool_]  # ... and whether they are written so that they may be negative.

    def placed(self, first: int, shift: Floats, rng: Generator) -> bytes:
        group, strings = np.frombuffer(self.group, np.uint8).copy(), list(self.strings)
        ids = (self.ids + first) << self.signed
        for n in range(_ID):
            more = 0x80 if n < _ID - 1 else 0
            group[self.gaps + n] = ((ids >> 7 * n) & 0x7F) | more
        for row, other in zip(
            self.names.tolist(), rng.permutation(self.names).tolist(), strict=True
        ):
            strings[row] = self.strings[other]
        table = b"".join(_text(1, s) for s in strings)
        west, south = np.rint(shift * 1e9).astype(np.int64).tolist()
        at = b"\x98\x01" + _varint(south % 2**64) + b"\xa0\x01" + _varint(west % 2**64)
        return _text(1, table) + _text(2, group.tobytes()) + at


@dataclass(frozen=True)
class _Version:
    """An extract with its tags exchanged, encoded."""

    blocks: tuple[list[_Block], list[_Block], list[_Block]]
    low: Floats
    size: Floats
    nodes: int
    ids: int

    @classmethod
    def of(cls, path: Path, number: int, rng: Generator) -> _Version:
        e = Extract.read(path)
        lonlat = np.array(e.lonlat)
        low, high = np.percentile(lonlat, (1, 99), axis=0)
        inside = ((lonlat >= low - GAP) & (lonlat <= high + GAP)).all(axis=1)
        groups: tuple[list[object], ...] = (
            [None] * len(lonlat), [w[0] == w[-1] for w in e.ways],
            [tags.get("type") for tags in e.relation_tags],
        )  # fmt: skip
        own = (e.node_tags, e.way_tags, e.relation_tags)
        tags = own if number == 0 else tuple(map(shuffled, own, groups, [rng] * 3))
        rows = np.flatnonzero(inside).tolist()
        steps = np.rint(lonlat * 1e7).astype(np.int64).tolist()
        ways = [(i, w) for i, w in enumerate(e.ways) if inside[w].all()]
        encoded = (
            [_nodes([(i, steps[i], tags[0][i]) for i in c]) for c in _chunks(rows)],
            [_ways([(i, w, tags[1][i]) for i, w in c]) for c in _chunks(ways)],
            [_relations([(i, m, tags[2][i]) for i, m in c])
             for c in _chunks(list(enumerate(e.relations)))],
        )  # fmt: skip
        return cls(encoded, low, high - low, len(rows), max(map(len, own)) + 1)


class _Writer:
    """A group that grows, its strings, and where ids are left out."""

    def __init__(self) -> None:
        self.strings: dict[bytes, int] = {b"": 0}
        self.names: set[int] = set()
        self.gaps: list[tuple[int, int, bool]] = []
        self.parts: list[bytes] = []
        self.at = 0

    def add(self, data: bytes, gaps: Iterable[tuple[int, int, bool]] = ()) -> None:
        self.gaps += [(self.at + at, value, signed) for at, value, signed in gaps]
        self.parts.append(data)
        self.at += len(data)

    def pairs(self, tags: Tags) -> list[tuple[int, int]]:
        found = []
        for key, value in tags.items():
            row = [self.strings.setdefault(s.encode(), len(self.strings)) for s in (key, value)]
            if key in NAMES:
                self.names.add(row[1])
            found.append((row[0], row[1]))
        return found

    def block(self) -> _Block:
        gaps, ids, signed = zip(*self.gaps, strict=True)
        return _Block(
            b"".join(self.parts), list(self.strings), np.array(sorted(self.names), np.int64),
            np.array(gaps, np.int64), np.array(ids, np.int64), np.array(signed, np.bool_),
        )  # fmt: skip


def _nodes(nodes: list[tuple[int, list[int], Tags]]) -> _Block:
    """Dense nodes: the first id is left out, the others follow as differences."""
    w = _Writer()
    rows = np.array([i for i, _, _ in nodes])
    at = np.array([steps for _, steps, _ in nodes])
    ids = bytes(_ID) + b"".join(_varint(d << 1) for d in np.diff(rows).tolist())
    lon, lat = (b"".join(map(_signed, np.diff(column, prepend=0).tolist())) for column in at.T)
    said = b"".join(
        b"".join(_varint(k) + _varint(v) for k, v in w.pairs(tags)) + b"\0" for *_, tags in nodes
    )
    dense = _text(1, ids) + _text(8, lat) + _text(9, lon) + _text(10, said)
    data = _text(2, dense)
    w.add(data, [(data.index(ids), int(rows[0]) + 1, True)])
    return w.block()


def _ways(ways: list[tuple[int, list[int], Tags]]) -> _Block:
    w = _Writer()
    for i, refs, tags in ways:
        _element(w, 3, (i, tags), (b"", _refs(8, refs), b""), refs[0])
    return w.block()


def _relations(relations: list[tuple[int, list[tuple[str, int, str]], Tags]]) -> _Block:
    w = _Writer()
    for i, members, tags in relations:
        kinds, refs, roles = zip(*members, strict=True)
        said = b"".join(_varint(w.strings.setdefault(r.encode(), len(w.strings))) for r in roles)
        types = _text(10, bytes("nwr".index(kind) for kind in kinds))
        _element(w, 4, (i, tags), (_text(8, said), _refs(9, refs), types), refs[0])
    return w.block()


def _refs(field: int, refs: Sequence[int]) -> bytes:
    """Members as differences, a gap for the first."""
    return _text(field, bytes(_ID) + b"".join(map(_signed, np.diff(refs).tolist())))


def _element(
    w: _Writer, field: int, own: tuple[int, Tags], parts: tuple[bytes, bytes, bytes], first: int
) -> None:
    """A way or relation of a row and tags: what stands before its members, they, and behind."""
    row, tags = own
    pairs, (before, members, behind) = w.pairs(tags), parts
    said = b"".join(_text(n + 2, b"".join(_varint(p[n]) for p in pairs)) for n in (0, 1) if pairs)
    start = b"\x08" + bytes(_ID) + said + before
    body = start + members + behind
    head = bytes([field << 3 | 2]) + _varint(len(body))
    gap = len(head) + len(start) + members.index(bytes(_ID))
    w.add(head + body, [(len(head) + 1, row + 1, False), (gap, first + 1, True)])


def _chunks(rows: list[Any]) -> list[list[Any]]:
    return [rows[n : n + BLOCK] for n in range(0, len(rows), BLOCK)]


def _varint(value: int) -> bytes:
    made = bytearray()
    while value > 0x7F:
        made.append(value & 0x7F | 0x80)
        value >>= 7
    made.append(value)
    return bytes(made)


def _signed(value: int) -> bytes:
    return _varint(value << 1 if value >= 0 else (-value << 1) - 1)


def _text(field: int, data: bytes) -> bytes:
    """A field of so many bytes."""
    return _varint(field << 3 | 2) + _varint(len(data)) + data


def _blob(kind: bytes, data: bytes) -> bytes:
    """A block of the file, compressed."""
    blob = b"\x10" + _varint(len(data)) + _text(3, zlib.compress(data, 6))
    head = _text(1, kind) + b"\x18" + _varint(len(blob))
    return struct.pack(">I", len(head)) + head + blob


CITIES = ("liechtenstein", "vancouver", "andorra", "ankara")
AFTER = 1000  # tiles after which a build that is done once is killed
EVERY = 0.5  # memory is looked at in steps of this time [s]


class Watch(Thread):
    """Peak memory [bytes] and processor time [s] of a process and of all that it starts."""

    def __init__(self, process: int) -> None:
        super().__init__(daemon=True)
        self.process, self.done = process, Event()
        self.heaps, self.pss, self.all = 0, 0, 0
        self.cpu: dict[int, float] = {}

    @property
    def seconds(self) -> float:
        """Processor time so far [s]."""
        return sum(list(self.cpu.values()))

    def run(self) -> None:
        """Look at it again and again, until `done`."""
        while not self.done.wait(EVERY):
            heaps = pss = total = 0
            for pid in _family(self.process):
                try:
                    fields = _sizes(f"/proc/{pid}/status")
                    pss += _sizes(f"/proc/{pid}/smaps_rollup")["Pss"]
                    heaps += fields["RssAnon"]
                    total += fields["VmRSS"]
                    self.cpu[pid] = _seconds(pid)
                except (OSError, KeyError, ValueError, IndexError):  # it has ended meanwhile
                    continue
            self.heaps, self.pss = max(self.heaps, heaps), max(self.pss, pss)
            self.all = max(self.all, total)


def _family(process: int) -> Iterator[int]:
    yield process
    for thread in Path(f"/proc/{process}/task").glob("*/children"):
        try:
            children = thread.read_text().split()
        except OSError:
            continue
        for child in children:
            yield from _family(int(child))


def _sizes(path: str) -> dict[str, int]:
    lines = Path(path).read_text().splitlines()
    found = (line.partition(":") for line in lines if line.endswith(" kB"))
    return {name: 1024 * int(value.split()[0]) for name, _, value in found}


def _seconds(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


def build(osm: Path, world: Path, workers: int, kill_after: int = 0) -> dict[str, float]:
    """Build in processes of their own; end them all once so many tiles are in the journal."""
    command = [sys.executable, "-m", "placegraph.cli", "world", "build", str(osm), "-o", str(world)]
    start = time.perf_counter()
    process = subprocess.Popen(  # noqa: S603  # our own command
        [*command, "--workers", str(workers), "--quiet"], start_new_session=True
    )
    watch = Watch(process.pid)
    watch.start()
    journal, tiles = (world / ".build" / name for name in ("journal.jsonl", "tiles.json"))
    begun, split = tiles.exists(), None
    while process.poll() is None:
        time.sleep(EVERY)
        if split is None and not begun and tiles.exists():
            split = {"split_seconds": time.perf_counter() - start, "split_cpu_s": watch.seconds}
        if kill_after and journal.exists() and journal.read_bytes().count(b"\n") >= kill_after:
            os.killpg(process.pid, signal.SIGKILL)
    watch.done.set()
    watch.join()
    if process.returncode and not kill_after:
        raise RuntimeError(f"{osm} could not be built ({process.returncode})")
    return {
        "seconds": time.perf_counter() - start,
        "cpu_s": watch.seconds,
        "heaps_bytes": watch.heaps,
        "pss_bytes": watch.pss,
        "resident_bytes": watch.all,
    } | (split or {})


def killed(osm: Path, world: Path, workers: int) -> dict[str, float]:
    """A build that is killed after some tiles, and taken up again, as one."""
    first = build(osm, world, workers, kill_after=AFTER)
    again = build(osm, world, workers)
    summed = ("seconds", "cpu_s")
    both = {k: first[k] + again[k] if k in summed else max(first[k], again[k]) for k in again}
    return first | both | {"killed_after_s": first["seconds"], "taken_up_s": again["seconds"]}


def shards(world: Path) -> dict[str, bytes]:
    """Last bytes of each shard: the digest of all before."""
    return {path.name: path.read_bytes()[-32:] for path in sorted((world / "shards").glob("*"))}


@table()
def world_build(
    run: Run,
    copies: Annotated[str, option("Numbers of copies with commas; one is 2.2 MB.")] = "4,80",
    workers: Annotated[str, option("Numbers of processes with commas.")] = "1,2",
    seed: Seed = 0,
    *,
    once: Annotated[bool, option("One build each, killed and taken up again.")] = False,
    quick: Quick = False,
) -> None:
    """How fast and in how much memory a world is built, and whether it survives being killed."""
    copies = "1" if quick else copies
    run.cache.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for n in map(int, parts(copies)):
        osm = run.cache / f"country_{n}.osm.pbf"
        nodes, before = written(run, osm, n, seed), None
        world = run.cache / "world"
        for many in map(int, parts(workers)):
            run.say(f"{n} x: building with {many}")
            shutil.rmtree(world, ignore_errors=True)
            row: dict[str, Any] = {
                "copies": n,
                "nodes": nodes,
                "pbf_bytes": osm.stat().st_size,
                "workers": many,
            }
            row |= killed(osm, world, many) if once else build(osm, world, many)
            made = shards(world)
            row |= {"shards": len(made), "same": before in {None, tuple(made.items())}}
            row["bytes"] = sum(path.stat().st_size for path in (world / "shards").glob("*"))
            before = tuple(made.items())
            rows.append(row)
        if not once:
            run.say(f"{n} x: killed and taken up again")
            shutil.rmtree(world)
            build(osm, world, many, kill_after=max(1, len(made) // 3))
            build(osm, world, many)
            rows[-1]["same_after_kill"] = shards(world) == made
        shutil.rmtree(world)
    header = [
        "copies",
        "nodes",
        "PBF",
        "workers",
        "wall",
        "CPU",
        "PBF a core",
        "heaps",
        "PSS",
        "resident",
    ]
    header += ["shards", "shards of PBF", "same bytes", "after kill -9"]
    print(markdown(header, [line(row) for row in rows]))
    run.save({"extracts": CITIES, "load": float(np.mean(os.getloadavg())), "rows": rows})


def written(run: Run, osm: Path, copies: int, seed: int) -> int:
    """Nodes of the extract of so many copies, which is written where it is not there yet."""
    count = osm.with_suffix(".nodes")
    if not count.exists():
        run.say(f"{copies} x: writing")
        nodes = country([run.osm / EXTRACTS[city] for city in CITIES], osm, copies, seed)
        count.write_text(str(nodes), encoding="utf-8")
    return int(count.read_text("utf-8"))


def line(row: dict[str, Any]) -> list[str]:
    """Row of the table."""
    mega = 1e-6
    again = row.get("same_after_kill")
    return [
        f"{row['copies']} x",
        number(row["nodes"]),
        number(row["pbf_bytes"] * mega, 1, "MB"),
        number(row["workers"]),
        number(row["seconds"], 0, "s"),
        number(row["cpu_s"], 0, "s"),
        number(row["pbf_bytes"] * mega / row["cpu_s"], 2, "MB/s"),
        number(row["heaps_bytes"] * mega, 0, "MB"),
        number(row["pss_bytes"] * mega, 0, "MB"),
        number(row["resident_bytes"] * mega, 0, "MB"),
        number(row["shards"]),
        number(row["bytes"] / row["pbf_bytes"], 2),
        "yes" if row["same"] else "no",
        "–" if again is None else "same" if again else "differs",
    ]
