"""Tables of the benchmark of scene maps: what a map takes, and what a smaller one loses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

from placegraph_lab.tables.indoor.bench import chosen
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
    markdown,
    number,
    option,
    parts,
    share,
    shares,
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
    Asking,
    Finding,
    Made,
    Maps,
    Paired,
    Refining,
    Size,
    difference,
    findings,
    recall_of,
    refinement,
    refinings,
    study,
)
from placegraph_lab.tables.scene.surface import Apart

KILO, MEGA, MILLI = 1e-3, 1e-6, 1e3
ROOM = 30  # objects of a usual room
STORAGE = {
    "HLoc": (294.4, 283.3), "MeshLoc": (1433.6, 589.7), "Loc-NeRF": (143.9, 66.6),
    "SG2Loc": (9.8, 28.2), "ACE": (4.2, 4.2),
}  # fmt: skip
"""MB a scene of 3RScan and of ScanNet: Table 3 of the paper."""
MAPPING = {"HLoc": 3520.0, "MeshLoc": 2208.0, "Loc-NeRF": 1490.0, "SG2Loc": 1.6, "ACE": 134.2}
"""Seconds a scene of 3RScan to make a map of it: Table 4."""


def report(
    made: Sequence[Made],
    apart: dict[str, Apart],
    pairs: Sequence[Paired],
    refined: Sequence[dict[str, Any]],
) -> str:
    """All tables that there are rows for; `apart` by the name of the map."""
    parts = ["#### What a map takes", maps_table(made, apart)]
    parts += ["#### Beside the paper", storage_table(made)]
    for place, title in ((p, PLACES[p].title) for p in PLACES):
        own = [m for m in made if m.place == place]
        mine = [p for p in pairs if _place(p) == place]
        if mine:
            named = [p for p in mine if not _swept(p.size)]
            parts += [f"#### {title}: recall{_limits(mine[0])}", recall_table(named)]
        if any(_swept(m.size) for m in own):
            parts += [f"#### {title}: bytes against recall", sweep_table(own, apart, mine)]
    if refined:
        header = ["", "size", "windows", "median", "10 cm, 5°", "accepted", "s refining"]
        lines = []
        for row in refined:
            after = row["after"]
            centimetres, degrees = after["median_position_m"], after["median_rotation_deg"]
            median = (
                "–"
                if centimetres is None
                else f"{number(100 * centimetres, 2)} cm, {number(degrees, 2)}°"
            )
            lines.append(
                [
                    row["row"],
                    row["size"],
                    number(row["windows"]),
                    median,
                    share(after["recall"]["0.1 m, 5 deg"]),
                    share(row["accepted"]),
                    number(row["refine_seconds"], 2),
                ]
            )
        parts += ["#### Refined poses", markdown(header, lines)]
    changed = changes(pairs)
    if changed:
        parts += ["#### Windows that are right on one map only", changed]
    return "\n\n".join(parts)


def maps_table(made: Sequence[Made], apart: dict[str, Apart]) -> str:
    """Bytes by part, size, time, memory and error of each map."""
    header = [
        "", "objects", "triangles", "graph kB", "surface kB", "colour kB", "total kB",
        "embeddings kB", "bytes an object", f"kB a room of {ROOM}", "build s", "command s",
        "peak MB", "opens ms", "off mm: mean / 95 % / most",
    ]  # fmt: skip
    return markdown(header, [_maps_line(m, apart.get(m.name)) for m in made])


def _maps_line(m: Made, off: Apart | None) -> list[str]:
    return [
        m.name,
        number(m.objects),
        number(m.triangles),
        *(number(KILO * m.parts[part], 1) for part in ("graph", "surface", "colour")),
        number(KILO * m.bytes, 1),
        number(KILO * m.parts["embeddings"], 1),
        number(m.bytes / m.objects),
        number(KILO * ROOM * m.bytes / m.objects),
        number(m.build_seconds, 2),
        number(m.command_seconds, 2),
        number(None if m.peak_bytes is None else MEGA * m.peak_bytes),
        number(MILLI * m.open_seconds),
        _distances(off),
    ]


def _distances(off: Apart | None) -> str:
    if off is None:
        return "–"
    return " / ".join(number(MILLI * d, 1) for d in (off.mean, off.most, off.maximum))


def storage_table(made: Sequence[Made]) -> str:
    """Tables 3 and 4 of the paper, and our maps."""
    header = ["", "MB a scene", "MB a room of 30 objects", "seconds to make it"]
    lines = [
        [f"*{name}, 3RScan / ScanNet*", f"{a} / {b}", "–", number(MAPPING[name], 1)]
        for name, (a, b) in STORAGE.items()
    ]
    lines += [
        [
            m.name,
            number(MEGA * m.bytes, 3),
            number(MEGA * ROOM * m.bytes / m.objects, 3),
            number(m.build_seconds, 1),
        ]
        for m in made
        if not _swept(m.size)
    ]
    return markdown(header, lines)


def recall_table(pairs: Sequence[Paired]) -> str:
    """Recall of every row by size, and the difference to the full map, rows pooled."""
    rows = list(dict.fromkeys(p.row for p in pairs))
    lines = []
    for size in dict.fromkeys(p.size for p in pairs):
        at = {p.row: p for p in pairs if p.size == size}
        lines.append(
            [size, *(shares(at[r].recalls) for r in rows), *_difference(list(at.values()))]
        )
    windows = {p.row: len(p.answers) for p in pairs}
    heads = [f"{r} ({windows[r]})" for r in rows]
    return markdown(["", *heads, "points against full", "gained / lost"], lines)


def sweep_table(made: Sequence[Made], apart: dict[str, Apart], pairs: Sequence[Paired]) -> str:
    """Bytes against recall, rows pooled."""
    header = [
        "", "total kB", "surface kB", "colour kB", "triangles", "off mm: mean / 95 % / most",
        "recall", "points against full", "gained / lost",
    ]  # fmt: skip
    lines = []
    for m in made:
        mine = [p for p in pairs if p.size == m.size]
        lines.append(
            [
                m.size,
                number(KILO * m.bytes, 1),
                *(number(KILO * m.parts[part], 1) for part in ("surface", "colour")),
                number(m.triangles),
                _distances(apart.get(m.name)),
                share(recall_of(mine)),
                *_difference(mine),
            ]
        )
    return markdown(header, lines)


def _difference(pairs: Sequence[Paired]) -> list[str]:
    steps = [step for p in pairs for step in p.steps]
    if not steps or all(p.size == FULL.name for p in pairs):
        return ["–", "–"]
    points, error = difference(steps)
    return [f"{points:+.1f} ± {error:.1f}", f"{steps.count(1)} / {steps.count(-1)}"]


def changes(pairs: Sequence[Paired]) -> str:
    """Windows that were lost or gained, by map and row."""
    lines = []
    for p in pairs:
        for what, windows in (("lost", p.lost), ("gained", p.gained)):
            if windows:
                lines.append(f"- {p.size}, {p.row}: {what} {'; '.join(windows)}")
    return "\n".join(lines)


def _place(pairs: Paired) -> str:
    table = pairs.row.partition(":")[0]
    return table if table in PLACES else "house"


def _swept(size: str) -> bool:
    return size in {s.name for s in SWEEP}


def _limits(pairs: Paired) -> str:
    names = [f"{100 * m:.0f} cm {d:.0f}°" for m, d in pairs.limits]
    return f" within {' / '.join(names)} (windows)"


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
