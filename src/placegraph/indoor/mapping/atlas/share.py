"""Compiled loops on several threads."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import TYPE_CHECKING

import numba

from placegraph.indoor.rays.embree import processors

if TYPE_CHECKING:
    from collections.abc import Callable


def share(work: Callable[..., None], count: int, *inputs: object) -> None:
    """Call `work(*inputs, first, last)` for parts of 0 to `count`, on as many threads as numba takes.

    `work` is compiled, lets go of the interpreter's lock, and writes to what is its own.
    """
    threads = min(processors(), numba.get_num_threads())
    # more parts than threads, since some are quicker than others
    parts = max(min(8 * threads, count), 1) if threads > 1 else 1
    ends = [count * part // parts for part in range(parts + 1)]
    with ThreadPoolExecutor(threads) as pool:
        for job in [pool.submit(work, *inputs, first, last) for first, last in pairwise(ends)]:
            job.result()
