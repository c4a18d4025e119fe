"""How small may a scene map be? Bytes, seconds, memory and recall of maps of many sizes.

    python benchmarks/scene_maps.py --every 13 --sizes full,default,small
    python benchmarks/scene_maps.py --only "instances: *; house found: *" --every 1
    python benchmarks/scene_maps.py --build-only

Prints Markdown tables and writes every row as JSON. Maps, measurements and answers are written down
at once: run it again and it goes on where it was cut. `docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from placegraph_lab.tables.indoor.jobs import chosen
from placegraph_lab.tables.indoor.metrics import dumps
from placegraph_lab.tables.indoor.windows import EVERY, OFFICE_EVERY
from placegraph_lab.tables.journal import Journal
from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.scene.maps import (
    FULL,
    LABELLED,
    NAMED,
    OFFICE_SIZES,
    PLACES,
    SWEEP,
    VERTICES,
    Maps,
    Size,
)
from placegraph_lab.tables.scene.maps_recall import Asking, findings, refinement, refinings, study
from placegraph_lab.tables.scene.maps_report import MAPPING, STORAGE, report

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
OUT = ROOT / "benchmarks/results/scene_maps.json"
ALL = {s.name: s for s in (*NAMED, VERTICES, LABELLED, *SWEEP)}


def sizes_of(place: str, names: list[str]) -> list[Size]:
    """Sizes of a place's maps, the full one first: those asked for, or all that make sense there."""
    fits = [s for s in ALL.values() if s != (LABELLED if place == "house" else VERTICES)]
    if not names and place != "house":
        names = list(OFFICE_SIZES)
    return [FULL, *(s for s in fits if s != FULL and (not names or s.name in names))]


def parted(text: str, mark: str) -> list[str]:
    """What stands between marks."""
    return [part.strip() for part in text.split(mark) if part.strip()]


def named(only: str) -> list[str]:
    """Names of rows; one without its number of frames means all of them."""
    return [n if n.endswith(("*", "frames")) else f"{n}, *" for n in parted(only, ";")]


def main(
    only: Annotated[
        str, typer.Option(help="Rows, with semicolons between: 'instances: *; a in b*'.")
    ] = "",
    sizes: Annotated[
        str,
        typer.Option(help=f"Sizes with commas between: {', '.join(ALL)}; full is always there."),
    ] = "",
    every: Annotated[int, typer.Option(help="Frames from one window of the house to the next.")] = (
        EVERY
    ),
    office_every: Annotated[int, typer.Option(help="The same for the office.")] = OFFICE_EVERY,
    seed: Annotated[int, typer.Option(help="Of the filter, the label noise and the starts.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    *,
    build_only: Annotated[bool, typer.Option(help="Ask about no window.")] = False,
    fresh: Annotated[bool, typer.Option(help="Measure and ask everything anew.")] = False,
    data: Annotated[Path, typer.Option(help="Folder with house and office.")] = SHARED / "data",
    weights: Annotated[Path, typer.Option(help="Network that labels images.")] = (
        SHARED / "weights/deeplabv3_mnv2_pascal_quant.tflite"
    ),
    cache: Annotated[Path, typer.Option(help="Folder for maps and answers.")] = (
        ROOT / ".benchmark-cache"
    ),
    out: Annotated[
        Path | None, typer.Option(help="JSON file; a part of it writes none by itself.")
    ] = None,
) -> None:
    """Measure scene maps of many sizes and print Markdown."""
    rows, refining = chosen(findings(), named(only)), chosen(refinings(), named(only))
    if not rows and not refining:
        known = [*(r.name for r in findings()), *(r.name for r in refinings())]
        raise typer.BadParameter(f"no row is named {only!r}; there are {'; '.join(known)}")
    names = parted(sizes, ",")
    unknown = sorted(set(names) - set(ALL))
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is no size; there are {', '.join(ALL)}")
    cache.mkdir(parents=True, exist_ok=True)
    path = cache / "scene_maps.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    maps = Maps(data, weights, cache, Journal(path), lambda text: typer.echo(text, err=True))
    asked = {r.place for r in rows} | {r.place for r in refining}
    wanted = {place: sizes_of(place, names) for place in PLACES if place in asked}
    if not (weights.exists() and find_spec("ai_edge_litert")):
        typer.echo("No labelled maps: they need --weights and the extra `segment`.", err=True)
        wanted = {place: [s for s in of if s != LABELLED] for place, of in wanted.items()}
    made = [maps.made(place, size) for place, of in wanted.items() for size in of]
    apart = {
        maps.made(place, size).name: maps.apart(place, size)
        for place, of in wanted.items()
        for size in of
        if size not in (FULL, LABELLED)
    }
    asking = Asking(maps, every, office_every, seed=seed, device=device)
    pairs = [] if build_only else study(asking, rows, wanted)
    refined = [] if build_only else refinement(asking, refining, wanted)
    print(report(made, apart, pairs, refined))
    target = out or (None if only or sizes or build_only else OUT)
    if target:
        target.parent.mkdir(parents=True, exist_ok=True)
        record = {
            "machine": machine(),
            "seed": seed,
            "device": device,
            "every": every,
            "office_every": office_every,
            "paper": {"storage_MB": STORAGE, "mapping_seconds": MAPPING},
            "maps": [
                asdict(m) | {"off_m": asdict(apart[m.name]) if m.name in apart else None}
                for m in made
            ],
            "recall": [p.to_dict() for p in pairs],
            "refined": refined,
        }
        target.write_text(dumps(record), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
