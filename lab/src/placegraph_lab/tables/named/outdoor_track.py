"""Table `outdoor_track`: what is a way worth? A few sentences along a walk, against one place at a time.

Walks of 3 to 5 places, two sentences at each, made of the raw extracts; the last place is sought.
`docs/benchmarks/outdoor.md` explains the protocol of the sentences.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import numpy as np
from numpy.random import Generator

from placegraph.core.estimate import CityEstimate
from placegraph.core.geometry import Floats, bearing
from placegraph.errors import OptionError
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.track.tracker import CityTracker
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, names_of, open_city
from placegraph_lab.tables.outdoor.metrics import Answer, measure, score
from placegraph_lab.tables.outdoor.queries import (
    CELL,
    FEWEST,
    JITTER,
    SIGHT,
    Query,
    Setting,
    Teller,
    load,
)
from placegraph_lab.tables.runner import Column as Col

Shape = Literal["straight", "bent"]
"""On in the same direction, give or take `STRAIGHT`, or with turns to any side."""
Method = Literal["last place alone", "all as one text", "track, told", "track, measured"]
METHODS: tuple[Method, ...] = get_args(Method)
NEAREST, FARTHEST = 30.0, 150.0  # distance of neighbouring places [m]
STRAIGHT, BENT = 0.2, 1.6  # deviation of the direction from one leg to the next [rad]
DISTANCE_ERROR, BEARING_ERROR = 0.15, np.deg2rad(20.0)
"""Deviations of what people say of their way: share of the distance, angle [rad]."""
ODOMETRY = 0.03  # deviation of measured motion along each axis, as a share of the distance
TRIES = 60
WINDS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


@dataclass(frozen=True)
class Step:
    """A place of a walk: how it was reached, and what is said there."""

    query: Query
    spoken: str  # what the speaker says of the way from the place before; empty at the first
    measured: tuple[float, float]  # what an odometer says of it, east and north [m]


@dataclass(frozen=True)
class Walk:
    """Places in the order of the walk."""

    steps: tuple[Step, ...]

    @property
    def last(self) -> Query:
        return self.steps[-1].query

    @property
    def text(self) -> str:
        return " ".join(step.query.text for step in self.steps)


def make_walks(
    osm_path: str | Path,
    *,
    n: int = 100,
    statements: int = 2,
    setting: Setting = "none",
    seed: int = 0,
    min_places: int = 3,
    max_places: int = 5,
) -> list[Walk]:
    """Make `n` walks of `min_places` to `max_places` places with `statements` sentences each.

    Every other walk is bent. The same seed gives the same walks in the settings that say the same
    things.
    """
    if not 1 <= min_places <= max_places:
        raise OptionError(f"A walk of {min_places} to {max_places} places is none; give 1 or more.")
    bins = load(osm_path)
    centers = bins.centers(CELL)
    full = centers[np.diff(bins.around(centers, SIGHT).starts) >= FEWEST]
    if not len(full):
        raise OptionError(f"{osm_path} has no 50 m cell with {FEWEST} objects; give a larger one.")
    teller = Teller(bins, setting, statements)
    walks: list[Walk] = []
    for stream in np.random.default_rng(seed).spawn(50 * n):
        path, speech = stream.spawn(2)
        places = int(path.integers(min_places, max_places + 1))
        shape: Shape = "bent" if len(walks) % 2 else "straight"
        found = _walk(teller, full[path.integers(len(full))], places, shape, (path, speech))
        if found is not None:
            walks.append(found)
        if len(walks) == n:
            return walks
    raise OptionError(f"{osm_path} has too few places for {n} walks; ask for fewer.")


def _walk(
    teller: Teller, center: Floats, places: int, shape: Shape, rng: tuple[Generator, Generator]
) -> Walk | None:
    """One walk from around a centre (2,) [m], or None where it finds nothing to say."""
    path, speech = rng
    radius, angle = JITTER * np.sqrt(path.random()), 2.0 * np.pi * path.random()
    at = center + radius * np.array([np.sin(angle), np.cos(angle)])
    ahead = 2.0 * np.pi * path.random()
    first = teller.describe(at, speech)
    if first is None:
        return None
    steps = [Step(first, "", (0.0, 0.0))]
    while len(steps) < places:
        for _ in range(TRIES):
            turn = path.normal(0.0, STRAIGHT if shape == "straight" else BENT)
            distance = path.uniform(NEAREST, FARTHEST)
            way = distance * np.array([np.sin(ahead + turn), np.cos(ahead + turn)])
            query = teller.describe(at + way, speech)
            if query is not None:
                break
        else:
            return None
        at, ahead = at + way, ahead + turn
        east, north = (way + path.normal(0.0, ODOMETRY * distance, 2)).tolist()
        steps.append(Step(query, describe_way(way, path), (east, north)))
    return Walk(tuple(steps))


def describe_way(way: Floats, rng: Generator) -> str:
    """Describe a way (2,) [m] as people do: roughly how far, and in which of the eight winds."""
    distance = float(np.hypot(*way)) * max(0.3, 1.0 + rng.normal(0.0, DISTANCE_ERROR))
    angle = float(bearing(way)) + rng.normal(0.0, BEARING_ERROR)
    wind = WINDS[round(angle / (np.pi / 4)) % 8]
    return f"I walked about {max(10, 10 * round(distance / 10))} metres {wind}."


def follow(city: CityMap, walk: Walk, method: Method) -> tuple[CityEstimate, list[float]]:
    """Estimate of the last place, and the seconds that every call took."""
    from time import perf_counter

    if method in ("last place alone", "all as one text"):
        start = perf_counter()
        estimate = city.locate(walk.last.text if method == "last place alone" else walk.text)
        return estimate, [perf_counter() - start]
    tracker = CityTracker(city)
    seconds = []
    for k, step in enumerate(walk.steps):
        start = perf_counter()
        if k and method == "track, told":
            tracker.tell(step.spoken)
        elif k:
            tracker.move(*step.measured)
        if k:
            seconds.append(perf_counter() - start)
            start = perf_counter()
        tracker.tell(step.query.text)
        seconds.append(perf_counter() - start)
    return tracker.estimate, seconds


SETTINGS: tuple[Setting, ...] = ("none", "replaced")


def ask(city: CityMap, walks: list[Walk], method: Method) -> dict[str, Any]:
    """Score a method on walks, and the percentiles of the time of all its calls."""
    answers: list[Answer] = []
    seconds: list[float] = []
    for walk in walks:
        estimate, spent = follow(city, walk, method)
        seconds += spent
        last = walk.last
        answers.append(measure(estimate, last.longitude, last.latitude, seconds=max(spent)))
    return {"score": score(answers), "ms_a_call": np.percentile(1e3 * np.array(seconds), (50, 95))}


COLUMNS = (
    Col("city", "city"), Col("relations", lambda r: "true" if r["setting"] == "none" else "20 % wrong"),
    Col("method", "method"),
    Col("25 m", lambda r: r["score"].within[25.0][1], lab.share),
    Col("50 m", lambda r: r["score"].within[50.0][1], lab.share),
    Col("5 in 50 m", lambda r: r["score"].within[50.0][5], lab.share),
    Col("median", "score.median", 0, "m"),
    Col("OK", lambda r: r["score"].status.get("OK", 0.0), lab.share),
    Col("right of OK", "score.right.OK", lab.share),
    Col("calibration", "score.calibration.error", lab.share),
    Col("of perfect", "score.calibration.floor", lab.share),
    Col("ms a call", "ms_a_call", lambda times: "/".join(f"{ms:.0f}" for ms in times)),
)  # fmt: skip


@lab.table()
def outdoor_track(
    run: lab.Run,
    cities: Annotated[str, lab.option("Names with commas.")] = "monaco,toronto,vancouver,ankara",
    seed: lab.Seed = 0,
    *,
    quick: lab.Quick = False,
) -> None:
    """A few sentences along a walk, against one place at a time."""
    rows: list[dict[str, Any]] = []
    names = names_of(cities)
    names, walks = (names[:1], 5) if quick else (names, 100)
    with run.progress() as progress:
        task = progress.add_task("walking", total=len(names) * len(SETTINGS) * len(METHODS))
        for name in names:
            city, osm = open_city(name, run.osm, run.cache), run.osm / EXTRACTS[name]
            for walk in make_walks(osm, n=2, statements=2, seed=seed + 1):
                for method in METHODS:  # warm
                    follow(city, walk, method)
            for setting in SETTINGS:
                made = make_walks(osm, n=walks, statements=2, setting=setting, seed=seed)
                for method in METHODS:
                    head = {"city": name, "setting": setting, "method": method}
                    rows.append(head | ask(city, made, method))
                    progress.advance(task)
    print(lab.render(COLUMNS, rows))
    run.save({"rows": rows})
