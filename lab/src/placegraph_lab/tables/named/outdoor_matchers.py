"""Which matcher finds the cell? Table II of the paper, on graphs from OpenStreetMap.

    placegraph-lab table outdoor_matchers
    placegraph-lab table outdoor_matchers --cities monaco --quick

Viewpoints lie where nothing was trained on: in the held-out tiles of four cities, and anywhere in
Monaco and Toronto. Prints Markdown, writes JSON. `docs/benchmarks.md` explains the protocol.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated

import numpy as np

from placegraph_lab.tables.outdoor.extracts import EXTRACTS, names_of, open_city, unseen_queries
from placegraph_lab.tables.outdoor.matchers import MATCHERS, SLOW, ask, matcher
from placegraph_lab.tables.outdoor.matchers_report import advantages, report
from placegraph_lab.tables.outdoor.queries import SETTINGS, load
from placegraph_lab.tables.outdoor.report import Protocol, Row, of_answers
from placegraph_lab.tables.run import Quick, Run, Seed, option, table

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from placegraph.outdoor.city import CityMap
    from placegraph_lab.tables.outdoor.matchers import Matcher


@dataclass(frozen=True)
class Asking:
    """Which matchers are asked, and how often."""

    methods: Sequence[str]
    queries: int
    slow: int
    seed: int
    tick: Callable[[], None]

    def rows(
        self, name: str, city: CityMap, path: Path, protocols: Sequence[Protocol]
    ) -> list[Row]:
        """All rows of a city."""
        bins = load(path)
        made: dict[tuple[str, str], Matcher] = {}
        rows = []
        for protocol in protocols:
            setting = protocol.setting
            spoken = partial(
                unseen_queries, name, city, path,
                setting=setting, in_the_middle=not protocol.anywhere,
            )  # fmt: skip
            asked, warming = spoken(n=self.queries, seed=self.seed), spoken(n=3, seed=self.seed + 1)
            for method in self.methods:
                key = method, setting if setting in ("names", "speaker") else ""
                if key not in made:
                    made[key] = matcher(method, city, bins, setting, seed=self.seed)
                    ask(made[key], city, warming)
                few = asked[: self.slow] if method in SLOW else asked
                rows.append(of_answers(name, protocol, method, ask(made[key], city, few)))
                self.tick()
        return rows


@table("GOTLoc, Table II")
def outdoor_matchers(
    run: Run,
    cities: Annotated[str, option("Names with commas; all where left out.")] = "",
    settings: Annotated[str, option("Settings with commas; all.")] = "",
    methods: Annotated[str, option("Matchers with semicolons; all.")] = "",
    queries: Annotated[int, option("Queries a city and setting.")] = 300,
    slow: Annotated[int, option("Of these, how many for edit distance.")] = 50,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Which matcher finds the cell? On graphs from OpenStreetMap."""
    if quick:
        queries, slow, settings = 40, 5, settings or "none,replaced"
    chosen = [s for s in SETTINGS if not settings or s in settings.split(",")]
    protocols = [Protocol(setting=s, anywhere=True) for s in chosen]
    protocols += [Protocol(setting="none")] if "none" in chosen else []
    shown = [m for m in MATCHERS if not methods or m in methods.split(";")]
    names = names_of(cities)
    run.one_core()
    rows: list[Row] = []
    cells = {}
    with run.progress() as progress:
        task = progress.add_task("asking", total=len(names) * len(protocols) * len(shown))
        asking = Asking(shown, queries, slow, seed, lambda: progress.advance(task))
        for name in names:
            city = open_city(name, run.osm, run.cache)
            cells[name] = len(city.cells)
            rows += asking.rows(name, city, run.osm / EXTRACTS[name], protocols)
    lead = advantages(rows, np.random.default_rng(seed))
    print(report(rows, lead))
    found = {"rows": [r.to_dict() for r in rows], "fused_against_best_single": lead}
    run.save({"queries": queries, "queries_of_edit_distance": slow, "cells": cells} | found)
