"""How right a robot's pose is as it goes, how soon it is found again, and how late it is told.

Walks through the house and the office with drifting odometry and three kidnappings each are followed frame
by frame; images and odometry are played by the clock; frames come by folder, bag and WebSocket; and a
walk without end is walked.

    placegraph-lab table robot_live
    placegraph-lab table robot_live --only lifelong --lifelong 100000 --out lifelong.json

Prints Markdown tables and writes JSON.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any

import numpy as np

from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.perturb import Recording
from placegraph_lab.tables.indoor.robustness import Places
from placegraph_lab.tables.live.walks import (
    SENSES,
    Row,
    Seen,
    bags,
    followed,
    from_files,
    from_server,
    looked_at,
    looped,
    paced,
    quantiles,
    walks,
)
from placegraph_lab.tables.runner import (
    Quick,
    Run,
    Seed,
    known,
    markdown,
    number,
    option,
    parts,
    share,
    table,
)
from placegraph_lab.tables.statistics import apart

DRIFT = 0.5  # of odometry [deg a frame]
LOOKS = 20  # times at which memory is looked at


@dataclass(frozen=True)
class Life:
    """A long run."""

    row: Row
    wall: dict[str, float]  # milliseconds a frame, odometry of its time included
    memory: list[tuple[int, float]]  # frames, and what the process holds then [MB], resident
    kidnapped: int

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers."""
        own = {"wall_ms": self.wall, "memory": self.memory, "kidnapped": self.kidnapped}
        return self.row.to_dict() | own


def lived(
    scene: SceneMap,
    recordings: Sequence[Recording],
    frames: int,
    seed: int,
    say: Callable[[str], None],
) -> Life:
    """So many frames to and fro along recordings, kidnapped from one to the next, in one tracker."""
    live = scene.live(seed=seed, background=False, options=SENSES)
    seen: list[Seen] = []
    memory, wall = [], []
    endless = looped(recordings, DRIFT, np.random.default_rng(seed))
    for done, (frame, truth, kidnapped) in enumerate(islice(endless, frames)):
        if done % max(1, frames // LOOKS) == 0:
            memory.append((done, resident()))
            say(f"{done} frames, {memory[-1][1]:.0f} MB")
        start = perf_counter()
        samples = [(frame.stamp, frame.odometry)]
        seen.append(looked_at(live, frame, truth, samples, kidnapped=kidnapped and done > 0))
        wall.append(perf_counter() - start)
    memory.append((frames, resident()))
    row = Row.of("house, without end", DRIFT, [seen])
    return Life(row, quantiles(wall), memory, sum(s.kidnapped for s in seen))


def resident() -> float:
    """What this process holds [MB]; NaN where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return float("nan")
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


PARTS = ("walks", "paced", "ways", "lifelong")
DRIFTS = (0.2, 0.5, 1.0)  # degrees a frame
RATES = (10.0, 30.0)  # images a second
SECONDS = 20.0  # of each
WALKED = ["", "drift", "frames", "right", "OK", "right of OK", "foretold", "false OK", "longest",
          "found after", "most", "CPU ms", "worst"]  # fmt: skip


@table()
def robot_live(
    run: Run,
    seed: Seed = 0,
    lifelong: Annotated[int, option("Frames of the walk without end.")] = 5000,
    only: Annotated[str, option(f"Parts with commas: {', '.join(PARTS)}.")] = "",
    *,
    quick: Quick = False,
) -> None:
    """How right a robot's pose is as it goes, how soon it is found again, and how late it is told."""
    wanted = known(parts(only) or (["walks"] if quick else []), PARTS, "part")
    places = Places(run.data, run.cache)
    house = places.scene("house")
    record: dict[str, Any] = {"load": os.getloadavg()}
    if "walks" in wanted:
        rows = walked(run, places, seed, DRIFTS[1:2] if quick else DRIFTS)
        print(f"{markdown(WALKED, map(cells, rows))}\n")
        record["walks"] = [row.to_dict() for row in rows]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "maps").mkdir()
        house.save(folder / "maps/house.scene")
        if "paced" in wanted:
            file = folder / "maps/house.scene"
            every = [apart(paced, run.data, run.cache, file, r, SECONDS, cores=2) for r in RATES]
            print(f"{pacing(every)}\n")
            record["paced"] = every
        if "ways" in wanted:
            paths = sorted((run.data / "house").glob("seq[0-9]*"))
            scene = places.scene("house")
            found = {
                "folder": from_files(scene, paths),
                "MCAP": from_files(scene, bags(paths, folder)),
                "WebSocket": from_server(folder / "maps", paths),
            }
            print(f"{ways_table(found)}\n")
            record["ways"] = found
    if "lifelong" in wanted:
        recordings = places.recordings("house")["house"]
        life = lived(house, recordings, lifelong, seed, run.say)
        print(told(life))
        record["lifelong"] = life.to_dict()
    run.save(record, whole=not only)


