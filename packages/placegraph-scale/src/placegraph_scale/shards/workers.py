"""Workers that hold shards open: this process, or those of a Dask cluster."""

from __future__ import annotations

import asyncio
from collections import Counter, OrderedDict
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from time import monotonic
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self
from zlib import crc32

from placegraph.errors import MapError, MissingExtraError, PlacegraphError, ServiceError
from placegraph_scale.folder import same
from placegraph_scale.shards import steps
from placegraph_scale.shards.steps import Proposed, Shard

if TYPE_CHECKING:
    from collections.abc import Iterator

    from distributed import Client, Worker

OPEN = 256
"""Shards that a process holds open at most."""
STEPS: dict[str, Callable[..., Any]] = {
    "gather": steps.gathered,
    "weigh": steps.weighed,
    "propose": steps.proposed,
    "compare": steps.compared,
    "look": steps.looked,
    "explain": steps.explained,
    "name": steps.named,
    "judge": steps.judged,
    "ask": steps.asked_back,
}
"""What can be done in a shard."""


class Lost(NamedTuple):
    """Why a shard did not answer."""

    reason: str


class Source(NamedTuple):
    """Where a shard lies, and which file it is."""

    key: str
    path: Path
    digest: str
    size: int
    """[bytes]"""


class Task(NamedTuple):
    """A step in a shard, and what it is told."""

    step: str
    source: Source
    told: tuple[Any, ...]


@dataclass(eq=False)
class Holder:
    """Shards that one process holds open; those that were not used for longest are closed first.

    Several threads may ask for steps: one is done after the other.
    """

    most: int = OPEN
    _open: OrderedDict[Path, tuple[str, Shard]] = field(default_factory=OrderedDict)
    _lock: Lock = field(default_factory=Lock)

    def work(self, tasks: Sequence[Task], deadline: float | None = None) -> list[Any]:
        """Results of tasks, in their order; fewer where the time is over.

        What shards propose is compared at once, as far as it counts among all that these propose.
        """
        done: list[Any] = []
        for task in tasks:
            if deadline is not None and monotonic() >= deadline:
                break
            done.append(self._do(task))
        proposed = [k for k, result in enumerate(done) if isinstance(result, Proposed)]
        for i, at in steps.counting([done[k] for k in proposed]):
            k = proposed[i]
            asked, told = tasks[k].told[0], done[k]
            scored = self._do(Task("compare", tasks[k].source, (asked, told.part(at))))
            done[k] = scored if isinstance(scored, Lost) else told._replace(scored=(at, scored))
        return done

    def _do(self, task: Task) -> Any:  # noqa: ANN401
        """Result of a step, or `Lost` where the shard is missing, damaged or of another version."""
        with self._lock:
            try:
                return STEPS[task.step](self.shard(task.source), *task.told)
            except PlacegraphError as error:
                return Lost(str(error))
            except MemoryError:
                return Lost(
                    f"{task.source.path} does not fit into this process's memory; use less of it."
                )

    def shard(self, source: Source) -> Shard:
        """Open a shard; raises `InputError` or `MapError`."""
        from placegraph.outdoor.city import CityMap

        held = self._open.get(source.path)
        if held is not None and held[0] == source.digest:
            self._open.move_to_end(source.path)
            return held[1]
        same(source.path, source.digest)
        city = CityMap.open(source.path, shard=True)
        if not len(city.objects):  # pragma: no cover  # which `open` refuses
            raise MapError(f"{source.path} is empty; build it again.")
        shard = Shard(source.key, city)
        self._open[source.path] = source.digest, shard
        while len(self._open) > self.most:
            self._open.popitem(last=False)
        return shard


class Crew(Protocol):
    """Does steps in shards."""

    def each(self, tasks: Sequence[Task], deadline: float | None = None) -> dict[int, Any]:
        """Results of tasks by their rows; those not done by the deadline are left out."""

    def close(self) -> None:
        """Let go of what is held."""


@dataclass(eq=False)
class Alone:
    """One process, one shard after the other."""

    holder: Holder = field(default_factory=Holder)

    def each(self, tasks: Sequence[Task], deadline: float | None = None) -> dict[int, Any]:
        """Results of tasks by their rows."""
        return dict(enumerate(self.holder.work(tasks, deadline)))

    def close(self) -> None:
        """Close all shards."""
        self.holder = Holder(self.holder.most)


PATIENCE = 10.0
"""A scheduler that does not answer for so long is not there [s]."""
LOOK = 2.0
"""So long after it was looked which workers are there, it is looked again [s]."""
EVEN = 1.05
"""No worker has so many times its share of the world."""
REPLACED = 300.0
"""Workers that all ended have others in their place by then [s]."""
ENDS = 3
"""A task at which so many workers ended is given up."""
BEGIN = 0.8
"""In this share of the time that is left a worker begins with shards: what it tells is to be in time."""
_STEPS = "placegraph_steps"
"""What workers are asked."""


