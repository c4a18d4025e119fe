"""Does what people write find its place? 1,023 descriptions from Pittsburgh (RVS).

The union of all landmarks is the map. Developed on the
even records only; the odd ones are reported beside them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import PlacegraphError
from placegraph.outdoor.city import CityMap, build_city
from placegraph_lab.tables.outdoor.metrics import HIT, distances
from placegraph_lab.tables.outdoor.places import (
    Baselines,
    Record,
    landmarks,
    read_records,
    write_osm,
)
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, number, option, render, share, shares, table
from placegraph_lab.tables.statistics import reliability

NEAR, WIDE = 100.0, 250.0  # radii of the table [m]


@dataclass(frozen=True)
class Guess:
    """One answer; no answer is infinitely far."""

    distance: float  # from the goal [m]
    probability: float | None = None
    status: str = ""
    seconds: float = float("nan")


def ask(city: CityMap, record: Record, listener: tuple[float, float] | None) -> Guess:
    """Give a text, and where "you" stand, to the map."""
    start = time.perf_counter()
    try:
        estimate = city.locate(record.text, listener=listener)
    except PlacegraphError as error:
        return Guess(np.inf, 0.0, type(error).__name__, time.perf_counter() - start)
    seconds = time.perf_counter() - start
    best = estimate.best
    if best is None:
        return Guess(np.inf, 0.0, estimate.status.name, seconds)
    place = np.array([best.longitude, best.latitude])
    return Guess(
        float(distances(place, *record.goal)[0]), best.probability, estimate.status.name, seconds
    )


def summary(guesses: Sequence[Guess]) -> dict[str, Any]:
    """Numbers of a row; calibration, statuses and times only where every guess has a probability."""
    off = np.array([g.distance for g in guesses])
    row: dict[str, Any] = {
        "records": len(off),
        "within": [float((off <= radius).mean()) for radius in (NEAR, WIDE)],
        "median_m": float(np.median(off)),
    }
    if any(g.probability is None for g in guesses):
        return row
    bins = reliability([g.probability or 0.0 for g in guesses], off <= HIT)
    statuses = np.array([g.status for g in guesses])
    p50, p95 = np.percentile([1e3 * g.seconds for g in guesses], (50, 95))
    kinds = np.unique(statuses).tolist()
    return row | {
        "calibration_error": bins.error,
        "calibration_error_of_perfect": bins.floor,
        "status": {s: float((statuses == s).mean()) for s in kinds},
        "right_within_250_m": {s: float((off[statuses == s] <= WIDE).mean()) for s in kinds},
        "p50_ms": float(p50),
        "p95_ms": float(p95),
    }


def _places(row: dict[str, Any]) -> str:
    return f"{shares(row['within'])}, {number(row['median_m'], 0, 'm').replace('∞ m', '∞')}"


COLUMNS = (
    Col("within 100 m/250 m, median", "name"), Col("all", "all", _places),
    Col("even (developed on)", "even", _places), Col("odd", "odd", _places),
    Col("calibration error", "all.calibration_error", share),
    Col("OK", lambda r: r["all"]["status"].get("OK", 0.0) if "status" in r["all"] else None, share),
    Col("p50", "all.p50_ms", 1, "ms"), Col("p95", "all.p95_ms", 1, "ms"),
)  # fmt: skip


@table()
def human_text(
    run: Run,
    *,
    baselines: Annotated[bool, option("Leave the map out.")] = False,
    quick: Quick = False,
) -> None:
    """Recall of 1,023 descriptions that people wrote in Pittsburgh (RVS)."""
    records = read_records(run.data / "text/rvs_pittsburgh.jsonl")[: 50 if quick else None]
    places = landmarks(records)
    simple = Baselines(places)
    rules: dict[str, Callable[[Record], Floats | None]] = {
        "rarest landmark named": simple.rarest,
        "700 m in the stated direction": simple.walk,
        "rarest landmark named, nearest to the start": simple.rarest_near,
    }
    answers = {
        name: [
            Guess(np.inf if (at := rule(r)) is None else float(distances(at, *r.goal)[0]))
            for r in records
        ]
        for name, rule in rules.items()
    }
    if not baselines:
        run.cache.mkdir(parents=True, exist_ok=True)
        write_osm(places, run.cache / "pittsburgh.osm")
        city = build_city(run.cache / "pittsburgh.osm", run.cache / "pittsburgh.city")
        run.one_core()
        for record in records[:10]:  # warm
            ask(city, record, record.start)
        for name, start in (("placegraph", False), ("placegraph, start known", True)):
            answers[name] = [
                ask(city, r, r.start if start else None) for r in run.track(records, name)
            ]
    rows = [
        {"name": name, "all": summary(g), "even": summary(g[::2]), "odd": summary(g[1::2])}
        for name, g in answers.items()
    ]
    print(render(COLUMNS, rows))
    run.save({"landmarks": len(places), "rows": rows})
