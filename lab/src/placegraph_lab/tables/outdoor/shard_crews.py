"""Who looks into the shards of a world: one process, workers of a cluster, and workers that are killed."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from placegraph_lab.tables.runner import number
from placegraph_lab.tables.statistics import apart

if TYPE_CHECKING:
    from placegraph.world.world import World

ALONE = "one process"
WORKED = [
    "shards", "by", "trips a text", "wall", "asks, CPU", "busiest worker, CPU", "together",
    "of one process", "alike",
]  # fmt: skip


def crew(world: Path, texts: list[str]) -> dict[str, Any]:
    """One process, one worker, two, and two of which one is killed; whether all answer alike."""
    from placegraph_scale.shards import WorldFile

    found = {f"{n} workers" if n else ALONE: apart(together, world, texts, n) for n in (0, 1, 2)}
    found["2 workers, one killed"] = apart(_killed, world, texts)
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
    """What texts take by workers of a cluster, one of which is killed in between; 0: by this process."""
    from distributed import LocalCluster

    import placegraph as pg

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
        planet.locate(text).to_dict()
    crew: Any = planet.planets[name].crew
    client: Any = getattr(crew, "client", None)
    each = crew.each

    def counted(*told: Any) -> Any:  # noqa: ANN401
        trips.append(len(told[0]))
        return each(*told)

    crew.each = counted
    before = client.run(time.process_time) if client else {}
    start, cpu, answers = time.perf_counter(), time.process_time(), []
    for k, text in enumerate(texts):
        if killed and k == len(texts) // 2:
            os.kill(next(iter(client.run(os.getpid).values())), signal.SIGKILL)
        answers.append(planet.locate(text).to_dict())
    seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
    after = client.run(time.process_time) if client else {}
    work = [now - before.get(worker, 0.0) for worker, now in after.items()]
    return {
        "seconds": seconds, "asks_s": cpu, "works_s": max(work, default=0.0),
        "trips": len(trips) / len(texts) if client else 0.0, "answers": answers,
    }  # fmt: skip


def worked(row: dict[str, Any]) -> list[list[str]]:
    """Rows of the table of workers, milliseconds a text."""
    alone, rows = row["by"][ALONE]["asks_s"], []
    for by, of in row["by"].items():
        path = of["asks_s"] + of["works_s"]
        told = (of["seconds"], of["asks_s"], of["works_s"], path)
        rows.append([
            number(row["shards"]), by, number(of["trips"], 1),
            *(number(1e3 * s / row["texts"], 0, "ms") for s in told),
            number(path / alone, 2), "yes" if row["alike"] else "no",
        ])  # fmt: skip
    return rows
