"""Which matcher finds the cell? Table II of the paper, on graphs from OpenStreetMap.

    python benchmarks/outdoor_matchers.py
    python benchmarks/outdoor_matchers.py --cities monaco --quick

Viewpoints lie where nothing was trained on: in the held-out tiles of four cities, and anywhere in
Monaco and Toronto. Prints Markdown, writes JSON. `docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

import json
import os
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, names_of, open_city, unseen_queries
from placegraph_lab.tables.outdoor.matchers import MATCHERS, SLOW, ask, matcher
from placegraph_lab.tables.outdoor.matchers_report import advantages, report
from placegraph_lab.tables.outdoor.queries import SETTINGS, load
from placegraph_lab.tables.outdoor.report import Protocol, Row, of_answers

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from placegraph.outdoor.city import CityMap
    from placegraph_lab.tables.outdoor.matchers import Matcher

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared/data/osm"


def run_city(
    name: str,
    city: CityMap,
    path: Path,
    table: Sequence[Protocol],
    methods: Sequence[str],
    *,
    queries: int,
    slow: int,
    seed: int,
    tick: Callable[[], None],
) -> list[Row]:
    """All rows of a city."""
    bins = load(path)
    known: dict[tuple[str, str], Matcher] = {}
    rows = []
    for protocol in table:
        setting = protocol.setting
        made = partial(
            unseen_queries,
            name,
            city,
            path,
            setting=setting,
            in_the_middle=not protocol.anywhere,
        )
        asked, warming = made(n=queries, seed=seed), made(n=3, seed=seed + 1)
        for method in methods:
            key = method, setting if setting in ("names", "speaker") else ""
            if key not in known:
                known[key] = matcher(method, city, bins, setting, seed=seed)
                ask(known[key], city, warming)
            few = asked[:slow] if method in SLOW else asked
            rows.append(of_answers(name, protocol, method, ask(known[key], city, few)))
            tick()
    return rows


def main(
    cities: Annotated[str, typer.Option(help="Names with commas; all where left out.")] = "",
    settings: Annotated[str, typer.Option(help="Settings with commas; all.")] = "",
    methods: Annotated[str, typer.Option(help="Matchers with semicolons; all.")] = "",
    queries: Annotated[int, typer.Option(help="Queries a city and setting.")] = 300,
    slow: Annotated[int, typer.Option(help="Of these, how many for edit distance.")] = 50,
    seed: Annotated[int, typer.Option(help="Seed of the queries.")] = 0,
    *,
    quick: Annotated[bool, typer.Option(help="40 queries (5 of them slow), 2 settings.")] = False,
    data: Annotated[Path, typer.Option(help="Folder with the extracts.")] = DATA,
    maps: Annotated[Path, typer.Option(help="Folder for maps.")] = ROOT / ".benchmark-cache",
    out: Annotated[Path, typer.Option(help="JSON file.")] = (
        ROOT / "benchmarks/results/outdoor_matchers.json"
    ),
) -> None:
    """Measure the recall of every matcher and print Markdown."""
    if quick:
        queries, slow, settings = 40, 5, settings or "none,replaced"
    chosen = [s for s in SETTINGS if not settings or s in settings.split(",")]
    table = [Protocol(setting=s, anywhere=True) for s in chosen]
    table += [Protocol(setting="none")] if "none" in chosen else []
    shown = [m for m in MATCHERS if not methods or m in methods.split(";")]
    names = names_of(cities)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # one core
    rows: list[Row] = []
    cells = {}
    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task("asking", total=len(names) * len(table) * len(shown))
        for name in names:
            city = open_city(name, data, maps)
            cells[name] = len(city.cells)
            rows += run_city(
                name,
                city,
                data / EXTRACTS[name],
                table,
                shown,
                queries=queries,
                slow=slow,
                seed=seed,
                tick=lambda: progress.advance(task),
            )
    lead = advantages(rows, np.random.default_rng(seed))
    print(report(rows, lead))
    out.parent.mkdir(parents=True, exist_ok=True)
    record = {
        "machine": machine(),
        "queries": queries,
        "queries_of_edit_distance": slow,
        "seed": seed,
        "cells": cells,
        "rows": [r.to_dict() for r in rows],
        "fused_against_best_single": lead,
    }
    out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
