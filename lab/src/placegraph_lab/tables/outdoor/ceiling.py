"""All viewpoints of a city compete for a query: which serve which of its statements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph_lab.tables.outdoor.baselines import Words, list_words, words_around
from placegraph_lab.tables.outdoor.nearby import DIRECTIONS, Bins
from placegraph_lab.tables.outdoor.outdoor_kernels import _likeliest, _rank
from placegraph_lab.tables.outdoor.places import Ints
from placegraph_lab.tables.outdoor.queries import CELL, NOISE, SIGHT, Query

STEP = 12.5  # edge of the grid of viewpoints that compete with the truth [m]
CHUNK = 50_000  # viewpoints looked at in one go: keeps memory small


@dataclass(frozen=True)
class Contest:
    """Viewpoints V of a grid, and the words W (statements) that the queries Q speak of."""

    words_asked: Ints
    """(A, 4) words of all queries, one query after the other: as said, and in the three other
    directions."""
    words_asked_starts: Ints  # (Q + 1,)
    served_starts: Ints  # (W + 1,) viewpoints that serve a word
    served: NDArray[np.int32]
    sayable: NDArray[
        np.int32
    ]  # (V,) different statements that the generator could make at a viewpoint
    own: Ints  # (Q,) statements that hold at the true viewpoint itself
    truth: Floats  # (Q, 2) true viewpoints, in steps of the grid
    column: NDArray[np.int32]  # (V, 2) viewpoints, in steps of the grid
    square: NDArray[np.int32]  # viewpoint of every square of the grid, -1 where there is none
    step: float

    @classmethod
    def of(
        cls,
        bins: Bins,
        queries: Sequence[Query],
        *,
        names: bool = False,
        step: float = STEP,
    ) -> Contest:
        """Look at all viewpoints of a grid over the city.

        `queries`: all about pairs of objects, or all about the speaker; `names`: objects are called
        by their names; `step`: edge of the grid [m]: 50 / step is a whole number.
        """
        city = bins.city
        label = city.named if names else city.label
        number = {name: i for i, name in enumerate(city.labels)}
        kind: Words = "triples" if queries[0].statements[0].target else "speaker"
        wanted = [list_words(q, kind, number) for q in queries]
        words = np.concatenate(wanted)
        labels = len(city.labels) + 1
        head, target = np.divmod(words, labels)
        source, said = np.divmod(head, len(DIRECTIONS))
        turned = (said[:, None] + np.arange(len(DIRECTIONS))) % len(DIRECTIONS)
        words_asked = np.asarray(
            (source[:, None] * len(DIRECTIONS) + turned) * labels + target[:, None]
        )
        known = np.unique(words_asked)
        truth = city.plane.to_plane([(q.longitude, q.latitude) for q in queries])

        def find_words(viewpoints: Floats) -> tuple[Ints, Ints, Ints]:
            """Viewpoint and word of what a query asks for; number of different words."""
            around = bins.around(viewpoints, SIGHT)
            at, word = words_around(
                kind, viewpoints, around, label, len(city.labels), SIGHT, same_label=False
            )
            pairs = np.unique(np.stack([at, word]), axis=1)
            place = np.minimum(np.searchsorted(known, pairs[1]), len(known) - 1)
            hit = known[place] == pairs[1]
            return pairs[0, hit], place[hit], np.bincount(pairs[0], minlength=len(viewpoints))

        grid = bins.centers(step)
        seen = [find_words(grid[i : i + CHUNK]) for i in range(0, len(grid), CHUNK)]
        at = np.concatenate([v + i * CHUNK for i, (v, _, _) in enumerate(seen)])
        word = np.concatenate([w for _, w, _ in seen])
        order = np.argsort(word, kind="stable")
        own_at, own_word, _ = find_words(truth)
        held = set(zip(own_at.tolist(), known[own_word].tolist(), strict=True))
        column = np.round((grid - bins.low) / step - 0.5).astype(np.int32)
        square = np.full(column.max(0) + 1, -1, np.int32)
        square[column[:, 0], column[:, 1]] = np.arange(len(grid))
        return cls(
            words_asked=np.searchsorted(known, words_asked),
            words_asked_starts=np.concatenate([[0], np.cumsum([len(w) for w in wanted])]),
            served_starts=np.searchsorted(word[order], np.arange(len(known) + 1)),
            served=at[order].astype(np.int32),
            sayable=np.concatenate([n for _, _, n in seen]).astype(np.int32),
            own=np.array([sum((q, w) in held for w in ws.tolist()) for q, ws in enumerate(wanted)]),
            truth=(truth - bins.low) / step - 0.5,
            column=column,
            square=square,
            step=step,
        )


MODE = 45.0  # the oracle sums the probability of viewpoints within this distance of a place's middle [m]
SLIP = 0.05
"""Share of wrong directions that the oracle expects of noise-free texts: its viewpoints stand on
a grid, a few metres from the true one."""


@dataclass(frozen=True)
class Ceiling:
    """Places that fit better than the true one, and others that fit as well, for each query."""

    better: Ints  # (Q,)
    tied: Ints  # (Q,)

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
        (contest.words_asked[:, 0], contest.words_asked_starts),
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
        (contest.words_asked, contest.words_asked_starts),
        (contest.served_starts, contest.served),
        (contest.column, contest.square),
        contest.sayable,
        contest.truth,
        (NOISE if replaced else SLIP, MODE / contest.step, CELL / contest.step),
        top,
    )
