"""Tables of the matchers (Table II), with the paper's figures and with paired intervals."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.network.network import EncodedCity, GraphTransformer
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.outdoor.extracts import (
    CITIES,
    EXTRACTS,
    Extract,
    extracts_of,
    unseen_queries,
)
from placegraph_lab.tables.outdoor.matchers import (
    COSINE,
    COSINE_DENSE,
    DENSE,
    FUSED,
    LOGIT,
    LOGIT_DENSE,
    MATCHERS,
    PRINTED,
    PRINTED_ALONE,
    PRINTED_EDITS,
    RELATIONAL,
    SLOW,
    RetrieveMatcher,
    ask,
    matcher,
)
from placegraph_lab.tables.outdoor.metrics import (
    RADII,
    RANKS,
    TUNED,
    Answer,
    Protocol,
    Row,
    mean_recall,
    of_answers,
)
from placegraph_lab.tables.outdoor.queries import SETTINGS, load
from placegraph_lab.tables.statistics import Interval, paired_interval, recall_interval

PAPER = {
    "*paper: Text2Loc, KITTI360Pose*": (0.28, 0.49, 0.58),
    "*paper: MambaPlace, KITTI360Pose*": (0.31, 0.53, 0.62),
    "*paper: rule-based, KITTI360Pose*": (0.24, 0.52, 0.66),
    "*paper: transformer, KITTI360Pose*": (0.30, 0.49, 0.57),
    "*paper: rule-based, OSM*": (0.29, 0.50, 0.58),
    "*paper: transformer, OSM*": (0.22, 0.39, 0.48),
}
"""Table II, test set: submap retrieval recall@1/3/5. Other places and texts than ours."""
EXACT = "exact"
MEASURES = (EXACT, *(f"{r:.0f} m" for r in RADII))


def title(protocol: Protocol) -> str:
    heading = Protocol(protocol.statements, protocol.setting).title
    return heading if protocol.anywhere else f"{heading}, near the middle of cells"


def methods(rows: Sequence[Row]) -> list[str]:
    """Methods in the order of the table; networks that were given for it last."""
    return [m for m in dict.fromkeys((*MATCHERS, *(r.method for r in rows)))
            if any(r.method == m for r in rows)]  # fmt: skip


def hits(rows: Sequence[Row], measure: str, rank: int = 1) -> Floats:
    """Whether the rows of one method and city, a seed each, found the answers (S, n)."""
    if measure == EXACT:
        return np.array([[any(a.exact[:rank]) for a in row.answers] for row in rows], np.float64)
    radius = float(measure.removesuffix(" m"))
    near = [[(a.distance[:rank] <= radius).any() for a in row.answers] for row in rows]
    return np.array(near, np.float64)


def by_city(rows: Sequence[Row], method: str) -> list[list[Row]]:
    """Rows of a method, a seed each, by city."""
    cities = dict.fromkeys(r.city for r in rows)
    found = ([r for r in rows if (r.city, r.method) == (city, method)] for city in cities)
    return [mine for mine in found if mine]


COMPARED = (
    (PRINTED, PRINTED_ALONE), (PRINTED, PRINTED_EDITS), (PRINTED, TUNED), (COSINE_DENSE, PRINTED),
    (COSINE_DENSE, DENSE), (LOGIT_DENSE, COSINE_DENSE), (LOGIT, COSINE), (RELATIONAL, PRINTED),
    (RELATIONAL, LOGIT), (FUSED, RELATIONAL),
)  # fmt: skip
"""Matchers whose recall@1 is set off against that of another, chosen before anything was measured."""


def advantage(
    rows: Sequence[Row], first: str, second: str, measure: str, rng: Generator
) -> Interval:
    """Recall@1 of one matcher minus that of another, on the queries that both had."""
    pairs = []
    for ours in by_city(rows, first):
        for theirs in by_city([r for r in rows if r.city == ours[0].city], second):
            n = min(len(ours[0].answers), len(theirs[0].answers))
            both = (hits(mine, measure).mean(axis=0)[:n] for mine in (ours, theirs))
            pairs.append(tuple(both))
    return paired_interval(pairs, rng)


def recalls(rows: Sequence[Row], rng: Generator) -> list[dict[str, Any]]:
    """Recall of the exact cell by protocol and method, with intervals over seeds and queries."""
    return [
        {
            "title": title(protocol),
            "method": method,
            "seeds": len(by_city(mine, method)[0]),
            "recall": {
                k: recall_interval([hits(city, EXACT, k) for city in by_city(mine, method)], rng)
                for k in RANKS
            },
        }
        for protocol, mine in _by_protocol(rows).items()
        for method in methods(mine)
    ]


def advantages(rows: Sequence[Row], rng: Generator) -> list[dict[str, Any]]:
    """By protocol and measure: how far one of `COMPARED` is ahead of the other."""
    return [
        {
            "title": title(protocol),
            "measure": measure,
            "first": first,
            "second": second,
            "difference": advantage(mine, first, second, measure, rng)._asdict(),
        }
        for protocol, mine in _by_protocol(rows).items()
        for first, second in COMPARED
        if {first, second} <= set(methods(mine))
        for measure in (EXACT, "50 m")
    ]


def of_the_slow(rows: Sequence[Row]) -> list[Row]:
    """All matchers on the queries that the slow ones had; none where these had none."""
    had = {(r.city, r.protocol): len(r.answers) for r in rows if r.method in SLOW}
    return [
        of_answers(r.city, r.protocol, r.method, r.answers[: had[r.city, r.protocol]])
        for r in rows
        if (r.city, r.protocol) in had
    ]


def report(
    rows: Sequence[Row], table: Sequence[dict[str, Any]], intervals: Sequence[dict[str, Any]] = ()
) -> str:
    slow = of_the_slow(rows)
    quick = [r for r in rows if r.method not in SLOW]
    parts = [*_glance(quick, paper=True), *_glance(slow, paper=False)]
    if intervals:
        header = ["", "texts", "seeds", *(f"exact cell @{k}, 95 % interval" for k in RANKS)]
        cells = [
            [
                row["method"], row["title"], lab.number(row["seeds"]),
                *(
                    f"{lab.share(r.mean)} ({lab.share(r.low)} to {lab.share(r.high)})"
                    for r in row["recall"].values()
                ),
            ]
            for row in intervals
        ]  # fmt: skip
        parts += ["#### Intervals over seeds and queries", lab.markdown(header, cells)]
    if table:
        lines = []
        for row in table:
            d = row["difference"]
            interval = f"{d['low']:+.3f} to {d['high']:+.3f}"
            who = f"{row['first']} minus {row['second']}"
            lines.append([who, row["title"], row["measure"], f"{d['mean']:+.3f}", interval])
        parts += [
            "#### Differences of recall@1",
            lab.markdown(["", "texts", "hit", "difference", "95 % interval"], lines),
        ]
    for protocol, mine in list(_by_protocol(rows).items())[:1]:
        shown = methods(mine)
        parts += [f"#### {title(protocol)}: mean of the cities, then each", _detail(mine, shown)]
    return "\n\n".join(parts)


def _glance(rows: Sequence[Row], *, paper: bool) -> list[str]:
    """Recall of the mean of the cities by protocol; with the paper's figures or without."""
    grouped, parts = _by_protocol(rows), []
    cities = list(dict.fromkeys(r.city for r in rows))
    asked = sorted({len(r.answers) for r in rows})
    for measure in (EXACT, "50 m") if rows else ():
        lines = [
            [m, *(lab.shares(_mean(mine, m, measure)) for mine in grouped.values())]
            for m in methods(rows)
        ]
        if measure == EXACT and paper:
            empty = ["–"] * (len(grouped) - 1)
            lines += [[name, lab.shares(values), *empty] for name, values in PAPER.items()]
        within = "the exact cell" if measure == EXACT else f"within {measure}"
        of = f"{'/'.join(map(str, asked))} queries a city, mean of {', '.join(cities)}"
        parts += [
            f"#### Recall@1/3/5, {within}, {of}",
            lab.markdown(["", *map(title, grouped)], lines),
        ]
    return parts


