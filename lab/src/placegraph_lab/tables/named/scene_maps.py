"""Table `scene_maps`: how small may a scene map be? Bytes, seconds, memory and recall of maps of many sizes.

Maps are built by `placegraph scene build`; all are asked about the same windows. Every answer is
written down at once: run it again and it goes on where it was cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor.bench import choose_jobs
from placegraph_lab.tables.indoor.refine import RefineScore
from placegraph_lab.tables.indoor.report import errors
from placegraph_lab.tables.indoor.windows import EVERY, OFFICE_EVERY
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.scene.maps import (
    FULL,
    LABELLED,
    NAMED,
    OFFICE_SIZES,
    PLACES,
    VERTICES,
    MapMeasurement,
    Maps,
    PairedAnswers,
    Size,
    WindowRunner,
    difference,
    findings,
    refinement,
    refinings,
    study,
)
from placegraph_lab.tables.scene.surface import SurfaceDistances

ROOM = 30  # objects of a usual room
STORAGE = {
    "HLoc": (294.4, 283.3), "MeshLoc": (1433.6, 589.7), "Loc-NeRF": (143.9, 66.6),
    "SG2Loc": (9.8, 28.2), "ACE": (4.2, 4.2),
}  # fmt: skip
"""MB a scene of 3RScan and of ScanNet: Table 3 of the paper."""
ALL = {s.name: s for s in (*NAMED, VERTICES, LABELLED)}


def _distances(off: SurfaceDistances | None) -> str:
    if off is None:
        return "–"
    return " / ".join(lab.number(1e3 * d, 1) for d in (off.mean, off.most, off.maximum))


MAPS = (
    Col("", "0.name"), Col("objects", "0.objects", 0), Col("triangles", "0.triangles", 0),
    *(Col(f"{part} kB", f"0.parts.{part}", 1, "", 1e-3) for part in ("graph", "surface", "colour")),
    Col("total kB", "0.bytes", 1, "", 1e-3), Col("embeddings kB", "0.parts.embeddings", 1, "", 1e-3),
    Col(f"kB a room of {ROOM}", lambda r: ROOM * r[0].bytes / r[0].objects, 0, "", 1e-3),
    Col("build s", "0.build_seconds", 2), Col("peak MB", "0.peak_bytes", 0, "", 1e-6),
    Col("opens ms", "0.open_seconds", 0, "", 1e3), Col("off mm: mean / 95 % / most", "1", _distances),
)  # fmt: skip
REFINED = (
    Col("", "0"), Col("size", "1"), Col("windows", "2.windows", 0),
    Col("median", "2.after.median", errors), Col("10 cm, 5°", "2.after.recall.0", lab.share),
    Col("accepted", "2.accepted", lab.share), Col("s refining", "2.refine_seconds", 2),
)  # fmt: skip


def report(
    made: Sequence[MapMeasurement],
    apart: dict[str, SurfaceDistances],
    pairs: Sequence[PairedAnswers],
    refined: Sequence[tuple[str, str, RefineScore]],
) -> str:
    """Return all tables that there are rows for; `apart` by the name of the map."""
    text = ["#### What a map takes", lab.render(MAPS, [(m, apart.get(m.name)) for m in made])]
    paper = [[f"*{name}*", lab.number(a, 1), lab.number(b, 1)] for name, (a, b) in STORAGE.items()]
    text += ["#### The paper's MB a scene", lab.markdown(["", "3RScan", "ScanNet"], paper)]
    for place, of in PLACES.items():
        if mine := [p for p in pairs if p.place == place]:
            limits = " / ".join(f"{100 * m:.0f} cm {d:.0f}°" for m, d in mine[0].limits)
            text += [f"#### {of.title}: recall within {limits} (windows)", recall_table(mine)]
    if refined:
        text += ["#### Refined poses", lab.render(REFINED, refined)]
    changed = [
        f"- {p.size}, {p.row}: {what} {'; '.join(windows)}"
        for p in pairs for what, windows in (("lost", p.lost), ("gained", p.gained)) if windows
    ]  # fmt: skip
    if changed:
        text += ["#### Windows that are right on one map only", "\n".join(changed)]
    return "\n\n".join(text)


def recall_table(pairs: Sequence[PairedAnswers]) -> str:
    """Return recall of every row by size, and the difference to the full map, rows pooled."""
    windows = {p.row: len(p.answers) for p in pairs}
    lines = []
    for size in dict.fromkeys(p.size for p in pairs):
        at = {p.row: p for p in pairs if p.size == size}
        steps = [step for p in at.values() for step in p.steps]
        points, error = difference(steps)
        told = [f"{points:+.1f} ± {error:.1f}", f"{steps.count(1)} / {steps.count(-1)}"]
        told = ["–", "–"] if size == FULL.name else told
        lines.append([size, *(lab.shares(at[row].recalls) for row in windows), *told])
    heads = [f"{row} ({count})" for row, count in windows.items()]
    return lab.markdown(["", *heads, "points against full", "gained / lost"], lines)


def sizes_of(place: str, names: list[str]) -> list[Size]:
    fits = [s for s in ALL.values() if s != (LABELLED if place == "house" else VERTICES)]
    if not names and place != "house":
        names = list(OFFICE_SIZES)
    return [FULL, *(s for s in fits if s != FULL and (not names or s.name in names))]


@lab.table("SG2Loc, Tables 3, 4")
def scene_maps(
    run: lab.Run,
    only: Annotated[
        str, lab.option("Rows, with semicolons between: 'instances: *; a in b*'.")
    ] = "",
    sizes: Annotated[
        str, lab.option(f"Sizes with commas between: {', '.join(ALL)}; full is always there.")
    ] = "",
    every: lab.Every = EVERY,
    office_every: lab.OfficeEvery = OFFICE_EVERY,
    seed: lab.Seed = 0,
    device: lab.Device = "auto",
    *,
    build_only: Annotated[bool, lab.option("Ask about no window.")] = False,
    fresh: lab.Fresh = False,
    quick: lab.Quick = False,
    weights: Annotated[
        Path | None, lab.option("Of the network that labels images; those of --data if not given.")
    ] = None,
) -> None:
    """Bytes, seconds, memory and recall of scene maps of many sizes."""
    rows, refining = findings(), refinings()
    if only:
        asked_for = [n if n.endswith(("*", "frames")) else f"{n}, *" for n in lab.parts(only, ";")]
        both = {r.name for r in choose_jobs([*rows, *refining], asked_for)}
        rows = [r for r in rows if r.name in both]
        refining = [r for r in refining if r.name in both]
    names = lab.parts(sizes)
    if quick:
        names, every, office_every = names or ["default", "small"], 50, 60
    lab.check_names(names, ALL, "size")
    weights = weights or run.shared / "weights/deeplabv3_mnv2_pascal_quant.tflite"
    maps = Maps(run.data, weights, run.cache, run.journal(fresh=fresh), run.log)
    asked = {r.place for r in rows} | {r.place for r in refining}
    wanted = {place: sizes_of(place, names) for place in PLACES if place in asked}
    if not (weights.exists() and find_spec("ai_edge_litert")):
        run.log("No labelled maps: they need the network's weights and the extra `segment`.")
        wanted = {place: [s for s in of if s != LABELLED] for place, of in wanted.items()}
    made = [maps.measure_map(place, size) for place, of in wanted.items() for size in of]
    apart = {
        maps.measure_map(place, size).name: maps.measure_distances(place, size)
        for place, of in wanted.items()
        for size in of
        if size not in (FULL, LABELLED)
    }
    asking = WindowRunner(maps, every, office_every, seed=seed, device=device)
    pairs = [] if build_only else study(asking, rows, wanted)
    refined = [] if build_only else refinement(asking, refining, wanted)
    print(report(made, apart, pairs, refined))
    built = [lab.plain(m) | {"off_m": apart.get(m.name)} for m in made]
    record = {"paper": {"storage_MB": STORAGE}, "maps": built}
    record |= {"recall": [p.record() for p in pairs], "refined": refined}
    run.save(record, complete=not (only or sizes or build_only))
