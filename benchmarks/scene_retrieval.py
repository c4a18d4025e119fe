"""Which scene of a library was a walk taken in? Homes, rooms of the house, the office.

    python benchmarks/scene_retrieval.py
    python benchmarks/scene_retrieval.py --encoders "labels; labels, 30 % wrong" --development

Prints Markdown tables in the shape of the paper's Table 5 and writes every figure as JSON. Walks,
vectors and answers are written down at once: run it again and it goes on where it was cut.
`docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from placegraph.errors import MissingExtraError
from placegraph_lab.tables.indoor.metrics import dumps
from placegraph_lab.tables.journal import Journal
from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.retrieval.retrieval_places import (
    FIRST,
    HOMES,
    Place,
    Walk,
    homes,
    house_rooms,
    office_half,
)
from placegraph_lab.tables.retrieval.retrieval_report import PAPER, figures, report
from placegraph_lab.tables.retrieval.retrieval_study import Study
from placegraph_lab.tables.retrieval.retrieval_vectors import BOTH, ROWS

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
LARGE = BOTH
"""The row that is asked in the large library, too: what a library does by default."""
OUT = ROOT / "benchmarks/results/scene_retrieval.json"


def main(
    encoders: Annotated[
        str, typer.Option(help=f"Rows, with semicolons between: {'; '.join(ROWS)}.")
    ] = "",
    scenes: Annotated[int, typer.Option(help="Scenes of the large library; 0: none.")] = 10_000,
    *,
    development: Annotated[
        bool, typer.Option(help="Homes to tune with; the tables are of others.")
    ] = False,
    thin: Annotated[
        bool, typer.Option(help="One walk a home: as it was, of every second months later.")
    ] = False,
    fresh: Annotated[bool, typer.Option(help="Ask everything anew.")] = False,
    data: Annotated[Path, typer.Option(help="Folder with house and office.")] = SHARED / "data",
    cache: Annotated[Path, typer.Option(help="Folder for walks, vectors and answers.")] = (
        ROOT / ".benchmark-cache"
    ),
    out: Annotated[
        Path | None, typer.Option(help="JSON file; a part of it writes none by itself.")
    ] = None,
) -> None:
    """Measure recall, time and size, and print Markdown."""
    rows = [name.strip() for name in encoders.split(";") if name.strip()] or list(ROWS)
    unknown = sorted(set(rows) - set(ROWS))
    if unknown:
        raise typer.BadParameter(f"{unknown[0]!r} is no row; there are {'; '.join(ROWS)}")
    cache.mkdir(parents=True, exist_ok=True)
    path = cache / "scene_retrieval.jsonl"
    if fresh:
        path.unlink(missing_ok=True)
    places, walks = asked(data, cache, 0 if development else FIRST, thin=thin)
    study = Study(places, walks, cache, Journal(path), lambda text: typer.echo(text, err=True))
    measured, large = [], []
    for name in rows:
        try:
            measured.append(study.row(name))
            if scenes and name == LARGE:
                large += study.scale(name, np.random.default_rng(0), scenes)
        except MissingExtraError as error:
            typer.echo(f"{name}: {error}", err=True)
    print(report(measured, large))
    target = out or (None if encoders or development else OUT)
    if target:
        record = {
            "machine": machine(),
            "scenes": [p.name for p in places],
            "walks": [w.name for w in walks],
            "walks_of_a_home": 1 if thin else 2,
            "paper": {str(n): row for n, row in PAPER.items()},
            "rows": figures(measured),
            "scale": [asdict(s) for s in large],
        }
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(dumps(record), encoding="utf-8")


def asked(data: Path, cache: Path, first: int, *, thin: bool) -> tuple[list[Place], list[Walk]]:
    """All scenes, and all walks through them, or of homes one each."""
    places, walks = house_rooms(data, cache)
    office, half = office_half(data, cache)
    places.append(office)
    walks.append(half)
    seeds = range(first, first + HOMES)
    console = Console(stderr=True)
    for place, own in track(homes(seeds, cache), "homes", total=len(seeds), console=console):
        walks += [own[len(places) % 2]] if thin else own
        places.append(place)
    return places, walks


if __name__ == "__main__":
    typer.run(main)
