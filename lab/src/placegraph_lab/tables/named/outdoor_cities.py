"""Whole cities: accuracy, seconds a query and megabytes. Table VI of the paper.

Queries as in `outdoor_matchers`: from held-out tiles, or anywhere in a city never trained on, of
six statements, viewpoints anywhere in a cell and near the middle of one; by the default, and by
GOTLoc as printed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from placegraph.outdoor.city import CityMap
from placegraph_lab.tables.outdoor.extracts import CITIES, Extract, extracts_of, unseen_queries
from placegraph_lab.tables.outdoor.matchers import (
    PIPELINES,
    PRINTED,
    LocateMatcher,
    Matcher,
    RetrieveMatcher,
    ask,
)
from placegraph_lab.tables.outdoor.metrics import RANKS, score
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, Seed, number, option, render, shares, table

PAPER = {
    "*paper: Karlsruhe*": (173.5, 1000, (0.28, 0.44, 0.52), 0.15, 15.44),
    "*paper: Sydney*": (12145.0, 486, (0.23, 0.38, 0.49), 0.13, 34.31),
    "*paper: Toronto*": (630.2, 479, (0.22, 0.36, 0.44), 0.29, 38.74),
}
"""Table VI: km², cells, accuracy at 1/3/5, seconds a query, MB."""


def run_city(extract: Extract, maps: Path, *, queries: int, seed: int) -> Iterator[dict[str, Any]]:
    """Figures of a city, a row a matcher."""
    city = extract.open(maps)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "city"
        city.save(file)
        size = file.stat().st_size
        city = CityMap.open(file)
    ways = {"anywhere": False, "near the middle": True}
    texts = {
        way: unseen_queries(
            extract, city, extract.osm(maps), n=queries, seed=seed, in_the_middle=middle
        )
        for way, middle in ways.items()
    }
    matchers: dict[str, Matcher] = {
        "default": LocateMatcher(city),
        PRINTED: RetrieveMatcher(city, PIPELINES[PRINTED]),
    }
    for title, matcher in matchers.items():
        ask(matcher, city, texts["anywhere"][:1])  # what is made on first use is not timed
        yield {
            "city": extract.name,
            "matcher": title,
            "km2": extract.area.km2
            if extract.area
            else len(city.cells) * city.cells.grid.stride**2 * 1e-6,
            "cells": len(city.cells),
            "bytes": size + int(city.encoded_as_printed.embeddings.nbytes) * (title == PRINTED),
            **{way: score(ask(matcher, city, of)) for way, of in texts.items()},
        }


def _ranks(recall: dict[int, float]) -> str:
    return shares(recall[k] for k in RANKS)


COLUMNS = (
    Col("", lambda r: f"{r['city']}, {r['matcher']}"), Col("km²", "km2", 1),
    Col("cells", "cells", 0),
    Col("exact @1/3/5, near the middle", lambda r: r["near the middle"].exact, _ranks),
    Col("exact @1/3/5", "anywhere.exact", _ranks),
    Col("50 m @1/3/5", lambda r: r["anywhere"].within[50.0], _ranks),
    Col("s/query", "anywhere.p50", 4), Col("s/query, 95 %", "anywhere.p95", 4),
    Col("MB", "bytes", 2, "", 1e-6),
)  # fmt: skip


@table("GOTLoc, Table VI")
def outdoor_cities(
    run: Run,
    cities: Annotated[str, option(f"{CITIES} All shared ones where left out.")] = "",
    queries: Annotated[int, option("Queries a city.")] = 200,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Whole cities: accuracy, seconds a query and megabytes."""
    extracts, asked = extracts_of(cities, run.osm), queries
    if quick:
        extracts, asked = extracts[:1], 50
    run.one_core()
    rows = [
        row for extract in extracts
        for row in run_city(extract, run.cache, queries=asked, seed=seed)
    ]  # fmt: skip
    paper = [
        [name, number(area, 1), number(cells), shares(recall), "–", "–", number(seconds, 2), "–",
         number(size, 2)]
        for name, (area, cells, recall, seconds, size) in PAPER.items()
    ]  # fmt: skip
    print(render(COLUMNS, [*rows, *paper]))
    run.save({"queries": asked, "rows": rows}, complete=not cities)
