"""How well a query can be answered at all, by someone who knows the generator's own objects.

Two bounds, neither of which reads text. The ceiling counts, at every viewpoint, the statements for
which some pair of objects in sight is as said, and breaks ties at random. The oracle also knows
how the generator draws: where little could be said, what was said is more likely to be said.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from placegraph.core.geometry import Floats
from placegraph_lab.tables.outdoor.ceiling_kernels import _likeliest, _rank
from placegraph_lab.tables.outdoor.contest import Contest
from placegraph_lab.tables.outdoor.queries import CELL, NOISE
from placegraph_lab.tables.outdoor.raw import Ints

MODE = 45.0
"""The oracle sums the probability of viewpoints within this distance of a place's middle [m]."""


SLIP = 0.05
"""Share of wrong directions that the oracle expects of noise-free texts: its viewpoints stand on
a grid, a few metres from the true one."""


@dataclass(frozen=True)
class Ceiling:
    """Places that fit better than the true one, and others that fit as well, for each query."""

    better: Ints
    """(Q,)"""
    tied: Ints
    """(Q,)"""

    def recall(self, k: int) -> float:
        """Share of queries whose true place is among the first k, ties broken at random."""
        room = np.maximum(k - self.better, 0)
        return float(np.minimum(room / (self.tied + 1), 1.0).mean())


def ceiling(contest: Contest, apart: float | None = 50.0) -> Ceiling:
    """Rank the true place of every query among all places of the city.

    `apart`: a place is whatever lies within this distance of one viewpoint [m], and no two
    competitors are nearer to each other. None: a place is a 50 m cell.
    """
    counts = _rank(
        (contest.asked[:, 0], contest.asked_starts),
        (contest.served_starts, contest.served),
        (contest.column, contest.square),
        contest.own,
        contest.truth,
        (CELL if apart is None else apart) / contest.step,
        apart is None,
    )
    return Ceiling(better=counts[:, 0], tied=counts[:, 1])


def oracle(contest: Contest, *, replaced: bool = False, top: int = 5) -> Floats:
    """Distances (Q, top) [m] from the truth to the places that the generator most likely meant.

    The likelihood of a statement at a viewpoint where U different ones can be made is 1 / U if it
    is one of them. Of wrong directions it expects `NOISE` where relations were replaced.
    """
    return contest.step * _likeliest(
        (contest.asked, contest.asked_starts),
        (contest.served_starts, contest.served),
        (contest.column, contest.square),
        contest.sayable,
        contest.truth,
        (NOISE if replaced else SLIP, MODE / contest.step, CELL / contest.step),
        top,
    )
