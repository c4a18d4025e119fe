"""Workers that hold shards open: this process, or those of a Dask cluster.

The scheduler of a cluster says which workers there are. They are asked directly, each for all of its
shards at once: a task by way of the scheduler takes several times as long as the step itself.
"""

from __future__ import annotations

import asyncio
import gc
import re
from collections import Counter, OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from threading import Lock
from time import monotonic
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, Self
from zlib import crc32

from placegraph.errors import (
    MissingExtraError,
    OptionError,
    PlacegraphError,
    ServiceError,
)
from placegraph_scale.shards.steps import STEPS, Proposal, Shard, ShardSource, choose_best

if TYPE_CHECKING:
    from distributed import Client, Worker

MEMORY = 2e9
"""Bytes that the open shards of a process take at most, if not given."""
TIMEOUT = 10.0
"""A scheduler that does not answer for so long is not there [s]."""
LOOK = 2.0
"""Time between two looks at which workers are there [s]."""
EVEN = 1.05
"""No worker has so many times its share of the world."""
REPLACED = 300.0
"""Time in which workers that all ended are replaced by others [s]."""
ENDS = 3
"""A task at which so many workers ended is given up."""
BEGIN = 0.8
"""Share of the time left in which a worker begins with shards, so that its results are in time."""
_STEPS = "placegraph_steps"
"""Name of the handler that workers get."""


class Failure(NamedTuple):
    """Why a shard did not answer."""

    reason: str


class ShardTask(NamedTuple):
    """A step in a shard, and its arguments."""

    step: str
    source: ShardSource
    arguments: tuple[Any, ...]


@dataclass(eq=False)
class ShardCache:
    """Shards that one process holds open, a `WorkerPool`; those not used for longest are closed first.

    Their objects are closed before any shard is. Several threads may ask for steps: one is done after the
    other.
    """

    memory: float = MEMORY
    """Bytes that open shards take at most."""
    _open: OrderedDict[Path, Shard] = field(default_factory=OrderedDict)
    _with_objects: OrderedDict[Path, None] = field(default_factory=OrderedDict)
    """Open shards whose objects are open as well."""
    _sizes: dict[Path, float] = field(default_factory=dict)
    """Memory of each shard after its last step [bytes]."""
    _size: float = 0.0
    """Sum of `_sizes` [bytes]."""
    _lock: Lock = field(default_factory=Lock)

    def run_tasks(
        self, tasks: Sequence[ShardTask], deadline: float | None = None
    ) -> dict[int, Any]:
        """Return the results of tasks by their rows; those not done by the deadline are left out."""
        return dict(enumerate(self.work(tasks, deadline)))

    def close(self) -> None:
        """Close all shards."""
        for held in (self._open, self._with_objects, self._sizes):
            held.clear()
        self._size = 0.0

    def work(self, tasks: Sequence[ShardTask], deadline: float | None = None) -> list[Any]:
        """Return the results of tasks, in their order; fewer where the time is over.

        Proposals are scored at once, as far as they count among all that these shards propose.
        """
        done: list[Any] = []
        for task in tasks:
            if deadline is not None and monotonic() >= deadline:
                break
            done.append(self._do(task))
        proposed = [k for k, result in enumerate(done) if isinstance(result, Proposal)]
        for i, at in choose_best([done[k] for k in proposed]):
            k = proposed[i]
            asked, proposal = tasks[k].arguments[0], done[k]
            scored = self._do(ShardTask("compare", tasks[k].source, (asked, proposal.part(at))))
            is_lost = isinstance(scored, Failure)
            done[k] = scored if is_lost else proposal._replace(scored=(at, scored))
        return done

    def _do(self, task: ShardTask) -> Any:  # noqa: ANN401
        """Return the result of a step, or `Failure` where the shard is missing, damaged or too large."""
        with self._lock:
            try:
                found = STEPS[task.step](self.shard(task.source), *task.arguments)
                self._close_unused(task.source.path)
            except PlacegraphError as error:
                return Failure(str(error))
            except MemoryError:
                return Failure(
                    f"{task.source.path} does not fit into the memory of this process; use a "
                    "smaller part."
                )
            else:
                return found

    def shard(self, source: ShardSource) -> Shard:
        """Open a shard; raises `InputError` or `MapError`."""
        held = self._open.get(source.path)
        if held is None or held.source.digest != source.digest:
            held = self._open[source.path] = Shard.open(source)
        self._open.move_to_end(source.path)
        return held

    def _close_unused(self, path: Path) -> None:
        """Close objects and shards not used for longest until the others fit; the shard at `path` stays."""
        if self._open[path].city_map is not None:
            self._with_objects[path] = None
            self._with_objects.move_to_end(path)
        while True:
            size = self._open[path].size if path in self._open else 0.0
            self._size += size - self._sizes.get(path, 0.0)
            self._sizes[path] = size
            if self._size <= self.memory or not (self._with_objects or len(self._open) > 1):
                break
            if self._with_objects:
                path, _ = self._with_objects.popitem(last=False)
                self._open[path].city_map = None
                self._open[path].requests.clear()
            else:
                path, _ = self._open.popitem(last=False)


