"""Whole cities: accuracy, seconds a query and megabytes. Table VI of the paper.

    placegraph-lab table outdoor_cities

Queries as in `outdoor_matchers`: from held-out tiles, or anywhere in a city never trained on, of
six statements, viewpoints anywhere in a cell and near the middle of one; by the default, and by the
paper's pipeline. Prints Markdown, writes JSON.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Annotated, Any

from placegraph.outdoor.city import CityMap
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, names_of, open_city, unseen_queries
from placegraph_lab.tables.outdoor.matchers import LocateMatcher, Matcher, RetrieveMatcher, ask
from placegraph_lab.tables.outdoor.metrics import RANKS, score
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, number, option, shares, table

PAPER = {
    "*paper: Karlsruhe*": (173.5, 1000, (0.28, 0.44, 0.52), 0.15, 15.44),
    "*paper: Sydney*": (12145.0, 486, (0.23, 0.38, 0.49), 0.13, 34.31),
    "*paper: Toronto*": (630.2, 479, (0.22, 0.36, 0.44), 0.29, 38.74),
}
"""Table VI: km², cells, accuracy at 1/3/5, seconds a query, MB."""

MATCHERS = ("default", "paper's pipeline")


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
    row: dict[str, Any] = {
        "city": name,
        "km2": len(city.cells) * city.cells.grid.stride**2 * 1e-6,
        "cells": len(city.cells),
        "bytes": size,
        "vector_bytes": int(city.embeddings.nbytes),
        "open_s": opening,
    }
    matchers: tuple[Matcher, ...] = (
        LocateMatcher(city),
        RetrieveMatcher(city, {"preset": "paper"}),
    )
    for name_of, matcher in zip(MATCHERS, matchers, strict=True):
        ask(matcher, city, asked["anywhere"][:1])  # what is made on first use is not timed
        row[name_of] = {
            way: score(ask(matcher, city, told)).to_dict() for way, told in asked.items()
        }
    return row


def line(row: dict[str, Any], matcher: str) -> list[str]:
    told, middle = row[matcher]["anywhere"], row[matcher]["near the middle"]

    def at(recall: dict[str, float]) -> str:
        return shares(recall[str(k)] for k in RANKS)

    return [
        f"{row['city']}, {matcher}",
        number(row["km2"], 1),
        number(row["cells"]),
        at(middle["exact"]),
        at(told["exact"]),
        at(told["within"]["50 m"]),
        number(1e-3 * told["p50_ms"], 4),
        number(1e-3 * told["p95_ms"], 4),
        number(1e-6 * (row["bytes"] + row["vector_bytes"] * (matcher != "default")), 2),
    ]


@table("GOTLoc, Table VI")
def outdoor_cities(
    run: Run,
    cities: Annotated[str, option("Names with commas; all where left out.")] = "",
    queries: Annotated[int, option("Queries a city.")] = 200,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Whole cities: accuracy, seconds a query and megabytes."""
    names, asked = names_of(cities), queries
    if quick:
        names, asked = names[:1], 50
    run.one_core()
    rows = [run_city(name, run.osm, run.cache, queries=asked, seed=seed) for name in names]
    header = ["", "km² of cells", "cells", "exact @1/3/5, near the middle", "exact @1/3/5"]
    header += ["50 m @1/3/5", "s/query", "95 %", "MB"]
    lines = [line(row, matcher) for row in rows for matcher in MATCHERS]
    for name, (area, cells, recall, seconds, size) in PAPER.items():
        figures = [number(area, 1), number(cells), shares(recall), "–", "–"]
        figures += [number(seconds, 2), "–", number(size, 2)]
        lines.append([name, *figures])
    print(markdown(header, lines))
    run.save({"queries": asked, "rows": rows})
