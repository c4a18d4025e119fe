"""What does localizing indoors cost? Time by particles, rays and triangles, memory, cold starts.

    placegraph-lab table indoor_speed
    placegraph-lab table indoor_speed --only "localizing,start"

Prints Markdown tables and writes JSON. `docs/benchmarks.md` explains what is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from placegraph.indoor.options import FilterOptions
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor.speed import (
    BASE,
    FRAMES,
    Cost,
    cold_start,
    costs,
    engines,
    localizing,
    no_cuda,
    resized,
    tracking,
)
from placegraph_lab.tables.runner import (
    Quick,
    Run,
    known,
    markdown,
    number,
    option,
    parts,
    share,
    table,
)
from placegraph_lab.tables.statistics import apart

PARTS = ("scoring", "engines", "localizing", "tracking", "start")
MEGA = 1e-6
PAPER = (
    ("*paper, three passes, a GPU (Tab. 4)*", "2.90 s"),
    ("*paper, coarse, a GPU (App. E)*", "1.60 s"),
)
METHODS = {
    "all terms": FilterOptions(),
    "semantic + depth": FilterOptions().only(semantic=True, depth=True),
    "semantic": FilterOptions().only(semantic=True),
    "depth + colour": FilterOptions().only(depth=True, colour=True),
    "all terms, without polish": replace(FilterOptions(), answer="mle"),
    "all terms, paper's recipe": FilterOptions.paper(),
    "all terms, paper's recipe, coarse": FilterOptions.coarse(),
}


def scoring(house: SceneMap, folder: Path, reason: str) -> tuple[str, list[dict[str, Any]]]:
    """Cost of scoring poses against one frame; on a GPU too where there is one."""
    found = costs(house, folder)
    if not reason:
        found += costs(house, folder, device="cuda")
    header = ["triangles", "device", "particles", "rays each", "ms", "µs a particle"]
    header += ["M rays/s", "casting"]
    lines = [cost_line(c) for c in found]
    if reason:
        lines.append(["", "cuda", *["–"] * 6])
    note = f"\n\nNo row for CUDA: {reason}" if reason else ""
    return markdown(header, lines) + note, [c.to_dict() for c in found]


def cost_line(c: Cost) -> list[str]:
    """Cells of one cost."""
    return [
        number(c.triangles),
        c.device,
        number(c.particles),
        number(c.rays),
        number(1e3 * c.seconds, 1),
        number(1e6 * c.seconds / c.particles, 1),
        number(MEGA * c.rate, 1),
        share(c.share) if not np.isnan(c.casting) else "–",
    ]


def casting(house: SceneMap, folder: Path) -> tuple[str, list[dict[str, Any]]]:
    """Rays a second of every engine at three sizes of the map."""
    rows: list[dict[str, Any]] = []
    for triangles in (BASE[2], len(house.mesh), 300_000):
        scene = house if triangles == len(house.mesh) else resized(house, triangles)
        rows.append({"triangles": len(scene.mesh), "rays_per_second": engines(scene, folder)})
    names = list(dict.fromkeys(name for row in rows for name in row["rays_per_second"]))
    lines = [
        [number(row["triangles"]), *(number(MEGA * row["rays_per_second"][n], 1) for n in names)]
        for row in rows
    ]
    return markdown(["M rays/s, triangles", *names], lines), rows


def methods(
    maps: dict[str, Path], folders: list[Path], reason: str, say: Callable[[str], None]
) -> tuple[str, list[dict[str, Any]]]:
    """Time a frame of each method on each map, in fresh processes."""
    rows = []
    for map_name, path in maps.items():
        for name, options in METHODS.items():
            if map_name != "house" and name not in {"all terms", "all terms, without polish"}:
                continue
            for device in ("cpu",) if reason else ("cpu", "cuda"):
                say(f"{name}, {map_name}, {device}")
                row = apart(localizing, path, folders, options, device)
                rows.append({"method": name, "map": map_name} | row)
    header = [f"{FRAMES} frames", "map", "device", "a frame", "reading", "search"]
    header += ["a frame and pass", "polish", "particles", "M rays a frame", "M rays/s"]
    header += ["scoring", "peak"]
    lines = [method_line(row) for row in rows]
    lines += [[name, "", "", seconds, *["–"] * 9] for name, seconds in PAPER]
    return markdown(header, lines), rows


def method_line(row: dict[str, Any]) -> list[str]:
    """Cells of one method."""
    stage = row["stage_seconds"]
    return [
        row["method"],
        row["map"],
        row["device"],
        number(1e3 * row["frame_seconds"], 0, "ms"),
        number(1e3 * stage.get("reading", 0.0), 1, "ms"),
        number(1e3 * stage.get("search", 0.0), 1, "ms"),
        number(1e3 * stage.get("filter", 0.0) / max(1, row["passes"]), 1, "ms"),
        number(1e3 * stage.get("polish", 0.0), 1, "ms"),
        number(row["particles"]),
        number(MEGA * row["rays_a_frame"], 2),
        number(MEGA * row["rays_per_second"], 1),
        share(row["scoring_share"]),
        number(MEGA * row["peak_bytes"], 0, "MB"),
    ]


def tracked(path: Path, folders: list[Path]) -> tuple[str, dict[str, Any]]:
    """Updates of the tracker, before and after it has converged."""
    row = apart(tracking, path, folders)
    after, worst = row["after_ok_seconds"], row["after_ok_p95_seconds"]
    header = ["tracker", "before it is OK", "after", "95th percentile", "rate", "peak"]
    cells = [
        f"house, {row['updates']} updates",
        number(1e3 * row["before_ok_seconds"], 0, "ms"),
        number(after and 1e3 * after, 0, "ms"),
        number(worst and 1e3 * worst, 0, "ms"),
        number(after and 1 / after, 0, "Hz"),
        number(MEGA * row["peak_bytes"], 0, "MB"),
    ]
    return markdown(header, [cells]), row


def started(path: Path, folder: Path) -> tuple[str, dict[str, Any]]:
    """Cold start of the command line, compiled code cached."""
    command = ["scene", "localize", str(path), str(folder), "--frames", f"0:{FRAMES}", "--json"]
    seconds = cold_start(command)
    text = f"`placegraph scene localize`, {FRAMES} frames, cold"
    return markdown([text, "s"], [["house", number(seconds, 2)]]), {"seconds": seconds}


@table("SG2Loc, Table 4")
def indoor_speed(
    run: Run,
    only: Annotated[str, option(f"Parts with commas: {', '.join(PARTS)}.")] = "",
    *,
    quick: Quick = False,
) -> None:
    """What does localizing indoors cost? By particles, rays and triangles; memory, cold starts."""
    wanted = known(parts(only) or (["start"] if quick else []), PARTS, "part")
    folders = sorted((run.data / "house").glob("seq[0-9]*"))
    reason = no_cuda()
    house = indoor_maps.house(run.data, run.cache)
    indoor_maps.coarse_house(run.data, run.cache)
    maps = {
        "house": indoor_maps.place(run.cache, "house"),
        "house, 20k triangles": indoor_maps.place(run.cache, f"house_{indoor_maps.COARSE}"),
    }
    work = {
        "start": ("Cold start", lambda: started(maps["house"], folders[0])),
        "localizing": (
            "Localizing, first frame and images included",
            lambda: methods(maps, folders, reason, run.say),
        ),
        "tracking": ("Tracking", lambda: tracked(maps["house"], folders)),
        "scoring": ("Scoring poses against one frame", lambda: scoring(house, folders[0], reason)),
        "engines": ("Ray casters, hits written to arrays", lambda: casting(house, folders[0])),
    }
    record: dict[str, Any] = {"no_cuda": reason}
    for part, (title, measured) in work.items():
        if part in wanted:
            run.say(part)
            text, record[part] = measured()
            print(f"#### {title}\n\n{text}\n")
    run.save(record, whole=not only)
