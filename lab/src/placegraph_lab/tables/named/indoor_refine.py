"""Does refining bring a pose to centimetres? Errors before and after, harm, covariances and time.

    placegraph-lab table indoor_refine --quick
    placegraph-lab table indoor_refine --only "house disturbed: *" --windows 10
    placegraph-lab table indoor_refine --matchers auto,roma

Prints Markdown tables and writes every row as JSON. Every answer is written down at once: run it
again and it goes on where it was cut. `docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from placegraph.indoor.refine.matching import Matcher
from placegraph_lab.tables.indoor.bench import Asker, Bench
from placegraph_lab.tables.indoor.jobs import ANSWERING, QUICK_EVERY, chosen
from placegraph_lab.tables.indoor.refine import GICP, MATCHERS, QUICK, RefineJob, ask, refine_jobs
from placegraph_lab.tables.indoor.refine_metrics import Refined
from placegraph_lab.tables.indoor.refine_report import RefineRow, refine_report
from placegraph_lab.tables.indoor.windows import EVERY, LENGTHS, OFFICE_EVERY, Window
from placegraph_lab.tables.runner import (
    Device,
    Every,
    Fresh,
    OfficeEvery,
    Quick,
    Run,
    Seed,
    fingerprint,
    option,
    parts,
    table,
)

WORDS = ("auto", "guided", *GICP)
"""What refines without a matcher of its own being made."""


class Matchers:
    """Matchers by name, each made once."""

    def __init__(self, weights: Path | None) -> None:
        self.weights = weights
        self._made: dict[str, Matcher] = {}

    def __getitem__(self, name: str) -> str | Matcher:
        if name in WORDS:
            return name
        if name not in self._made:
            from placegraph.indoor.refine.matching import matcher

            weights = self.weights if name == "xfeat" else None
            self._made[name] = matcher(name, weights=weights)
        return self._made[name]


@table("SG2Loc, Tables 1, 2, 4, 7, 9, 10")
def indoor_refine(
    run: Run,
    only: Annotated[
        str, option("Rows, with semicolons between: 'house found: *; b in a disturbed: *'.")
    ] = "",
    windows: Annotated[str, option("Frames of a window.")] = ",".join(map(str, LENGTHS)),
    matchers: Annotated[str, option("What refines, with commas.")] = ",".join(MATCHERS),
    every: Every = EVERY,
    office_every: OfficeEvery = OFFICE_EVERY,
    seed: Seed = 0,
    device: Device = "auto",
    *,
    quick: Quick = False,
    fresh: Fresh = False,
) -> None:
    """Does refining bring a pose to centimetres? Errors before and after, harm, covariances, time."""
    names = parts(only, ";")
    if quick:
        windows, every, office_every = "5,10", QUICK_EVERY, 2 * OFFICE_EVERY
        names = names or list(QUICK)
    jobs = chosen(refine_jobs(parts(matchers)), names)
    bench = Bench(run.data, run.cache, every, office_every)
    weights = run.shared / "weights/xfeat.pt"
    refining = Matchers(weights if weights.exists() else None)
    code = fingerprint(ANSWERING)  # once: what is loaded now is what answers
    rows = []
    with Asker(run, fresh=fresh) as asker:
        for job in jobs:
            for n in map(int, windows.split(",")):

                def once(window: Window, seed: int, job: RefineJob = job) -> dict[str, Any]:
                    scene, its = bench.scene(job.place), refining[job.matcher]
                    found = ask(job, scene, window, matcher=its, seed=seed, device=device)
                    return found.to_dict()

                asked = bench.windows(job.place, n)
                keys = [f"{job.key(w, seed, code)} {device}" for w in asked]
                told = asker.answers(f"{job.name}, {n} frames", asked, keys, once, seed)
                rows.append(RefineRow(job, n, tuple(map(Refined.from_dict, told))))
    print(refine_report(rows))
    run.save({"rows": [r.to_dict() for r in rows]}, whole=not names)
