"""Compiled loops on several threads, and matrix products on as many as help.

Numba's own parallel loops are not used: they take twice as long to compile, two of them at once end
the process on some machines, and so does one after a fork.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from itertools import pairwise
from multiprocessing import parent_process
from threading import Thread
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import OptionError

SINGLE_THREAD_TERMS = 1 << 18
"""Largest matrix product that OpenBLAS computes on one thread [terms]."""
PARALLEL_TERMS = 1 << 26
"""Smallest matrix product that is worth waking threads of OpenBLAS, which wait busily [terms]."""
_MAX_THREADS: ContextVar[int | None] = ContextVar("max_threads", default=None)


def count_processors() -> int:
    """Return the number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def end_with_parent() -> None:
    """End this process when its parent ends, even if the parent is killed."""
    parent = parent_process()
    if parent is None:
        return

    def wait_and_exit() -> None:
        parent.join()
        os._exit(1)

    Thread(target=wait_and_exit, daemon=True).start()


@contextmanager
def limit_threads(max_threads: int) -> Iterator[None]:
    """Limit `run_parallel` in the body to so many threads; by default it takes all processors."""
    if max_threads < 1:
        raise OptionError(f"max_threads is {max_threads}; give at least 1 thread.")
    token = _MAX_THREADS.set(max_threads)
    try:
        yield
    finally:
        _MAX_THREADS.reset(token)


def run_parallel(work: Callable[..., None], count: int, *inputs: object) -> None:
    """Call `work(*inputs, first, last)` for parts of the range 0 to `count`, on several threads.

    `work` is a kernel that releases the interpreter's lock; parts must not write to the same data.
    """
    threads = min(_MAX_THREADS.get() or count_processors(), count_processors(), max(count, 1))
    if threads == 1:
        work(*inputs, 0, count)
        return
    # more parts than threads, since some are quicker than others
    parts = min(8 * threads, count)
    remaining = iter(list(pairwise(count * part // parts for part in range(parts + 1))))

    def take_parts() -> None:
        for first, last in remaining:
            work(*inputs, first, last)

    pool = _thread_pool(os.getpid())
    jobs = [pool.submit(take_parts) for _ in range(threads - 1)]
    take_parts()
    for job in jobs:
        if not job.cancel():  # a job that has not begun would find nothing left
            job.result()


def multiply_matrices(x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
    """Return the product (N, M) of x (N, K) and y (K, M), on one thread unless it is large."""
    rows = max(1, SINGLE_THREAD_TERMS // max(1, y.size))
    if len(x) <= rows or len(x) * y.size >= PARALLEL_TERMS:
        return np.asarray(x @ y)
    out = np.empty((len(x), y.shape[1]), np.result_type(x, y))
    for first in range(0, len(x), rows):
        np.matmul(x[first : first + rows], y, out=out[first : first + rows])
    return out


@cache
def _thread_pool(_process: int) -> ThreadPoolExecutor:
    """Return the threads of this process: starting one takes as long as a small loop."""
    return ThreadPoolExecutor(max(count_processors() - 1, 1), thread_name_prefix="placegraph")
