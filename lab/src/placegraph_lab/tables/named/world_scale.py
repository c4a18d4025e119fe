"""Larger maps than there are extracts: copies of a city's map side by side, their words shuffled."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from placegraph.outdoor.city import CityMap
from placegraph.outdoor.search.locate import make_estimate, search_views
from placegraph.outdoor.search.posterior import (
    NO_MARGIN,
    Candidates,
    Posterior,
    compute_posterior,
    score_candidates,
)
from placegraph.outdoor.search.request import Hints, Matching, Request, make_request
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, open_city, tile
from placegraph_lab.tables.outdoor.queries import Query, load, make_queries
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, number, option, table
from placegraph_lab.tables.statistics import peak, run_apart

SAME = 40.0  # best places nearer than this are one [m]: as far apart as modes are at least
SURE = 0.1  # texts whose best place holds more by an exhaustive search are counted apart
COMMONER = (
    8  # of so many times as many texts those are kept that speak of the commonest things alone
)


def build(small: Path, path: Path, copies: int, seed: int) -> dict[str, Any]:
    """Lay out copies of a map, and write it with its index."""
    begun = _now()
    made = tile(CityMap.open(small), copies, np.random.default_rng(seed))
    start = _now()
    viewpoints = len(made.views)
    index = _since(start)
    made.save(path)
    return {
        "all": _since(begun),
        "cells": len(made.cells),
        "objects": len(made.objects),
        "viewpoints": viewpoints,
        "index": index,
        "bytes": path.stat().st_size,
        "peak_bytes": peak(),
    }


def ask(path: Path, small: Path, texts: Mapping[str, Sequence[str]]) -> dict[str, Any]:
    """Open a map and give it all texts; compiled code was loaded by a small map before."""
    CityMap.open(small).locate("A bench is north of me.")
    before = _resident()
    start = _now()
    city = CityMap.open(path)
    opened = _since(start)
    start = _now()
    city.locate(next(iter(texts.values()))[0])
    first = _since(start)
    kinds = {kind: _times(city, some) for kind, some in texts.items()}
    return {
        "open": opened, "first": first, "kinds": kinds, "before": before, "resident": _resident(),
    }  # fmt: skip


def equal(path: Path, texts: Mapping[str, Sequence[str]], most: int) -> dict[str, dict[str, float]]:
    city = CityMap.open(path)
    return {kind: _compared(city, some[:most]) for kind, some in texts.items()}


def _compared(city: CityMap, texts: Sequence[str]) -> dict[str, float]:
    off: list[float] = []
    missed: list[float] = []
    sure: list[bool] = []
    for text in texts:
        asked = make_request(city, text, Hints(), Matching())
        if not asked.is_positive:
            continue
        some, every = (
            make_estimate(asked, p, 5).modes for p in (search_views(asked), exhaustive(asked))
        )
        if not (some and every):
            missed += [1.0] if some or every else []
            continue
        one, two = (city.plane.to_plane((e[0].longitude, e[0].latitude)) for e in (some, every))
        is_same = bool(np.hypot(*(one - two)) < SAME)
        sure += [is_same] if every[0].probability > SURE else []
        if is_same:
            off.append(abs(some[0].probability - every[0].probability))
        else:
            missed.append(every[0].probability)
    return {
        "texts": len(off) + len(missed),
        "same_mode": len(off),
        "within_1_percent": sum(d <= 0.01 for d in off),
        "probability_off": max(off, default=0.0),
        "missed_probability": max(missed, default=0.0),
        "sure": len(sure),
        "sure_same": sum(sure),
    }


def exhaustive(request: Request) -> Posterior:
    every = Candidates.of_views(request, np.arange(len(request.city.views)))
    return compute_posterior(request, score_candidates(request, every, NO_MARGIN))


def texts_of(osm: Path, n: int, seed: int) -> dict[str, list[str]]:
    """Texts by kind: with names, of six statements, and of the commonest things alone."""
    city = load(osm).city
    often = Counter(np.array(city.labels)[city.label].tolist())

    def rarest(query: Query) -> int:
        return min(
            often[label] for s in query.statements for label in (s.source, s.target) if label
        )

    common = sorted(make_queries(osm, n=COMMONER * n, seed=seed + 1), key=rarest, reverse=True)
    return {
        "names": [q.text for q in make_queries(osm, n=n, seed=seed + 2, setting="names")],
        "six statements": [q.text for q in make_queries(osm, n=n, seed=seed)],
        "the commonest things": [q.text for q in common[:n]],
        "of the speaker": [
            q.text for q in make_queries(osm, n=n, seed=seed + 3, setting="speaker")
        ],
    }


def _times(city: CityMap, texts: Sequence[str]) -> dict[str, float]:
    for text in texts[::10]:
        city.locate(text)
    took = []
    for text in texts:
        start = _now()
        city.locate(text)
        took.append(_since(start))
    columns = {which: np.array([t[which] for t in took]) for which in ("wall_s", "cpu_s")}
    return {
        f"{p}_{which}": float(np.percentile(column, q))
        for which, column in columns.items()
        for p, q in (("p50", 50), ("p95", 95))
    }


def _now() -> tuple[float, float]:
    return time.perf_counter(), time.process_time()


def _since(start: tuple[float, float]) -> dict[str, float]:
    wall, cpu = _now()
    return {"wall_s": wall - start[0], "cpu_s": cpu - start[1]}


def _resident() -> dict[str, int]:
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    names = {"own": "RssAnon", "files": "RssFile", "all": "VmRSS"}
    return {name: 1024 * int(status[key].split()[0]) for name, key in names.items()}


@table()
def world_scale(
    run: Run,
    city: Annotated[str, option("City that is copied.")] = "vancouver",
    copies: Annotated[str, option("Numbers of copies with commas.")] = "1,2,19",
    queries: Annotated[int, option("Queries of each kind.")] = 60,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Cost of a search in maps of up to ten million cells, and agreement with full search."""
    if quick:
        copies, queries = "1,2", 10
    open_city(city, run.osm, run.cache)
    texts = texts_of(run.osm / EXTRACTS[city], queries, seed)
    rows: list[dict[str, Any]] = []
    for n in (int(c) for c in copies.split(",")):
        path = run.cache / f"world_{city}_{n}.city"
        run.log(f"{n} x: building")
        made = run_apart(build, run.cache / f"{city}.city", path, n, seed)
        run.log(f"{n} x: asking")
        load_ = os.getloadavg()[0]
        found = run_apart(ask, path, run.cache / f"{city}.city", texts)
        run.log(f"{n} x: comparing")
        same = run_apart(equal, path, texts, COMPARED if n == 1 else 0)
        rows.append({"copies": n, "load": load_} | made | found | {"equal": same})
        path.unlink()
    print(markdown(_HEADER, [_line(row) for row in rows]))
    kinds = [[f"{row['cells']:,}", kind, *_of_kind(row, kind)] for row in rows for kind in texts]
    print(markdown(_KINDS, kinds))
    run.save({"extract": EXTRACTS[city], "rows": rows})


