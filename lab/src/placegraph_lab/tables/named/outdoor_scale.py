"""Does time grow slower than the map? Copies of one city side by side, labels shuffled.

The queries come from the first copy, which keeps its labels, and are the same on every map.
Every build and every round of queries runs in a fresh process.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import placegraph as pg
from placegraph_lab.tables.outdoor.extracts import EXTRACTS
from placegraph_lab.tables.outdoor.metrics import measure, score
from placegraph_lab.tables.outdoor.queries import Query, make_queries
from placegraph_lab.tables.outdoor.tiling import tile
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, Seed, option, render, share, table
from placegraph_lab.tables.statistics import peak, run_apart


def build(osm: Path, city: Path, small: Path) -> dict[str, float]:
    """Build a map, after a small one has loaded and compiled what is needed."""
    pg.build_city(small, city)
    start = time.perf_counter()
    made = pg.build_city(osm, city)
    seconds = time.perf_counter() - start
    return {
        "build_s": seconds,
        "cells": len(made.cells),
        "objects": len(made.objects),
        "bytes": city.stat().st_size,
        "build_peak_bytes": peak(),
    }


def ask(city: Path, queries: Sequence[Query]) -> dict[str, Any]:
    """Open a map and give it all texts, after every tenth has warmed it."""
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    pg.CityMap.open(city)  # what is imported once does not count
    start = time.perf_counter()
    opened = pg.CityMap.open(city)
    open_s = time.perf_counter() - start
    start = time.perf_counter()
    opened.locate(queries[0].text)
    first_s = time.perf_counter() - start
    answers = []
    for round_ in range(2):
        for q in queries[:: 10 if round_ == 0 else 1]:
            start = time.perf_counter()
            estimate = opened.locate(q.text)
            seconds = time.perf_counter() - start
            if round_:
                answers.append(measure(estimate, q.longitude, q.latitude, seconds=seconds))
    result = score(answers)
    return {
        "open_s": open_s,
        "first_query_s": first_s,
        "p50_s": result.p50,
        "p95_s": result.p95,
        "recall_at_1_within_50_m": result.within[50.0][1],
        "query_peak_bytes": peak(),
    }


COLUMNS = (
    Col("copies", lambda r: f"{r['copies']} x"), Col("objects", "objects", 0), Col("cells", "cells", 0),
    Col("build", "build_s", 1, "s"), Col("cells/s", lambda r: r["cells"] / r["build_s"], 0),
    Col("build peak", "build_peak_bytes", 0, "MB", 1e-6), Col("file", "bytes", 2, "MB", 1e-6),
    Col("bytes/cell", lambda r: r["bytes"] / r["cells"], 0), Col("open", "open_s", 0, "ms", 1e3),
    Col("first query", "first_query_s", 0, "ms", 1e3), Col("p50", "p50_s", 1, "ms", 1e3),
    Col("p95", "p95_s", 1, "ms", 1e3), Col("query peak", "query_peak_bytes", 0, "MB", 1e-6),
    Col("@1 50 m", "recall_at_1_within_50_m", share),
)  # fmt: skip


@table()
def outdoor_scale(
    run: Run,
    city: Annotated[str, option("City that is copied.")] = "monaco",
    copies: Annotated[str, option("Numbers of copies with commas.")] = "1,10,100",
    queries: Annotated[int, option("Queries.")] = 200,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Time against the size of the map: copies of one city side by side, labels shuffled."""
    if quick:
        copies, queries = "1,2", 20
    osm = run.osm / EXTRACTS[city]
    run.cache.mkdir(parents=True, exist_ok=True)
    asked = make_queries(osm, n=queries, seed=seed)
    rows: list[dict[str, Any]] = []
    for n in (int(c) for c in copies.split(",")):
        run.log(f"{n} x: writing, building, asking")
        tiled, made = run.cache / f"tiled_{n}.osm.pbf", run.cache / f"tiled_{n}.city"
        tile([osm], tiled, n, seed)
        rows.append(
            {"copies": n} | run_apart(build, tiled, made, osm) | run_apart(ask, made, asked)
        )
    print(render(COLUMNS, rows))
    run.save({"extract": osm.name, "rows": rows})
