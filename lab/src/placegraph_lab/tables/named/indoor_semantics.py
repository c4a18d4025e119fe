"""What is each encoder worth to the particle filter? Alone, and with depth and colour beside it.

    placegraph-lab table indoor_semantics --every 13
    placegraph-lab table indoor_semantics --only "house: labels: *" --windows 5,10

Prints Markdown in the shape of the paper's Tables 7 and 8, and writes every row as JSON. Nothing is
refined. Every answer is written down at once: run it again and it goes on where it was cut.
"""

from __future__ import annotations

from typing import Annotated, Any

from placegraph_lab.tables.indoor.bench import Asker
from placegraph_lab.tables.indoor.jobs import ANSWERING, QUICK_EVERY, chosen
from placegraph_lab.tables.indoor.metrics import Answer
from placegraph_lab.tables.indoor.semantics import Case, SemanticBench, ask, available, cases
from placegraph_lab.tables.indoor.semantics_report import Row, report
from placegraph_lab.tables.indoor.windows import EVERY, OFFICE_EVERY, Window
from placegraph_lab.tables.journal import fingerprint
from placegraph_lab.tables.run import (
    Device,
    Every,
    Fresh,
    OfficeEvery,
    Quick,
    Run,
    Seed,
    option,
    parts,
    table,
)


@table("SG2Loc, Tables 7, 8")
def indoor_semantics(
    run: Run,
    only: Annotated[str, option("Rows, with semicolons between: 'house: labels: *'.")] = "",
    windows: Annotated[str, option("Frames of a window.")] = "5",
    every: Every = EVERY,
    office_every: OfficeEvery = OFFICE_EVERY,
    seed: Seed = 0,
    device: Device = "auto",
    *,
    quick: Quick = False,
    fresh: Fresh = False,
) -> None:
    """What is each encoder worth to the particle filter? Alone, and with depth and colour."""
    if quick:
        every, office_every = QUICK_EVERY, 2 * office_every
    bench = SemanticBench(run.data, run.cache, every, office_every)
    code = fingerprint(ANSWERING)
    done = []
    with Asker(run, fresh=fresh) as asker:
        for case in chosen(cases(available()), parts(only, ";")):
            for n in map(int, windows.split(",")):

                def once(window: Window, seed: int, case: Case = case) -> dict[str, Any]:
                    scene = bench.scene(case.place)
                    return ask(case, scene, window, seed=seed, device=device).to_dict()

                asked = bench.windows(case.place, n)
                keys = [f"{case.key(w, seed, code)} {device}" for w in asked]
                told = asker.answers(f"{case.name}, {n} frames", asked, keys, once, seed)
                done.append(Row(case, n, tuple(map(Answer.from_dict, told))))
    print(report(done))
    run.save({"rows": [row.to_dict() for row in done]}, whole=not only)
