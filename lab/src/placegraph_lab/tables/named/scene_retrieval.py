"""Tables of the retrieval benchmark, in the shape of the paper's Table 5."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np

from placegraph.core.estimate import Status
from placegraph.errors import MissingExtraError
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.scene.places import (
    FIRST,
    HOMES,
    ROWS,
    Place,
    Walk,
    homes,
    house_rooms,
    office_half,
)
from placegraph_lab.tables.scene.search import (
    ABSENT,
    LENGTHS,
    METHODS,
    WHOLE,
    Answer,
    Row,
    Study,
    hit,
    recall,
)
from placegraph_lab.tables.statistics import reliability

RANKS = (1, 3, 5)
PAPER = {
    1: ((0.82, 0.94, 0.98), 0.3, (0.69, 0.79, 0.84), 1.5),
    5: ((0.84, 0.95, 0.98), 1.5, (0.72, 0.84, 0.88), 7.5),
    10: ((0.86, 0.95, 0.98), 3.0, (0.75, 0.85, 0.89), 15.0),
    25: ((0.88, 0.96, 0.98), 7.5, (0.78, 0.87, 0.91), 37.5),
    50: ((0.89, 0.96, 0.98), 15.0, (0.81, 0.89, 0.92), 75.0),
}
"""Table 5 on 3RScan: recalls and milliseconds among 10 and among 50 scenes, by length."""
BASELINES = {
    "CVNet": ((0.79, 0.91, 0.95), 60.0, (0.67, 0.77, 0.82), 311.1, 239.1),
    "AnyLoc": ((0.88, 0.95, 0.98), 1826.4, (0.81, 0.87, 0.90), 1451.1, 5720.3),
}
"""The same of the baselines in Table 5, and megabytes of their maps; no length is printed."""
STORAGE = 5.4  # of the paper's map [MB], as for its baselines
BINS = 10
CAPTION = (
    "The rooms of the house and the office were looked at while the method was made, too; the homes "
    "were not."
)


def report(rows: Sequence[Row]) -> str:
    head = ["encoder, method", *(f"{n} frames" for n in LENGTHS)]
    table = [
        [
            f"{row.name}, {method}",
            *(lab.share(recall(row.answers.get((method, "50", n), []), 1)) for n in LENGTHS),
        ]
        for row in rows
        if any(method == "without rarity" for method, _, _ in row.answers)
        for method in METHODS
    ]
    parts = [
        "## Which scene is it? (shape of Table 5)",
        CAPTION,
        main_table(rows),
        "## What it takes: recall@1 among 50 scenes",
        lab.markdown(head, table),
        "## Months later: recall@1 among 50 scenes, as it was / changed",
        split_table(
            rows, [("as it was", lambda a: not a.changed), ("changed", lambda a: a.changed)]
        ),
        "## By kind of scene: recall@1 among 50 scenes, homes / house / office",
        split_table(rows, [(k, _of_kind(k)) for k in ("home", "house", "office")]),
        "## How sure: status and calibration, 50 scenes",
        status_table(rows),
    ]
    return "\n\n".join(parts)


def main_table(rows: Sequence[Row]) -> str:
    """Recall and time by encoder, method and length."""
    printed = [("3RScan: SGL" if n == 1 else "3RScan: Seq. SGL", str(n), *told, STORAGE)
               for n, told in PAPER.items()]  # fmt: skip
    printed += [(f"3RScan: {name}", "–", *told) for name, told in BASELINES.items()]
    lines: list[Any] = [
        [
            f"*paper, {name}, {megabytes:,.1f} MB*", n, lab.shares(ten), f"{a:.1f}",
            lab.shares(fifty), f"{b:.1f}", "–", "–",
        ]
        for name, n, ten, a, fifty, b, megabytes in printed
    ]  # fmt: skip
    lines += [
        (row, method, n, row.answers.get((method, "10", n), []), fifty)
        for row in rows for method in WHOLE for n in LENGTHS
        if (fifty := row.answers.get((method, "50", n), []))
    ]  # fmt: skip
    return lab.render(MAIN, lines)


def _recalls(answers: Sequence[Answer]) -> str:
    return lab.shares(recall(answers, k) for k in RANKS)


MAIN = (
    Col("encoder, method", lambda r: f"{r[0].name}, {r[1]}"), Col("frames", "2"),
    Col("10: R@1/3/5", "3", _recalls), Col("ms", lambda r: milliseconds(r[3]), 1),
    Col("50: R@1/3/5", "4", _recalls), Col("ms", lambda r: milliseconds(r[4]), 1),
    Col("with encoding", lambda r: milliseconds(r[4]) + r[2] * r[0].encoding, 0),
    Col("kB a scene", "0.kilobytes", 1),
)  # fmt: skip


def split_table(rows: Sequence[Row], parts: Sequence[tuple[str, Callable[[Answer], bool]]]) -> str:
    """Recall@1 among 50 of parts of the queries, and how many these are."""
    head = ["encoder, method", *(f"{n} frames" for n in LENGTHS), "queries"]
    table = []
    for row in rows:
        for method in WHOLE:
            by_length = [row.answers.get((method, "50", n), []) for n in LENGTHS]
            split = [[[a for a in all_ if of(a)] for _, of in parts] for all_ in by_length]
            cells = [lab.shares(recall(part, 1) for part in each) for each in split]
            counts = ("/".join(str(len(part)) for part in each) for each in split)
            table.append([f"{row.name}, {method}", *cells, ", ".join(counts)])
    return lab.markdown(head, table)


def status_table(rows: Sequence[Row]) -> str:
    """Tabulate how often an answer is sure, and right if it is; with the right scene and without."""
    head = [
        "encoder", "frames", "OK", "of these right", "ambiguous", "lost", "calibration error",
        "absent: OK", "ambiguous", "lost",
    ]  # fmt: skip
    lines = []
    for row in rows:
        for n in LENGTHS:
            there, absent = (row.answers.get(("ours", kind, n), []) for kind in ("50", ABSENT))
            if there:
                sure = [a for a in there if a.status == Status.OK.name]
                told = reliability([a.probability for a in there], [hit(a, 1) for a in there], BINS)
                found = [_part(there, s) for s in Status]
                none = [lab.share(_part(absent, s)) for s in Status]
                error = f"{told.error:.3f} (floor {told.floor:.3f})"
                cells = [found[0], recall(sure, 1), *found[1:]]
                lines.append([row.name, str(n), *map(lab.share, cells), error, *none])
    return lab.markdown(head, lines)


def figures(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Every cell as plain numbers."""
    return [
        {
            "encoder": row.name, "method": method, "pool": kind, "frames": n, "queries": len(answers),
            "recall": {str(k): recall(answers, k) for k in RANKS},
            "milliseconds": milliseconds(answers), "encoding_milliseconds": row.encoding * n,
            "kilobytes": row.kilobytes, "objects": row.objects,
            "status": None if method == "paper" else {s.name: _part(answers, s) for s in Status},
        }
        for row in rows for (method, kind, n), answers in row.answers.items()
    ]  # fmt: skip