def parse_memory(memory: str | float) -> float:
    """Return the bytes of a size such as "500MB" or "4GB"; `OptionError` where it is none."""
    found = re.fullmatch(r"([\d.]+) *([kMGT]?)B?", str(memory).strip())
    with suppress(ValueError):
        size = 1e3 ** " kMGT".index(found[2] or " ") * float(found[1]) if found else 0.0
        if size > 0.0:
            return size
    raise OptionError(f'memory is {memory!r}; give a size such as "500MB" or "4GB".')


class WorkerPool(Protocol):
    """Does steps in shards."""

    def run_tasks(
        self, tasks: Sequence[ShardTask], deadline: float | None = None
    ) -> dict[int, Any]:
        """Return the results of tasks by their rows; those not done by the deadline are left out."""

    def close(self) -> None:
        """Release all shards."""


def connect(address: str, timeout: float = TIMEOUT) -> Client:
    """Connect to a scheduler.

    Raises `MissingExtraError`: dask is not installed; `ServiceError`: there is no scheduler, it has
    no worker, or it or a worker runs another version of Dask.
    """
    try:
        from distributed import Client
    except ImportError as error:
        raise MissingExtraError(
            "A scheduler needs Dask; run `pip install 'placegraph[scale]'`."
        ) from error
    gc.collect()  # a dropped client that ends while another one starts waits for its lock forever
    try:
        client = Client(address, timeout=timeout, set_as_default=False)
    except (OSError, ValueError, TimeoutError, RuntimeError, ImportError) as error:
        raise ServiceError(
            f"No scheduler answers at {address!r} ({error}). Start one with `dask scheduler`, or leave "
            "--scheduler out to work in this process."
        ) from error
    try:
        _check_workers(client, address)
    except BaseException:
        client.close()
        raise
    return client


def _check_workers(client: Client, address: str) -> None:
    """Raise `ServiceError` where the cluster has no worker, or another version of Dask."""
    if not client.scheduler_info(n_workers=-1)["workers"]:
        raise ServiceError(
            f"The scheduler at {address} has no worker; start some with `dask worker {address}`."
        )
    versions: Any = client.get_versions()
    ours = version("distributed")
    for who, found in {"the scheduler": versions["scheduler"], **versions["workers"]}.items():
        theirs = (found or {}).get("packages", {}).get("distributed")
        if theirs != ours:
            raise ServiceError(
                f"{who} of {address} runs distributed {theirs}, but this process {ours}; install "
                "the same version everywhere."
            )


@dataclass(eq=False)
class Cluster:
    """Workers of a cluster; where one ends, another one does its tasks."""

    client: Client
    address: str
    sources: Sequence[ShardSource]
    """All shards of the world."""
    _there: list[str] = field(default_factory=list)
    """Workers when they were last asked for ..."""
    _checked: float = 0.0
    """... and when that was [s]."""
    _ready: set[str] = field(default_factory=set)
    """Workers that have the handler."""
    _shares: tuple[tuple[str, ...], dict[str, str]] = ((), {})
    """Workers, and which of them has each shard."""

    @classmethod
    def at(cls, address: str, sources: Sequence[ShardSource]) -> Self:
        """Return the cluster of a scheduler, for these shards; raises as `connect`."""
        return cls(connect(address, TIMEOUT), address, sources)

    def run_tasks(
        self, tasks: Sequence[ShardTask], deadline: float | None = None
    ) -> dict[int, Any]:
        """Return results by row; `ServiceError` where the scheduler or all workers are gone."""
        if self.client.status == "closed":  # the scheduler went away, and may have come again
            self.client = connect(self.address, TIMEOUT)
            self._checked = 0.0
        work = _Dispatch(self, tasks, deadline)
        self.client.sync(work.do)
        return work.results

    async def workers(self, age: float = LOOK) -> list[str]:
        """Return addresses of all workers that are there now, or were no longer ago [s]."""
        if monotonic() - self._checked >= age:
            with _expecting_answer(self.address):
                if self.client.scheduler is None:  # it is being left
                    raise OSError("the connection is closed")
                scheduler: Any = self.client.scheduler
                found = await scheduler.identity()
            self._there, self._checked = sorted(found["workers"]), monotonic()
        return self._there

    async def ask(self, worker: str, tasks: list[ShardTask], seconds: float | None) -> list[Any]:
        """Return the results of tasks by a worker, as of `ShardCache.work`; `OSError` where it ends."""
        from distributed.protocol.pickle import dumps, loads

        rpc = self.client.rpc(worker)
        batch, answer = dumps((tasks, seconds)), None
        if worker in self._ready:
            answer = await getattr(rpc, _STEPS)(message=batch)
        if answer is None:  # it is new, or another one at the same address
            await rpc.run(function=dumps(_prepare))
            self._ready.add(worker)
            answer = await getattr(rpc, _STEPS)(message=batch)
        found: list[Any] = loads(answer)
        return found

    def shares(self, workers: tuple[str, ...]) -> dict[str, str]:
        """Return the worker of each shard, by its key."""
        if self._shares[0] != workers:
            self._shares = workers, share_out(self.sources, workers)
        return self._shares[1]

    def close(self) -> None:
        """Leave the cluster; its workers stay."""
        self.client.close()


