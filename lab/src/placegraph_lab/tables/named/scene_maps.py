"""How small may a scene map be? Bytes, seconds, memory and recall of maps of many sizes.

    placegraph-lab table scene_maps --every 13 --sizes full,default,small
    placegraph-lab table scene_maps --only "instances: *; house found: *" --every 1
    placegraph-lab table scene_maps --build-only

Prints Markdown tables and writes every row as JSON. Maps, measurements and answers are written down
at once: run it again and it goes on where it was cut. `docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path  # Typer reads the annotations
from typing import Annotated

from placegraph_lab.tables.indoor.jobs import chosen
from placegraph_lab.tables.indoor.windows import EVERY, OFFICE_EVERY
from placegraph_lab.tables.runner import (
    Device,
    Every,
    Fresh,
    OfficeEvery,
    Quick,
    Run,
    Seed,
    known,
    option,
    parts,
    table,
)
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
from placegraph_lab.tables.scene.maps_recall import (
    Asking,
    Finding,
    Refining,
    findings,
    refinement,
    refinings,
    study,
)
from placegraph_lab.tables.scene.maps_report import MAPPING, STORAGE, report

ALL = {s.name: s for s in (*NAMED, VERTICES, LABELLED, *SWEEP)}


def sizes_of(place: str, names: list[str]) -> list[Size]:
    """Sizes of a place's maps, the full one first: those asked for, or all that make sense there."""
    fits = [s for s in ALL.values() if s != (LABELLED if place == "house" else VERTICES)]
    if not names and place != "house":
        names = list(OFFICE_SIZES)
    return [FULL, *(s for s in fits if s != FULL and (not names or s.name in names))]


def named(only: str) -> list[str]:
    """Names of rows; one without its number of frames means all of them."""
    return [n if n.endswith(("*", "frames")) else f"{n}, *" for n in parts(only, ";")]


@table("SG2Loc, Tables 3, 4")
def scene_maps(
    run: Run,
    only: Annotated[str, option("Rows, with semicolons between: 'instances: *; a in b*'.")] = "",
    sizes: Annotated[
        str, option(f"Sizes with commas between: {', '.join(ALL)}; full is always there.")
    ] = "",
    every: Every = EVERY,
    office_every: OfficeEvery = OFFICE_EVERY,
    seed: Seed = 0,
    device: Device = "auto",
    *,
    build_only: Annotated[bool, option("Ask about no window.")] = False,
    fresh: Fresh = False,
    quick: Quick = False,
    weights: Annotated[
        Path | None, option("Of the network that labels images; those of --data if not given.")
    ] = None,
) -> None:
    """How small may a scene map be? Bytes, seconds, memory and recall of maps of many sizes."""
    rows, refining = findings(), refinings()
    if only:
        every_row: list[Finding | Refining] = [*rows, *refining]
        both = {r.name for r in chosen(every_row, named(only))}
        rows = [r for r in rows if r.name in both]
        refining = [r for r in refining if r.name in both]
    names = parts(sizes)
    if quick:
        names, every, office_every = names or ["default", "small"], 50, 60
    known(names, ALL, "size")
    weights = weights or run.shared / "weights/deeplabv3_mnv2_pascal_quant.tflite"
    maps = Maps(run.data, weights, run.cache, run.journal(fresh=fresh), run.say)
    asked = {r.place for r in rows} | {r.place for r in refining}
    wanted = {place: sizes_of(place, names) for place in PLACES if place in asked}
    if not (weights.exists() and find_spec("ai_edge_litert")):
        run.say("No labelled maps: they need the network's weights and the extra `segment`.")
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
    built = [
        asdict(m) | {"off_m": asdict(apart[m.name]) if m.name in apart else None} for m in made
    ]
    record = {"paper": {"storage_MB": STORAGE, "mapping_seconds": MAPPING}, "maps": built}
    record |= {"recall": [p.to_dict() for p in pairs], "refined": refined}
    run.save(record, whole=not (only or sizes or build_only))
