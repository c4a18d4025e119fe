"""Rows and tables of the outdoor benchmark."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph_lab.tables.outdoor.metrics import HIT, RADII, RANKS, Answer, Score, score
from placegraph_lab.tables.runner import markdown, number, share, shares
from placegraph_lab.tables.statistics import reliability

if TYPE_CHECKING:
    from placegraph_lab.tables.outdoor.nearby import Position
    from placegraph_lab.tables.outdoor.queries import Setting

OURS, BAG, TUNED = "placegraph", "triple bag", "triple bag, tuned"
CEILING, ORACLE = "ceiling", "oracle"
BAGS = {"label bag": (50.0, 50.0), BAG: (50.0, 50.0), TUNED: (30.0, 25.0)}
"""How near to a cell's centre its objects are, and how far apart those of a triple [m]: as in the
published generator, and as fits the texts best."""


@dataclass(frozen=True)
class Protocol:
    """How the queries of a table are made; see `make_queries`."""

    statements: int = 6
    setting: Setting = "none"
    position: Position = "nearest"
    same_label: bool = False
    anywhere: bool = False

    @property
    def title(self) -> str:
        """Heading of its table."""
        noise = {
            "none": "no noise",
            "replaced": "20 % of relations replaced",
            "absent": "20 % about things that are not there",
            "synonyms": "everyday words",
            "names": "names kept",
            "speaker": "about the speaker",
        }[self.setting]
        more = [
            "things stand at their centroids" if self.position == "centroid" else "",
            "also pairs of one kind" if self.same_label else "",
            "viewpoints anywhere" if self.anywhere else "",
        ]
        return ", ".join([f"{self.statements} statements", noise, *filter(None, more)])

    @property
    def group(self) -> tuple[object, ...]:
        """Queries of one group share their look at the city (`Contest`)."""
        setting = self.setting if self.setting in ("names", "speaker") else ""
        return self.position, self.same_label, setting


@dataclass(frozen=True)
class Row:
    """One method on one city's queries."""

    city: str
    protocol: Protocol
    method: str
    recall: dict[str, list[float]]
    """Recall@1/3/5 by "exact", "25 m", "50 m"."""
    score: Score | None
    """None for the ceiling."""
    answers: tuple[Answer, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`."""
        row = {"city": self.city, "method": self.method, "title": self.protocol.title}
        row |= {"protocol": asdict(self.protocol), "recall": self.recall}  # type: ignore[dict-item]
        return row | (self.score.to_dict() if self.score else {})


def of_answers(city: str, protocol: Protocol, method: str, answers: Sequence[Answer]) -> Row:
    """Row of a method that ranks places."""
    s = score(answers)
    recall = {"exact": [s.exact[k] for k in RANKS]}
    recall |= {f"{r:.0f} m": [s.within[r][k] for k in RANKS] for r in RADII}
    return Row(city, protocol, method, recall, s, tuple(answers))


HEADER = ["", "exact @1/3/5", "25 m @1/3/5", "50 m @1/3/5", "median", "calibration error"]
HEADER += ["OK", "OK right", "p50", "p95"]


def line(head: str, rows: Sequence[Row]) -> list[str]:
    """Cells of one method, averaged over rows (cities)."""
    cells = [head]
    for name in ("exact", *(f"{r:.0f} m" for r in RADII)):
        found = [r.recall[name] for r in rows if name in r.recall]
        cells += [shares(np.mean(found, axis=0))] if found else ["–"]
    scores = [r.score for r in rows if r.score]
    if not scores:
        return cells + ["–"] * (len(HEADER) - len(cells))
    median = float(np.mean([s.median for s in scores]))
    cells.append(number(median, 0, "m"))
    errors = [s.calibration.error for s in scores if s.calibration]
    cells.append(share(float(np.mean(errors))) if errors else "–")
    ok = [s.status.get("OK", 0.0) for s in scores]
    right = [s.right["OK"] for s in scores if "OK" in s.right]
    cells.append(share(float(np.mean(ok))) if any(s.status for s in scores) else "–")
    cells.append(share(float(np.mean(right))) if right else "–")
    cells += [number(1e3 * float(np.mean([s.p50 for s in scores])), 1, "ms")]
    cells += [number(1e3 * float(np.mean([s.p95 for s in scores])), 1, "ms")]
    return cells


def methods(rows: Sequence[Row]) -> list[str]:
    """Methods in the order of the issue's table."""
    return [m for m in (*BAGS, OURS, CEILING, ORACLE) if any(r.method == m for r in rows)]


def mean_recall(rows: Sequence[Row], method: str, name: str) -> list[float]:
    """Recall@1/3/5 of a method, averaged over cities."""
    found = np.array([r.recall[name] for r in rows if r.method == method])
    return [float(x) for x in found.mean(axis=0)]


def report(rows: Sequence[Row], cities: Sequence[str]) -> str:
    """Tables of a split: the mean of its cities by protocol, then every city at 6 statements."""
    by_protocol: dict[Protocol, list[Row]] = defaultdict(list)
    for row in rows:
        by_protocol[row.protocol].append(row)
    shown = methods(rows)
    overview = [
        [p.title, *(shares(mean_recall(mine, m, "50 m")) for m in shown)]
        for p, mine in by_protocol.items()
    ]
    parts = [
        f"#### Recall @1/3/5 within 50 m, mean of {', '.join(cities)}",
        markdown(["", *shown], overview),
    ]
    for p in (Protocol(), Protocol(setting="replaced")):
        mine = by_protocol.get(p, [])
        if not mine:
            continue
        lines = [line(m, [r for r in mine if r.method == m]) for m in shown]
        for city in cities if len(cities) > 1 else ():
            lines += [line(f"{city}: {r.method}", [r]) for r in mine if r.city == city]
        parts += [f"#### {p.title}: mean of the cities, then each", markdown(HEADER, lines)]
    parts += aims(by_protocol)
    return "\n\n".join(parts)


def aims(by_protocol: dict[Protocol, list[Row]]) -> list[str]:
    """Tables of the aims beside what was reached."""
    header = ["names removed, 6 statements", "to triple bag, @1 50 m", "to the tuned bag"]
    header += [
        "oracle to triple bag",
        "@5 50 m",
        "ceiling @5",
        "oracle @5",
        "calibration error",
        "pooled",
        "of perfect",
        "p50",
        "p95",
    ]
    lines = [["aim", "1.5", "", "", ".95", "", "", ".05", "", "", "5 ms", "20 ms"]]
    for p, rows in by_protocol.items():
        ours = [r for r in rows if r.method == OURS]
        if not ours or p.statements != 6 or p.setting == "names":
            continue
        reached = {m: mean_recall(rows, m, "50 m") for m in methods(rows)}

        bins = reliability(
            [a.probability or 0.0 for r in ours for a in r.answers],
            [len(a.distance) > 0 and a.distance[0] <= HIT for r in ours for a in r.answers],
        )
        mine = line("", ours)
        lines.append(
            [
                p.title,
                number(reached[OURS][0] / reached[BAG][0], 2),
                number(reached[OURS][0] / reached[TUNED][0], 2),
                number(reached[ORACLE][0] / reached[BAG][0], 2),
                share(reached[OURS][2]),
                share(reached[CEILING][2]),
                share(reached[ORACLE][2]),
                mine[5],
                share(bins.error),
                share(bins.floor),
                mine[8],
                mine[9],
            ]
        )
    return ["#### Aims", markdown(header, lines)] if len(lines) > 1 else []
