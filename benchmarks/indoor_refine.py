"""Does refining bring a pose to centimetres? Errors before and after, harm, covariances and time.

    python benchmarks/indoor_refine.py --quick
    python benchmarks/indoor_refine.py --only "house disturbed: *" --windows 10
    python benchmarks/indoor_refine.py --matchers auto,roma

Prints Markdown tables and writes every row as JSON. Every answer is written down at once: run it
again and it goes on where it was cut. `docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress

from placegraph_lab.tables.indoor.bench import Bench
from placegraph_lab.tables.indoor.jobs import QUICK_EVERY, chosen
from placegraph_lab.tables.indoor.metrics import dumps
from placegraph_lab.tables.indoor.refine import (
    GICP,
    MATCHERS,
    QUICK,
    REFINING,
    RefineJob,
    ask,
    refine_jobs,
)
from placegraph_lab.tables.indoor.refine_metrics import Refined
from placegraph_lab.tables.indoor.refine_report import RefineRow, refine_report
from placegraph_lab.tables.indoor.windows import EVERY, LENGTHS, OFFICE_EVERY
from placegraph_lab.tables.journal import Journal, fingerprint
from placegraph_lab.tables.machine import machine

if TYPE_CHECKING:
    from placegraph.indoor.refine.matching import Matcher
    from placegraph_lab.tables.indoor.windows import Window

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
OUT = ROOT / "benchmarks/results/indoor_refine.json"
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


def run(
    bench: Bench,
    job: RefineJob,
    length: int,
    journal: Journal,
    *,
    matchers: Matchers,
    code: str,
    seed: int,
    device: str,
    tick: Progress,
) -> RefineRow:
    """Ask a job about all windows of a length that nobody asked about yet."""
    windows = bench.windows(job.place, length)
    keys = [f"{job.key(w, seed, code)} {device}" for w in windows]

    def once(window: Window, seed: int) -> dict[str, Any]:
        scene = bench.scene(job.place)
        return ask(
            job, scene, window, matcher=matchers[job.matcher], seed=seed, device=device
        ).to_dict()

    task = tick.add_task(f"{job.name}, {length} frames", total=len(journal.missing(keys)))
    rows = journal.filled(
        keys,
        lambda i: once(windows[i], seed),
        warm=lambda: once(windows[0], seed + 1),
        tick=lambda: tick.advance(task),
    )
    tick.remove_task(task)
    return RefineRow(job, length, tuple(map(Refined.from_dict, rows)))


def main(
    only: Annotated[
        str,
        typer.Option(help="Rows, with semicolons between: 'house found: *; b in a disturbed: *'."),
    ] = "",
    windows: Annotated[str, typer.Option(help="Frames of a window.")] = ",".join(map(str, LENGTHS)),
    matchers: Annotated[str, typer.Option(help="What refines, with commas between.")] = (
        ",".join(MATCHERS)
    ),
    weights: Annotated[Path, typer.Option(help="XFeat's weights, if they are there.")] = (
        SHARED / "weights/xfeat.pt"
    ),
    every: Annotated[int, typer.Option(help="Frames from one window of the house to the next.")] = (
        EVERY
    ),
    office_every: Annotated[int, typer.Option(help="The same for the office.")] = OFFICE_EVERY,
    seed: Annotated[int, typer.Option(help="Of the filter, the label noise and the starts.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    *,
    quick: Annotated[bool, typer.Option(help="Few rows and windows, 5 and 10 frames.")] = False,
    fresh: Annotated[bool, typer.Option(help="Ask everything anew.")] = False,
    data: Annotated[Path, typer.Option(help="Folder with house and office.")] = SHARED / "data",
    cache: Annotated[Path, typer.Option(help="Folder for maps and answers.")] = (
        ROOT / ".benchmark-cache"
    ),
    out: Annotated[
        Path | None, typer.Option(help="JSON file; a part of the rows writes none by itself.")
    ] = None,
) -> None:
    """Measure the refinement of indoor poses and print Markdown."""
    names = [name.strip() for name in only.split(";") if name.strip()]
    if quick:
        windows, every, office_every = "5,10", QUICK_EVERY, 2 * OFFICE_EVERY
        names = names or list(QUICK)
    every_job = refine_jobs([m.strip() for m in matchers.split(",") if m.strip()])
    jobs = chosen(every_job, names)
    if not jobs:
        known = ", ".join(repr(j.name) for j in every_job)
        raise typer.BadParameter(f"no row is named {only!r}; there are {known}")
    cache.mkdir(parents=True, exist_ok=True)
    path = cache / "indoor_refine.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    journal, bench = Journal(path), Bench(data, cache, every, office_every)
    made = Matchers(weights if weights.exists() else None)
    code = fingerprint(REFINING)  # once: what is loaded now is what answers
    with Progress(console=Console(stderr=True), transient=True) as tick:
        rows = [
            run(
                bench, job, length, journal,
                matchers=made, code=code, seed=seed, device=device, tick=tick,
            )
            for job in jobs
            for length in [int(n) for n in windows.split(",")]
        ]  # fmt: skip
    print(refine_report(rows))
    target = out or (OUT if not names and not quick else None)
    if target:
        target.parent.mkdir(parents=True, exist_ok=True)
        record = {
            "machine": machine(),
            "seed": seed,
            "device": device,
            "every": every,
            "office_every": office_every,
            "rows": [r.to_dict() for r in rows],
        }
        target.write_text(dumps(record), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
