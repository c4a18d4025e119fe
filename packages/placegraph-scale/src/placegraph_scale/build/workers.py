"""Who does the tasks of a build: this process, processes of this machine, or a Dask cluster.

A task is a function and one argument, both of which can be sent; it writes its files in one step, so
that it can be done again wherever its worker was killed.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import get_context
from typing import Any, TypeVar

from placegraph.core.threads import end_with_parent
from placegraph.errors import MapError, OptionError, ServiceError
from placegraph_scale.shards.cluster import connected

Task = TypeVar("Task")
Made = TypeVar("Made")


TRIES = 3
"""A task is given up when so many of its workers were killed."""


def done(
    work: Callable[[Task], Made], tasks: Sequence[Task], workers: int, scheduler: str | None = None
) -> Generator[tuple[int, Made]]:
    """Numbers and results of all tasks, in the order in which they are done; close it if you leave it.

    Parameters
    ----------
    work
        Function of a module, so that other processes find it.
    tasks
        What it is called with, once each; again where a worker was killed.
    workers
        Processes of this machine; 1: this one itself.
    scheduler
        Address of a Dask scheduler (``tcp://host:port``), whose workers do it instead.

    Raises
    ------
    MissingExtraError
        Dask is wanted, and not installed.
    MapError
        A task's worker was killed again and again.
    OptionError
        `workers` is less than 1.
    ServiceError
        The scheduler does not answer, or is of another version.

    """
    if workers < 1:
        raise OptionError(f"workers is {workers}; give at least 1.")
    if scheduler is not None:
        return _on_cluster(work, tasks, scheduler)
    if workers == 1 or len(tasks) < 2:
        return (pair for pair in enumerate(map(work, tasks)))
    return _in_processes(work, tasks, workers)


def _in_processes(
    work: Callable[[Task], Made], tasks: Sequence[Task], workers: int
) -> Generator[tuple[int, Made]]:
    """Results from processes of this machine; new ones take the place of those that were killed."""
    left, killed = dict(enumerate(tasks)), 0
    while left:
        before = len(left)
        try:
            with ProcessPoolExecutor(workers, get_context("spawn"), end_with_parent) as pool:
                try:
                    for number, result in _answers(pool, work, left, workers):
                        del left[number]
                        yield number, result
                except BaseException:
                    pool.shutdown(wait=False, cancel_futures=True)
                    raise
        except BrokenProcessPool as error:
            killed = killed + 1 if len(left) == before else 1
            if killed == TRIES:
                raise _killed(next(iter(left.values())), "Give fewer --workers") from error


def _answers(
    pool: ProcessPoolExecutor, work: Callable[[Task], Made], tasks: dict[int, Task], workers: int
) -> Iterator[tuple[int, Made]]:
    """Numbers and results; few wait in the pool at a time, so that the first that fails ends it."""
    rest = iter(list(tasks.items()))
    waiting = {pool.submit(work, task): n for n, task in islice(rest, 2 * workers)}
    while waiting:
        ready, _ = wait(waiting, return_when=FIRST_COMPLETED)
        for future in ready:
            number = waiting.pop(future)
            for n, task in islice(rest, 1):
                waiting[pool.submit(work, task)] = n
            yield number, future.result()


def _on_cluster(
    work: Callable[[Task], Made], tasks: Sequence[Task], scheduler: str
) -> Generator[tuple[int, Made]]:
    """Results from the workers of a Dask scheduler, which gives a killed one's tasks to others."""
    client = connected(scheduler)
    import distributed

    try:
        rest = iter(enumerate(tasks))
        running, numbers = distributed.as_completed(loop=client.loop), {}

        def start(most: int) -> None:
            for n, task in islice(rest, most):
                future = client.submit(work, task, pure=False)
                numbers[future.key] = n
                running.add(future)

        start(4 * max(1, len(client.scheduler_info(n_workers=-1)["workers"])))
        for future in running:
            result = _result(distributed, future)
            start(1)
            yield numbers.pop(future.key), result
    finally:
        client.close()


def _result(distributed: Any, future: Any) -> Any:  # noqa: ANN401  # Dask has no types
    try:
        return future.result()
    except distributed.scheduler.KilledWorker as error:
        raise _killed(future.key, "Give workers more memory") from error
    except (distributed.CancelledError, distributed.comm.CommClosedError) as error:
        raise ServiceError(
            f"The scheduler went away ({error}); start it and the same command again, which goes on "
            "where it stopped."
        ) from error


def _killed(task: object, mend: str) -> MapError:
    key = getattr(task, "key", task)
    return MapError(
        f"{key}, or a task beside it: its worker was killed {TRIES} times, as it is where memory is "
        f"short. {mend}, or choose a higher --zoom (smaller tiles); what is finished stays."
    )
