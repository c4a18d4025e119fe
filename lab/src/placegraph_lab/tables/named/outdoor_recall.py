"""Does a sentence find its place? Recall, calibration and time on real OpenStreetMap extracts.

`docs/benchmarks/outdoor.md` explains the protocol.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.outdoor.city import CityMap
from placegraph_lab.tables.outdoor.baselines import Bag, Words
from placegraph_lab.tables.outdoor.ceiling import Contest, ceiling, oracle
from placegraph_lab.tables.outdoor.extracts import EXTRACTS
from placegraph_lab.tables.outdoor.extracts import TRAINED as DEV
from placegraph_lab.tables.outdoor.extracts import UNSEEN as TEST
from placegraph_lab.tables.outdoor.metrics import (
    BAGS,
    CEILING,
    ORACLE,
    OURS,
    RADII,
    RANKS,
    Answer,
    Protocol,
    Row,
    distances,
    measure,
    of_answers,
    positions,
    report,
)
from placegraph_lab.tables.outdoor.nearby import Bins
from placegraph_lab.tables.outdoor.queries import CELL, SETTINGS, Query, load, make_queries
from placegraph_lab.tables.runner import Quick, Run, Seed, option, parts, table

if TYPE_CHECKING:
    from rich.progress import Progress


class Split(StrEnum):
    """Which cities: those that were tuned on, or those that are reported once."""

    dev = "dev"
    test = "test"
    all = "all"


def protocols(statements: Sequence[int], settings: Sequence[str]) -> list[Protocol]:
    """All settings at all lengths; the speaker and the other readings of the paper at 6."""
    chosen = [s for s in SETTINGS if s in settings]
    table = [Protocol(n, s) for n in statements for s in chosen if s != "speaker" or n == 6]
    if 6 in statements and "variants" in settings:
        table.append(Protocol(anywhere=True))
    return table


def bounds(
    city: str, bins: Bins, group: Sequence[Protocol], queries: dict[Protocol, list[Query]]
) -> list[Row]:
    """Rows of the ceiling and of the oracle; the protocols look at the city in the same way."""
    together = [q for p in group for q in queries[p]]

    contest = Contest.of(bins, together, names=group[0].setting == "names")
    ceilings = {"exact": ceiling(contest, None)}
    ceilings |= {f"{r:.0f} m": ceiling(contest, r) for r in RADII}
    loud = [p.setting == "replaced" for p in group for _ in queries[p]]
    quiet_guess, loud_guess = oracle(contest), oracle(contest, replaced=True)
    guess = np.where(np.array(loud)[:, None], loud_guess, quiet_guess)
    rows, end = [], 0
    for p in group:
        part = slice(end, end := end + len(queries[p]))
        recall = {
            name: [type(c)(c.better[part], c.tied[part]).recall(k) for k in RANKS]
            for name, c in ceilings.items()
        }
        rows.append(Row(city, p, CEILING, recall, None))
        recall = {
            f"{r:.0f} m": [float((guess[part, :k] <= r).any(1).mean()) for k in RANKS]
            for r in RADII
        }
        rows.append(Row(city, p, ORACLE, recall, None))
    return rows


def same_cell(places: Floats, query: Query, bins: Bins) -> tuple[bool, ...]:
    """Whether places (K, 2) [deg] lie in the query's cell of the grid it was drawn from."""
    at, truth = (
        bins.cells(bins.city.plane.to_plane(p), CELL)
        for p in (places, [(query.longitude, query.latitude)])
    )
    return tuple((at == truth).all(1).tolist())


def ask_map(city: CityMap, bins: Bins, queries: Sequence[Query]) -> list[Answer]:
    """Give every text, and only the text, to a city map."""
    answers = []
    for query in queries:
        start = time.perf_counter()
        estimate = city.locate(query.text, top=max(RANKS))
        seconds = time.perf_counter() - start
        answers.append(
            measure(
                estimate,
                query.longitude,
                query.latitude,
                seconds=seconds,
                exact=same_cell(positions(estimate), query, bins),
                cell=city.cells.at(query.longitude, query.latitude),
            )
        )
    return answers


