import asyncio
import os
import signal
import socket
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

import placegraph as pg
from placegraph.core.estimate import Status
from placegraph.errors import MissingExtraError, ServiceError
from placegraph_scale.shards import workers
from placegraph_scale.shards.steps import ShardSource
from shards_world import TEXTS, shards_of

dask = pytest.importorskip("dask")
distributed = pytest.importorskip("distributed")


def local(**options):
    given = {"threads_per_worker": 1, "dashboard_address": ":0", "scheduler_port": 0} | options
    return distributed.LocalCluster(**given)


@pytest.fixture(scope="module")
def scheduler():
    with local(n_workers=2, processes=False, protocol="tcp") as found:
        yield found.scheduler_address


def test_workers_answer_as_one_process(scheduler, sharded):
    alone, together = pg.open_world(sharded), pg.open_world(sharded, scheduler=scheduler)
    for text in TEXTS[:3]:
        assert together.locate(text).to_dict() == alone.locate(text).to_dict()
    together.close()


def test_a_step_is_sent_once_to_each_worker(scheduler, sharded, monkeypatch):
    planet, sent = pg.open_world(sharded, scheduler=scheduler), []
    real = shards_of(planet).pool.ask

    async def asked(worker, tasks, seconds):
        sent.append(tasks)
        return await real(worker, tasks, seconds)

    monkeypatch.setattr(shards_of(planet).pool, "ask", asked)
    tasks = [workers.ShardTask("name", shard, ([],)) for shard in shards_of(planet).sources]
    assert shards_of(planet).pool.run_tasks(tasks) == {row: [] for row in range(len(tasks))}
    assert len(sent) == 2 < len(tasks) == sum(map(len, sent))
    planet.close()


def test_a_text_takes_a_few_trips(scheduler, sharded, monkeypatch):
    planet, trips = pg.open_world(sharded, scheduler=scheduler), []
    real = shards_of(planet).pool.run_tasks
    monkeypatch.setattr(
        shards_of(planet).pool, "run_tasks", lambda *told: trips.append(told) or real(*told)
    )
    found = planet.locate("A bench is north of me. A tree is east of me. A cafe is south of me.")
    assert len(trips) <= 5
    trips.clear()
    assert all(mode.evidence for mode in found.modes)
    assert len(trips) == 1
    planet.close()


def test_a_lost_shard_is_named_by_workers_too(scheduler, world):
    next((world / "shards").iterdir()).unlink()
    planet = pg.open_world(world, scheduler=scheduler)
    found = planet.locate("A bench is north of me. A tree is east of me.")
    assert len(found.notes) == 1
    planet.close()


def test_a_scheduler_that_is_not_there_is_said():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(ServiceError, match="No scheduler answers"):
        workers.connect(address, 0.2)
    with pytest.raises(ServiceError, match="No scheduler answers"):
        workers.connect("nonsense://x", 0.2)


def test_another_version_and_no_workers_are_said(scheduler, monkeypatch):
    monkeypatch.setattr(workers, "version", lambda _: "1999.1")
    with pytest.raises(ServiceError, match="1999"):
        workers.connect(scheduler)
    monkeypatch.undo()
    with (
        local(n_workers=0, processes=False, protocol="tcp") as empty,
        pytest.raises(ServiceError, match="has no worker"),
    ):
        workers.connect(empty.scheduler_address)


