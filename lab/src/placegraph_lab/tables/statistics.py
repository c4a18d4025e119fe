"""Statistics of answers, and work in fresh processes."""

from __future__ import annotations

import os
import resource
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from math import sqrt
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from placegraph.core.geometry import Floats
from placegraph.errors import OptionError


class Interval(NamedTuple):
    """A mean and the interval that holds it."""

    mean: float
    low: float
    high: float


def paired_interval(
    pairs: Sequence[tuple[ArrayLike, ArrayLike]],
    rng: Generator,
    *,
    level: float = 0.95,
    rounds: int = 5000,
) -> Interval:
    """Bootstrap interval of the mean difference first - second.

    `pairs`: for every group (city) the values (n,) of both methods on the same queries. Queries are
    drawn anew within each group, both values of a query together; groups weigh the same.
    """
    means, drawn = [], []
    for first, second in pairs:
        a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
        if a.ndim != 1 or a.shape != b.shape or not len(a):
            raise OptionError(f"Values of shapes {a.shape} and {b.shape} are not of one list.")
        delta = a - b
        means.append(delta.mean())
        rows = rng.integers(len(delta), size=(rounds, len(delta)))
        drawn.append(delta[rows].mean(axis=1))
    if not means:
        raise OptionError("There is nothing to compare.")
    tail = 0.5 * (1.0 - level)
    low, high = np.quantile(np.mean(drawn, axis=0), (tail, 1.0 - tail))
    return Interval(float(np.mean(means)), float(low), float(high))


def recall_interval(
    groups: Sequence[ArrayLike], rng: Generator, *, level: float = 0.95, rounds: int = 5000
) -> Interval:
    """Bootstrap interval of a recall over seeds and queries.

    `groups`: for every group (city) whether each of S seeds found the answer of each query (S, n).
    Seeds are drawn anew, the same ones for all groups, and queries within each group; groups weigh the
    same.
    """
    hits = [np.asarray(group, np.float64) for group in groups]
    seeds = rng.integers(len(hits[0]), size=(rounds, len(hits[0])))
    drawn = []
    for group in hits:
        rows = rng.integers(group.shape[1], size=(rounds, group.shape[1]))
        drawn.append([group[s].mean(axis=0)[q].mean() for s, q in zip(seeds, rows, strict=True)])
    tail = 0.5 * (1.0 - level)
    low, high = np.quantile(np.mean(drawn, axis=0), (tail, 1.0 - tail))
    return Interval(float(np.mean([group.mean() for group in hits])), float(low), float(high))


def wilson_interval(share: float, count: int) -> Interval:
    """Wilson's 95 % interval of a share among `count` independent trials."""
    z = 1.959964
    centre = (share + 0.5 * z * z / count) / (1.0 + z * z / count)
    spread = (
        z / (1.0 + z * z / count) * sqrt(share * (1.0 - share) / count + (0.5 * z / count) ** 2)
    )
    return Interval(share, max(0.0, centre - spread), min(1.0, centre + spread))


ROUNDING = 1e-6  # how far a sum of probabilities may stray from 0 to 1


@dataclass(frozen=True)
class Reliability:
    """Bins of equal mass, from the least to the most confident."""

    count: Floats  # (B,) answers in a bin
    confidence: Floats  # (B,) mean confidence
    accuracy: Floats  # (B,) share that is right

    @property
    def error(self) -> float:
        gap = np.abs(self.accuracy - self.confidence)
        return float(np.average(gap, weights=self.count))

    @property
    def floor(self) -> float:
        """Error that answers with these confidences would show if perfectly calibrated.

        The mean of a bin of n answers scatters by sqrt(p (1 - p) / n); the mean absolute value
        of a normal deviate is sqrt(2 / pi).
        """
        sure = np.clip(self.confidence, 0.0, 1.0)
        spread = np.sqrt(sure * (1.0 - sure) / self.count)
        return float(np.average(np.sqrt(2.0 / np.pi) * spread, weights=self.count))


def reliability(confidence: ArrayLike, right: ArrayLike, bins: int = 10) -> Reliability:
    """Sort answers by confidence (N,) in [0, 1] into bins of equal mass; `right` (N,) is bool."""
    sure, true = np.asarray(confidence, np.float64), np.asarray(right, np.float64)
    if sure.ndim != 1 or sure.shape != true.shape or not len(sure) or bins < 1:
        raise OptionError("Calibration needs at least one answer, a confidence each, and a bin.")
    if not ((sure >= -ROUNDING) & (sure <= 1.0 + ROUNDING)).all():
        raise OptionError("A confidence lies outside 0 to 1; give probabilities.")
    order = np.argsort(sure, kind="stable")
    parts = [part for part in np.array_split(order, bins) if len(part)]
    return Reliability(
        count=np.array([len(part) for part in parts], np.float64),
        confidence=np.array([sure[part].mean() for part in parts]),
        accuracy=np.array([true[part].mean() for part in parts]),
    )


def run_apart(work: Callable[..., Any], *given: object, cores: int = 0) -> Any:
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
