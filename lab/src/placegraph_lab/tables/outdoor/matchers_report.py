"""Tables of the matchers (Table II), with the paper's figures and with paired intervals."""

from __future__ import annotations

from collections import defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph_lab.tables.bootstrap import Interval, paired_interval
from placegraph_lab.tables.outdoor.matchers import FUSED, MATCHERS
from placegraph_lab.tables.outdoor.metrics import RADII
from placegraph_lab.tables.outdoor.report import Protocol, mean_recall
from placegraph_lab.tables.tables import markdown, number, share, shares

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator

    from placegraph_lab.tables.outdoor.report import Row

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


def best_single(rows: Sequence[Row], measure: str) -> str:
    """Single matcher with the highest recall@1, mean of the cities."""
    single = [m for m in methods(rows) if m != FUSED]
    return max(single, key=lambda m: mean_recall(rows, m, measure)[0])


def advantage(rows: Sequence[Row], other: str, measure: str, rng: Generator) -> Interval:
    """Recall@1 of both fused minus that of another matcher, on the queries that both had."""
    pairs = []
    for city in dict.fromkeys(r.city for r in rows):
        found = {r.method: hits(r, measure) for r in rows if r.city == city}
        if FUSED in found and other in found:
            n = min(len(found[FUSED]), len(found[other]))
            pairs.append((found[FUSED][:n], found[other][:n]))
    return paired_interval(pairs, rng)


def advantages(rows: Sequence[Row], rng: Generator) -> list[dict[str, Any]]:
    """By protocol and measure: the best single matcher, and how far both fused are ahead of it."""
    table = []
    for protocol, mine in _by_protocol(rows).items():
        for measure in MEASURES:
            if FUSED not in methods(mine) or len(methods(mine)) < 2:
                continue
            other = best_single(mine, measure)
            table.append(
                {
                    "title": title(protocol),
                    "measure": measure,
                    "fused": mean_recall(mine, FUSED, measure)[0],
                    "best_single": other,
                    "single": mean_recall(mine, other, measure)[0],
                    "difference": advantage(mine, other, measure, rng)._asdict(),
                }
            )
    return table


def report(rows: Sequence[Row], table: Sequence[dict[str, Any]]) -> str:
    """Markdown: every setting at a glance, the lead of both fused, and what each city gives."""
    grouped = _by_protocol(rows)
    shown = methods(rows)
    parts = []
    for measure in (EXACT, "50 m"):
        lines = [
            [m, *(shares(_mean(mine, m, measure)) for mine in grouped.values())] for m in shown
        ]
        if measure == EXACT:
            empty = ["–"] * (len(grouped) - 1)
            lines += [[name, shares(values), *empty] for name, values in PAPER.items()]
        within = "the exact cell" if measure == EXACT else f"within {measure}"
        parts += [
            f"#### Recall@1/3/5, {within}, mean of the cities",
            markdown(["", *map(title, grouped)], lines),
        ]
    if table:
        parts += ["#### Recall@1 of both fused, and of the best single matcher", _lead(table)]
    for protocol, mine in list(grouped.items())[:1]:
        parts += [f"#### {title(protocol)}: mean of the cities, then each", _detail(mine, shown)]
    return "\n\n".join(parts)


def _by_protocol(rows: Sequence[Row]) -> dict[Protocol, list[Row]]:
    grouped: dict[Protocol, list[Row]] = defaultdict(list)
    for row in rows:
        grouped[row.protocol].append(row)
    return grouped


def _mean(rows: Sequence[Row], method: str, measure: str) -> list[float]:
    return mean_recall(rows, method, measure) if method in methods(rows) else [float("nan")] * 3


def _lead(table: Sequence[dict[str, Any]]) -> str:
    header = ["", "hit", "fused", "best single", "matcher", "difference", "95 % interval"]
    lines = []
    for row in table:
        d = row["difference"]
        interval = f"{d['low']:+.3f} to {d['high']:+.3f}"
        figures = [share(row["fused"]), share(row["single"]), row["best_single"]]
        lines.append([row["title"], row["measure"], *figures, f"{d['mean']:+.3f}", interval])
    return markdown(header, lines)


def _detail(rows: Sequence[Row], shown: Sequence[str]) -> str:
    header = ["", "queries", *(f"{m} @1/3/5" for m in MEASURES), "median", "p50", "p95"]
    lines = [_line(m, [r for r in rows if r.method == m]) for m in shown]
    for city in dict.fromkeys(r.city for r in rows):
        lines += [
            _line(f"{city}: {m}", [r for r in rows if (r.city, r.method) == (city, m)])
            for m in shown
        ]
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
