"""Tables of the matchers (Table II), with the paper's figures and with paired intervals."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.random import Generator

from placegraph_lab.tables.outdoor.matchers import (
    COSINE,
    DENSE,
    FUSED,
    LOGIT,
    LOGIT_DENSE,
    MATCHERS,
    PAPER_EDITS,
    PAPER_TRANSFORMER,
    RELATIONAL,
    SLOW,
)
from placegraph_lab.tables.outdoor.metrics import RADII
from placegraph_lab.tables.outdoor.report import Protocol, Row, mean_recall, of_answers
from placegraph_lab.tables.runner import markdown, number, shares
from placegraph_lab.tables.statistics import Interval, paired_interval

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
    """Heading of a protocol: viewpoints lie anywhere but where that is said."""
    heading = Protocol(protocol.statements, protocol.setting).title
    return heading if protocol.anywhere else f"{heading}, near the middle of cells"


def methods(rows: Sequence[Row]) -> list[str]:
    """Matchers that were measured, in the order of the table."""
    return [m for m in MATCHERS if any(r.method == m for r in rows)]


def hits(row: Row, measure: str) -> list[bool]:
    """Whether the best place is right, query by query."""
    if measure == EXACT:
        return [any(a.exact[:1]) for a in row.answers]
    radius = float(measure.removesuffix(" m"))
    return [bool((a.distance[:1] <= radius).any()) for a in row.answers]


COMPARED = (
    (PAPER_TRANSFORMER, DENSE),
    (LOGIT_DENSE, PAPER_TRANSFORMER),
    (PAPER_TRANSFORMER, PAPER_EDITS),
    (LOGIT, COSINE),
    (RELATIONAL, PAPER_TRANSFORMER),
    (RELATIONAL, LOGIT),
    (FUSED, RELATIONAL),
)
"""Matchers whose recall@1 is set off against that of another, chosen before anything was measured."""


def advantage(
    rows: Sequence[Row], first: str, second: str, measure: str, rng: Generator
) -> Interval:
    """Recall@1 of one matcher minus that of another, on the queries that both had."""
    pairs = []
    for city in dict.fromkeys(r.city for r in rows):
        found = {r.method: hits(r, measure) for r in rows if r.city == city}
        if first in found and second in found:
            n = min(len(found[first]), len(found[second]))
            pairs.append((found[first][:n], found[second][:n]))
    return paired_interval(pairs, rng)


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


def report(rows: Sequence[Row], table: Sequence[dict[str, Any]]) -> str:
    """Markdown: every setting at a glance, the slow matchers' queries, differences, each city."""
    slow = of_the_slow(rows)
    quick = [r for r in rows if r.method not in SLOW]
    parts = [*_glance(quick, paper=True), *_glance(slow, paper=False)]
    if table:
        parts += ["#### Differences of recall@1", _lead(table)]
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
            [m, *(shares(_mean(mine, m, measure)) for mine in grouped.values())]
            for m in methods(rows)
        ]
        if measure == EXACT and paper:
            empty = ["–"] * (len(grouped) - 1)
            lines += [[name, shares(values), *empty] for name, values in PAPER.items()]
        within = "the exact cell" if measure == EXACT else f"within {measure}"
        of = f"{'/'.join(map(str, asked))} queries a city, mean of {', '.join(cities)}"
        parts += [f"#### Recall@1/3/5, {within}, {of}", markdown(["", *map(title, grouped)], lines)]
    return parts


def _by_protocol(rows: Sequence[Row]) -> dict[Protocol, list[Row]]:
    grouped: dict[Protocol, list[Row]] = defaultdict(list)
    for row in rows:
        grouped[row.protocol].append(row)
    return grouped


def _mean(rows: Sequence[Row], method: str, measure: str) -> list[float]:
    return mean_recall(rows, method, measure) if method in methods(rows) else [float("nan")] * 3


def _lead(table: Sequence[dict[str, Any]]) -> str:
    lines = []
    for row in table:
        d = row["difference"]
        interval = f"{d['low']:+.3f} to {d['high']:+.3f}"
        who = f"{row['first']} minus {row['second']}"
        lines.append([who, row["title"], row["measure"], f"{d['mean']:+.3f}", interval])
    return markdown(["", "texts", "hit", "difference", "95 % interval"], lines)


def _detail(rows: Sequence[Row], shown: Sequence[str]) -> str:
    header = ["", "queries", *(f"{m} @1/3/5" for m in MEASURES), "median", "p50", "p95"]
    lines = [_line(m, [r for r in rows if r.method == m]) for m in shown]
    for city in dict.fromkeys(r.city for r in rows):
        mine = [r for r in rows if r.city == city]
        lines += [_line(f"{city}: {r.method}", [r]) for m in shown for r in mine if r.method == m]
    return markdown(header, lines)


def _line(head: str, rows: Sequence[Row]) -> list[str]:
    scores = [r.score for r in rows if r.score]
    recall = [shares(np.mean([r.recall[m] for r in rows], axis=0).tolist()) for m in MEASURES]

    def mean(values: Sequence[float]) -> float:
        return float(np.mean(values))

    return [
        head,
        number(sum(s.queries for s in scores)),
        *recall,
        number(mean([s.median for s in scores]), 0, "m"),
        number(1e3 * mean([s.p50 for s in scores]), 1, "ms"),
        number(1e3 * mean([s.p95 for s in scores]), 1, "ms"),
    ]
