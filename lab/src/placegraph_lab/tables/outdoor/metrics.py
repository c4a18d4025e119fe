"""Measures of outdoor answers: recall, distance, calibration, status and time."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.estimate import CityEstimate
from placegraph.core.geometry import Floats, LocalPlane
from placegraph.errors import OptionError
from placegraph_lab.tables.runner import markdown, number, share, shares
from placegraph_lab.tables.statistics import Reliability, reliability

if TYPE_CHECKING:
    from placegraph_lab.tables.outdoor.queries import Setting

RANKS = (1, 3, 5)
RADII = (25.0, 50.0)  # A place within this distance of the truth is a hit [m]
HIT = 50.0  # what a place's probability speaks of: the truth lies within this distance of it [m]


@dataclass(frozen=True)
class Answer:
    """Ranked places for one query, measured against the truth."""

    distance: Floats  # (K,) from the truth [m], best place first
    exact: tuple[bool, ...]  # (K,) whether the place lies in the truth's cell of the queries' grid
    seconds: float  # wall time, reading the text included
    status: str = ""  # name of the estimate's status; empty for a method that has none
    probability: float | None = None  # of the best place; None for a method that gives none
    own_cell: tuple[bool, ...] | None = None
    """(K,) whether the map's own cell of the place is the truth's; None where there is no map."""


def distances(lonlat: Floats, longitude: float, latitude: float) -> Floats:
    """Distances (K,) [m] of positions (K, 2) [deg] from one."""
    here = LocalPlane(longitude, latitude)
    return np.asarray(np.hypot(*here.to_plane(np.reshape(lonlat, (-1, 2))).T))


def measure(
    estimate: CityEstimate,
    longitude: float,
    latitude: float,
    *,
    seconds: float,
    exact: Sequence[bool] = (),
    cell: str | None = None,
) -> Answer:
    """Measure an estimate against the true position [deg].

    `exact` says of every mode whether it lies in the truth's cell of the queries' grid, `cell` is
    the map's own cell at the truth.
    """
    return Answer(
        distance=distances(positions(estimate), longitude, latitude),
        exact=tuple(exact),
        seconds=seconds,
        status=estimate.status.name,
        probability=estimate.best.probability if estimate.best else 0.0,
        own_cell=tuple(cell is not None and m.cell == cell for m in estimate.modes),
    )


def positions(estimate: CityEstimate) -> Floats:
    """Longitude and latitude (K, 2) [deg] of the modes, best first."""
    places = [(m.longitude, m.latitude) for m in estimate.modes]
    return np.array(places, np.float64).reshape(-1, 2)


@dataclass(frozen=True)
class Score:
    """Row of a table."""

    queries: int
    exact: dict[int, float]  # recall of the exact cell of the queries' grid by rank
    within: dict[float, dict[int, float]]  # recall by radius [m] and rank
    median: float  # median distance of the best place [m]; infinite where most answers have none
    calibration: (
        Reliability | None
    )  # of the best place's probability to lie within 50 m of the truth
    status: dict[str, float] = field(default_factory=dict)  # share of every status
    right: dict[str, float] = field(default_factory=dict)
    """Share of a status's best places that lie within 50 m of the truth."""
    own_cell: dict[int, float] = field(default_factory=dict)
    """Recall of the map's own cell by rank; its grid need not be that of the queries."""
    p50: float = float("nan")
    p95: float = float("nan")  # median and 95th percentile of the time for a query [s]

    def to_dict(self) -> dict[str, Any]:
        bins = self.calibration
        return {
            "queries": self.queries,
            "exact": {str(k): round(v, 4) for k, v in self.exact.items()},
            "own_cell": {str(k): round(v, 4) for k, v in self.own_cell.items()},
            "within": {
                f"{r:.0f} m": {str(k): round(v, 4) for k, v in by_rank.items()}
                for r, by_rank in self.within.items()
            },
            "median_m": _finite(self.median, 1),
            "calibration_error": bins and round(bins.error, 4),
            "calibration_error_of_perfect": bins and round(bins.floor, 4),
            "reliability": bins
            and {
                "count": bins.count.tolist(),
                "confidence": bins.confidence.round(4).tolist(),
                "accuracy": bins.accuracy.round(4).tolist(),
            },
            "status": {k: round(v, 4) for k, v in self.status.items()},
            "right": {k: round(v, 4) for k, v in self.right.items()},
            "p50_ms": _finite(1e3 * self.p50, 3),
            "p95_ms": _finite(1e3 * self.p95, 3),
        }