def _by_protocol(rows: Sequence[Row]) -> dict[Protocol, list[Row]]:
    grouped: dict[Protocol, list[Row]] = defaultdict(list)
    for row in rows:
        grouped[row.protocol].append(row)
    return grouped


def _mean(rows: Sequence[Row], method: str, measure: str) -> list[float]:
    return mean_recall(rows, method, measure) if method in methods(rows) else [float("nan")] * 3


def _detail(rows: Sequence[Row], methods_: Sequence[str]) -> str:
    header = ["", "queries", *(f"{m} @1/3/5" for m in MEASURES), "median", "p50", "p95"]
    lines = [_line(m, [r for r in rows if r.method == m]) for m in methods_]
    for city in dict.fromkeys(r.city for r in rows):
        mine = [r for r in rows if r.city == city]
        lines += [
            _line(f"{city}: {r.method}", [r]) for m in methods_ for r in mine if r.method == m
        ]
    return lab.markdown(header, lines)


def _line(head: str, rows: Sequence[Row]) -> list[str]:
    scores = [r.score for r in rows if r.score]
    recall = [lab.shares(np.mean([r.recall[m] for r in rows], axis=0).tolist()) for m in MEASURES]

    def mean(values: Sequence[float]) -> float:
        return float(np.mean(values))

    return [
        head,
        lab.number(sum(s.queries for s in scores)),
        *recall,
        lab.number(mean([s.median for s in scores]), 0, "m"),
        lab.number(1e3 * mean([s.p50 for s in scores]), 1, "ms"),
        lab.number(1e3 * mean([s.p95 for s in scores]), 1, "ms"),
    ]


