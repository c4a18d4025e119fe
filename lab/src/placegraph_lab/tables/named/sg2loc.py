"""Tables of the SG2Loc paper: its figures as printed, of HLoc too, and ours below them.

Errors are in metres and degrees, recalls are shares. Sequence lengths are set off by bars.
"""

from __future__ import annotations

import inspect
import math
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

from placegraph.errors import InputError
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor import sg2loc as sources
from placegraph_lab.tables.indoor.metrics import score
from placegraph_lab.tables.indoor.report import errors
from placegraph_lab.tables.indoor.scan3r import Split
from placegraph_lab.tables.indoor.sg2loc import (
    IMAGES,
    LAYOUT,
    How,
    Reply,
    Set,
    WindowRunner,
    group,
    recipes,
)
from placegraph_lab.tables.indoor.windows import DRIFTING, EXACT, Odometry
from placegraph_lab.tables.named.scene_retrieval import figures, main_table
from placegraph_lab.tables.scene.places import (
    FIRST,
    HOMES,
    NOISY,
    Place,
    Walk,
    encoder_of,
    homes,
)
from placegraph_lab.tables.scene.search import Cosines, Scenes, Study
from placegraph_lab.tables.statistics import wilson_interval


def read_published(table: int) -> list[tuple[str, list[list[float | None]]]]:
    """Rows of a table: name, and published by sequence length; None where there is none."""
    text = Path(sources.__file__).with_suffix(".txt").read_text("utf-8")
    lines = [line.split(";") for line in text.splitlines() if not line.startswith("#")]
    return [
        (
            row.strip(),
            [[None if w == "-" else float(w) for w in p.split()] for p in text.split("|")],
        )
        for of, row, text in lines
        if int(of) == table
    ]


class Spec(NamedTuple):
    """One table."""

    asks: str
    columns: tuple[str, ...] = ()
    lengths: tuple[int, ...] = (5,)
    rows: tuple[tuple[str, str, bool], ...] = ()
    """Name, recipe, and whether what comes after the filter counts."""
    pace: float = 0.0  # seconds in which a frame is done with (Table 6); 0: as measured
    rooms: int = 1  # fewest rooms that a set shows
    scenes: int = 0  # scenes of 3RScan that the paper has; 0: all of the split


FULL = (
    ("SG2Loc as printed", "paper", True),
    ("SG2Loc as published, filter alone", "published", False),
    ("placegraph's default", "ours", True),
)
SEMANTIC = ("SG2Loc w/ semantic", "semantic", False)
ALL = ("SG2Loc w/ semantic+depth+RGB", "paper", False)
COARSE = (FULL[0], ("SG2Loc (Coarse)", "coarse", True), FULL[2])
ABLATION = (
    ("Max. raycast resolution", "stride 1", False), ("Uniform sampling", "uniform", False),
    ("w/o adaptive resampling", "fixed", False), SEMANTIC,
    ("SG2Loc w/ semantic+depth", "semantic+depth", False), ALL, *FULL[::2],
)  # fmt: skip
ONE_SIGNAL = (
    SEMANTIC, ("SG2Loc w/ depth", "depth", False), ("SG2Loc w/ RGB", "RGB", False),
)  # fmt: skip
ERRORS = ("mean", "median")
NEAR, TWO = "25 cm / 2° / both", "10 cm 5° / 25 cm 10°"
LENGTHS = (5, 10, 25, 50)

