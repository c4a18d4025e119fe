"""Build a world of an extract as large as a country: seconds, memory, and whether kills hurt.

Copies of four extracts stand side by side as one; the build's processes are watched from outside.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event, Thread
from typing import Annotated, Any

import numpy as np

from placegraph_lab.tables.outdoor.extracts import EXTRACTS
from placegraph_lab.tables.outdoor.tiling import tile
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, Seed, option, parts, render, table

CITIES = ("liechtenstein", "vancouver", "andorra", "ankara")
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


def shards(world: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes()[-32:] for path in sorted((world / "shards").glob("*"))}


SAME = {None: "–", True: "same", False: "differs"}
COLUMNS = (
    Col("copies", lambda r: f"{r['copies']} x"), Col("nodes", "nodes", 0),
    Col("PBF", "pbf_bytes", 1, "MB", 1e-6), Col("workers", "workers", 0),
    Col("wall", "seconds", 0, "s"), Col("CPU", "cpu_s", 0, "s"),
    Col("PBF a core", lambda r: r["pbf_bytes"] / r["cpu_s"], 2, "MB/s", 1e-6),
    Col("heaps", "heaps_bytes", 0, "MB", 1e-6), Col("PSS", "pss_bytes", 0, "MB", 1e-6),
    Col("resident", "resident_bytes", 0, "MB", 1e-6), Col("shards", "shards", 0),
    Col("shards of PBF", lambda r: r["bytes"] / r["pbf_bytes"], 2),
    Col("same bytes", lambda r: "yes" if r["same"] else "no"),
    Col("after kill -9", "same_after_kill", SAME.__getitem__),
)  # fmt: skip


@table()
def world_build(
    run: Run,
    copies: Annotated[str, option("Numbers of copies with commas; one is 2.2 MB.")] = "4,80",
    workers: Annotated[str, option("Numbers of processes with commas.")] = "1,2",
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Speed and memory of building a world, and builds resumed after a kill."""
    copies = "1" if quick else copies
    run.cache.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, Any]] = []
    for n in map(int, parts(copies)):
        osm = run.cache / f"country_{n}.osm.pbf"
        nodes, before = write_extract(run, osm, n, seed), None
        world = run.cache / "world"
        for many in map(int, parts(workers)):
            run.log(f"{n} x: building with {many}")
            shutil.rmtree(world, ignore_errors=True)
            size = osm.stat().st_size
            row: dict[str, Any] = {"copies": n, "nodes": nodes, "pbf_bytes": size, "workers": many}
            row |= build(osm, world, many)
            made = shards(world)
            row |= {"shards": len(made), "same": before in {None, tuple(made.items())}}
            row["bytes"] = sum(path.stat().st_size for path in (world / "shards").glob("*"))
            before = tuple(made.items())
            rows.append(row)
        run.log(f"{n} x: killed and taken up again")
        shutil.rmtree(world)
        build(osm, world, many, kill_after=max(1, len(made) // 3))
        build(osm, world, many)
        rows[-1]["same_after_kill"] = shards(world) == made
        shutil.rmtree(world)
    print(render(COLUMNS, rows))
    run.save({"extracts": CITIES, "load": float(np.mean(os.getloadavg())), "rows": rows})


def write_extract(run: Run, osm: Path, copies: int, seed: int) -> int:
    """Nodes of the extract of so many copies, which is written where it is not there yet."""
    count = osm.with_suffix(".nodes")
    if not count.exists():
        run.log(f"{copies} x: writing")
        nodes = tile([run.osm / EXTRACTS[city] for city in CITIES], osm, copies, seed)
        count.write_text(str(nodes), encoding="utf-8")
    return int(count.read_text("utf-8"))
