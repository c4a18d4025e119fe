"""Table `indoor_speed`: time by stage and map, of the tracker, memory, cold starts.

`docs/benchmarks/indoor.md#speed` explains what is measured.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph.indoor.likelihood.observe import COARSE
from placegraph.indoor.options import FilterOptions, PoseSearchOptions
from placegraph.indoor.pose.search import search
from placegraph.indoor.pose.window import PoseQuery, observe
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor.metrics import mean_particles
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import (
    Quick,
    Run,
    check_names,
    option,
    parts,
    render,
    share,
    table,
)
from placegraph_lab.tables.statistics import peak, run_apart

FRAMES = 10  # frames of a sequence that are localized
PARTS = ("localizing", "search", "tracking", "start")
MEGA = 1e-6
PAPER = (
    ("*paper, three passes, a GPU (Tab. 4)*", "2.90 s"),
    ("*paper, coarse, a GPU (App. E)*", "1.60 s"),
)
METHODS = {
    "all terms": PoseSearchOptions(),
    "semantic + depth": PoseSearchOptions().only(semantic=True, depth=True),
    "semantic": PoseSearchOptions().only(semantic=True),
    "depth + colour": PoseSearchOptions().only(depth=True, colour=True),
    "all terms, without polish": replace(FilterOptions(), answer="mle"),
    "all terms, paper's recipe": FilterOptions.paper(),
    "all terms, paper's recipe, coarse": FilterOptions.coarse(),
}


def _stage(name: str) -> Any:
    return lambda row: row["stage_seconds"].get(name, 0.0)


LOCALIZING = (
    Col(f"{FRAMES} frames", "method"), Col("map", "map"),
    Col("a frame", "frame_seconds", 0, "ms", 1e3), Col("reading", _stage("reading"), 1, "ms", 1e3),
    Col("search", _stage("search"), 1, "ms", 1e3),
    Col("a frame and pass", lambda r: _stage("filter")(r) / max(1, r["passes"]), 1, "ms", 1e3),
    Col("polish", _stage("polish"), 1, "ms", 1e3), Col("particles", "particles", 0),
    Col("M rays a frame", "rays_a_frame", 2, "", MEGA),
    Col("M rays/s", "rays_per_second", 1, "", MEGA), Col("scoring", "scoring_share", share),
    Col("peak", "peak_bytes", 0, "MB", MEGA),
)  # fmt: skip
SEARCH = (
    Col("search, median CPU, house", "method"),
    Col("1 frame", lambda r: r["cpu_seconds"]["1"], 0, "ms", 1e3),
    Col(f"{FRAMES} frames", lambda r: r["cpu_seconds"][str(FRAMES)], 0, "ms", 1e3),
)  # fmt: skip
TRACKING = (
    Col("tracker", lambda r: f"house, {r['updates']} updates"),
    Col("before it is OK", "before_ok_seconds", 0, "ms", 1e3),
    Col("after", "after_ok_seconds", 0, "ms", 1e3),
    Col("95th percentile", "after_ok_p95_seconds", 0, "ms", 1e3),
    Col("rate", lambda r: r["after_ok_seconds"] and 1 / r["after_ok_seconds"], 0, "Hz"),
    Col("peak", "peak_bytes", 0, "MB", MEGA),
)  # fmt: skip


def time_localization(
    scene: Path, folders: Sequence[Path], options: PoseSearchOptions
) -> dict[str, Any]:
    """Time a frame, by stage, of the first frames of each sequence; run in a fresh process."""
    opened = SceneMap.open(scene)
    stages: dict[str, float] = {}
    total = {"seconds": 0.0, "rays": 0.0, "poses": 0.0, "scoring": 0.0, "particles": 0.0}
    start = time.perf_counter()
    ask = partial(opened.localize, options=options, refine=False)
    ask(open_capture(folders[0])[:FRAMES], seed=1)
    first = time.perf_counter() - start
    for folder in folders:
        capture = open_capture(folder)[:FRAMES]
        start = time.perf_counter()
        estimate = ask(capture, seed=0)
        total["seconds"] += time.perf_counter() - start
        stats = estimate.stats
        for stage, seconds in stats["seconds"].items():
            stages[stage] = stages.get(stage, 0.0) + seconds
        total["rays"] += stats["rays"]
        total["poses"] += stats["poses_scored"]
        total["scoring"] += stats["seconds_scoring"]
        total["particles"] += mean_particles(stats) * FRAMES
    frames = FRAMES * len(folders)
    return {
        "frame_seconds": total["seconds"] / frames,
        "stage_seconds": {stage: seconds / frames for stage, seconds in stages.items()},
        "passes": len(options.particle_filter.passes) if options.particle_filter else 0,
        "particles": None if np.isnan(total["particles"]) else total["particles"] / frames,
        "poses_a_frame": total["poses"] / frames,
        "rays_a_frame": total["rays"] / frames,
        "rays_per_second": total["rays"] / total["scoring"],
        "scoring_share": total["scoring"] / total["seconds"],
        "first_call_seconds": first,
        "peak_bytes": peak(),
    }


def time_search(
    scene: Path, folders: Sequence[Path], options: PoseSearchOptions
) -> dict[str, float]:
    """Median CPU time of the search of one frame and of a sequence; in a fresh process."""
    opened, spent = SceneMap.open(scene), {}
    captures = [open_capture(folder) for folder in folders]
    for count in (1, FRAMES):
        seconds = []
        for lap in range(3):  # the first compiles, and makes the table
            for capture in captures:
                query = PoseQuery.of(opened, capture[:count], options=options)
                window = observe(query)
                window.views(COARSE)
                start = time.process_time()
                search(window, np.random.default_rng(0))
                if lap:
                    seconds.append(time.process_time() - start)
        spent[str(count)] = float(np.median(seconds))
    return spent


def time_tracking(scene: Path, folders: Sequence[Path]) -> dict[str, Any]:
    """Time of an update of the tracker before and after it first says OK; in a fresh process."""
    opened = SceneMap.open(scene)
    before: list[float] = []
    after: list[float] = []
    for lap, folder in enumerate([folders[0], *folders]):
        capture = open_capture(folder)
        tracker = opened.tracker(capture.camera, seed=0)
        found = False
        for frame in capture:
            start = time.perf_counter()
            status = tracker.update(frame).status.name
            seconds = time.perf_counter() - start
            if lap:  # the first sequence warms the process
                (after if found else before).append(seconds)
            found |= status == "OK"
    return {
        "before_ok_seconds": float(np.median(before)),
        "after_ok_seconds": float(np.median(after)) if after else None,
        "after_ok_p95_seconds": float(np.percentile(after, 95)) if after else None,
        "updates": len(before) + len(after),
        "peak_bytes": peak(),
    }


def methods(run: Run, path: Path, folders: list[Path]) -> list[dict[str, Any]]:
    """Time a frame of each method in fresh processes."""
    rows = []
    for method, options in METHODS.items():
        run.log(method)
        row = run_apart(time_localization, path, folders, options)
        rows.append({"method": method, "map": "house"} | row)
    return rows


@table("SG2Loc, Table 4")
def indoor_speed(
    run: Run,
    only: Annotated[str, option(f"Parts with commas: {', '.join(PARTS)}.")] = "",
    *,
    quick: Quick = False,
) -> None:
    """Time of indoor localization by stage; tracker, memory, cold starts."""
    wanted = check_names(parts(only) or (["start"] if quick else []), PARTS, "part")
    folders = sorted((run.data / "house").glob("seq[0-9]*"))
    indoor_maps.house(run.data, run.cache)
    house = indoor_maps.place(run.cache, "house")
    record: dict[str, Any] = {}
    if "start" in wanted:
        given = [str(house), str(folders[0]), "--frames", f"0:{FRAMES}", "--json"]
        command = ["scene", "localize", *given]
        spent = []
        for attempt in range(3 + 1):  # the first compiles, if nothing else did
            start = time.perf_counter()
            done = subprocess.run(  # noqa: S603  # our own command line
                [sys.executable, "-m", "placegraph.cli", *command],
                capture_output=True, text=True, check=False,
            )  # fmt: skip
            if done.returncode:
                raise PlacegraphError(f"{' '.join(command)} fails: {done.stderr.strip()[-300:]}")
            if attempt:
                spent.append(time.perf_counter() - start)
        json.loads(done.stdout)
        record["start"] = {"map": "house", "seconds": float(np.median(spent))}
        title = f"`placegraph scene localize`, {FRAMES} frames, cold"
        text = render((Col(title, "map"), Col("s", "seconds", 2)), [record["start"]])
        print(f"#### Cold start\n\n{text}\n")
    if "localizing" in wanted:
        record["localizing"] = methods(run, house, folders)
        paper = [[name, "", seconds, *["–"] * (len(LOCALIZING) - 3)] for name, seconds in PAPER]
        text = render(LOCALIZING, [*record["localizing"], *paper])
        print(f"#### Localizing, first frame and images included\n\n{text}\n")
    if "search" in wanted:
        record["search"] = [
            {"method": name, "cpu_seconds": run_apart(time_search, house, folders, given, cores=1)}
            for name, given in list(METHODS.items())[:4]
        ]
        print(f"#### Search\n\n{render(SEARCH, record['search'])}\n")
    if "tracking" in wanted:
        record["tracking"] = run_apart(time_tracking, house, folders)
        print(f"#### Tracking\n\n{render(TRACKING, [record['tracking']])}\n")
    run.save(record, complete=not only)