SPECS = {
    1: Spec("How far off are poses of 5 to 50 frames? Mean and median.", ERRORS, LENGTHS, FULL),
    2: Spec("How many poses of 5 to 50 frames are right?", (NEAR,), LENGTHS, FULL),
    3: Spec("How many bytes does the map of a scene take?"),
    4: Spec("How long do mapping, localizing and the final fit take?", rows=FULL),
    5: Spec("Which scene of 10 or 50 was a sequence taken in, and how long does it take?", rooms=2),
    6: Spec(
        "What remains of 100 frames that come as fast as they were taken?",
        (*ERRORS, NEAR), (100,), FULL[::2],
    ),
    7: Spec("What is each part of the method worth?", (TWO,), (5,), ABLATION, scenes=4),
    8: Spec("What is each signal worth alone?", (*ERRORS, TWO), (5,), ONE_SIGNAL),
    9: Spec("What are the signals worth, by length? Errors.", ERRORS, LENGTHS[:3], (SEMANTIC, ALL, FULL[0])),
    10: Spec("What are the signals worth, by length? Recall.", (TWO,), LENGTHS[:3], (SEMANTIC, ALL, FULL[0])),
    11: Spec(
        "Is the pose found in several scenes that are one map?",
        ("R@1", *ERRORS, TWO), (50,), FULL[::2], rooms=3,
    ),
    12: Spec("What does one coarse pass cost? Errors.", ERRORS, (5, 25), COARSE),
    13: Spec("What does one coarse pass cost? Recall.", (NEAR,), (5, 25), COARSE),
    14: Spec(
        "What does the drift of odometry cost?", ("median", "25 cm 2°"), (5,), FULL[::2]
    ),
}  # fmt: skip
"""By number in the paper."""
Made = tuple[str, list[Any]]


def storage(_: Spec, asking: WindowRunner, of: Sequence[Set]) -> Made:
    """Table 3: megabytes of a map's file."""
    rows = _printed(3, ("3RScan [MB]", "ScanNet [MB]"))
    for its in of:
        scenes = [its.scene(name) for name in its.rooms]
        megabytes = float(np.mean([_filed(scene)[1] for scene in scenes])) / 1e6
        objects = sum(len(scene) for scene in scenes)
        vertices = sum(len(scene.mesh.vertices) for scene in scenes)
        rows.append(
            {"row": f"{its.name}, placegraph", "scenes": len(scenes), "a scene [MB]": megabytes,
             "objects a scene": objects / len(scenes), "vertices an object": vertices / objects}
        )  # fmt: skip
        asking.run.log(f"{its.name}: {len(scenes)} maps")
    return _written(rows), rows


def seconds(spec: Spec, asking: WindowRunner, of: Sequence[Set]) -> Made:
    """Table 4: seconds of mapping (rays, panoramas, embeddings), of a frame, of the final fit."""
    heads = ("mapping [s]", "a frame [s]", "final fit [s]")
    rows = _printed(4, heads)
    for its in of:
        for name, recipe, _ in spec.rows:
            replies = [r for n in spec.lengths for r in asking.replies(its, recipe, n)]
            walk, window = its.windows(min(spec.lengths), 1, 0, asking.odometry)[0]
            mapping = []
            for _again in range(3):  # the first compiles
                scene = _filed(its.scene(walk.map))[0]
                start = time.perf_counter() + asking.saved_seconds
                asking.ready(its, recipes()[recipe], scene, window, walk.map)
                mapping.append(time.perf_counter() + asking.saved_seconds - start)
            told = (
                min(mapping),
                float(np.median([r.filter.seconds / r.filter.frames for r in replies])),
                float(np.median([r.refining for r in replies])),
            )
            row = {"row": f"{its.name}: {name}", "windows": len(replies)}
            rows.append(row | dict(zip(heads, told, strict=True)))
    return _written(rows), rows


