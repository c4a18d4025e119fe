"""Endurance tests: memory stays flat, the slowest hundredth no slower, and no file stays open.

Each load runs in a process of its own, as many at once as there are processors, until its share of
the time is over or its count is reached. The first quarter is warm-up.
"""

from __future__ import annotations

import gc
import os
from array import array
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from math import inf
from multiprocessing import get_context
from pathlib import Path
from time import perf_counter, process_time

import numpy as np

from placegraph.core.threads import count_processors
from placegraph_lab.campaign.outages import Server
from placegraph_lab.campaign.row import Effort, Row
from placegraph_lab.campaign.trial import prepare

MEMORY_GROWTH, MEMORY_NOISE = 0.02, 4e6  # allowed growth after the first quarter; at least [bytes]
SLOWDOWN = 1.5  # allowed ratio of the slowest hundredths of the last and the second quarter
TRANSIENT = 3  # files that may be open for a moment: a connection, a page
SAMPLE_INTERVAL = 0.5  # between samples of memory and files [s]
MIN_ANSWERS = 200  # answers a quarter that the slowest hundredth needs
LOADS = {"sentences": 1e6, "localizations": 2e4, "tracker frames": 2e5, "a server": inf}
"""Number of answers after which a load ends."""
WORDS = (
    "bakery", "church", "library", "fountain", "pharmacy", "bank", "hotel", "café", "museum", "zoo",
)  # fmt: skip
SIDES = ("north", "south", "east", "west", "left", "right")
PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class LoadReport:
    """Durations, memory and open files of a load."""

    count: int
    milliseconds: tuple[
        float, float
    ]  # Slowest hundredth of the second and of the last quarter, CPU time
    memory: tuple[float, float]  # peak bytes of the second and of the last quarter
    files: tuple[int, int]  # most open files of the second and of the last quarter
    enough: bool  # whether there were enough answers for the slowest hundredth
    seconds: float = 0.0  # wall time of all

    @classmethod
    def of(
        cls,
        took: Sequence[float],
        memory: Sequence[float],
        files: Sequence[int],
        seconds: float = 0.0,
    ) -> LoadReport:
        """Return the report of durations [s], and of samples of memory and open files."""
        late = [1e3 * float(np.percentile(part, 99)) for part in _quarters(took)]
        held, there = ([max(part) for part in _quarters(each)] for each in (memory, files))
        return cls(
            len(took), (late[0], late[1]), (held[0], held[1]), (int(there[0]), int(there[1])),
            len(took) >= 4 * MIN_ANSWERS, seconds,
        )  # fmt: skip

    @property
    def faults(self) -> list[str]:
        """Names of what grew: memory, slower, files."""
        found, (before, after) = [], self.memory
        if after - before > max(MEMORY_GROWTH * before, MEMORY_NOISE):
            found.append("memory")
        if self.enough and self.milliseconds[1] > SLOWDOWN * self.milliseconds[0]:
            found.append("slower")
        if self.files[1] > self.files[0] + TRANSIENT:
            found.append("files")
        return found

    def __str__(self) -> str:
        late, held = self.milliseconds, self.memory
        said = f"slowest hundredth {late[0]:.1f} -> {late[1]:.1f} ms, " if self.enough else ""
        return (
            f"{said}memory {held[0] / 1e6:.1f} -> {held[1] / 1e6:.1f} MB "
            f"({held[1] / max(held[0], 1.0) - 1.0:+.1%}), open files {self.files[0]} -> {self.files[1]}"
        )


def rows(effort: Effort) -> Iterator[Row]:
    """Yield the rows of this part."""
    prepare(effort.folder / "inputs")
    loads = [load for load in LOADS if effort.wants(load)]
    at_once = min(count_processors(), max(1, len(loads)))
    share = effort.seconds * at_once / max(1, len(loads))
    with ProcessPoolExecutor(at_once, get_context("spawn"), max_tasks_per_child=1) as pool:
        started = {
            pool.submit(run_load, load, effort.folder, share, effort.seed): load for load in loads
        }
        for ended in as_completed(started):
            yield _row(started[ended], *ended.result(), effort)


def _row(load: str, report: LoadReport, wrong: int, effort: Effort) -> Row:
    effort.report(f"{load}: {report.count:,}, {report}; {', '.join(report.faults)}")
    grown = int(bool({"memory", "files"} & set(report.faults)))
    late = int("slower" in report.faults)
    counts = {
        "accepted": max(0, report.count - wrong - grown - late),
        "untyped": wrong,
        "hang": late,
        "memory": grown,
    }
    return Row.from_counts("soak", load, counts, effort.seed, report.seconds, str(report))


def run_load(load: str, folder: Path, seconds: float, seed: int) -> tuple[LoadReport, int]:
    """Run a load for `seconds` in this process; return its report and the number of wrong answers."""
    inputs = folder / "inputs"
    if load == "a server":
        return load_server(inputs, folder, seconds, seed)
    return run_in_process(load, inputs, seconds, seed), 0