def walked(run: Run, places: Places, seed: int, drifts: tuple[float, ...]) -> list[Row]:
    """All walks at each drift."""
    rows = []
    for place in ("house", "office"):
        for degrees in drifts:
            seen = []
            for where, recordings in places.recordings(place).items():
                for walk in walks(recordings, degrees, seed):
                    run.say(f"{where}, {degrees} degrees a frame, {len(walk.frames)} frames")
                    seen.append(followed(places.scene(where), walk, seed))
            rows.append(Row.of(place, degrees, seen))
    return rows


def cells(row: Row) -> list[str]:
    """A row of the table of walks."""
    found = [r for r in row.recovered if r is not None]
    lost = len(row.recovered) - len(found)
    most = "–" if not found else str(max(found)) + (f", {lost} never" if lost else "")
    return [
        row.place, f"{row.degrees:g}°", str(row.frames), share(row.right), share(row.sure),
        f"{row.tracked:.3f}", share(row.foretold), f"{row.false:.3f}", str(row.longest),
        number(float(np.median(found)) if found else None), most, number(row.milliseconds),
        number(row.worst),
    ]  # fmt: skip


def pacing(every: list[dict[str, Any]]) -> str:
    """Images and odometry by the clock."""
    header = ["images", "looked at", "dropped", "odometry", "ms a call", "99 %", "most",
              "age of poses, ms", "95 %", "cores"]  # fmt: skip
    rows = [
        [f"{p['rate']:g} Hz", number((p["images"] - p["dropped"]) / p["seconds"], 1, "Hz"),
         share(p["dropped"] / p["images"]), number(p["moves"] / p["seconds"], 0, "Hz"),
         number(p["move_ms"]["p50"], 2), number(p["move_ms"]["p99"], 1),
         number(p["move_ms"]["most"], 1), number(p["age_ms"].get("p50"), 0),
         number(p["age_ms"].get("p95"), 0), number(p["cores"], 2)]
        for p in every
    ]  # fmt: skip
    return markdown(header, rows)


def ways_table(found: dict[str, dict[str, Any]]) -> str:
    """From a frame to its pose."""
    header = ["frames by", "ms, median", "95 %", "CPU ms", "a second", "within 100 ms", "OK"]
    rows = [
        [name, number(w["wall_ms"]["p50"]), number(w["wall_ms"]["p95"]),
         number(w["cpu_ms"]["p50"]), number(1e3 / w["wall_ms"]["p50"], 1), share(w["in_time"]),
         share(w["sure"])]
        for name, w in found.items()
    ]  # fmt: skip
    return markdown(header, rows)


def told(life: Life) -> str:
    """What became of a long run."""
    row, found = life.row, [r for r in life.row.recovered if r is not None]
    held = life.memory[len(life.memory) // 4 :]
    grown = (held[-1][1] - held[0][1]) / max(1, held[-1][0] - held[0][0]) * 1e4
    memory = ", ".join(
        f"{mb:.0f} after {n:,}" for n, mb in life.memory[:: max(1, len(life.memory) // 6)]
    )
    return (
        f"{row.frames:,} frames, {life.kidnapped} kidnappings, {row.degrees:g}° of drift a frame: "
        f"{row.right:.1%} right, {row.sure:.1%} OK, of these {row.tracked:.2%} right; false OK "
        f"{row.false:.2%}, {row.longest} in a row at most. Found again after "
        f"{np.median(found) if found else np.nan:.0f} frames (median), {max(found, default=0)} at most, "
        f"{len(row.recovered) - len(found)} times never. CPU {row.milliseconds:.0f} ms a frame, worst "
        f"{row.worst:.0f}; wall {life.wall['p50']:.0f}, worst {life.wall['most']:.0f}. MB: {memory}; "
        f"{grown:+.1f} MB in 10,000 frames after the first quarter."
    )