def retrieval(_: Spec, asking: WindowRunner, of: Sequence[Set]) -> Made:
    """Table 5: which scene it is, by the paper's sum and by ours, with the time it takes."""
    text, rows = [], []
    for its in of:
        if its.name == "homes":  # the fifty and more of `scene_retrieval`, a walk in each
            made = list(homes(range(FIRST, FIRST + HOMES), asking.run.cache))
            places = [place for place, _ in made]
            walks = [own[i % 2] for i, (_, own) in enumerate(made)]
        else:
            show = its.pictures if asking.named_encoder else lambda _: ()
            places = [
                Place(name, its.scene(name), room, show(name)) for name, room in its.rooms.items()
            ]
            walks = [Walk(w.name, w.map, w.open()[0], bool(w.changed)) for w in its.walks]
        named = (lambda _: asking.named_encoder) if asking.named_encoder else encoder_of
        study = Study(places, walks, asking.run.cache, asking.journal, asking.run.log, named)
        labelled = any(w.capture.label_kind == "labels" for w in walks)
        row = study.row(asking.how.encoder or (NOISY if labelled else "appearance"))
        text += [f"#### {its.name}: {len(places)} scenes, {len(walks)} walks", main_table([row])]
        rows += [{"set": its.name, "scenes": len(places)} | told for told in figures([row])]
    return "\n\n".join(text), rows


def _filed(scene: SceneMap) -> tuple[SceneMap, int]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one.scene"
        scene.save(path)
        return SceneMap.open(path), path.stat().st_size


def _printed(table: int, heads: Sequence[str]) -> list[dict[str, Any]]:
    return [
        {"row": f"*paper, {row}*"} | dict(zip(heads, numbers, strict=True))
        for row, (numbers,) in read_published(table)
    ]


def _written(rows: list[dict[str, Any]]) -> str:
    heads = list(dict.fromkeys(head for row in rows for head in row if head != "row"))
    counts = {"scenes", "windows", "objects a scene", "vertices an object"}
    return lab.markdown(
        ["", *heads],
        [
            [row["row"], *(lab.number(row.get(h), 0 if h in counts else 2) for h in heads)]
            for row in rows
        ],
    )


COLUMNS = {
    "R@1": 1, "mean": 2, "median": 2, "25 cm / 2° / both": 3, "25 cm 2°": 1,
    "10 cm 5° / 25 cm 10°": 2,
}  # fmt: skip
"""Numbers in each column: errors in metres and degrees, or recalls."""
_STATES = {False: "unchanged", True: "changed", None: ""}


def list_published(
    table: int, columns: Sequence[str], lengths: Sequence[int]
) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    for name, by_length in read_published(table):
        for length, part in zip(lengths, by_length, strict=False):
            left = iter(part)
            told = {c: [next(left) for _ in range(COLUMNS[c])] for c in columns}
            rows.append({"set": "paper", "row": name, "frames": length} | told)
    return rows


def summarize_set(
    name: str, row: str, replies: Sequence[Reply], *, refined: bool
) -> list[dict[str, Any]]:
    """Rows of a set, one for each state that its scenes were in; `refined`: with the final fit."""
    rows = []
    for state in dict.fromkeys(r.final.changed for r in replies):
        told = [r for r in replies if r.final.changed is state]
        of = [r.final if refined else r.filter for r in told]
        its = score(of)
        at = {
            (m, d): sum(a.within(m, d) for a in of) / len(of)
            for m in (0.1, 0.25, math.inf)
            for d in (2.0, 5.0, 10.0, 180.0)
        }
        figures = {
            "R@1": (sum(r.right for r in told) / len(told),),
            "mean": its.mean,
            "median": its.median,
            "25 cm / 2° / both": (at[0.25, 180.0], at[math.inf, 2.0], at[0.25, 2.0]),
            "25 cm 2°": (at[0.25, 2.0],),
            "10 cm 5° / 25 cm 10°": (at[0.1, 5.0], at[0.25, 10.0]),
        }
        rows.append(
            {"set": name, "state": _STATES[state], "row": row, "frames": of[0].frames, "windows": len(of)}
            | figures
            | {"seconds": float(np.median([a.seconds / a.frames for a in of]))}
            | {"particles": its.particles}
        )  # fmt: skip
    return rows


