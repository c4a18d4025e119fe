import os
import signal
import socket
import sys

import pytest
from tests.world.shards.test_planet import TEXTS, town

import placegraph as pg
from placegraph.errors import MissingExtraError, ServiceError
from placegraph.estimate import Status
from placegraph.world.shards import cluster, workers

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
    real = town(planet).crew.client.submit
    monkeypatch.setattr(
        town(planet).crew.client,
        "submit",
        lambda do, batch, **how: sent.append(batch) or real(do, batch, **how),
    )
    tasks = [workers.Task(source, ([],)) for source in town(planet).sources]
    assert sorted(town(planet).crew.each("name", tasks)) == [(row, []) for row in range(len(tasks))]
    assert len(sent) <= 2 < len(tasks) == sum(len(batch.tasks) for batch in sent)
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
        cluster.connected(address, 0.2)
    with pytest.raises(ServiceError, match="No scheduler answers"):
        cluster.connected("nonsense://x", 0.2)


def test_another_version_and_no_workers_are_said(scheduler, monkeypatch):
    monkeypatch.setattr(cluster, "version", lambda _: "1999.1")
    with pytest.raises(ServiceError, match="1999"):
        cluster.connected(scheduler)
    monkeypatch.undo()
    with (
        local(n_workers=0, processes=False, protocol="tcp") as empty,
        pytest.raises(ServiceError, match="has no worker"),
    ):
        cluster.connected(empty.scheduler_address)


def test_without_dask_a_sentence_says_what_to_install(sharded, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[scale\]"):
        pg.open_world(sharded, scheduler="tcp://127.0.0.1:1")


def test_a_scheduler_that_goes_away_is_said_and_may_come_again(sharded, monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE", 1.0)
    options = {"n_workers": 1, "processes": False, "protocol": "tcp"}
    with local(**options) as found:
        address = found.scheduler_address
        planet = pg.open_world(sharded, scheduler=address)
        before = planet.locate(TEXTS[0]).to_dict()
    for _ in range(2):
        with pytest.raises(ServiceError, match=r"went away|No scheduler answers"):
            planet.locate(TEXTS[0])
    with local(**options | {"scheduler_port": int(address.rpartition(":")[2])}):
        assert planet.locate(TEXTS[0]).to_dict() == before
        planet.close()


def test_a_worker_out_of_memory_is_a_shard_that_does_not_answer(scheduler, sharded, monkeypatch):
    small = next(iter(town(pg.open_world(sharded)).sources)).path

    def full(self, source, known=workers.Holder.shard):
        if source.path == small:
            raise MemoryError
        return known(self, source)

    monkeypatch.setattr(workers.Holder, "shard", full)  # workers are threads of this process
    planet = pg.open_world(sharded, scheduler=scheduler)
    found = planet.locate("A bench is north of me. A tree is east of me.")
    planet.close()
    assert len(found.notes) == 1
    assert "memory" in found.notes[0]
    assert str(small) in found.notes[0]
    assert "1 of the shards did not answer" in found.reason
    assert found.status is not Status.OK
    assert found.modes


@pytest.mark.parametrize("ended", [MemoryError(), distributed.KilledWorker("task", None, 3)])
def test_where_every_worker_ended_the_shard_is_lost(ended):
    class Future:
        def exception(self):
            return ended

    task = workers.Task(workers.Source("0", "0.city", ""), ())
    (told,) = cluster._result(Future(), [task], "x")
    assert told.reason.startswith("0.city: every worker")
    assert cluster._result(Future(), [task, task], "x") is None  # each is tried alone


@pytest.mark.all
@pytest.mark.parametrize("workers", [1, 2])
def test_a_worker_killed_in_between_loses_nothing(sharded, workers):
    with local(n_workers=workers, processes=True) as found:
        alone = pg.open_world(sharded)
        planet = pg.open_world(sharded, scheduler=found.scheduler_address)
        planet.locate(TEXTS[0])
        victim = next(iter(town(planet).crew.client.run(os.getpid).values()))
        os.kill(victim, signal.SIGKILL)
        for text in TEXTS[:4]:
            assert planet.locate(text).to_dict() == alone.locate(text).to_dict()
        planet.close()


def test_a_worker_stops_while_its_answer_is_still_in_time():
    sent = []

    class Client:
        def submit(self, _do, batch, **_how):
            sent.append(batch)

    tasks = [workers.Task(workers.Source("0", "0.city", ""), ())]
    crew, deadline = cluster.Cluster(Client(), "x"), cluster.monotonic() + 100.0
    for until in (deadline, None):
        crew._sent("name", tasks, [0], ["worker"], until)
    assert 0.0 < sent[0].seconds < 90.0
    assert sent[1].seconds is None
