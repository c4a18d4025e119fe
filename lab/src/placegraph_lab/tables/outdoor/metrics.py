"""What an outdoor answer is worth: recall, distance, calibration, status and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from placegraph.core.estimate import CityEstimate
from placegraph.core.geometry import Floats, LocalPlane
from placegraph.errors import OptionError
from placegraph_lab.tables.statistics import Reliability, reliability

RANKS = (1, 3, 5)
RADII = (25.0, 50.0)
"""A place within this distance of the truth is a hit [m]."""
HIT = 50.0
"""What a place's probability speaks of: the truth lies within this distance of it [m]."""


@dataclass(frozen=True)
class Answer:
    """Ranked places for one query, measured against the truth."""

    distance: Floats
    """(K,) from the truth [m], best place first."""
    exact: tuple[bool, ...]
    """(K,) whether the place lies in the truth's cell of the queries' grid."""
    seconds: float
    """Wall time, reading the text included."""
    status: str = ""
    """Name of the estimate's status; empty for a method that has none."""
    probability: float | None = None
    """Of the best place; None for a method that gives none."""
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
    exact: dict[int, float]
    """Recall of the exact cell of the queries' grid by rank."""
    within: dict[float, dict[int, float]]
    """Recall by radius [m] and rank."""
    median: float
    """Median distance of the best place [m]; infinite where most answers have none."""
    calibration: Reliability | None
    """Of the best place's probability to lie within 50 m of the truth."""
    status: dict[str, float] = field(default_factory=dict)
    """Share of every status."""
    right: dict[str, float] = field(default_factory=dict)
    """Share of a status's best places that lie within 50 m of the truth."""
    own_cell: dict[int, float] = field(default_factory=dict)
    """Recall of the map's own cell by rank; its grid need not be that of the queries."""
    p50: float = float("nan")
    p95: float = float("nan")
    """Median and 95th percentile of the time for a query [s]."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, ready for `json.dumps`; infinity and nan become None."""
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
    """Summarize answers; one without any place misses at every rank.

    Raises
    ------
    OptionError
        Where there are no answers.
    """
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