def score(answers: Sequence[Answer]) -> Score:
    """Summarize answers; one without any place misses at every rank."""
    if not answers:
        raise OptionError("There are no answers to score.")
    n = len(answers)
    best = np.array([a.distance[0] if len(a.distance) else np.inf for a in answers])
    statuses = [a.status for a in answers]
    sure = [a.probability for a in answers if a.probability is not None]
    seconds = [a.seconds for a in answers]
    return Score(
        queries=n,
        exact={k: sum(any(a.exact[:k]) for a in answers) / n for k in RANKS},
        within={
            r: {k: sum(bool((a.distance[:k] <= r).any()) for a in answers) / n for k in RANKS}
            for r in RADII
        },
        median=float(np.median(best)),
        calibration=reliability(sure, best <= HIT) if len(sure) == n else None,
        status={s: statuses.count(s) / n for s in sorted(set(statuses)) if s},
        right={
            s: float((best[np.array(statuses) == s] <= HIT).mean())
            for s in sorted(set(statuses))
            if s
        },
        own_cell={
            k: sum(any((a.own_cell or ())[:k]) for a in answers) / n
            for k in RANKS
            if any(a.own_cell is not None for a in answers)
        },
        p50=float(np.percentile(seconds, 50)),
        p95=float(np.percentile(seconds, 95)),
    )


def _finite(value: float, digits: int) -> float | None:
    return round(value, digits) if np.isfinite(value) else None


OURS, BAG, TUNED = "placegraph", "triple bag", "triple bag, tuned"
CEILING, ORACLE = "ceiling", "oracle"
BAGS = {"label bag": (50.0, 50.0), BAG: (50.0, 50.0), TUNED: (30.0, 25.0)}
"""Distance of objects from a cell's centre, and of the two objects of a triple [m]: as in the published
generator, and as fits the texts best."""


@dataclass(frozen=True)
class Protocol:
    """Protocol of the queries of a table; see `make_queries`."""

    statements: int = 6
    setting: Setting = "none"
    anywhere: bool = False

    @property
    def title(self) -> str:
        noise = {
            "none": "no noise",
            "replaced": "20 % of relations replaced",
            "absent": "20 % about things that are not there",
            "synonyms": "everyday words",
            "names": "names kept",
            "speaker": "about the speaker",
        }[self.setting]
        return f"{self.statements} statements, {noise}" + ", viewpoints anywhere" * self.anywhere

    @property
    def group(self) -> str:
        """Queries of one group share their look at the city (`Contest`)."""
        return self.setting if self.setting in ("names", "speaker") else ""


@dataclass(frozen=True)
class Row:
    """One method on one city's queries."""

    city: str
    protocol: Protocol
    method: str
    recall: dict[str, list[float]]  # recall@1/3/5 by "exact", "25 m", "50 m"
    score: Score | None  # none for the ceiling
    answers: tuple[Answer, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        row = {"city": self.city, "method": self.method, "title": self.protocol.title}
        row |= {"protocol": asdict(self.protocol), "recall": self.recall}  # type: ignore[dict-item]
        return row | (self.score.to_dict() if self.score else {})


def of_answers(city: str, protocol: Protocol, method: str, answers: Sequence[Answer]) -> Row:
    s = score(answers)
    recall = {"exact": [s.exact[k] for k in RANKS]}
    recall |= {f"{r:.0f} m": [s.within[r][k] for k in RANKS] for r in RADII}
    return Row(city, protocol, method, recall, s, tuple(answers))


HEADER = ["", "exact @1/3/5", "25 m @1/3/5", "50 m @1/3/5", "median", "calibration error"]
HEADER += ["OK", "OK right", "p50", "p95"]


def line(head: str, rows: Sequence[Row]) -> list[str]:
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
    return [m for m in (*BAGS, OURS, CEILING, ORACLE) if any(r.method == m for r in rows)]


def mean_recall(rows: Sequence[Row], method: str, name: str) -> list[float]:
    found = np.array([r.recall[name] for r in rows if r.method == method])
    return [float(x) for x in found.mean(axis=0)]


def report(rows: Sequence[Row], cities: Sequence[str]) -> str:
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
    return "\n\n".join(parts)
