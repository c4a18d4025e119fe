"""Compiled loops on several threads, and matrix products on one where more would only wait.

A loop is one range, cut into parts that write to what is their own.

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
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import OptionError

if TYPE_CHECKING:
    from multiprocessing.process import BaseProcess


SINGLE_THREAD_TERMS = 1 << 18
"""Terms of a matrix product that OpenBLAS reckons on one thread."""
PARALLEL_TERMS = 1 << 26
"""Terms from which threads of OpenBLAS are worth waking: they wait busily for each other."""
_MOST: ContextVar[int | None] = ContextVar("most", default=None)


def count_processors() -> int:
    """Processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def end_with_parent() -> None:
    """Let this process end with the one that started it, which may be killed: a pool would wait on."""

    def end(parent: BaseProcess) -> None:
        parent.join()
        os._exit(1)

    if (parent := parent_process()) is not None:
        Thread(target=end, args=(parent,), daemon=True).start()


@contextmanager
def limit_threads(most: int) -> Iterator[None]:
    """Within it, `run_parallel` takes at most so many threads; it takes all processors otherwise."""
    if most < 1:
        raise OptionError(f"most is {most}; give at least 1 thread.")
    token = _MOST.set(most)
    try:
        yield
    finally:
        _MOST.reset(token)


def run_parallel(work: Callable[..., None], count: int, *inputs: object) -> None:
    """Call `work(*inputs, first, last)` for parts of 0 to `count`, on several threads.

    `work` is compiled, lets go of the interpreter's lock, and writes to what is its own.
    """
    threads = min(_MOST.get() or count_processors(), count_processors(), max(count, 1))
    if threads == 1:
        work(*inputs, 0, count)
        return
    # more parts than threads, since some are quicker than others
    parts = min(8 * threads, count)
    rest = iter(list(pairwise(count * part // parts for part in range(parts + 1))))

    def take_parts() -> None:
        for first, last in rest:
            work(*inputs, first, last)

    pool = _helpers(os.getpid())
    helpers = [pool.submit(take_parts) for _ in range(threads - 1)]
    take_parts()
    for helper in helpers:
        if not helper.cancel():  # one that has not begun would find nothing left
            helper.result()


def multiply_matrices(x: NDArray[Any], y: NDArray[Any]) -> NDArray[Any]:
    """Matrix product (N, M) of x (N, K) and y (K, M), on one thread unless it is a large one."""
    rows = max(1, SINGLE_THREAD_TERMS // max(1, y.size))
    if len(x) <= rows or len(x) * y.size >= PARALLEL_TERMS:
        return np.asarray(x @ y)
    out = np.empty((len(x), y.shape[1]), np.result_type(x, y))
    for first in range(0, len(x), rows):
        np.matmul(x[first : first + rows], y, out=out[first : first + rows])
    return out


@cache
def _helpers(_process: int) -> ThreadPoolExecutor:
    """Threads of this process, kept: starting one takes as long as a small loop."""
    return ThreadPoolExecutor(max(count_processors() - 1, 1), thread_name_prefix="placegraph")