def connected(address: str, patience: float = PATIENCE) -> Client:
    """Client of a scheduler.

    Raises
    ------
    MissingExtraError
        Dask is not installed.
    ServiceError
        There is no scheduler, it has no worker, or it or a worker runs another Dask or placegraph.

    """
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingExtraError(
            "A scheduler takes Dask; install it with `pip install 'placegraph[scale]'`."
        ) from error
    try:
        client = Client(address, timeout=patience, set_as_default=False)
    except (OSError, ValueError, TimeoutError, RuntimeError, ImportError) as error:
        raise ServiceError(
            f"No scheduler answers at {address!r} ({error}). Start one with `dask scheduler`, or leave "
            "--scheduler out to work in this process."
        ) from error
    try:
        _check(client, address)
    except BaseException:
        client.close()
        raise
    return client


def _check(client: Client, address: str) -> None:
    """Raise `ServiceError` where the cluster cannot do the work."""
    workers = client.scheduler_info(n_workers=-1)["workers"]
    if not workers:
        raise ServiceError(
            f"The scheduler at {address} has no worker; start some with `dask worker {address}`."
        )
    versions: Any = client.get_versions()
    told = {"the scheduler": versions["scheduler"], **versions["workers"]}
    for who, found in told.items():
        ours, theirs = version("distributed"), (found or {}).get("packages", {}).get("distributed")
        if theirs != ours:
            raise ServiceError(
                f"{who} of {address} runs distributed {theirs}, and this process {ours}; install one "
                "version everywhere."
            )


@dataclass(eq=False)
class Cluster:
    """Workers of a cluster; what one did not end is done by another one."""

    client: Client
    address: str
    sources: Sequence[Source]
    """All shards of the world."""
    _there: list[str] = field(default_factory=list)
    """Workers when they were last asked for ..."""
    _seen: float = 0.0
    """... and when that was [s]."""
    _ready: set[str] = field(default_factory=set)
    """Workers that know what to do."""
    _shared: tuple[tuple[str, ...], dict[str, str]] = ((), {})
    """Whose the shards are, among which workers."""

    @classmethod
    def at(cls, address: str, sources: Sequence[Source]) -> Self:
        """Cluster of a scheduler, for these shards; raises as `connected`."""
        return cls(connected(address, PATIENCE), address, sources)

    def each(self, tasks: Sequence[Task], deadline: float | None = None) -> dict[int, Any]:
        """Results of tasks by their rows; `ServiceError` where the scheduler or all workers are gone."""
        if self.client.status == "closed":  # the scheduler went away, and may have come again
            self.client = connected(self.address, PATIENCE)
            self._seen = 0.0
        work = _Work(self, tasks, deadline)
        self.client.sync(work.do)
        return work.found

    async def workers(self, age: float = LOOK) -> list[str]:
        """Addresses of all workers that are there now, or were no longer ago [s]."""
        if monotonic() - self._seen >= age:
            with _answering(self.address):
                if self.client.scheduler is None:  # it is being left
                    raise OSError("the connection is closed")
                scheduler: Any = self.client.scheduler
                told = await scheduler.identity()
            self._there, self._seen = sorted(told["workers"]), monotonic()
        return self._there

    async def asked(self, worker: str, tasks: list[Task], seconds: float | None) -> list[Any]:
        """Results of tasks by a worker, as of `Holder.work`; `OSError` where it ends."""
        from distributed.protocol.pickle import dumps, loads

        rpc = self.client.rpc(worker)
        batch, told = dumps((tasks, seconds)), None
        if worker in self._ready:
            told = await getattr(rpc, _STEPS)(told=batch)
        if told is None:  # it is new, or another one at the same address
            await rpc.run(function=dumps(_prepare))
            self._ready.add(worker)
            told = await getattr(rpc, _STEPS)(told=batch)
        found: list[Any] = loads(told)
        return found

    def shared(self, workers: tuple[str, ...]) -> dict[str, str]:
        """The worker of each shard, by its key."""
        if self._shared[0] != workers:
            self._shared = workers, shared(self.sources, workers)
        return self._shared[1]

    def close(self) -> None:
        """Leave the cluster; its workers stay."""
        self.client.close()