def milliseconds(answers: Sequence[Answer]) -> float:
    return float(np.median([a.milliseconds for a in answers])) if answers else float("nan")


def _part(answers: Sequence[Answer], status: Status) -> float:
    return float(np.mean([a.status == status.name for a in answers])) if answers else float("nan")


def _of_kind(kind: str) -> Callable[[Answer], bool]:
    return lambda answer: answer.place.split()[0] == kind


def read_walks(run: lab.Run, first: int, *, thin: bool) -> tuple[list[Place], list[Walk]]:
    """All scenes, and all walks through them, or of homes one each."""
    places, walks = house_rooms(run.data, run.cache)
    office, half = office_half(run.data, run.cache)
    places.append(office)
    walks.append(half)
    seeds = range(first, first + HOMES)
    for place, own in run.track(homes(seeds, run.cache), "homes", total=len(seeds)):
        walks += [own[len(places) % 2]] if thin else own
        places.append(place)
    return places, walks


@lab.table("SG2Loc, Table 5")
def scene_retrieval(
    run: lab.Run,
    encoders: Annotated[str, lab.option(f"Rows, with semicolons between: {'; '.join(ROWS)}.")] = "",
    *,
    fresh: lab.Fresh = False,
    quick: lab.Quick = False,
) -> None:
    """Recall of the scene that a walk was taken in: homes, rooms of the house, the office."""
    rows = lab.check_names(lab.parts(encoders, ";"), ROWS, "row")
    if quick:
        rows = rows[:1]
    journal = run.journal(fresh=fresh)
    places, walks = read_walks(run, FIRST, thin=quick)
    study = Study(places, walks, run.cache, journal, run.log)
    measured = []
    for name in rows:
        try:
            measured.append(study.row(name))
        except MissingExtraError as error:
            run.log(f"{name}: {error}")
    print(report(measured))
    record = {
        "scenes": [p.name for p in places],
        "walks": [w.name for w in walks],
        "walks_of_a_home": 1 if quick else 2,
        "paper": PAPER,
        "rows": figures(measured),
    }
    run.save(record, complete=not encoders)
