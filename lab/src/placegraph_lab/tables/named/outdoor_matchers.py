"""Which matcher finds the cell? Table II of the paper, on graphs from OpenStreetMap.

    placegraph-lab table outdoor_matchers
    placegraph-lab table outdoor_matchers --cities monaco --quick

Viewpoints lie where nothing was trained on: in the held-out tiles of four cities, and anywhere in
Monaco and Toronto. Interrupted, the same command goes on. Prints Markdown, writes JSON.
`docs/benchmarks/gotloc-tables.md` explains the protocol.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np

from placegraph.outdoor.city import CityMap
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, names_of, open_city, unseen_queries
from placegraph_lab.tables.outdoor.matchers import MATCHERS, SLOW, ask, matcher
from placegraph_lab.tables.outdoor.matchers_report import advantages, report, title
from placegraph_lab.tables.outdoor.metrics import Answer
from placegraph_lab.tables.outdoor.queries import SETTINGS, load
from placegraph_lab.tables.outdoor.report import Protocol, Row, of_answers
from placegraph_lab.tables.runner import (
    Journal,
    Quick,
    Run,
    Seed,
    fingerprint,
    known,
    option,
    parts,
    table,
)

CODE = (
    "placegraph/outdoor/**/*.py",
    "placegraph/outdoor/**/data/*",
    "placegraph_lab/tables/outdoor/*.py",
)
"""What decides an answer."""


@dataclass(frozen=True)
class Asking:
    """Which matchers are asked, and how often; answers are written down as they come."""

    methods: Sequence[str]
    queries: int
    slow: int
    slow_cities: Sequence[str]
    seed: int
    journal: Journal
    tick: Callable[[], None]

    def asked(self, name: str, protocol: Protocol, method: str) -> int:
        """How many queries a matcher gets."""
        if method not in SLOW:
            return self.queries
        wanted = name in self.slow_cities and protocol == Protocol(anywhere=True)
        return min(self.slow, self.queries) if wanted else 0

    def rows(
        self, name: str, city: CityMap, path: Path, protocols: Sequence[Protocol]
    ) -> list[Row]:
        """All rows of a city."""
        bins, code, rows = load(path), fingerprint(CODE), []
        for protocol in protocols:
            setting = protocol.setting
            spoken = partial(
                unseen_queries, name, city, path,
                setting=setting, in_the_middle=not protocol.anywhere,
            )  # fmt: skip
            asked, warming = spoken(n=self.queries, seed=self.seed), spoken(n=3, seed=self.seed + 1)
            for method in self.methods:
                n = self.asked(name, protocol, method)
                key = f"{name}, {title(protocol)}, {method}, {n}, {self.seed}, {code}"
                if n and key not in self.journal:
                    found = matcher(method, city, bins, setting, seed=self.seed)
                    ask(found, city, warming)
                    answers = ask(found, city, asked[:n])
                    plain = [(a.distance.tolist(), a.exact, a.seconds) for a in answers]
                    self.journal.put(key, plain)
                if n:
                    answers = [Answer(np.array(d), tuple(e), s) for d, e, s in self.journal[key]]
                    rows.append(of_answers(name, protocol, method, answers))
                self.tick()
        return rows


@table("GOTLoc, Table II")
def outdoor_matchers(
    run: Run,
    cities: Annotated[str, option("Names with commas; all where left out.")] = "",
    settings: Annotated[str, option("Settings with commas.")] = "none",
    methods: Annotated[str, option("Matchers with semicolons; all.")] = "",
    queries: Annotated[int, option("Queries a city and setting.")] = 200,
    slow: Annotated[int, option("Of these, how many for plain edit distance.")] = 100,
    slow_cities: Annotated[
        str, option("Cities that plain edit distance is asked in, without noise.")
    ] = "liechtenstein,monaco,toronto",
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Which matcher finds the cell? On graphs from OpenStreetMap."""
    if quick:
        queries, slow = 40, 5
    asked_for = known(parts(settings), SETTINGS, "setting")
    chosen = [s for s in SETTINGS if s in asked_for]
    protocols = [Protocol(setting=s, anywhere=True) for s in chosen]
    protocols += [Protocol(setting="none")] if "none" in chosen else []
    shown = known(parts(methods, ";"), MATCHERS, "matcher")
    names = names_of(cities)
    run.one_core()
    rows: list[Row] = []
    cells = {}
    with run.progress() as progress:
        task = progress.add_task("asking", total=len(names) * len(protocols) * len(shown))
        asking = Asking(
            shown, queries, slow, parts(slow_cities), seed, run.journal(),
            lambda: progress.advance(task),
        )  # fmt: skip
        for name in names:
            city = open_city(name, run.osm, run.cache)
            cells[name] = len(city.cells)
            rows += asking.rows(name, city, run.osm / EXTRACTS[name], protocols)
    lead = advantages(rows, np.random.default_rng(seed))
    print(report(rows, lead))
    found = {"rows": [r.to_dict() for r in rows], "differences": lead}
    run.save({"cells": cells} | found, whole=not (cities or methods))
