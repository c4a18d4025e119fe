"""Search of a world's shards: by one process, by workers of a cluster, and by workers that are killed."""

from __future__ import annotations

import os
import re
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

import placegraph as pg
from placegraph.maps import is_world
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.outdoor.extracts import EXTRACTS
from placegraph_lab.tables.outdoor.queries import Query, make_queries
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.statistics import peak, run_apart
from placegraph_lab.worlds.shards import copies_of, finish_copies, write_copies, write_shards
from placegraph_scale.shards import WorldFile

if TYPE_CHECKING:
    from placegraph.world.world import World

ALONE = "one process"
LONG = 1e6  # budget of a search that is to end by itself [s]


WORKED = (
    Col("shards", "shards", 0), Col("by", "by"), Col("trips a text", "trips", 1),
    *(Col(title, key, 0, "ms", 1e3) for title, key in (
        ("wall", "seconds"), ("asks, CPU", "asks_s"), ("busiest worker, CPU", "works_s"),
        ("together", "path_s"))),
    Col("of one process", "of_alone", 2), Col("alike", lambda r: "yes" if r["alike"] else "no"),
)  # fmt: skip


def work_rows(timed: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield rows of the table of workers, seconds a text."""
    alone = timed["by"][ALONE]["asks_s"]
    for by, of in timed["by"].items():
        path, names = of["asks_s"] + of["works_s"], ("seconds", "asks_s", "works_s")
        row = {"by": by, "shards": timed["shards"], "alike": timed["alike"], "trips": of["trips"]}
        row |= {name: of[name] / timed["texts"] for name in names}
        yield row | {"path_s": path / timed["texts"], "of_alone": path / alone}


def time_workers(world: Path, texts: list[str]) -> dict[str, Any]:
    """One process, one worker, two, and two of which one is killed; whether all answer alike."""
    found = {
        f"{n} workers" if n else ALONE: run_apart(together, world, texts, n) for n in (0, 1, 2)
    }
    found["2 workers, one killed"] = run_apart(_killed, world, texts)
    answers = [one.pop("answers") for one in found.values()]
    alike = all(one == answers[0] for one in answers)
    return {
        "texts": len(texts),
        "shards": len(WorldFile.read(world).shards),
        "alike": alike,
        "by": found,
    }


def _killed(world: Path, texts: list[str]) -> dict[str, Any]:
    return together(world, texts, 2, killed=True)


def together(
    world: Path, texts: list[str], workers: int, *, killed: bool = False
) -> dict[str, Any]:
    """Time texts with workers of a cluster, one of which is killed in between; 0: in this process."""
    from distributed import LocalCluster

    if not workers:
        return _timed(pg.open_world(world), world.name, texts)
    with LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster:
        planet = pg.open_world(world, scheduler=cluster.scheduler_address)
        found = _timed(planet, world.name, texts, killed=killed)
        planet.close()
    return found


def _timed(planet: World, name: str, texts: list[str], *, killed: bool = False) -> dict[str, Any]:
    """Answers, seconds of wall, and of the processor: whoever asks, and the worker that did most.

    All texts were asked before. Counted with whoever asks is the scheduler, in the same process.
    """
    trips: list[int] = []
    for text in texts:
        planet.locate(text, budget=LONG).to_dict()
    town: Any = planet.planets[name]
    crew = town.pool
    client: Any = getattr(crew, "client", None)
    each = crew.run_tasks

    def counted(*told: Any) -> Any:
        trips.append(len(told[0]))
        return each(*told)

    crew.run_tasks = counted
    before = client.run(time.process_time) if client else {}
    start, cpu, answers = time.perf_counter(), time.process_time(), []
    for k, text in enumerate(texts):
        if killed and k == len(texts) // 2:
            os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
        answers.append(planet.locate(text, budget=LONG).to_dict())
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    after = client.run(time.process_time) if client else {}
    work = [now - before.get(worker, 0.0) for worker, now in after.items()]
    return {
        "seconds": seconds, "asks_s": cpu, "works_s": max(work, default=0.0),
        "trips": len(trips) / len(texts) if client else 0.0, "answers": answers,
    }  # fmt: skip


KINDS = {
    "common words": "none",
    "names": "names",
    "the speaker": "speaker",
    "everyday words": "synonyms",
}
"""Kinds of text, and the setting of `make_queries` that makes them."""
NAME = re.compile("[Tt]he [A-Z0-9]")
"""Pattern of names; a fifth of the texts of the setting `names` mention common things alone."""
NEAR = 500.0  # radius of the fix of texts of the kind "with a fix" [m]
PLANET = 1.5e9  # cells of the planet, as extrapolated from four extracts

Texts = dict[str, list["Query"]]


def count_touched(reason: str) -> int:
    return int(reason.rpartition("Searched ")[2].split()[0].replace(",", ""))


def compare_texts(city: Path, world: Path, texts: Texts) -> list[dict[str, Any]]:
    """One map against its shards, text by text."""
    whole, planet, rows = pg.CityMap.open(city), pg.open_world(world), []
    for kind, queries in texts.items():
        whole.locate(queries[0].text)
        planet.locate(queries[0].text)
        row: dict[str, Any] = {"kind": kind, "same": 0, "differ": [], "ms": [], "ms_shards": []}
        row["touched"] = []
        for q in queries:
            start = time.process_time()
            one = whole.locate(q.text)
            middle = time.process_time()
            many = planet.locate(q.text)
            row["ms_shards"].append(1e3 * (time.process_time() - middle))
            row["ms"].append(1e3 * (middle - start))
            row["touched"].append(count_touched(many.reason) if many.modes else 0)
            if one.best is None or many.best is None:
                row["same"] += one.best is None and many.best is None
                continue
            a, b = whole.plane.to_plane(
                np.array([(m.longitude, m.latitude) for m in (one.best, many.best)], float)
            )
            row["same"] += bool(np.hypot(*(a - b)) < 20.0)
            row["differ"].append(abs(one.best.probability - many.best.probability))
        rows.append(row | {"queries": len(queries), "shards": _sources(planet.planets[world.name])})
    return rows


def time_texts(world: Path, texts: Texts) -> dict[str, Any]:
    """Time and shards of all texts in one process, after a few have opened what they need."""
    start = time.process_time()
    planet = pg.open_world(world)
    town: Any = planet.planets[world.name]
    town.pool.memory = np.inf
    planet.locate(next(iter(texts.values()))[0].text)
    first = time.process_time() - start
    found: dict[str, Any] = {"first_s": first, "shards": len(town.sources)}
    for kind, queries in texts.items():
        for q in queries[:3]:
            planet.locate(q.text, **fix(kind, q))
        ms, touched, right = [], [], 0
        for q in queries:
            start = time.process_time()
            estimate = planet.locate(q.text, **fix(kind, q))
            ms.append(1e3 * (time.process_time() - start))
            touched.append(count_touched(estimate.reason) if estimate.modes else 0)
            right += estimate.best is not None and near(estimate.best, q)
        found[kind] = {"ms": ms, "touched": touched, "right": right / len(queries)}
    mapped = Path("/proc/self/maps").read_text("utf-8").count(f"{world}/shards/")
    return found | {
        "peak_bytes": peak(), "mapped": mapped, "handles": len(list(Path("/proc/self/fd").iterdir())),
    }  # fmt: skip


def fix(kind: str, q: Query) -> dict[str, Any]:
    return {"near": (q.longitude, q.latitude), "radius": NEAR} if kind == "with a fix" else {}


def near(best: Any, q: Query) -> bool:
    east = (best.longitude - q.longitude) * np.cos(np.radians(q.latitude))
    return bool(np.hypot(east, best.latitude - q.latitude) * 111_000.0 < 50.0)


def _median(key: str) -> Callable[[dict[str, Any]], float]:
    return lambda row: float(np.median(row[key]))


def _p95_of(key: str) -> Callable[[dict[str, Any]], float]:
    return lambda row: float(np.quantile(row[key], 0.95))


EQUAL = (
    Col("texts", "kind"), Col("shards", "shards", 0),
    Col("same best", lambda r: r["same"] / r["queries"], lab.share),
    Col("within 1 %", lambda r: float((np.array(r["differ"]) <= 0.01).mean()), lab.share),
    Col("largest", lambda r: max(r["differ"]), lab.share), Col("whole p50", _median("ms"), 1, "ms"),
    Col("shards p50", _median("ms_shards"), 1, "ms"), Col("touched p50", _median("touched"), 0),
)  # fmt: skip
GROWN = (
    Col("copies", lambda r: f"{r['copies']} x"), Col("cells", "cells", 0), Col("shards", "shards", 0),
    Col("MB", "bytes", 0, "", 1e-6), Col("texts", "kind"), Col("p50", _median("ms"), 0, "ms"),
    Col("p95", _p95_of("ms"), 0, "ms"), Col("touched p50", _median("touched"), 0),
    Col("p95", _p95_of("touched"), 0), Col("@1 50 m", "right", lab.share),
    Col("peak", "peak_bytes", 0, "MB", 1e-6), Col("handles", "handles", 0), Col("mapped", "mapped", 0),
)  # fmt: skip


@lab.table()
def world_shards(
    run: lab.Run,
    city: Annotated[str, lab.option("City that is cut and copied.")] = "vancouver",
    zoom: Annotated[int, lab.option("Level of the quadtree.")] = 12,
    copies: Annotated[
        str, lab.option("Numbers of copies with commas; the last is predicted.")
    ] = "2,4,8,19",
    queries: Annotated[int, lab.option("Queries of a kind.")] = 30,
    seed: lab.Seed = 0,
    *,
    quick: lab.Quick = False,
) -> None:
    """A world in shards against one map: agreement, time of texts as it grows, workers."""
    if quick:
        copies, queries = "1,2", 6
    folder = run.cache / "worlds"  # what is there already is not built again
    folder.mkdir(parents=True, exist_ok=True)
    osm, map_file, numbers = run.osm / EXTRACTS[city], folder / "whole.city", lab.parts(copies)
    run.log("building")
    if not map_file.exists():
        pg.build_city(osm, map_file)
    made = build_worlds(map_file, folder, zoom, [int(n) for n in numbers], seed)
    base = made.pop(0)
    texts = {k: make_queries(osm, n=queries, seed=seed, setting=s) for k, s in KINDS.items()}  # type: ignore[arg-type]
    run.log("asking both")
    rows = run_apart(compare_texts, map_file, base, texts)
    print(lab.render(EQUAL, rows))
    kept = {
        "common words": texts["common words"],
        "a name": [q for q in texts["names"] if NAME.search(q.text)],
        "with a fix": texts["common words"],
    }
    grown = []
    for n, world in zip(numbers, made, strict=True):
        run.log(f"{n} copies")
        grown.append({"copies": int(n)} | sizes(world) | run_apart(time_texts, world, kept))
        print(lab.render(GROWN, [grown[-1] | grown[-1][kind] | {"kind": kind} for kind in kept]))
    run.log("workers")
    said = [q.text for q in texts["common words"][:20]]
    crews = [time_workers(world, said) for world in (made[1], made[-2 if len(made) > 2 else -1])]
    print(lab.render(WORKED, [row for one in crews for row in work_rows(one)]))
    capacity = model(grown)
    print(lab.markdown(["", "model", "measured", "planet, extrapolated"], capacity))
    run.save({
        "rows": rows, "grown": grown, "model": capacity, "crews": crews,
    })  # fmt: skip


def _sources(town: Any) -> int:
    return len(town.sources)


def build_worlds(city: Path, folder: Path, zoom: int, copies: list[int], seed: int) -> list[Path]:
    """Folders of a city's shards and of worlds of copies of them; those that are finished stay."""
    base, large = folder / "base", folder / "large"
    if not is_world(base):
        write_shards(pg.CityMap.open(city), base, zoom)
    made = [folder / f"shards_{n}" for n in copies]
    if not all(map(is_world, made)):
        write_copies(base, large, max(copies), seed)
    for n, world in zip(copies, made, strict=True):
        if not is_world(world):
            copies_of(base, large, world, n)
            finish_copies(base, world, n)
    return [base, *made]


def sizes(folder: Path) -> dict[str, float]:
    shards = WorldFile.read(folder).shards
    return {
        "shards": len(shards),
        "cells": sum(s.cells for s in shards),
        "bytes": sum(s.bytes for s in shards),
        "words_bytes": (folder / "words.table").stat().st_size,
    }


def model(grown: list[dict[str, Any]]) -> list[list[str]]:
    """Lines in the number of cells, fitted to all worlds but the last, checked on that, and the planet's."""
    cells = np.array([row["cells"] for row in grown], float)
    measured = {
        "shards": [row["shards"] for row in grown],
        "disk [MB]": [1e-6 * (row["bytes"] + row["words_bytes"]) for row in grown],
        "memory, all shards open [MB]": [1e-6 * row["peak_bytes"] for row in grown],
        "table of words [MB]": [1e-6 * row["words_bytes"] for row in grown],
        "common words, p95 [core ms]": _p95(grown, "common words"),
        "a name, p50 [core ms]": [float(np.median(row["a name"]["ms"])) for row in grown],
        "a name, p95 [core ms]": _p95(grown, "a name"),
        "with a fix, p95 [core ms]": _p95(grown, "with a fix"),
    }
    rows = []
    for name, values in measured.items():
        fitted = np.polyfit(cells[:-1], values[:-1], 1 if len(cells) > 2 else 0)
        rows.append([
            name, *(f"{x:,.1f}" for x in (np.polyval(fitted, cells[-1]), values[-1])),
            f"{np.polyval(fitted, PLANET):,.0f}",
        ])  # fmt: skip
    return rows


def _p95(grown: list[dict[str, Any]], kind: str) -> list[float]:
    return [float(np.quantile(row[kind]["ms"], 0.95)) for row in grown]