def run_in_process(load: str, inputs: Path, seconds: float, seed: int) -> LoadReport:
    """Run a load that needs no server for `seconds`."""
    rng = np.random.default_rng(seed)
    work = {"sentences": sentences, "localizations": localizations, "tracker frames": frames}[load]
    ask = work(inputs, rng)
    for _ in range(3):  # fills caches
        ask()
    took, memory, files = array("f"), array("d"), array("l")
    seen, begun = 0.0, perf_counter()
    while perf_counter() < begun + seconds and len(took) < LOADS[load]:
        start = process_time()
        ask()
        took.append(process_time() - start)
        if perf_counter() > seen + SAMPLE_INTERVAL:
            gc.collect()  # frees reference cycles
            memory.append(resident_bytes(os.getpid()))
            files.append(len(list(Path("/proc/self/fd").iterdir())))
            seen = perf_counter()
    return LoadReport.of(took, memory, files, perf_counter() - begun)


def sentences(inputs: Path, rng: np.random.Generator) -> Callable[[], object]:
    """Return a function that locates drawn sentences in one map."""
    from placegraph.outdoor.city import CityMap

    city = CityMap.open(inputs / "town.city")
    return lambda: city.locate(draw_sentence(rng))


def draw_sentence(rng: np.random.Generator) -> str:
    """Draw one to three sentences about the speaker."""
    said = [
        f"A {rng.choice(WORDS)} is {rng.choice(SIDES[:4])} of me, {rng.integers(5, 200)} m away."
        if rng.random() < 0.5
        else f"There is a {rng.choice(WORDS)} on my {rng.choice(SIDES[4:])}."
        for _ in range(rng.integers(1, 4))
    ]
    return " ".join(said)


def localizations(inputs: Path, rng: np.random.Generator) -> Callable[[], object]:
    """Return a function that localizes one to three frames in one map, by all or two of three cues.

    One in fifty is refined, one in ten more is searched in the whole map, and the others near a prior.
    """
    from placegraph.indoor.options import PoseSearchOptions
    from placegraph.indoor.pose.prior import Prior
    from placegraph.io.capture.capture import open_capture
    from placegraph.maps import open_scene

    scene, film = open_scene(inputs / "flat.scene"), open_capture(inputs / "walk")
    found = [scene.localize(film, frames=[k], refine=False).best for k in range(len(film))]
    near = [Prior(*best.pose.tolist()) if best else None for best in found]
    options = (
        PoseSearchOptions(), PoseSearchOptions(modes=3),
        PoseSearchOptions(semantic=False), PoseSearchOptions(depth=False), PoseSearchOptions(colour=False),
    )  # fmt: skip

    def ask() -> object:
        kind, count = rng.random(), int(rng.integers(1, 4))
        first = int(rng.integers(len(film) - count + 1))
        return scene.localize(
            film, frames=slice(first, first + count), refine=kind < 0.02,
            prior=near[first] if kind > 0.12 else None,
            options=options[rng.integers(len(options))], seed=int(rng.integers(1000)),
        )  # fmt: skip

    return ask


def frames(inputs: Path, rng: np.random.Generator) -> Callable[[], object]:
    """Return a function that feeds frames, to and fro, to one tracker."""
    from dataclasses import replace

    from placegraph.io.capture.capture import open_capture
    from placegraph.maps import open_scene

    scene, film = open_scene(inputs / "flat.scene"), list(open_capture(inputs / "walk"))
    live = scene.live(background=False, seed=int(rng.integers(1000)))
    there = list(range(len(film)))
    loop = [*there, *there[-2:0:-1]]
    count = 0

    def ask() -> object:
        nonlocal count
        frame = film[loop[count % len(loop)]]
        count += 1
        return live.step(replace(frame, stamp=0.2 * count, index=count))

    return ask


def load_server(inputs: Path, at: Path, seconds: float, seed: int) -> tuple[LoadReport, int]:
    """Send valid and invalid requests to a server; return the report and the number of wrong answers."""
    import json
    import shutil

    folder, room = at / "served", at / "serving"
    for each in (folder, room):
        each.mkdir()
    shutil.copy(inputs / "town.city", folder)
    rng, server = np.random.default_rng(seed), Server.start(folder, room)
    took, memory, files, wrong = array("f"), array("d"), array("l"), 0
    try:
        own = [server.process.pid, *server.workers()]
        seen, begun = 0.0, perf_counter()
        while perf_counter() < begun + seconds:
            kind = int(rng.integers(8))
            text = draw_sentence(rng) if kind < 5 else ""
            body = json.dumps({"text": text, "map": "town"}).encode()
            wanted, path = (200, "/v1/locate") if kind < 5 else (422, "/v1/locate")
            start = perf_counter()
            if kind < 6:
                status, _ = server.ask("POST", path, body)
            else:
                wanted, (status, _) = 200, server.ask("GET", ("/v1/maps", "/")[kind - 6])
            took.append(perf_counter() - start)
            wrong += status != wanted and not (wanted == 422 and 400 <= status < 500)
            if perf_counter() > seen + SAMPLE_INTERVAL:
                memory.append(sum(map(resident_bytes, own)))
                files.append(sum(len(list(Path(f"/proc/{p}/fd").iterdir())) for p in own))
                seen = perf_counter()
    finally:
        server.end()
    return LoadReport.of(took, memory, files, perf_counter() - begun), wrong


def _quarters(values: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
    """Return the second and the last quarter; all values where there are fewer than four."""
    quarter = len(values) // 4
    return (values[quarter : 2 * quarter], values[-quarter:]) if quarter else (values, values)


def resident_bytes(process: int) -> float:
    """Return the resident memory of a process [bytes]; 0 where it has ended."""
    try:
        return float(Path(f"/proc/{process}/statm").read_text().split()[1]) * PAGE
    except OSError:
        return 0.0
