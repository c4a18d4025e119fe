"""Workers of a Dask cluster: each holds the shards open that it was asked for before."""

from __future__ import annotations

from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from time import monotonic
from typing import TYPE_CHECKING, Any, Self
from zlib import crc32

from placegraph.errors import MissingExtraError, ServiceError
from placegraph.world.shards.workers import Alone, Holder, Lost

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from distributed import Client, Future

    from placegraph.world.shards.workers import Task

PATIENCE = 10.0
"""A scheduler that does not answer for so long is not there [s]."""
LOOK = 2.0
"""Where no task was done for so long, it is looked whether all workers are there [s]."""
BEGIN = 0.8
"""In this share of the time that is left a worker begins with shards: what it tells is to be in time."""
_HOLDER = "_placegraph_shards"


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
    """Workers of a cluster; a task whose worker ends is done by another one."""

    client: Client
    address: str
    _there: list[str] = field(default_factory=list)
    """Workers when they were last asked for ..."""
    _seen: float = 0.0
    """... and when that was [s]."""

    @classmethod
    def at(cls, address: str) -> Self:
        """Cluster of a scheduler; raises as `connected`."""
        return cls(connected(address, PATIENCE), address)

    def each(
        self, step: str, tasks: Sequence[Task], deadline: float | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Row and result of tasks, as they are done; `ServiceError` where the scheduler is gone."""
        from distributed import as_completed

        if self.client.status == "closed":  # the scheduler went away, and may have come again
            self.client = connected(self.address, PATIENCE)
            self._seen = 0.0
        there = self._workers()
        asked = self._sent(step, tasks, range(len(tasks)), there, deadline)
        try:
            while asked:
                left = LOOK if deadline is None else min(LOOK, deadline - monotonic())
                alone: list[int] = []
                with suppress(TimeoutError):
                    for future in as_completed(
                        [*asked], loop=self.client.loop, timeout=max(left, 0.0)
                    ):
                        rows = asked.pop(future)
                        results = _result(future, [tasks[row] for row in rows], self.address)
                        if results is None:
                            alone += rows
                        else:
                            yield from zip(rows, results, strict=False)  # fewer where it was late
                if deadline is not None and monotonic() > deadline:
                    return
                for row in alone:  # one of them ends workers
                    asked |= self._sent(step, tasks, [row], there, deadline)
                if asked and there != (
                    there := self._workers(0.0)
                ):  # some wait for one that is gone
                    self.client.cancel([*asked])
                    left_over = [row for rows in asked.values() for row in rows]
                    asked = self._sent(step, tasks, left_over, there, deadline)
        finally:
            if self.client.status == "running" and asked:
                self.client.cancel([*asked])

    def _workers(self, age: float = LOOK) -> list[str]:
        """Addresses of all workers that are there now, or were no longer ago [s]."""
        if monotonic() - self._seen >= age:
            with _answering(self.address):
                self._there = sorted(self.client.scheduler_info(n_workers=-1)["workers"])
            self._seen = monotonic()
        return self._there

    def _sent(
        self, step: str, tasks: Sequence[Task], rows: Iterable[int], workers: Sequence[str],
        deadline: float | None,
    ) -> dict[Future[Any], list[int]]:  # fmt: skip
        """Rows of tasks by what each worker was sent: all of its tasks at once."""
        of: dict[str, list[int]] = {}
        for row in rows:
            of.setdefault(_favourite(tasks[row].source.key, workers), []).append(row)
        seconds = None if deadline is None else BEGIN * max(0.0, deadline - monotonic())
        with _answering(self.address):
            return {
                self.client.submit(
                    _done, _Batch(step, [tasks[row] for row in mine], seconds), pure=False, retries=1,
                    **({"workers": [worker], "allow_other_workers": True} if worker else {}),
                ): mine
                for worker, mine in of.items()
            }  # fmt: skip

    def close(self) -> None:
        """Leave the cluster; its workers stay."""
        self.client.close()


@dataclass(frozen=True, slots=True)
class _Batch:
    """A step in all shards of a worker; what they are told alike travels once."""

    step: str
    tasks: list[Task]
    seconds: float | None
    """After which no more is begun."""


def _favourite(key: str, workers: Sequence[str]) -> str:
    """The worker that holds a shard open if any does: the same one as long as it is there.

    Empty where none is known for a moment, as where all are being replaced.
    """
    return max(workers, key=lambda worker: crc32(f"{key} {worker}".encode()), default="")


def _done(batch: _Batch) -> list[Any]:
    """Do a step in the worker, with the shards that it holds; fewer where the time is over."""
    from distributed import get_worker

    worker = get_worker()
    holder = getattr(worker, _HOLDER, None)
    if holder is None:
        holder = Holder()
        setattr(worker, _HOLDER, holder)
    deadline = None if batch.seconds is None else monotonic() + batch.seconds
    return [result for _, result in Alone(holder).each(batch.step, batch.tasks, deadline)]


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


def _result(future: Future[Any], tasks: Sequence[Task], address: str) -> list[Any] | None:
    """What came of tasks; `Lost` where all workers ended, as one does that is out of memory.

    None where these were several: each is to be tried alone.
    """
    from distributed import CancelledError, KilledWorker

    with _answering(address):
        error = future.exception()
        if error is None:
            found: list[Any] = future.result()
            return found
        if isinstance(error, CancelledError):
            raise error
    if not isinstance(error, KilledWorker | MemoryError):
        raise error
    if len(tasks) > 1:
        return None
    return [
        Lost(
            f"{task.source.path}: every worker that opened it ended ({type(error).__name__}); give workers "
            "more memory."
        )
        for task in tasks
    ]
