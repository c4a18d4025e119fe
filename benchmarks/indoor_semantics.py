"""What is each encoder worth to the particle filter? Alone, and with depth and colour beside it.

    python benchmarks/indoor_semantics.py --every 13
    python benchmarks/indoor_semantics.py --only "house: labels: *" --windows 5,10

Prints Markdown in the shape of the paper's Tables 7 and 8, and writes every row as JSON. Nothing is
refined. Every answer is written down at once: run it again and it goes on where it was cut.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import Progress

from placegraph_lab.tables.indoor.jobs import ANSWERING, chosen
from placegraph_lab.tables.indoor.metrics import Answer, dumps
from placegraph_lab.tables.indoor.semantics import Case, SemanticBench, ask, available, cases
from placegraph_lab.tables.indoor.semantics_report import Row, report
from placegraph_lab.tables.indoor.windows import EVERY, OFFICE_EVERY
from placegraph_lab.tables.journal import Journal, fingerprint
from placegraph_lab.tables.machine import machine

if TYPE_CHECKING:
    from placegraph_lab.tables.indoor.windows import Window

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared/data"
OUT = ROOT / "benchmarks/results/indoor_semantics.json"


def run(
    bench: SemanticBench,
    case: Case,
    length: int,
    journal: Journal,
    *,
    code: str,
    seed: int,
    device: str,
    tick: Progress,
) -> Row:
    """Ask a case about all windows of a length that nobody asked about yet."""
    windows = bench.windows(case.place, length)
    keys = [f"{case.key(w, seed, code)} {device}" for w in windows]

    def once(window: Window, seed: int) -> dict[str, Any]:
        scene = bench.scene(case.place)
        return ask(case, scene, window, seed=seed, device=device).to_dict()

    task = tick.add_task(f"{case.name}, {length} frames", total=len(journal.missing(keys)))
    rows = journal.filled(
        keys,
        lambda i: once(windows[i], seed),
        warm=lambda: once(windows[0], seed + 1),
        tick=lambda: tick.advance(task),
    )
    tick.remove_task(task)
    return Row(case, length, tuple(map(Answer.from_dict, rows)))


def main(
    only: Annotated[
        str, typer.Option(help="Rows, with semicolons between, such as 'house: labels: *'.")
    ] = "",
    windows: Annotated[str, typer.Option(help="Frames of a window.")] = "5",
    every: Annotated[int, typer.Option(help="Frames from one window of the house to the next.")] = (
        EVERY
    ),
    office_every: Annotated[int, typer.Option(help="The same for the office.")] = OFFICE_EVERY,
    seed: Annotated[int, typer.Option(help="Seed of the filter and of the label noise.")] = 0,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    *,
    fresh: Annotated[bool, typer.Option(help="Ask everything anew.")] = False,
    data: Annotated[Path, typer.Option(help="Folder with house and office.")] = DATA,
    cache: Annotated[Path, typer.Option(help="Folder for maps and answers.")] = (
        ROOT / ".benchmark-cache"
    ),
    out: Annotated[Path | None, typer.Option(help="JSON file.")] = None,
) -> None:
    """Measure what encoders are worth and print Markdown."""
    rows = cases(available())
    wanted = chosen(rows, [name.strip() for name in only.split(";") if name.strip()])
    if not wanted:
        known = ", ".join(repr(c.name) for c in rows)
        raise typer.BadParameter(f"no row is named {only!r}; there are {known}")
    cache.mkdir(parents=True, exist_ok=True)
    path = cache / "indoor_semantics.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    journal = Journal(path)
    bench = SemanticBench(data, cache, every, office_every)
    code = fingerprint([*ANSWERING, "indoor/encode/data/*", "evaluate/indoor_semantics.py"])
    with Progress(console=Console(stderr=True), transient=True) as tick:
        done = [
            run(bench, case, n, journal, code=code, seed=seed, device=device, tick=tick)
            for case in wanted
            for n in map(int, windows.split(","))
        ]
    print(report(done))
    target = out or (None if only else OUT)
    if target:
        record = {
            "machine": machine(),
            "seed": seed,
            "device": device,
            "every": every,
            "office_every": office_every,
            "rows": [row.to_dict() for row in done],
        }
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(dumps(record), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
