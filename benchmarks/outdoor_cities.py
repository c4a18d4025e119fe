"""Whole cities: accuracy, seconds a query and megabytes. Table VI of the paper.

    python benchmarks/outdoor_cities.py

Queries as in `outdoor_matchers.py`: from held-out tiles, of six statements, viewpoints anywhere in a
cell and near the middle of one. Prints Markdown, writes JSON.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from placegraph.outdoor.city import CityMap
from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, names_of, open_city, unseen_queries
from placegraph_lab.tables.outdoor.matchers import LocateMatcher, ask
from placegraph_lab.tables.outdoor.metrics import RANKS, score
from placegraph_lab.tables.tables import markdown, number, shares

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared/data/osm"
PAPER = {
    "*paper: Karlsruhe*": (173.5, 1000, (0.28, 0.44, 0.52), 0.15, 15.44),
    "*paper: Sydney*": (12145.0, 486, (0.23, 0.38, 0.49), 0.13, 34.31),
    "*paper: Toronto*": (630.2, 479, (0.22, 0.36, 0.44), 0.29, 38.74),
}
"""Table VI: km², cells, accuracy at 1/3/5, seconds a query, MB."""


def run_city(name: str, data: Path, maps: Path, *, queries: int, seed: int) -> dict[str, Any]:
    """Figures of a city."""
    path = data / EXTRACTS[name]
    city = open_city(name, data, maps)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "city"
        city.save(file)
        size = file.stat().st_size
        start = time.perf_counter()
        city = CityMap.open(file)
        opening = time.perf_counter() - start
    asked = {
        way: unseen_queries(
            name, city, path, n=queries, seed=seed, in_the_middle=way == "near the middle"
        )
        for way in ("anywhere", "near the middle")
    }
    start = time.perf_counter()
    ask(LocateMatcher(city), city, asked["anywhere"][:1])
    first = time.perf_counter() - start
    row: dict[str, Any] = {
        "city": name,
        "km2": len(city.cells) * city.cells.grid.stride**2 * 1e-6,
        "cells": len(city.cells),
        "bytes": size,
        "vector_bytes": int(city.embeddings.nbytes),
        "open_s": opening,
        "first_query_s": first,
    }
    for way, told in asked.items():
        row[way] = score(ask(LocateMatcher(city), city, told)).to_dict()
    return row


def line(row: dict[str, Any]) -> list[str]:
    """Row of the table."""
    told, middle = row["anywhere"], row["near the middle"]

    def at(recall: dict[str, float]) -> str:
        return shares(recall[str(k)] for k in RANKS)

    return [
        row["city"],
        number(row["km2"], 1),
        number(row["cells"]),
        at(middle["exact"]),
        at(told["exact"]),
        at(told["within"]["50 m"]),
        number(1e-3 * told["p50_ms"], 4),
        number(1e-3 * told["p95_ms"], 4),
        number(1e-6 * row["bytes"], 2),
        number(1e-6 * (row["bytes"] + row["vector_bytes"]), 2),
        number(row["first_query_s"], 2, "s"),
    ]


def main(
    cities: Annotated[str, typer.Option(help="Names with commas.")] = (
        "vancouver,ankara,liechtenstein"
    ),
    queries: Annotated[int, typer.Option(help="Queries a city.")] = 500,
    seed: Annotated[int, typer.Option(help="Seed of the queries.")] = 0,
    *,
    quick: Annotated[bool, typer.Option(help="50 queries of one city.")] = False,
    data: Annotated[Path, typer.Option(help="Folder with the extracts.")] = DATA,
    maps: Annotated[Path, typer.Option(help="Folder for maps.")] = ROOT / ".benchmark-cache",
    out: Annotated[Path, typer.Option(help="JSON file.")] = (
        ROOT / "benchmarks/results/outdoor_cities.json"
    ),
) -> None:
    """Measure whole cities and print Markdown."""
    names = names_of(cities)[:1] if quick else names_of(cities)
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # one core
    rows = [
        run_city(name, data, maps, queries=50 if quick else queries, seed=seed) for name in names
    ]
    header = ["", "km² of cells", "cells", "exact @1/3/5, near the middle", "exact @1/3/5"]
    header += ["50 m @1/3/5", "s/query", "95 %", "MB", "with vectors", "first query"]
    lines = [line(row) for row in rows]
    for name, (area, cells, recall, seconds, size) in PAPER.items():
        figures = [number(area, 1), number(cells), shares(recall), "–", "–"]
        figures += [number(seconds, 2), "–", number(size, 2), "–", "–"]
        lines.append([name, *figures])
    print(markdown(header, lines))
    out.parent.mkdir(parents=True, exist_ok=True)
    record = {"machine": machine(), "queries": queries, "seed": seed, "rows": rows}
    out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