COMPARED = 60
"""Texts of a kind that are compared with an exhaustive search, in the map of one copy."""

_HEADER = [
    "cells", "map built (CPU)", "of it index", "build peak", "bytes/cell", "open (CPU)", "first query (CPU)",
    "resident", "own", "before", "own before",
]  # fmt: skip
_KINDS = [
    "cells", "texts", "p50 (CPU)", "p95 (CPU)", "p50", "p95", "same mode", "of those above .10", "within 1 %",
    "probability off", "missed",
]  # fmt: skip


def _line(row: dict[str, Any]) -> list[str]:
    def seconds(key: str) -> str:
        return f"{row[key]['wall_s']:.2f} s ({row[key]['cpu_s']:.2f})"

    mb: Callable[[float], str] = lambda n: f"{n / 1e6:,.0f} MB"  # noqa: E731
    return [
        f"{row['cells']:,}", seconds("all"), seconds("index"), mb(row["peak_bytes"]),
        f"{row['bytes'] / row['cells']:.0f}", seconds("open"), seconds("first"),
        mb(row["resident"]["all"]), mb(row["resident"]["own"]),
        mb(row["before"]["all"]), mb(row["before"]["own"]),
    ]  # fmt: skip


def _of_kind(row: dict[str, Any], kind: str) -> list[str]:
    times, same = row["kinds"][kind], row["equal"][kind]
    n = same["texts"]
    return [
        *(f"{1e3 * times[f'{p}_{w}']:.1f} ms" for w in ("cpu_s", "wall_s") for p in ("p50", "p95")),
        *(
            f"{same[what]} of {same[of]}" if n else "–"
            for what, of in (("same_mode", "texts"), ("sure_same", "sure"), ("within_1_percent", "texts"))
        ),
        *(number(same[what], 4) if n else "–" for what in ("probability_off", "missed_probability")),
    ]  # fmt: skip
