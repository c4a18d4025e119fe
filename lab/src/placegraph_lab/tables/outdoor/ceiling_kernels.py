# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `ceiling`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.jit import kernel
from placegraph_lab.tables.outdoor.raw import Ints

UNSAID = 5e-5
"""Probability of a statement that the generator would not make at a viewpoint."""


@kernel
def _same_place(a: Floats, b: Floats, apart: float, by_cell: bool) -> bool:
    """Whether two viewpoints (2,), in steps of the grid, are one place."""
    if by_cell:  # squares are numbered by their centres: cells begin half a step earlier
        same = np.floor((a + 0.5) / apart) == np.floor((b + 0.5) / apart)
        return bool(same[0] and same[1])
    return bool((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 <= apart * apart)


@kernel
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


@kernel
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


@kernel
def _likeliest(
    statements: tuple[Ints, Ints],
    postings: tuple[Ints, NDArray[np.int32]],
    squares: tuple[NDArray[np.int32], NDArray[np.int32]],
    sayable: NDArray[np.int32],
    truth: Floats,
    scale: tuple[float, float, float],
    top: int,
) -> Floats:
    asked, asked_starts = statements
    column = squares[0]
    wrong, reach, apart = scale
    distance = np.full((len(truth), top), np.inf)
    once, gain = np.zeros(len(column)), np.zeros(len(column))
    for q in range(len(truth)):
        for words in asked[asked_starts[q] : asked_starts[q + 1]]:
            _hear(words, postings, sayable, wrong, once, gain)
        best = gain.max()
        likely = np.flatnonzero(gain > max(best - 12.0, 0.0))  # the rest has no weight to speak of
        likely = likely[np.argsort(-gain[likely])[:2000]]
        weight = np.exp(gain - best) * (gain > 0.0)
        for k in range(top):
            mass = np.array([_mass(v, weight, squares, reach, False) for v in likely])
            if not len(mass) or mass.max() == 0.0:
                break
            middle = likely[np.argmax(mass)]
            delta = column[middle] - truth[q]
            distance[q, k] = np.hypot(delta[0], delta[1])
            _mass(middle, weight, squares, apart, True)
        gain[:] = 0.0
    return distance


@kernel
def _hear(
    words: Ints,
    postings: tuple[Ints, NDArray[np.int32]],
    sayable: NDArray[np.int32],
    wrong: float,
    once: Floats,
    gain: Floats,
) -> None:
    """Add a statement's log-likelihood, above `UNSAID`, to the viewpoints that could mean it."""
    starts, at = postings
    for d in range(len(words)):
        share = 1.0 - wrong if d == 0 else wrong / (len(words) - 1)
        for v in at[starts[words[d]] : starts[words[d] + 1]]:
            once[v] += share / sayable[v]
    for word in words:
        for v in at[starts[word] : starts[word + 1]]:
            gain[v] += np.log1p(once[v] / UNSAID)
            once[v] = 0.0


@kernel
def _mass(
    v: np.int64,
    weight: Floats,
    squares: tuple[NDArray[np.int32], NDArray[np.int32]],
    apart: float,
    clear: bool,
) -> float:
    """Sum of the weights within `apart` steps of a viewpoint; set them to 0 with `clear`."""
    column, square = squares
    reach, total = int(apart), 0.0
    x, y = column[v]
    for i in range(max(x - reach, 0), min(x + reach + 1, square.shape[0])):
        for j in range(max(y - reach, 0), min(y + reach + 1, square.shape[1])):
            other = square[i, j]
            if other >= 0 and (i - x) ** 2 + (j - y) ** 2 <= apart * apart:
                total += weight[other]
                if clear:
                    weight[other] = 0.0
    return total
