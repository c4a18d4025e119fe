"""What is a way worth? A few sentences along a walk, against one place at a time.

    placegraph-lab table outdoor_track
    placegraph-lab table outdoor_track --cities monaco --walks 20

Walks of 3 to 5 places, two sentences at each, made of the raw extracts; the last place is sought.
Prints a Markdown table and writes JSON. `docs/benchmarks.md` explains the protocol of the sentences.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from placegraph.outdoor.city import CityMap
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, names_of, open_city
from placegraph_lab.tables.outdoor.metrics import Answer, Score, measure, score
from placegraph_lab.tables.outdoor.queries import Setting
from placegraph_lab.tables.outdoor.walks import METHODS, Method, Walk, follow, make_walks
from placegraph_lab.tables.run import Quick, Run, Seed, option, table
from placegraph_lab.tables.tables import markdown, number, share, shares

SETTINGS: tuple[Setting, ...] = ("none", "replaced")


def ask(city: CityMap, walks: list[Walk], method: Method) -> tuple[Score, list[float]]:
    """Score a method on walks; also the seconds of all its calls."""
    answers: list[Answer] = []
    seconds: list[float] = []
    for walk in walks:
        estimate, took = follow(city, walk, method)
        seconds += took
        last = walk.last
        answers.append(measure(estimate, last.longitude, last.latitude, seconds=max(took)))
    return score(answers), seconds


def row_of(
    name: str, setting: Setting, method: Method, found: Score, s: list[float]
) -> dict[str, Any]:
    """One row, in plain numbers."""
    told = found.to_dict()
    for key in ("exact", "own_cell", "p50_ms", "p95_ms"):
        del told[key]
    ms = np.percentile(1e3 * np.array(s), (50, 95)).round(2).tolist()
    return {"city": name, "setting": setting, "method": method} | told | {"ms_a_call_p50_p95": ms}


def printed(rows: list[dict[str, Any]]) -> str:
    """Markdown of all rows."""
    return markdown(
        ["city", "relations", "method", "25 m", "50 m", "5 in 50 m", "median", "OK", "right of OK",
         "calibration", "of perfect", "ms a call"],
        [
            [
                r["city"],
                "true" if r["setting"] == "none" else "20 % wrong",
                r["method"],
                *(share(r["within"][radius]["1"]) for radius in ("25 m", "50 m")),
                share(r["within"]["50 m"]["5"]),
                number(np.inf if r["median_m"] is None else r["median_m"], 0, "m"),
                share(r["status"].get("OK", 0.0)),
                share(r["right"].get("OK")),
                shares([r["calibration_error"]]),
                shares([r["calibration_error_of_perfect"]]),
                "/".join(f"{ms:.0f}" for ms in r["ms_a_call_p50_p95"]),
            ]
            for r in rows
        ],
    )  # fmt: skip


@table()
def outdoor_track(
    run: Run,
    cities: Annotated[str, option("Names with commas.")] = "monaco,toronto,vancouver,ankara",
    walks: Annotated[int, option("Walks a city and setting.")] = 100,
    statements: Annotated[int, option("Sentences at a place.")] = 2,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """What is a way worth? A few sentences along a walk, against one place at a time."""
    rows: list[dict[str, Any]] = []
    names = names_of(cities)
    if quick:
        names, walks = names[:1], 5
    with run.progress() as progress:
        task = progress.add_task("walking", total=len(names) * len(SETTINGS) * len(METHODS))
        for name in names:
            city, osm = open_city(name, run.osm, run.cache), run.osm / EXTRACTS[name]
            for walk in make_walks(osm, n=2, statements=statements, seed=seed + 1):
                for method in METHODS:  # warm
                    follow(city, walk, method)
            for setting in SETTINGS:
                made = make_walks(osm, n=walks, statements=statements, setting=setting, seed=seed)
                for method in METHODS:
                    rows.append(row_of(name, setting, method, *ask(city, made, method)))
                    progress.advance(task)
    print(printed(rows))
    run.save({"rows": rows})