def test_without_dask_a_sentence_says_what_to_install(sharded, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[scale\]"):
        pg.open_world(sharded, scheduler="tcp://127.0.0.1:1")


def test_a_scheduler_that_goes_away_is_said_and_may_come_again(sharded, monkeypatch):
    monkeypatch.setattr(workers, "TIMEOUT", 2.0)
    options = {"n_workers": 1, "processes": False, "protocol": "tcp"}
    with local(**options) as found:
        address = found.scheduler_address
        planet = pg.open_world(sharded, scheduler=address)
        before = planet.locate(TEXTS[0]).to_dict()
    for _ in range(2):
        with pytest.raises(
            ServiceError, match=r"connection to the scheduler .* was lost|No scheduler"
        ):
            planet.locate(TEXTS[0])
    with local(**options | {"scheduler_port": int(address.rpartition(":")[2])}):
        assert planet.locate(TEXTS[0]).to_dict() == before
        planet.close()


def test_a_worker_out_of_memory_is_a_shard_that_does_not_answer(scheduler, sharded, monkeypatch):
    small = next(iter(shards_of(pg.open_world(sharded)).sources)).path

    def full(self, source, known=workers.ShardCache.shard):
        if source.path == small:
            raise MemoryError
        return known(self, source)

    monkeypatch.setattr(workers.ShardCache, "shard", full)  # workers are threads of this process
    planet = pg.open_world(sharded, scheduler=scheduler)
    found = planet.locate("A bench is north of me. A tree is east of me.")
    planet.close()
    assert len(found.notes) == 1
    assert "memory" in found.notes[0]
    assert str(small) in found.notes[0]
    assert "1 of the shards did not answer" in found.reason
    assert found.status is not Status.OK
    assert found.modes


def source(key, size=1):
    return ShardSource(key, f"{key}.city", "", size)


TASKS = [workers.ShardTask("name", source("1"), ())]


def ran(work):
    """What a coroutine returns; in a thread, since tests of pages leave a loop in this one."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(asyncio.run, work).result()


class Ending(workers.Cluster):
    """Its workers are new at each look, and end at the shard 0."""

    looks = 0

    async def workers(self, _age=0.0):
        self.looks += 1
        return [f"tcp://{self.looks}:{i}" for i in range(2)]

    async def ask(self, _worker, tasks, _seconds):
        if any(task.source.key == "0" for task in tasks):
            raise OSError("closed")
        return [task.source.key for task in tasks]


def test_where_every_worker_ended_the_shard_is_lost_and_no_other():
    sources = [source(str(k)) for k in range(6)]
    work = workers._Dispatch(
        Ending(None, "x", sources), [workers.ShardTask("name", s, ()) for s in sources], None
    )
    ran(work.do())
    assert work.results.pop(0).reason.startswith("0.city: every worker")
    assert work.results == {k: str(k) for k in range(1, 6)}


def test_where_no_worker_is_left_it_is_said(monkeypatch):
    class Empty(Ending):
        async def workers(self, _age=0.0):
            return []

    monkeypatch.setattr(workers, "REPLACED", 0.0)
    work = workers._Dispatch(Empty(None, "x", []), TASKS, None)
    with pytest.raises(ServiceError, match="start some with"):
        ran(work.do())


def test_workers_share_the_world_and_keep_their_shards():
    sources = [source(str(k), 1 + k % 7) for k in range(200)]
    three, four = (workers.share_out(sources, [f"w{i}" for i in range(n)]) for n in (3, 4))
    loads = [sum(s.size for s in sources if three[s.key] == f"w{i}") for i in range(3)]
    assert max(loads) <= 1.05 * sum(loads) / 3 + 7
    moved = sum(three[s.key] != four[s.key] and four[s.key] != "w3" for s in sources)
    assert moved < len(sources) // 5


def test_steps_of_two_clients_are_done_one_after_the_other(monkeypatch):
    inside, overlaps = [], []

    def step(shard):
        inside.append(shard)
        sys.setswitchinterval(1e-6)
        overlaps.extend(inside[1:])
        inside.remove(shard)

    monkeypatch.setitem(workers.STEPS, "name", step)
    shard = SimpleNamespace(city_map=None, size=10, source=source("0"))
    monkeypatch.setattr(workers.Shard, "open", lambda _: shard)
    holder, before = workers.ShardCache(memory=20), sys.getswitchinterval()
    tasks = [workers.ShardTask("name", source(str(k % 7)), ()) for k in range(300)]
    try:
        with ThreadPoolExecutor(4) as pool:
            done = [pool.submit(holder.work, tasks) for _ in range(4)]
            assert all(len(one.result()) == len(tasks) for one in done)
    finally:
        sys.setswitchinterval(before)
    assert not overlaps
    assert len(holder._open) == 2


@pytest.mark.all
@pytest.mark.parametrize("count", [1, 2])
def test_a_worker_killed_in_between_loses_nothing(sharded, count):
    slow = {"distributed.deploy.lost-worker-timeout": "10 minutes"}  # to start on a busy machine
    with dask.config.set(slow), local(n_workers=count, processes=True) as found:
        alone = pg.open_world(sharded)
        planet = pg.open_world(sharded, scheduler=found.scheduler_address)
        planet.locate(TEXTS[0])
        victim = next(iter(shards_of(planet).pool.client.run(os.getpid).values()))
        os.kill(victim, signal.SIGKILL)
        for text in TEXTS[:4]:
            assert planet.locate(text).to_dict() == alone.locate(text).to_dict()
        planet.close()


def test_a_worker_stops_while_its_answer_is_still_in_time():
    sent = []

    class EndingWorker(Ending):
        async def ask(self, _worker, tasks, seconds):
            sent.append(seconds)
            return [None for _ in tasks]

    for until in (workers.monotonic() + 100.0, None):
        ran(workers._Dispatch(EndingWorker(None, "x", [source("1")]), TASKS, until).do())
    assert 0.0 < sent[0] < 90.0
    assert sent[1] is None


def test_the_world_waits_for_no_worker_longer_than_was_given():
    class Hanging(Ending):
        async def ask(self, *_):
            await asyncio.Event().wait()

    work = workers._Dispatch(Hanging(None, "x", [source("1")]), TASKS, workers.monotonic() + 0.01)
    ran(work.do())
    assert work.results == {}
