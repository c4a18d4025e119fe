"""Does what people write find its place? 1,023 descriptions from Pittsburgh (RVS).

    placegraph-lab table human_text

The union of all landmarks is the map. Prints a Markdown table, writes JSON. Developed on the
even records only; the odd ones are reported beside them.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import PlacegraphError
from placegraph_lab.tables.outdoor.metrics import HIT, distances
from placegraph_lab.tables.outdoor.places import (
    Baselines,
    Record,
    landmarks,
    read_records,
    write_osm,
)
from placegraph_lab.tables.runner import Quick, Run, markdown, number, option, share, shares, table
from placegraph_lab.tables.statistics import reliability

if TYPE_CHECKING:
    from placegraph.outdoor.city import CityMap

NEAR, WIDE = 100.0, 250.0  # radii of the table [m]
QUOTED = {
    "rarest landmark named": ".23/.37, 930 m",
    "700 m in the stated direction": ".02/.13, 586 m",
    "rarest landmark named, nearest to the start": ".29/.47, 306 m",
    "placegraph": "aim .35/.50",
    "placegraph, start known": "aim .45/.65",
}


@dataclass(frozen=True)
class Guess:
    """One answer; no answer is infinitely far."""

    distance: float  # from the goal [m]
    probability: float | None = None
    status: str = ""
    seconds: float = float("nan")


def guess(place: Floats | None, record: Record) -> Guess:
    return Guess(np.inf if place is None else float(distances(place, *record.goal)[0]))


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
    """Numbers of a row."""
    off = np.array([g.distance for g in guesses])
    row: dict[str, Any] = {
        "records": len(off),
        "within_100_m": round(float((off <= NEAR).mean()), 4),
        "within_250_m": round(float((off <= WIDE).mean()), 4),
        "median_m": round(float(np.median(off)), 1) if np.isfinite(np.median(off)) else None,
    }
    if all(g.probability is not None for g in guesses):
        bins = reliability([g.probability or 0.0 for g in guesses], off <= HIT)
        states = sorted({g.status for g in guesses})
        seconds = [g.seconds for g in guesses]
        row |= {
            "calibration_error": round(bins.error, 4),
            "calibration_error_of_perfect": round(bins.floor, 4),
            "status": {s: round(np.mean([g.status == s for g in guesses]), 4) for s in states},
            "right_within_250_m": {
                s: round(float((off[[g.status == s for g in guesses]] <= WIDE).mean()), 4)
                for s in states
            },
            "p50_ms": round(1e3 * float(np.percentile(seconds, 50)), 2),
            "p95_ms": round(1e3 * float(np.percentile(seconds, 95)), 2),
        }
    return row


def cells(row: dict[str, Any]) -> str:
    median = number(row["median_m"], 0, "m") if row["median_m"] is not None else "∞"
    return f"{shares([row['within_100_m'], row['within_250_m']])}, {median}"


@table()
def human_text(
    run: Run,
    *,
    baselines: Annotated[bool, option("Leave the map out.")] = False,
    quick: Quick = False,
) -> None:
    """Does what people write find its place? 1,023 descriptions from Pittsburgh (RVS)."""
    told = read_records(run.data / "text/rvs_pittsburgh.jsonl")[: 50 if quick else None]
    places = landmarks(told)
    simple = Baselines(places)
    answers: dict[str, list[Guess]] = {
        "rarest landmark named": [guess(simple.rarest(r), r) for r in told],
        "700 m in the stated direction": [guess(simple.walk(r), r) for r in told],
        "rarest landmark named, nearest to the start": [
            guess(simple.rarest_near(r), r) for r in told
        ],
    }
    if not baselines:
        import placegraph as pg

        run.cache.mkdir(parents=True, exist_ok=True)
        write_osm(places, run.cache / "pittsburgh.osm")
        pg.build_city(run.cache / "pittsburgh.osm", run.cache / "pittsburgh.city")
        city: CityMap = pg.CityMap.open(run.cache / "pittsburgh.city")
        run.one_core()
        for record in told[:10]:  # warm
            ask(city, record, record.start)
        for name, start in (("placegraph", False), ("placegraph, start known", True)):
            answers[name] = [
                ask(city, r, r.start if start else None) for r in run.track(told, name)
            ]
    rows = {
        name: {"all": summary(g), "even": summary(g[::2]), "odd": summary(g[1::2])}
        for name, g in answers.items()
    }
    header = ["within 100 m/250 m, median", "all", "even (developed on)", "odd", "as quoted"]
    header += ["calibration error", "OK", "p50", "p95"]
    print(markdown(header, [line(name, row) for name, row in rows.items()]))
    run.save({"landmarks": len(places), "rows": rows})


def line(name: str, row: dict[str, Any]) -> list[str]:
    whole = row["all"]
    return [
        name,
        *(cells(row[part]) for part in ("all", "even", "odd")),
        QUOTED[name],
        share(whole.get("calibration_error")),
        share(whole["status"].get("OK", 0.0)) if "status" in whole else "–",
        number(whole.get("p50_ms"), 1, "ms"),
        number(whole.get("p95_ms"), 1, "ms"),
    ]