def report(rows: Sequence[dict[str, Any]], columns: Sequence[str]) -> str:
    """Table of rows; recalls are followed by the 95 % interval of the last one."""
    lines = []
    recalls = [c for c in columns if c not in {"mean", "median"}]
    for row in rows:
        title = ": ".join(filter(None, [row["set"], row.get("state"), row["row"]]))
        windows: Any = row.get("windows")
        cells = []
        for c in columns:
            values = row.get(c, [None] * COLUMNS[c])
            cells.append(lab.shares(values) if c in recalls else errors(values))
            if c in recalls[-1:]:
                known = None not in (windows, values[-1])
                bounds = wilson_interval(values[-1], windows)[1:] if known else ()
                cells.append(" to ".join(map(lab.share, bounds)) or "–")
        costs = [lab.number(row.get(k), 2 * (k == "seconds")) for k in ("seconds", "particles")]
        lines.append([title, lab.number(row.get("frames")), lab.number(windows), *cells, *costs])
    heads = [h for c in columns for h in ([c, "95 %"] if c in recalls[-1:] else [c])]
    return lab.markdown(["", "frames", "windows", *heads, "s/frame", "particles"], lines)


DRIFTS = {
    "exact": EXACT, "SLAM-like": DRIFTING, "drifting": Odometry(0.05, math.radians(1.0)),
}  # fmt: skip
"""Rows of Table 14 where no trajectories are given."""
MERGED = {"homes": (2, 5, 10), "3RScan": (3,), "ScanNet": (3,)}
"""Scenes that are one map; the paper has 3."""


def poses(table: int, spec: Spec, asking: WindowRunner, of: Sequence[Set]) -> tuple[str, list[Any]]:
    by = {6: _keyframes, 11: _merged, 14: _drifting}.get(table, _plain)
    rows = list_published(table, spec.columns, SPECS[table].lengths)
    rows += [row for its in of for row in by(spec, asking, its)]
    return report(rows, spec.columns), rows


def _plain(spec: Spec, asking: WindowRunner, of: Set) -> Iterator[dict[str, Any]]:
    for length in spec.lengths:
        for name, recipe, refined in spec.rows:
            yield from summarize_set(
                of.name, name, asking.replies(of, recipe, length), refined=refined
            )


def _keyframes(spec: Spec, asking: WindowRunner, of: Set) -> Iterator[dict[str, Any]]:
    for length in spec.lengths:
        for name, recipe, refined in spec.rows:
            if length > of.longest:
                continue
            pace = spec.pace or _pace(asking, of, recipe)
            step = max(1, math.ceil(pace * of.rate))
            replies = asking.replies(of, recipe, length, step=step)
            yield from summarize_set(
                of.name, f"{name}, one frame in {step}", replies, refined=refined
            )


def _pace(asking: WindowRunner, of: Set, recipe: str) -> float:
    replies = asking.replies(of, recipe, 5)
    return float(np.median([r.filter.seconds / r.filter.frames for r in replies]))


def _merged(spec: Spec, asking: WindowRunner, of: Set) -> Iterator[dict[str, Any]]:
    for count in MERGED[of.name]:
        for length in spec.lengths:
            for title, frames in (("SGL, one frame", 1), ("Seq. SGL", length)):
                found = _retrieved(asking, of, length, frames, count)
                if found:
                    told = {"windows": len(found), "R@1": [float(np.mean(found))]}
                    yield {
                        "set": of.name,
                        "row": f"{count} scenes, {title}",
                        "frames": frames,
                    } | told
            for name, recipe, refined in spec.rows:
                replies = asking.replies(of, recipe, length, merged=count)
                yield from summarize_set(
                    of.name, f"{count} scenes, {name}", replies, refined=refined
                )


def _retrieved(asking: WindowRunner, of: Set, length: int, frames: int, count: int) -> list[bool]:
    """Whether the paper's sum (Sec. 4) names the right one of the scenes that are merged."""
    found = []
    for walk, window in asking.windows(of, length):
        names = group(of, walk.map, count)
        show = of.pictures if asking.named_encoder else lambda _: ()
        scenes = Scenes([Place(name, of.scene(name), pictures=show(name)) for name in names])
        its = asking.plain_encoder(window)
        scenes.know(its)
        told = Cosines(scenes.library(names, [its])).search(window.capture[:frames])
        found.append(told.names[0] == walk.map)
    return found


