"""Do a few frames find their pose? Errors, recall, status and time on the house and the office.

Every answer is written down at once: run it again and it goes on where it was cut.
`docs/benchmarks/indoor.md#do-a-few-frames-find-their-pose` explains the protocol.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.indoor import bench as benches
from placegraph_lab.tables.indoor.bench import Bench, Job, ask, choose_jobs, house_jobs, office_jobs
from placegraph_lab.tables.indoor.metrics import AXES, THRESHOLDS, Answer, Score, score
from placegraph_lab.tables.indoor.report import (
    PARTS,
    Row,
    ask_windows,
    by_job,
    changes_table,
    errors,
)
from placegraph_lab.tables.indoor.windows import (
    COVERED,
    EVERY,
    HALVES,
    LENGTHS,
    OFFICE_EVERY,
    OFFICE_LENGTH,
    Window,
)
from placegraph_lab.tables.runner import Column as Col

RECALL = THRESHOLDS.index((0.25, 2.0))
RECALLS = " / ".join(
    f"{100 * m:.0f} cm {d:.0f}°" if m < 1 else f"{m:.0f} m {d:.0f}°" for m, d in THRESHOLDS
)
Line = tuple[str, Score]
SCORES = (
    Col("", "0"), Col("windows", "1.windows"),
    Col("mean", "1.mean", errors), Col("median", "1.median", errors),
    Col(RECALLS, "1.recall", lab.shares),
    Col("OK", lambda r: r[1].status.get("OK", 0.0), lab.share),
    Col("OK right", "1.right", lab.share), Col("truth in modes", "1.among_modes", lab.share),
    Col("honest", "1.honest", lab.share), Col("particles", "1.particles", 0),
    Col("s/frame", "1.frame_seconds", 3),
)  # fmt: skip
CALIBRATION = (
    Col("", "0"), Col("answers", "1.windows"),
    Col("calibration error", "1.calibration.error", lab.share),
    Col("of perfect", "1.calibration.floor", lab.share),
    *(Col(f"error / sigma: {axis}" if not i else axis, f"1.spread.{i}", 2)
      for i, axis in enumerate(AXES)),
    Col("within the 95 % ellipsoid", "1.inside", lab.share),
)  # fmt: skip


def report(rows: Sequence[Row]) -> str:
    text: list[str] = []
    for name, title in benches.TITLES.items():
        for length in sorted({r.length for r in rows if r.job.table == name}):
            mine = [r for r in rows if r.job.table == name and r.length == length]
            lines = [line for row in mine for line in _lines(row)]
            text += [f"#### {title}, {length} frames", lab.render(SCORES, lines)]
    house = [r for r in rows if r.job.table not in HALVES]
    if house:
        recall = lambda s: s.recall[RECALL]  # noqa: E731
        text += ["#### House, unchanged / changed scenes, 25 cm 2°", changes_table(house, recall)]
    pooled = [
        (job.name, score([a for row in of.values() for a in row.results]))
        for job, of in by_job(rows)
    ]
    text += ["#### Calibration of right answers, and of the probability"]
    text += [lab.render(CALIBRATION, pooled)]
    wrong = [(row, [w for w in row.score.worst if " OK " in w]) for row in rows]
    listed = [f"- {r.job.name}, {r.length} frames: {'; '.join(w)}" for r, w in wrong if w]
    if listed:
        text += ["#### Answers said to be OK that are not", "\n".join(listed)]
    return "\n\n".join(text)


def _lines(row: Row) -> list[Line]:
    """Return a row; in the office, also the windows that the map covers and the others."""
    titles = {
        f"covered to {COVERED:.0%} or more": f"covered {COVERED:.0%}",
        "the others": "not covered",
    }
    found = {title: row.part(PARTS[part]) for title, part in titles.items()}
    split = row.job.table in HALVES and all(found.values())
    return [
        (row.job.row, row.score),
        *((f"{row.job.row}: {title}", s) for title, s in found.items() if split),
    ]


@lab.table("SG2Loc, Tables 1, 2, 4, 7, 12, 13")
def indoor_filter(
    run: lab.Run,
    only: Annotated[
        str, lab.option("Rows, with commas or semicolons between: 'classes: all, b in a: *'.")
    ] = "",
    windows: Annotated[str, lab.option("Lengths of the house's windows.")] = ",".join(
        map(str, LENGTHS)
    ),
    every: lab.Every = EVERY,
    office_every: lab.OfficeEvery = OFFICE_EVERY,
    seed: lab.Seed = 0,
    device: lab.Device = "auto",
    *,
    quick: lab.Quick = False,
    fresh: lab.Fresh = False,
) -> None:
    """Localization by a few frames: errors, recall, status and time in house and office."""
    names = lab.parts(only, ";" if ";" in only else ",")
    if quick:
        windows, every, office_every = "5,10", benches.QUICK_EVERY, 2 * OFFICE_EVERY
        names = names or list(benches.QUICK)
    jobs = choose_jobs([*house_jobs(), *office_jobs()], names)
    bench = Bench(run.data, run.cache, every, office_every)

    def once(job: Job, window: Window, seed: int) -> Answer:
        return ask(job, bench.scene(job.map), window, seed=seed, device=device)

    asked = ask_windows(
        run, sorted(jobs, key=lambda j: j.map), bench,
        lambda job: [OFFICE_LENGTH] if job.table in HALVES else map(int, windows.split(",")),
        once, seed=seed, device=device, fresh=fresh,
    )  # fmt: skip
    rows = [Row(job, n, tuple(Answer(**a) for a in answers)) for job, n, answers in asked]
    order = {j.name: i for i, j in enumerate(jobs)}
    rows.sort(key=lambda r: (order[r.job.name], r.length))
    print(report(rows))
    run.save({"rows": [row.record() for row in rows]}, complete=not names)