@dataclass(eq=False)
class _Dispatch:
    """Tasks on their way to workers, and their results."""

    cluster: Cluster
    tasks: Sequence[ShardTask]
    deadline: float | None
    results: dict[int, Any] = field(default_factory=dict)
    ends: Counter[int] = field(default_factory=Counter)
    """Number of workers that ended at each task; after any such end, tasks are tried alone."""
    gone: set[str] = field(default_factory=set)
    """Workers that ended."""

    async def do(self) -> None:
        """Do all that can be done in time."""
        age, since = LOOK, monotonic()
        while self.seconds_left() > 0.0 and len(self.results) < len(self.tasks):
            there = [w for w in await self.cluster.workers(age) if w not in self.gone]
            age = 0.0
            if not there:
                await self._wait(monotonic() - since)
                continue
            of, whose = dict[str, list[int]](), self.cluster.shares(tuple(there))
            for row in (row for row in range(len(self.tasks)) if row not in self.results):
                of.setdefault(whose[self.tasks[row].source.key], []).append(row)
            await asyncio.gather(*(self._by(worker, rows) for worker, rows in of.items()))
            since = monotonic()

    async def _wait(self, waited: float) -> None:
        """Wait for a worker, as where all are being replaced [s]."""
        if waited >= REPLACED:
            raise ServiceError(
                f"No worker of the scheduler at {self.cluster.address} answers any more; start "
                f"some with `dask worker {self.cluster.address}` where this process can reach them."
            )
        if waited >= TIMEOUT:
            self.gone.clear()  # others may have taken their addresses
        await asyncio.sleep(0.1)

    def seconds_left(self) -> float:
        """Return the time that is left [s]."""
        return float("inf") if self.deadline is None else self.deadline - monotonic()

    async def _by(self, worker: str, rows: list[int]) -> None:
        """Have a worker do tasks until it ends."""
        for part in [[row] for row in rows] if self.ends else [rows]:
            try:
                results = await self._ask(worker, [self.tasks[row] for row in part])
            except OSError as error:
                self.gone.add(worker)
                self.ends.update(part)
                self.results |= {
                    row: Failure(
                        f"{self.tasks[row].source.path}: every worker that opened it ended ({error}); "
                        "give workers more memory."
                    )
                    for row in part if self.ends[row] >= ENDS
                }  # fmt: skip
                return
            self.results |= zip(part, results, strict=False)  # fewer where it was late

    async def _ask(self, worker: str, tasks: list[ShardTask]) -> list[Any]:
        """Ask a worker; return nothing once the time is over, raise `OSError` if the worker is gone."""
        seconds = None if self.deadline is None else BEGIN * max(0.0, self.seconds_left())
        call = asyncio.ensure_future(self.cluster.ask(worker, tasks, seconds))
        try:
            while not call.done():
                await asyncio.wait({call}, timeout=max(0.0, min(LOOK, self.seconds_left())))
                if self.seconds_left() <= 0.0 and not call.done():
                    return []
                if not call.done() and worker not in await self.cluster.workers(LOOK):
                    raise OSError(f"{worker} is gone")
            return call.result()
        finally:
            call.cancel()


def share_out(shards: Sequence[ShardSource], workers: Sequence[str]) -> dict[str, str]:
    """Return the worker of each shard, by its key: nearly the same one whichever others there are.

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


def _prepare(dask_worker: Worker) -> None:
    """Give a worker the handler that does steps."""
    cache = ShardCache()

    def work(message: bytes) -> bytes:
        from distributed.protocol.pickle import dumps, loads

        tasks, seconds = loads(message)
        deadline = None if seconds is None else monotonic() + seconds
        return bytes(dumps(cache.work(tasks, deadline)))

    async def do(
        message: bytes,
    ) -> bytes:  # in a thread, so that the worker goes on to say it is there
        return await asyncio.to_thread(work, message)

    dask_worker.handlers.setdefault(_STEPS, do)


@contextmanager
def _expecting_answer(address: str) -> Iterator[None]:
    """Turn errors of a scheduler that may have gone into `ServiceError`."""
    from distributed import CancelledError

    try:
        yield
    except (OSError, RuntimeError, LookupError, CancelledError) as error:
        raise ServiceError(
            f"The connection to the scheduler at {address} was lost "
            f"({type(error).__name__}: {error}); start it and try again."
        ) from error