def _drifting(spec: Spec, asking: WindowRunner, of: Set) -> Iterator[dict[str, Any]]:
    given, kinds = asking.odometry, DRIFTS
    if given.trajectories is not None or given == EXACT:
        kinds = {"exact": EXACT} | ({"SLAM": given} if given != EXACT else {})
    for title, odometry in kinds.items():
        for length in spec.lengths:
            for name, recipe, refined in spec.rows:
                replies = asking.replies(of, recipe, length, odometry=odometry)
                yield from summarize_set(
                    of.name, f"{name}, {title} odometry", replies, refined=refined
                )


_OF_POSES = {"frames", "lengths", "only", "matcher", "seed", "device", "pace", "odometry"}
UNUSED = {3: {*_OF_POSES, "encoder"}, 5: _OF_POSES, 6: set[str]()}
"""Options that a table does not have; of those not named here, the pace."""


BROUGHT = ("3RScan", "ScanNet")
"""Sets that a user brings."""


def find_sets(
    run: lab.Run, names: list[str], split: Split, pairs: Path | None, scenes: int
) -> Iterator[Set]:
    """The sets named, or all whose data there are; `InputError` where they are not.

    `pairs`: list of the pairs of scans of the one set that is named; `scenes`: first scenes that are
    asked of sets that a user brings, 0: all.
    """
    data, cache = run.data, run.cache
    known: dict[str, tuple[Path, Callable[[], Set]]] = {
        "3RScan": (run.shared / "3RScan", lambda: sources.of_3rscan(run, split, pairs)),
        "ScanNet": (run.shared / "ScanNet", lambda: sources.of_scannet(run, pairs)),
        "house": (data / "house", lambda: sources.of_house(data, cache)),
        "office": (data / "office", lambda: sources.of_office(data, cache)),
        "freiburg1_rpy": (data / "freiburg1_rpy", lambda: sources.of_freiburg(data, cache)),
        "homes": (data, lambda: sources.of_homes(cache)),
    }
    found = names or [name for name, (path, _) in known.items() if path.is_dir()]
    for name in found:
        if name not in known:
            raise InputError(f"sets: there is no {name!r}; there are {', '.join(known)}.")
        if name != "homes" and not known[name][0].is_dir():
            raise InputError(f"{known[name][0]} is not there. {LAYOUT}")
    if not found:
        raise InputError(f"{run.shared} holds nothing to measure. {LAYOUT}")
    if pairs is not None and (len(found) > 1 or found[0] not in BROUGHT):
        raise InputError(f"pairs: a list is of one set; name it: --sets {' or '.join(BROUGHT)}.")

    def first(of: Set) -> Set:
        few = scenes and of.name in BROUGHT
        return replace(of, walks=of.walks[:scenes]) if few else of

    return (first(known[name][1]()) for name in found)


def answerable(run: lab.Run, of: Spec, sets: list[Set]) -> list[Set]:
    """Sets that the table can be measured in; says where it cannot, `InputError` if nowhere."""
    kept, why = [], []
    for its in sets:
        rooms = len(set(its.rooms.values()))
        if rooms < of.rooms:
            why.append(f"The table asks for {of.rooms} rooms or more; {its.name} shows {rooms}.")
            continue
        # of tables without rows, no windows are asked about
        missing = [length for length in of.lengths if of.rows and length > its.longest]
        why += [f"There is no window of {n} frames in {its.name}." for n in missing]
        if len(missing) < len(of.lengths):
            kept.append(its)
    if not kept:
        raise InputError(" ".join(why))
    for text in why:
        run.log(text)
    return kept


