"""Work in fresh processes, so that its memory and its compiling are its own."""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any


def apart(work: Callable[..., Any], *given: object, cores: int = 0) -> Any:  # noqa: ANN401
    """Run a function in a fresh process that has seen only some cores from its start; 0: all."""
    mine = os.sched_getaffinity(0)
    if cores:
        os.sched_setaffinity(0, sorted(mine)[:cores])
    try:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            return pool.submit(work, *given).result()
    finally:
        os.sched_setaffinity(0, mine)


def peak() -> int:
    """Largest memory of this process so far [bytes]."""
    status = Path("/proc/self/status")
    if status.exists():  # what `getrusage` says begins with what its parent held
        told = dict(line.split(":", 1) for line in status.read_text().splitlines())
        return 1024 * int(told["VmHWM"].split()[0])
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