@dataclass(eq=False)
class _Work:
    """Tasks, and what became of them."""

    cluster: Cluster
    tasks: Sequence[Task]
    deadline: float | None
    found: dict[int, Any] = field(default_factory=dict)
    ends: Counter[int] = field(default_factory=Counter)
    """How many workers ended at a task; if any did, each is tried alone."""
    gone: set[str] = field(default_factory=set)
    """Workers that ended."""

    async def do(self) -> None:
        """Do all that can be done in time."""
        age, since = LOOK, monotonic()
        while self.left() > 0.0 and len(self.found) < len(self.tasks):
            there = [w for w in await self.cluster.workers(age) if w not in self.gone]
            age = 0.0
            if not there:
                await self._wait(monotonic() - since)
                continue
            of, whose = dict[str, list[int]](), self.cluster.shared(tuple(there))
            for row in (row for row in range(len(self.tasks)) if row not in self.found):
                of.setdefault(whose[self.tasks[row].source.key], []).append(row)
            await asyncio.gather(*(self._by(worker, rows) for worker, rows in of.items()))
            since = monotonic()

    async def _wait(self, waited: float) -> None:
        """Wait for a worker, as where all are being replaced [s]."""
        if waited >= REPLACED:
            raise ServiceError(
                f"The scheduler at {self.cluster.address} has no worker any more that answers; start "
                f"some with `dask worker {self.cluster.address}`, where this process can reach them."
            )
        if waited >= PATIENCE:
            self.gone.clear()  # others may have taken their addresses
        await asyncio.sleep(0.1)

    def left(self) -> float:
        """Time that is left [s]."""
        return float("inf") if self.deadline is None else self.deadline - monotonic()

    async def _by(self, worker: str, rows: list[int]) -> None:
        """Have a worker do tasks until it ends."""
        for part in [[row] for row in rows] if self.ends else [rows]:
            try:
                results = await self._asked(worker, [self.tasks[row] for row in part])
            except OSError as error:
                self.gone.add(worker)
                self.ends.update(part)
                self.found |= {
                    row: Lost(
                        f"{self.tasks[row].source.path}: every worker that opened it ended ({error}); "
                        "give workers more memory."
                    )
                    for row in part if self.ends[row] >= ENDS
                }  # fmt: skip
                return
            self.found |= zip(part, results, strict=False)  # fewer where it was late

    async def _asked(self, worker: str, tasks: list[Task]) -> list[Any]:
        """As `Cluster.asked`; nothing where the time is over, `OSError` where the worker is gone."""
        seconds = None if self.deadline is None else BEGIN * max(0.0, self.left())
        call = asyncio.ensure_future(self.cluster.asked(worker, tasks, seconds))
        try:
            while not call.done():
                await asyncio.wait({call}, timeout=max(0.0, min(LOOK, self.left())))
                if self.left() <= 0.0 and not call.done():
                    return []
                if not call.done() and worker not in await self.cluster.workers(LOOK):
                    raise OSError(f"{worker} is gone")
            return call.result()
        finally:
            call.cancel()


def shared(shards: Sequence[Source], workers: Sequence[str]) -> dict[str, str]:
    """The worker of each shard, by its key: nearly the same one whichever others there are.

    None has much more than its share of the bytes.
    """
    load, most = dict.fromkeys(workers, 0), EVEN * sum(s.size for s in shards) / len(workers)
    found = {}
    for source in sorted(shards, key=lambda s: -s.size):
        room = [w for w in workers if load[w] + source.size <= most]
        room = room or [min(workers, key=load.__getitem__)]
        found[source.key] = max(room, key=lambda w: crc32(f"{source.key} {w}".encode()))
        load[found[source.key]] += source.size
    return found


@dataclass(eq=False)
class _Steps:
    """What a worker holds, and does when it is asked."""

    holder: Holder = field(default_factory=Holder)

    async def do(self, told: bytes) -> bytes:
        """Do tasks in a thread, so that the worker goes on to say that it is there."""
        return await asyncio.to_thread(self._done, told)

    def _done(self, told: bytes) -> bytes:
        from distributed.protocol.pickle import dumps, loads

        tasks, seconds = loads(told)
        deadline = None if seconds is None else monotonic() + seconds
        return bytes(dumps(self.holder.work(tasks, deadline)))


def _prepare(dask_worker: Worker) -> None:
    """Have a worker do steps when it is asked."""
    dask_worker.handlers.setdefault(_STEPS, _Steps().do)


@contextmanager
def _answering(address: str) -> Iterator[None]:
    """Within it, a scheduler is asked that may have gone: `ServiceError`."""
    from distributed import CancelledError

    try:
        yield
    except (OSError, RuntimeError, LookupError, CancelledError) as error:
        raise ServiceError(
            f"The scheduler at {address} went away ({type(error).__name__}: {error}); start it and ask "
            "again."
        ) from error