def run_city(
    name: str,
    path: Path,
    table: Sequence[Protocol],
    *,
    n: int,
    seed: int,
    city: CityMap | None,
    tick: Progress,
) -> list[Row]:
    """All rows of a city; without a map those of the baselines and the ceiling."""
    bins = load(path)
    task = tick.add_task(name, total=len(table) + len({p.group for p in table}))
    queries = {
        p: make_queries(
            path,
            statements=p.statements,
            setting=p.setting,
            n=n,
            seed=seed,
            anywhere=p.anywhere,
        )
        for p in table
    }
    if city is not None:
        ask_map(city, bins, make_queries(path, n=20, seed=seed + 1))  # warm
    bags: dict[tuple[object, ...], Bag] = {}
    rows = []
    for p, asked in queries.items():
        for method, (reach, longest) in BAGS.items():
            pairs: Words = "speaker" if p.setting == "speaker" else "triples"
            words: Words = "labels" if method == "label bag" else pairs
            key = (words, method, p.setting == "names")
            if key not in bags:
                bags[key] = Bag.of(
                    bins,
                    words,
                    reach=reach,
                    longest=longest,
                    names=p.setting == "names",
                    seed=seed,
                )
            bag = bags[key]
            answers = []
            for query in asked:
                start = time.perf_counter()
                places = bag.locate(query, top=max(RANKS))
                seconds = time.perf_counter() - start
                off = distances(places, query.longitude, query.latitude)
                answers.append(Answer(off, same_cell(places, query, bins), seconds))
            rows.append(of_answers(name, p, method, answers))
        if city is not None:
            rows.append(of_answers(name, p, OURS, ask_map(city, bins, asked)))
        tick.advance(task)
    del bags
    for group in {p.group: None for p in table}:
        rows += bounds(name, bins, [p for p in table if p.group == group], queries)
        tick.advance(task)
    return rows


@table()
def outdoor_recall(
    run: Run,
    split: Annotated[Split, option("Cities: dev (tuned on), test, all.")] = Split.dev,
    cities: Annotated[str, option("Names with commas, instead of a split.")] = "",
    queries: Annotated[int, option("Queries a city and setting.")] = 500,
    statements: Annotated[str, option("Lengths with commas.")] = "4,6,10",
    settings: Annotated[str, option("Settings with commas.")] = "",
    seed: Seed = 0,
    *,
    quick: Quick = False,
    baselines: Annotated[bool, option("Leave the map out.")] = False,
) -> None:
    """Recall, calibration and time of sentences on OpenStreetMap extracts."""
    if quick:
        queries, statements, settings = 100, "6", settings or "none,replaced"
    asked = protocols(
        [int(n) for n in statements.split(",")],
        settings.split(",") if settings else [*SETTINGS, "variants"],
    )
    names = parts(cities) or list({Split.dev: DEV, Split.test: TEST, Split.all: EXTRACTS}[split])
    rows: list[Row] = []
    maps: dict[str, CityMap | None] = dict.fromkeys(names)
    if not baselines:
        import placegraph as pg

        run.cache.mkdir(parents=True, exist_ok=True)
        for name in names:  # always anew: the map's making is part of what is measured
            pg.build_city(run.osm / EXTRACTS[name], run.cache / f"{name}.city")
            maps[name] = pg.CityMap.open(run.cache / f"{name}.city")
    run.one_core()
    with run.progress() as tick:
        for name in names:
            path = run.osm / EXTRACTS[name]
            rows += run_city(name, path, asked, n=queries, seed=seed, city=maps[name], tick=tick)
    for title, group in (("Tuned on", DEV), ("Reported once", TEST)):
        chosen = [c for c in names if c in group]
        if chosen:
            print(f"### {title}\n\n{report([r for r in rows if r.city in chosen], chosen)}\n")
    cells = {name: len(m.cells) for name, m in maps.items() if m is not None}
    run.save({"queries": queries, "cells": cells, "rows": [r.to_dict() for r in rows]})
