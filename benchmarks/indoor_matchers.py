"""Which matches of photographs with renderings of the map are right? House and office.

    python benchmarks/indoor_matchers.py
    python benchmarks/indoor_matchers.py --only "sift; xfeat scale=1.5" --part odd

Prints Markdown tables and writes every row as JSON. A matcher is a name and options, such as
`xfeat dense=True`. The matchers' defaults were chosen on even queries; all are reported, and
`--part odd` asks those that nobody tuned on. `docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

import ast
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import track

from placegraph.indoor.refine.matching import matcher
from placegraph_lab.tables.indoor.bench import Bench
from placegraph_lab.tables.indoor.matches import Query, Trial, ask, starts
from placegraph_lab.tables.indoor.matches_report import report, to_dict
from placegraph_lab.tables.indoor.metrics import dumps
from placegraph_lab.tables.indoor.windows import HALVES
from placegraph_lab.tables.machine import machine

if TYPE_CHECKING:
    from placegraph.indoor.refine.matching import Matcher

ROOT = Path(__file__).parents[1]
SHARED = ROOT.parent / "shared"
OUT = ROOT / "benchmarks/results/indoor_matchers.json"
MATCHERS = "sift; sift upright=False; xfeat; xfeat least=0.82; xfeat dense=True"
EVERY, OFFICE_EVERY = 5, 6


class Part(StrEnum):
    """Which queries of each place are asked."""

    ALL = "all"
    EVEN = "even"
    ODD = "odd"

    @property
    def rows(self) -> slice:
        """Of the place's queries."""
        return {"all": slice(None), "even": slice(0, None, 2), "odd": slice(1, None, 2)}[self.value]


def made(spec: str, weights: Path, device: str) -> Matcher:
    """Matcher of a name and options: `sift ratio=0.8`."""
    name, *options = spec.split()
    chosen: dict[str, Any] = {}
    for option in options:
        key, _, value = option.partition("=")
        chosen[key] = ast.literal_eval(value)
    if name == "xfeat":
        chosen["weights"] = weights
    return matcher(name, device=device, **chosen)


def queries(bench: Bench, place: str, seed: int) -> list[Query]:
    """Single frames of a place, with the poses to render from."""
    rng = np.random.default_rng(seed)
    scene = bench.scene(place)
    return [Query(w, scene, tuple(starts(w.truth, rng))) for w in bench.windows(place, 1)]


def main(
    only: Annotated[str, typer.Option(help="Matchers, with semicolons between.")] = MATCHERS,
    every: Annotated[int, typer.Option(help="Frames of the house from query to query.")] = EVERY,
    office_every: Annotated[int, typer.Option(help="The same for the office.")] = OFFICE_EVERY,
    seed: Annotated[int, typer.Option(help="Of the disturbed poses, and of RANSAC.")] = 0,
    device: Annotated[str, typer.Option(help="cpu, cuda or auto.")] = "cpu",
    *,
    part: Annotated[Part, typer.Option(help="Queries: even ones tune, odd ones test.")] = Part.ALL,
    data: Annotated[Path, typer.Option(help="Folder with house and office.")] = SHARED / "data",
    weights: Annotated[Path, typer.Option(help="XFeat's.")] = SHARED / "weights/xfeat.pt",
    cache: Annotated[Path, typer.Option(help="Folder for maps.")] = ROOT / ".benchmark-cache",
    out: Annotated[Path | None, typer.Option(help="JSON file; a part of it writes none.")] = None,
) -> None:
    """Measure matchers on renderings of the map and print Markdown."""
    specs = [spec.strip() for spec in only.split(";") if spec.strip()]
    matchers = {spec: made(spec, weights, device) for spec in specs}
    bench = Bench(data, cache, every, office_every)
    parts: dict[str, list[Trial]] = {spec: [] for spec in specs}
    console = Console(stderr=True)
    for place in ("house", *HALVES):
        asked = queries(bench, place, seed)[part.rows]
        for query in track(asked, place, console=console, transient=True):
            for spec, its in matchers.items():
                parts[spec].append(ask(spec, its, [query], seed=seed))
            query.forget()
    trials = [Trial.joined(spec, part) for spec, part in parts.items()]
    print(report(trials))
    target = out or (OUT if only == MATCHERS and part is Part.ALL else None)
    if target:
        target.parent.mkdir(parents=True, exist_ok=True)
        record = {
            "machine": machine(),
            "seed": seed,
            "device": device,
            "every": every,
            "office_every": office_every,
            "part": part.value,
            "rows": [to_dict(t) for t in trials],
        }
        target.write_text(dumps(record), encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
