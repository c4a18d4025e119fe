"""How sure a difference is that was measured on the same queries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

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

    Parameters
    ----------
    pairs
        For every group (city) the values (n,) of both methods on the same queries. Queries are
        drawn anew within each group, both values of a query together; groups weigh the same.

    Raises
    ------
    OptionError
        Where values are missing, or not of the same queries.
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
