"""Workers of a Dask cluster: each holds the shards open that it was asked for before."""

from __future__ import annotations

from contextlib import contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import version
from time import monotonic
from typing import TYPE_CHECKING, Any, Self
from zlib import crc32

from placegraph.errors import MissingExtraError, ServiceError
from placegraph.world.shards.workers import Holder, Lost

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from distributed import Client, Future

    from placegraph.world.shards.workers import Task

PATIENCE = 10.0
"""A scheduler that does not answer for so long is not there [s]."""
LOOK = 2.0
"""Where no task was done for so long, it is looked whether all workers are there [s]."""
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
        there = self._workers()
        asked = {self._sent(step, task, there): row for row, task in enumerate(tasks)}
        try:
            while asked:
                left = LOOK if deadline is None else min(LOOK, deadline - monotonic())
                with suppress(TimeoutError):
                    for future in as_completed(
                        [*asked], loop=self.client.loop, timeout=max(left, 0.0)
                    ):
                        result = _result(future, tasks[asked[future]], self.address)
                        yield asked.pop(future), result
                if deadline is not None and monotonic() > deadline:
                    return
                if asked and there != (there := self._workers()):  # what waits for one that is gone
                    self.client.cancel([*asked])
                    asked = {self._sent(step, tasks[row], there): row for row in asked.values()}
        finally:
            if self.client.status == "running":
                self.client.cancel([*asked])

    def _workers(self) -> list[str]:
        """Addresses of all workers that are there now."""
        with _answering(self.address):
            return sorted(self.client.scheduler_info(n_workers=-1)["workers"])

    def _sent(self, step: str, task: Task, workers: Sequence[str]) -> Future[Any]:
        favourite = _favourite(task.source.key, workers)
        with _answering(self.address):
            return self.client.submit(_done, step, task, pure=False, retries=1, **favourite)

    def close(self) -> None:
        """Leave the cluster; its workers stay."""
        self.client.close()


def _favourite(key: str, workers: Sequence[str]) -> dict[str, Any]:
    """The worker that holds a shard open if any does: the same one as long as it is there."""
    if not workers:  # none is known for a moment, as where all are being replaced
        return {}
    best = max(workers, key=lambda worker: crc32(f"{key} {worker}".encode()))
    return {"workers": [best], "allow_other_workers": True}


def _done(step: str, task: Task) -> Any:  # noqa: ANN401
    """Do a step in the worker, with the shards that it holds."""
    from distributed import get_worker

    worker = get_worker()
    holder = getattr(worker, _HOLDER, None)
    if holder is None:
        holder = Holder()
        setattr(worker, _HOLDER, holder)
    return holder.do(step, task)


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


def _result(future: Future[Any], task: Task, address: str) -> Any:  # noqa: ANN401
    """What came of a task; `Lost` where all its workers ended, as one does that is out of memory."""
    from distributed import CancelledError, KilledWorker

    with _answering(address):
        error = future.exception()
        if error is None:
            return future.result()
        if isinstance(error, CancelledError):
            raise error
    if isinstance(error, KilledWorker | MemoryError):
        return Lost(
            f"{task.source.path}: every worker that opened it ended ({type(error).__name__}); give workers "
            "more memory."
        )
    raise error
