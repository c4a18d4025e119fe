"""Do a few frames find their pose? Errors, recall, status and time on the house and the office.

    placegraph-lab table indoor_filter --quick
    placegraph-lab table indoor_filter --only "instances: *" --windows 5,10

Prints Markdown tables and writes every row as JSON. Every answer is written down at once: run it
again and it goes on where it was cut. `docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

from typing import Annotated, Any

from placegraph_lab.tables.indoor.bench import (
    QUICK,
    QUICK_EVERY,
    Asker,
    Bench,
    Job,
    ask,
    chosen,
    house_jobs,
    office_jobs,
)
from placegraph_lab.tables.indoor.metrics import Answer
from placegraph_lab.tables.indoor.report import Row, report
from placegraph_lab.tables.indoor.windows import (
    EVERY,
    HALVES,
    LENGTHS,
    OFFICE_EVERY,
    OFFICE_LENGTH,
    Window,
)
from placegraph_lab.tables.runner import (
    INDOOR,
    Device,
    Every,
    Fresh,
    OfficeEvery,
    Quick,
    Run,
    Seed,
    code_key,
    option,
    parts,
    table,
)

ALL_LENGTHS = ",".join(str(n) for n in LENGTHS)


@table()
def indoor_filter(
    run: Run,
    only: Annotated[
        str, option("Rows, with commas or semicolons between: 'classes: all, b in a: *'.")
    ] = "",
    windows: Annotated[str, option("Lengths of the house's windows.")] = ALL_LENGTHS,
    every: Every = EVERY,
    office_every: OfficeEvery = OFFICE_EVERY,
    seed: Seed = 0,
    device: Device = "auto",
    *,
    quick: Quick = False,
    fresh: Fresh = False,
) -> None:
    """Do a few frames find their pose? Errors, recall, status, time: house and office."""
    names = parts(only, ";" if ";" in only else ",")
    if quick:
        windows, every, office_every = "5,10", QUICK_EVERY, 2 * OFFICE_EVERY
        names = names or list(QUICK)
    jobs = chosen([*house_jobs(), *office_jobs()], names)
    bench = Bench(run.data, run.cache, every, office_every)
    code = code_key(INDOOR)  # once: what is loaded now is what answers
    lengths = [int(n) for n in windows.split(",")]
    rows = []
    with Asker(run, fresh=fresh) as asker:
        for job in sorted(jobs, key=lambda j: j.map):
            for n in [OFFICE_LENGTH] if job.table in HALVES else lengths:

                def once(window: Window, seed: int, job: Job = job) -> dict[str, Any]:
                    scene = bench.scene(job.map)
                    return ask(job, scene, window, seed=seed, device=device).to_dict()

                asked = bench.windows(job.table, n)
                keys = [f"{job.key(w, seed, code)} {device}" for w in asked]
                told = asker.answers(f"{job.name}, {n} frames", asked, keys, once, seed)
                rows.append(Row(job, n, tuple(map(Answer.from_dict, told))))
    order = {j.name: i for i, j in enumerate(jobs)}
    rows.sort(key=lambda r: (order[r.job.name], r.length))
    print(report(rows))
    run.save({"rows": [r.to_dict() for r in rows]}, whole=not names)