def select_part(spec: Spec, lengths: str, only: str, pace: float) -> Spec:
    """The part of a table that was asked for; `typer.BadParameter` where it has no such part."""
    words = lab.parts(lengths)
    if not all(word.isdecimal() and int(word) for word in words):
        raise typer.BadParameter(
            f"lengths are whole numbers of frames from 1 up, with commas between, not {lengths!r}."
        )
    if not 0.0 <= pace < math.inf:
        raise typer.BadParameter(f"pace is 0 or more seconds, not {pace}.")
    rows = lab.check_names(lab.parts(only, ";"), (name for name, *_ in spec.rows), "row")
    return spec._replace(
        lengths=tuple(map(int, words)) or spec.lengths,
        rows=tuple(row for row in spec.rows if row[0] in rows),
        pace=pace,
    )


def make_table(table: int) -> lab.Table:
    """Table of the paper by its number."""
    spec = SPECS[table]

    def measure(
        run: lab.Run,
        *,
        sets: Annotated[str, lab.option("Sets, with commas between; all that there are.")] = "",
        frames: Annotated[
            int, typer.Option(min=0, help="Most frames of a set, a state and a length; 0: all.")
        ] = 0,
        lengths: Annotated[str, lab.option("Sequence lengths; those of the table.")] = "",
        only: Annotated[str, lab.option("Rows of the table, with semicolons between.")] = "",
        pace: Annotated[float, lab.option("Seconds a frame (Table 6); 0: as measured.")] = 0.0,
        encoder: Annotated[
            str, lab.option(f"Of images; {IMAGES}, where they bring no labels.")
        ] = "",
        matcher: Annotated[str, lab.option("Of the paper's final fit; theirs is roma.")] = "sift",
        odometry: Annotated[
            str,
            lab.option(
                "exact: the true poses, as in the paper; drift: with errors of 1 % and 0.1 degrees a "
                "step; or a SLAM system's: a TUM file, or a folder with SCAN.tum."
            ),
        ] = "drift",
        split: Annotated[Split, lab.option("Of 3RScan.")] = "test",
        pairs: Annotated[
            Path | None,
            lab.option(
                "List of the pairs of 3RScan or ScanNet, map and query a line, instead of pairs.txt."
            ),
        ] = None,
        scenes: Annotated[
            int,
            typer.Option(
                min=0,
                help="First scenes of 3RScan and ScanNet; 0: all, in Table 7 four as printed.",
            ),
        ] = 0,
        seed: lab.Seed = 0,
        device: lab.Device = "auto",
        quick: lab.Quick = False,
        fresh: lab.Fresh = False,
    ) -> None:
        of = select_part(spec, lengths, only, pace)
        if quick:
            frames, of = 10, of._replace(lengths=of.lengths[:1])
        scenes = scenes or (0 if pairs else spec.scenes)
        chosen = answerable(run, of, list(find_sets(run, lab.parts(sets), split, pairs, scenes)))
        how = How(frames, encoder, matcher, seed, device, odometry)
        asking = WindowRunner(run, how, fresh=fresh)
        costs = {3: storage, 4: seconds, 5: retrieval}.get(table)
        text, rows = costs(of, asking, chosen) if costs else poses(table, of, asking, chosen)
        print(f"Table {table}. {spec.asks}\n\n{text}")
        run.save({"rows": rows}, complete=not (sets or lengths or only))

    its = inspect.signature(measure, eval_str=True)
    used = [p for p in its.parameters.values() if p.name not in UNUSED.get(table, {"pace"})]
    measure.__signature__ = its.replace(parameters=used)  # type: ignore[attr-defined]
    measure.__name__ = f"sg2loc-{table}"
    measure.__doc__ = f"{spec.asks}\n\n{LAYOUT}"
    return lab.Table(measure, f"SG2Loc, Table {table}")


TABLES = {f"sg2loc-{table}": make_table(table) for table in SPECS}
