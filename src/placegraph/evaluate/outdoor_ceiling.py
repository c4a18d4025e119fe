"""The ceiling: how often the true place fits a query best, ties broken at random.

It knows the generator's own objects and reads no text. A place's fit is the number of statements
for which some pair of objects in sight of a viewpoint there is as the statement says.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from placegraph.evaluate.outdoor_baselines import spoken, words_around
from placegraph.evaluate.outdoor_queries import CELL, SIGHT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.evaluate.outdoor_baselines import Words
    from placegraph.evaluate.outdoor_nearby import Bins, Position
    from placegraph.evaluate.outdoor_queries import Query
    from placegraph.evaluate.outdoor_raw import Ints
    from placegraph.geometry import Floats

STEP = 12.5
"""Edge of the grid of viewpoints that compete with the truth [m]."""
CHUNK = 50_000
"""Viewpoints looked at in one go: keeps memory small."""


@dataclass(frozen=True)
class Ceiling:
    """Places that fit better than the true one, and those that fit as well, for each query."""

    better: Ints
    """(Q,)"""
    tied: Ints
    """(Q,) the true place not counted."""

    def recall(self, k: int) -> float:
        """Share of queries whose true place is among the first k, ties broken at random."""
        room = np.maximum(k - self.better, 0)
        return float(np.minimum(room / (self.tied + 1), 1.0).mean())


@dataclass(frozen=True)
class Contest:
    """Which viewpoints of a city serve which statements of a set of queries."""

    asked: Ints
    """(A,) statements (words) of all queries, one query after the other."""
    asked_starts: Ints
    """(Q + 1,)"""
    served_starts: Ints
    """(W + 1,) viewpoints that serve a statement."""
    served: NDArray[np.int32]
    own: Ints
    """(Q,) statements that hold at the true viewpoint itself."""
    truth: Floats
    """(Q, 2) true viewpoints, in steps of the grid."""
    column: NDArray[np.int32]
    """(V, 2) viewpoints, in steps of the grid."""
    square: NDArray[np.int32]
    """Viewpoint of every square of the grid, -1 where there is none."""
    step: float

    @classmethod
    def of(
        cls,
        bins: Bins,
        queries: Sequence[Query],
        *,
        position: Position = "nearest",
        names: bool = False,
        step: float = STEP,
    ) -> Contest:
        """Look at all viewpoints of a grid over the city.

        Parameters
        ----------
        queries
            All about pairs of objects, or all about the speaker.
        position, names
            As the queries were made (`make_queries`).
        step
            Edge of the grid [m]: 50 / step is a whole number.
        """
        city = bins.city
        label = city.named if names else city.label
        number = {name: i for i, name in enumerate(city.labels)}
        kind: Words = "triples" if queries[0].said[0].target else "speaker"
        wanted = [spoken(q, kind, number) for q in queries]
        known = np.unique(np.concatenate(wanted))
        truth = city.plane.to_plane([(q.longitude, q.latitude) for q in queries])

        def holding(viewpoints: Floats) -> tuple[Ints, Ints]:
            """Viewpoint and word of everything that a query asks for."""
            around = bins.around(viewpoints, SIGHT, position)
            at, word = words_around(kind, viewpoints, around, label, len(city.labels), SIGHT)
            asked = np.minimum(np.searchsorted(known, word), len(known) - 1)
            hit = known[asked] == word
            pairs = np.unique(np.stack([asked[hit], at[hit]]), axis=1)
            return pairs[1], pairs[0]

        grid = bins.centers(step)
        found = [holding(grid[i : i + CHUNK]) for i in range(0, len(grid), CHUNK)]
        at = np.concatenate([v + i * CHUNK for i, (v, _) in enumerate(found)])
        word = np.concatenate([w for _, w in found])
        order = np.argsort(word, kind="stable")
        own_at, own_word = holding(truth)
        own_at, own_word = own_at[np.argsort(own_at)], own_word[np.argsort(own_at)]
        own_starts = np.searchsorted(own_at, np.arange(len(queries) + 1))
        column = np.round((grid - bins.low) / step - 0.5).astype(np.int32)
        square = np.full(column.max(0) + 1, -1, np.int32)
        square[column[:, 0], column[:, 1]] = np.arange(len(grid))
        return cls(
            asked=np.concatenate([np.searchsorted(known, w) for w in wanted]),
            asked_starts=np.concatenate([[0], np.cumsum([len(w) for w in wanted])]),
            served_starts=np.searchsorted(word[order], np.arange(len(known) + 1)),
            served=at[order].astype(np.int32),
            own=np.array(
                [
                    np.isin(known[own_word[own_starts[q] : own_starts[q + 1]]], w).sum()
                    for q, w in enumerate(wanted)
                ]
            ),
            truth=(truth - bins.low) / step - 0.5,
            column=column,
            square=square,
            step=step,
        )

    def ceiling(self, apart: float | None = 50.0) -> Ceiling:
        """Rank the true place of every query among all places of the city.

        `apart`: a place is whatever lies within this distance of one viewpoint [m], and no two
        competitors are nearer to each other. None: a place is a 50 m cell.
        """
        counts = _rank(
            (self.asked, self.asked_starts),
            (self.served_starts, self.served),
            (self.column, self.square),
            self.own,
            self.truth,
            (CELL if apart is None else apart) / self.step,
            apart is None,
        )
        return Ceiling(better=counts[:, 0], tied=counts[:, 1])


@njit(cache=True)
def _same_place(a: Floats, b: Floats, apart: float, by_cell: bool) -> bool:
    """Whether two viewpoints (2,), in steps of the grid, are one place."""
    if by_cell:  # squares are numbered by their centres: cells begin half a step earlier
        same = np.floor((a + 0.5) / apart) == np.floor((b + 0.5) / apart)
        return bool(same[0] and same[1])
    return bool((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 <= apart * apart)


@njit(cache=True)
def _rank(
    statements: tuple[Ints, Ints],
    postings: tuple[Ints, NDArray[np.int32]],
    squares: tuple[NDArray[np.int32], NDArray[np.int32]],
    own: Ints,
    truth: Floats,
    apart: float,
    by_cell: bool,
) -> Ints:
    """Places (Q, 2) with a better and with the same score as the true one, best first, greedily."""
    asked, asked_starts = statements
    starts, at = postings
    column = squares[0]
    counts = np.zeros((len(own), 2), np.int64)
    score = np.zeros(len(column), np.int16)
    for q in range(len(own)):
        words = asked[asked_starts[q] : asked_starts[q + 1]]
        for w in words:
            score[at[starts[w] : starts[w + 1]]] += 1
        rivals, best = [0 for _ in range(0)], own[q]
        for w in words:
            for v in at[starts[w] : starts[w + 1]]:
                if score[v] >= max(best, 1):
                    if _same_place(column[v].astype(np.float64), truth[q], apart, by_cell):
                        best = max(best, score[v])
                    else:
                        rivals.append(v)
        for level in range(len(words), max(best, 1) - 1, -1):
            places = _take_places(rivals, level, score, squares, apart, by_cell)
            counts[q, 0 if level > best else 1] += places
        for w in words:
            score[at[starts[w] : starts[w + 1]]] = 0
    return counts


@njit(cache=True)
def _take_places(
    rivals: list[int],
    level: int,
    score: NDArray[np.int16],
    squares: tuple[NDArray[np.int32], NDArray[np.int32]],
    apart: float,
    by_cell: bool,
) -> int:
    """Count the places whose score is `level`, and set the score of all their viewpoints to 0."""
    column, square = squares
    reach, places = int(apart), 0
    for v in rivals:
        if score[v] != level:
            continue
        places += 1
        here = column[v].astype(np.float64)
        for i in range(max(column[v, 0] - reach, 0), min(column[v, 0] + reach + 1, len(square))):
            last = min(column[v, 1] + reach + 1, square.shape[1])
            for other in square[i, max(column[v, 1] - reach, 0) : last]:
                there = column[other].astype(np.float64)
                if other >= 0 and _same_place(here, there, apart, by_cell):
                    score[other] = 0
    return places
