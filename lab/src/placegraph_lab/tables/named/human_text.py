"""Does what people write find its place? Meeting places (RVS), notes of a city, and walks.

The union of all landmarks is the map of Pittsburgh; all other texts are asked of real maps. Texts about
Pittsburgh were developed on the even records, all others on the odd ones (the first, the third, ...).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import PlacegraphError
from placegraph.outdoor.city import CityMap, build_city
from placegraph.outdoor.map.objects import LINE
from placegraph_lab.tables.outdoor.metrics import HIT, distances
from placegraph_lab.tables.outdoor.places import (
    Baselines,
    Note,
    Record,
    landmarks,
    plain,
    read_notes,
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


def ask(city: CityMap, record: Record | Note, listener: tuple[float, float] | None) -> Guess:
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


SETS = {
    "fountains, notes": ("vancouver_2015", "vancouver_places", "fountain", False),
    "fountains, sentences": ("vancouver_2015", "vancouver_places", "fountain", True),
    "works of art, notes": ("vancouver_2015", "vancouver_places", "art", False),
    "works of art, sentences": ("vancouver_2015", "vancouver_places", "art", True),
    "meeting places, Manhattan": ("manhattan_2025", "rvs_manhattan", "", False),
    "meeting places, lower Manhattan": ("lower_manhattan_2024", "rvs_lower_manhattan", "", False),
}
"""Map, file, kind and form of the texts that are asked of real maps."""
ON_MAPS = (
    Col("within 100 m/250 m", "name"), Col("even texts", "even.records"),
    Col("rarest name", "rarest.within", shares), Col("nearest crossing", "crossing.within", shares),
    Col("odd (developed on)", "odd.within", shares), Col("even", "even.within", shares),
    Col("even, `OK`", lambda r: r["even"]["status"].get("OK", 0.0), share),
    Col("of these > 250 m", lambda r: 1.0 - r["even"]["right_within_250_m"].get("OK", 1.0), share),
    Col("p50", "even.p50_ms", 0, "ms"),
)  # fmt: skip


def list_places(city: CityMap) -> list[tuple[str, float, float]]:
    """List every name of a map with the centres of what bears it: name, longitude, latitude [deg]."""
    o = city.objects
    lonlat = city.plane.to_lonlat(o.center.astype(np.float64)).tolist()
    return [
        (o.names[value], *lonlat[row])
        for row in range(len(o))
        for value in o.name_values[o.name_starts[row] : o.name_starts[row + 1]].tolist()
    ]


def sample_streets(city: CityMap, simple: Baselines) -> dict[str, Floats]:
    """Sample points (n, 2) [m] of streets, by their names and by these without the last word."""
    o, found = city.objects, dict[str, list[Floats]]()
    for row in np.flatnonzero((o.kind == LINE) & (np.diff(o.name_starts) > 0)).tolist():
        if not o.label(row).startswith("highway="):
            continue
        name = plain(o.name(row))
        for line in o.parts(row):
            along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))))
            at = np.arange(0.0, along[-1] + 15.0, 15.0)
            points = np.column_stack([np.interp(at, along, axis) for axis in line.T])
            points = simple.plane.to_plane(city.plane.to_lonlat(points))
            for spoken in {name, name.rpartition(" ")[0] or name}:
                found.setdefault(spoken, []).append(points)
    return {name: np.concatenate(points) for name, points in found.items()}


def ask_sets(run: Run, *, quick: bool) -> Iterator[dict[str, Any]]:
    """Ask the texts of every set of its map; yield a row each."""
    cities: dict[str, tuple[CityMap, Baselines, dict[str, Floats]]] = {}
    for name, (town, file, kind, sentences) in SETS.items():
        if town not in cities:
            city = build_city(run.osm / f"{town}.osm.pbf", run.cache / f"{town}.city")
            simple = Baselines(list_places(city))
            cities[town] = city, simple, sample_streets(city, simple)
        city, simple, streets = cities[town]
        path = run.data / f"text/{file}.jsonl"
        notes: Sequence[Record | Note] = (
            read_notes(path, kind, sentences=sentences) if kind else read_records(path)
        )
        notes = notes[: 10 if quick else None]
        for note in notes[:4]:  # warm
            ask(city, note, None)
        found = [ask(city, note, None) for note in run.track(notes, name)]
        row: dict[str, Any] = {
            "name": name, "odd": summary(found[::2]), "even": summary(found[1::2]),
        }  # fmt: skip
        rules: dict[str, Callable[[Record | Note], Floats | None]]
        rules = {"rarest": simple.rarest, "crossing": partial(simple.crossing, streets=streets)}
        for rule, guess in rules.items():
            off = [
                np.inf if (at := guess(note)) is None else float(distances(at, *note.goal)[0])
                for note in notes[1::2]
            ]
            row[rule] = {"within": [float(np.mean(np.array(off) <= r)) for r in (NEAR, WIDE)]}
        yield row


TOWARDS = (25.0, 50.0, 100.0)  # radii of the ends of walks [m]
ALONG = (
    Col("walks, ends within 25 m/50 m/100 m", "name"), Col("even texts", "even.records"),
    Col("odd (developed on)", "odd.within", shares), Col("even", "even.within", shares),
    Col("even, `OK`", "even.ok", share), Col("of these > 100 m", "even.wrong", share),
    Col("p50", "even.p50_ms", 0, "ms"),
)  # fmt: skip


def follow_walks(run: Run, *, quick: bool) -> Iterator[dict[str, Any]]:
    """Follow the walks that people told in Manhattan, with and without the heading at their start."""
    city = build_city(run.osm / "manhattan_2025.osm.pbf", run.cache / "manhattan_2025.city")
    lines = (run.data / "text/walks_manhattan.jsonl").read_text("utf-8").splitlines()
    walks = [json.loads(line) for line in lines[: 6 if quick else None]]
    for name, known in (("start known", False), ("start and heading known", True)):
        found = []
        for walk in run.track(walks, name):
            start, goal = (walk["route"][k][::-1] for k in (0, -1))
            heading = np.deg2rad(walk["start_heading_deg"]) if known else None
            begin = time.perf_counter()
            estimate = city.locate(walk["text"], listener=start, heading=heading)
            seconds, best = time.perf_counter() - begin, estimate.best
            place = np.array([best.longitude, best.latitude]) if best else np.full(2, np.inf)
            found.append((float(distances(place, *goal)[0]), estimate.status.name, seconds))
        row: dict[str, Any] = {"name": name}
        for half, of in (("odd", found[::2]), ("even", found[1::2])):
            off, ok = np.array([f[0] for f in of]), np.array([f[1] == "OK" for f in of])
            row[half] = {
                "records": len(of),
                "within": [float(np.mean(off <= radius)) for radius in TOWARDS],
                "ok": float(ok.mean()),
                "wrong": float(np.mean(off[ok] > TOWARDS[-1])) if ok.any() else 0.0,
                "p50_ms": 1e3 * float(np.median([f[2] for f in of])),
            }
        yield row


@table()
def human_text(
    run: Run,
    *,
    baselines: Annotated[bool, option("Leave the map out.")] = False,
    maps: Annotated[bool, option("Only texts about real maps, without Pittsburgh.")] = False,
    quick: Quick = False,
) -> None:
    """Recall of descriptions that people wrote: 1,023 in Pittsburgh (RVS), and of real maps."""
    run.cache.mkdir(parents=True, exist_ok=True)
    run.one_core()
    asked = [] if baselines else list(ask_sets(run, quick=quick))
    print(render(ON_MAPS, asked), "\n")
    walks = [] if baselines else list(follow_walks(run, quick=quick))
    print(render(ALONG, walks), "\n")
    if maps:
        run.save({"maps": asked, "walks": walks})
        return
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
        write_osm(places, run.cache / "pittsburgh.osm")
        city = build_city(run.cache / "pittsburgh.osm", run.cache / "pittsburgh.city")
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
    run.save({"landmarks": len(places), "rows": rows, "maps": asked, "walks": walks})
