"""What does localizing indoors cost? Time by particles, rays and triangles, memory, cold starts.

    python benchmarks/indoor_speed.py
    python benchmarks/indoor_speed.py --only "localizing,start"

Prints Markdown tables and writes JSON. `docs/benchmarks.md` explains what is measured.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from placegraph.indoor.options import FilterOptions
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor.metrics import dumps
from placegraph_lab.tables.indoor.speed import (
    BASE,
    FRAMES,
    Cost,
    apart,
    cold_start,
    costs,
    engines,
    localizing,
    no_cuda,
    resized,
    tracking,
)
from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.tables import markdown, number, share

if TYPE_CHECKING:
    from placegraph.indoor.scene_map import SceneMap

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared/data"
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
    "all terms, coarse only": FilterOptions.coarse(),
    "all terms, without polish": replace(FilterOptions(), polish=False),
    "all terms, paper's recipe": FilterOptions.paper(),
}


def say(text: str) -> None:
    """Tell the person who waits, apart from the tables."""
    print(text, file=sys.stderr)


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
    maps: dict[str, Path], folders: list[Path], reason: str
) -> tuple[str, list[dict[str, Any]]]:
    """Time a frame of each method on each map, in fresh processes."""
    rows = []
    for map_name, path in maps.items():
        for name, options in METHODS.items():
            if map_name != "house" and name not in {"all terms", "all terms, coarse only"}:
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
        number(1e3 * stage.get("filter", 0.0) / row["passes"], 1, "ms"),
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


def main(
    only: Annotated[str, typer.Option(help=f"Parts with commas: {', '.join(PARTS)}.")] = "",
    data: Annotated[Path, typer.Option(help="Folder with house and office.")] = DATA,
    cache: Annotated[Path, typer.Option(help="Folder for maps.")] = ROOT / ".benchmark-cache",
    out: Annotated[Path | None, typer.Option(help="JSON file; with --only none.")] = None,
) -> None:
    """Measure what indoor localization costs and print Markdown."""
    parts = [p.strip() for p in only.split(",") if p.strip()] or list(PARTS)
    unknown = sorted(set(parts) - set(PARTS))
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is no part; there are {', '.join(PARTS)}")
    folders = sorted((data / "house").glob("seq[0-9]*"))
    reason = no_cuda()
    house = indoor_maps.house(data, cache)
    indoor_maps.coarse_house(data, cache)
    maps = {
        "house": indoor_maps.place(cache, "house"),
        "house, 20k triangles": indoor_maps.place(cache, f"house_{indoor_maps.COARSE}"),
    }
    record: dict[str, Any] = {"machine": machine(), "no_cuda": reason}
    if "start" in parts:
        say("cold start")
        text, record["start"] = started(maps["house"], folders[0])
        print(f"#### Cold start\n\n{text}\n")
    if "localizing" in parts:
        text, record["localizing"] = methods(maps, folders, reason)
        print(f"#### Localizing, first frame and images included\n\n{text}\n")
    if "tracking" in parts:
        say("tracking")
        text, record["tracking"] = tracked(maps["house"], folders)
        print(f"#### Tracking\n\n{text}\n")
    if "scoring" in parts:
        say("scoring")
        text, record["scoring"] = scoring(house, folders[0], reason)
        print(f"#### Scoring poses against one frame\n\n{text}\n")
    if "engines" in parts:
        say("engines")
        text, record["engines"] = casting(house, folders[0])
        print(f"#### Ray casters, hits written to arrays\n\n{text}\n")
    target = out or (None if only else ROOT / "benchmarks/results/indoor_speed.json")
    if target:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(dumps(record), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
