"""Do a few frames find their pose? Errors, recall, status and time on the house and the office.

    python benchmarks/indoor_filter.py --quick
    python benchmarks/indoor_filter.py --only "instances: *" --windows 5,10

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
from placegraph_lab.tables.indoor.jobs import (
    ANSWERING,
    QUICK,
    QUICK_EVERY,
    Job,
    ask,
    chosen,
    house_jobs,
    office_jobs,
)
from placegraph_lab.tables.indoor.metrics import Answer, dumps
from placegraph_lab.tables.indoor.report import Row, report
from placegraph_lab.tables.indoor.windows import (
    EVERY,
    HALVES,
    LENGTHS,
    OFFICE_EVERY,
    OFFICE_LENGTH,
)
from placegraph_lab.tables.journal import Journal, fingerprint
from placegraph_lab.tables.machine import machine

if TYPE_CHECKING:
    from placegraph_lab.tables.indoor.windows import Window

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared/data"
OUT = ROOT / "benchmarks/results/indoor_filter.json"
ALL_LENGTHS = ",".join(str(n) for n in LENGTHS)


def run(
    bench: Bench,
    job: Job,
    length: int,
    journal: Journal,
    *,
    code: str,
    seed: int,
    device: str,
    tick: Progress,
) -> Row:
    """Ask a job about all windows of a length that nobody asked about yet."""
    windows = bench.windows(job.table, length)
    keys = [f"{job.key(w, seed, code)} {device}" for w in windows]

    def once(window: Window, seed: int) -> dict[str, Any]:
        scene = bench.scene(job.map)
        return ask(job, scene, window, seed=seed, device=device).to_dict()

    task = tick.add_task(f"{job.name}, {length} frames", total=len(journal.missing(keys)))
    rows = journal.filled(
        keys,
        lambda i: once(windows[i], seed),
        warm=lambda: once(windows[0], seed + 1),
        tick=lambda: tick.advance(task),
    )
    tick.remove_task(task)
    return Row(job, length, tuple(map(Answer.from_dict, rows)))


def main(
    only: Annotated[
        str,
        typer.Option(
            help="Rows, with commas or semicolons between, such as 'classes: all, b in a: *'."
        ),
    ] = "",
    windows: Annotated[str, typer.Option(help="Lengths of the house's windows.")] = ALL_LENGTHS,
    every: Annotated[int, typer.Option(help="Frames from one window of the house to the next.")] = (
        EVERY
    ),
    office_every: Annotated[int, typer.Option(help="The same for the office.")] = OFFICE_EVERY,
    seed: Annotated[int, typer.Option(help="Seed of the filter and of the label noise.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    *,
    quick: Annotated[bool, typer.Option(help="Few rows and windows, 5 and 10 frames.")] = False,
    fresh: Annotated[bool, typer.Option(help="Ask everything anew.")] = False,
    data: Annotated[Path, typer.Option(help="Folder with house and office.")] = DATA,
    cache: Annotated[Path, typer.Option(help="Folder for maps and answers.")] = (
        ROOT / ".benchmark-cache"
    ),
    out: Annotated[Path | None, typer.Option(help="JSON file; a quick run writes none.")] = None,
) -> None:
    """Measure indoor localization and print Markdown."""
    names = [name.strip() for name in only.split(";" if ";" in only else ",") if name.strip()]
    if quick:
        windows, every, office_every = "5,10", QUICK_EVERY, 2 * OFFICE_EVERY
        names = names or list(QUICK)
    jobs = chosen([*house_jobs(), *office_jobs()], names)
    if not jobs:
        known = ", ".join(repr(j.name) for j in [*house_jobs(), *office_jobs()])
        raise typer.BadParameter(f"no row is named {only!r}; there are {known}")
    cache.mkdir(parents=True, exist_ok=True)
    path = cache / "indoor_filter.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    journal = Journal(path)
    bench = Bench(data, cache, every, office_every)
    code = fingerprint(ANSWERING)  # once: what is loaded now is what answers
    lengths = [int(n) for n in windows.split(",")]
    with Progress(console=Console(stderr=True), transient=True) as tick:
        rows = [
            run(bench, job, n, journal, code=code, seed=seed, device=device, tick=tick)
            for job in sorted(jobs, key=lambda j: j.map)
            for n in ([OFFICE_LENGTH] if job.table in HALVES else lengths)
        ]
    order = {j.name: i for i, j in enumerate(jobs)}
    rows.sort(key=lambda r: (order[r.job.name], r.length))
    print(report(rows))
    whole = not names and not quick
    target = out or (OUT if whole else None)
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