@dataclass(frozen=True)
class MatcherRunner:
    """Which matchers are asked, and how often; answers are written down as they come."""

    methods: Sequence[str]
    queries: int
    slow: int
    slow_cities: Sequence[str]
    seed: int
    journal: lab.Journal
    tick: Callable[[], None]
    networks: Mapping[str, Sequence[Path]] = field(default_factory=dict)
    """Weights of the paper's network by name of the row, a seed each."""

    def query_count(self, name: str, protocol: Protocol, method: str) -> int:
        if method not in SLOW:
            return self.queries
        own = name not in EXTRACTS
        wanted = (own or name in self.slow_cities) and protocol == Protocol(anywhere=True)
        return min(self.slow, self.queries) if wanted else 0

    def rows(
        self, extract: Extract, city: CityMap, path: Path, protocols: Sequence[Protocol]
    ) -> list[Row]:
        """All rows of a city, whose extract or the part of it that is the map lies at `path`."""
        name = extract.name
        bins, code, rows = load(path), lab.code_key(lab.OUTDOOR), []
        for protocol in protocols:
            setting = protocol.setting
            spoken = partial(
                unseen_queries, extract, city, path,
                setting=setting, in_the_middle=not protocol.anywhere,
            )  # fmt: skip
            asked, warming = spoken(n=self.queries, seed=self.seed), spoken(n=3, seed=self.seed + 1)
            runs: list[tuple[str, Path | None]] = [(method, None) for method in self.methods]
            runs += [(method, path) for method, paths in self.networks.items() for path in paths]
            for method, weights in runs:
                n = self.query_count(name, protocol, method)
                key = f"{extract.key}, {title(protocol)}, {method}, {n}, {self.seed}, {code}"
                network = None if weights is None else GraphTransformer.open(weights)
                key += "" if network is None else f", {network.digest}"
                if n and key not in self.journal:
                    found = (
                        matcher(method, city, bins, setting, seed=self.seed) if network is None
                        else RetrieveMatcher(
                            city, {"preset": "paper", "encoded": EncodedCity(city, network)}
                        )
                    )  # fmt: skip
                    ask(found, city, warming)
                    answers = ask(found, city, asked[:n])
                    plain = [(a.distance.tolist(), a.exact, a.seconds) for a in answers]
                    self.journal.put(key, plain)
                if n:
                    answers = [Answer(np.array(d), tuple(e), s) for d, e, s in self.journal[key]]
                    rows.append(of_answers(name, protocol, method, answers))
                self.tick()
        return rows


@lab.table("GOTLoc, Table II")
def outdoor_matchers(
    run: lab.Run,
    cities: Annotated[str, lab.option(f"{CITIES} All shared ones where left out.")] = "",
    settings: Annotated[str, lab.option("Settings with commas.")] = "none",
    methods: Annotated[str, lab.option("Matchers with semicolons; all.")] = "",
    queries: Annotated[int, lab.option("Queries a city and setting.")] = 200,
    slow: Annotated[int, lab.option("Of these, how many for plain edit distance.")] = 100,
    slow_cities: Annotated[
        str,
        lab.option(
            "Shared cities that plain edit distance is asked in, without noise; yours always."
        ),
    ] = "liechtenstein,monaco,toronto",
    seed: lab.Seed = 0,
    *,
    networks: Annotated[
        str,
        lab.option(
            "Further networks as the paper prints it (`city train --printed`): NAME=FILE,FILE with "
            "a file a seed, and semicolons between names."
        ),
    ] = "",
    quick: lab.Quick = False,
) -> None:
    """Recall of the cell by matcher, on graphs from OpenStreetMap."""
    if quick:
        queries, slow = 40, 5
    asked_for = lab.check_names(lab.parts(settings), SETTINGS, "setting")
    chosen = [s for s in SETTINGS if s in asked_for]
    protocols = [Protocol(setting=s, anywhere=True) for s in chosen]
    protocols += [Protocol(setting="none")] if "none" in chosen else []
    shown = lab.check_names(lab.parts(methods, ";"), MATCHERS, "matcher")
    extracts = extracts_of(cities, run.osm)
    pairs = (part.partition("=") for part in lab.parts(networks, ";"))
    given = {name.strip(): [Path(file) for file in lab.parts(files)] for name, _, files in pairs}
    run.one_core()
    rows: list[Row] = []
    cells = {}
    with run.progress() as progress:
        task = progress.add_task(
            "asking",
            total=len(extracts) * len(protocols) * (len(shown) + sum(map(len, given.values()))),
        )
        asking = MatcherRunner(
            shown, queries, slow, lab.parts(slow_cities), seed, run.journal(),
            lambda: progress.advance(task), given,
        )  # fmt: skip
        for extract in extracts:
            city = extract.open(run.cache)
            cells[extract.name] = len(city.cells)
            rows += asking.rows(extract, city, extract.osm(run.cache), protocols)
    lead = advantages(rows, np.random.default_rng(seed))
    found = recalls(rows, np.random.default_rng(seed))
    print(report(rows, lead, found))
    parts = {"rows": [r.to_dict() for r in rows], "differences": lead, "intervals": found}
    run.save({"cells": cells} | parts, complete=not (cities or methods))
