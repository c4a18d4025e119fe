"""Training examples with the viewpoints that relational matching confuses with the true ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.outdoor.language.description import Description
from placegraph.outdoor.likelihood.query import Query, compile_query
from placegraph.outdoor.network.batches import Fits, fits_of
from placegraph.outdoor.network.graphs import TextGraphs
from placegraph.outdoor.search.candidates import candidates
from placegraph.outdoor.search.request import Request
from placegraph.outdoor.search.rerank import HARD
from placegraph.outdoor.search.viewpoints import score
from placegraph_learn.train.city.sample import Speaker

OTHERS = 4
"""Viewpoints from anywhere beside the `HARD` that relational matching finds best."""
AT = 25.0
"""A viewpoint is right where the speaker stands in the square of twice this edge around it [m]."""
NEARBY = 60.0
"""Viewpoints nearer than this and not right are neither right nor wrong [m]."""


@dataclass(frozen=True, eq=False)
class Pool:
    """Q examples of one city, each with K viewpoints."""

    texts: TextGraphs
    fits: Fits
    positions: NDArray[np.float64]
    """(Q, 2) where the text was given [m]."""
    views: NDArray[np.int64]
    """(Q, K) rows of `city.views`, -1 where there are fewer."""
    scores: NDArray[np.float32]
    """(Q, K) log-likelihood ratio of relational matching; NaN where it was not asked."""
    right: NDArray[np.int8]
    """(Q, K) 1 right, 0 wrong, -1 neither (or no viewpoint)."""

    def __len__(self) -> int:
        return len(self.positions)


def fill(speaker: Speaker, n: int, rng: Generator, tick: Callable[[], None] = lambda: None) -> Pool:
    """Make `n` examples of one city."""
    city = speaker.city
    descriptions: list[Description] = []
    positions, views, scores, right, queries = [], [], [], [], []
    for example in speaker.examples(rng):
        query = compile_query(example.description, city)
        if not any(not s.negated for s in query.used):
            continue
        rows, values = _candidates(query, speaker, example.position, rng)
        delta = np.abs(city.views.positions[rows] - example.position).max(axis=1)
        label = np.where(delta <= AT, 1, np.where(delta <= NEARBY, -1, 0))
        label[rows < 0] = -1
        descriptions.append(example.description)
        positions.append(example.position)
        queries.append(query)
        views.append(rows)
        scores.append(values)
        right.append(label)
        tick()
        if len(positions) == n:
            break
    texts = TextGraphs.of(descriptions)
    return Pool(
        texts,
        fits_of(texts, queries),
        np.array(positions),
        np.array(views, np.int64),
        np.array(scores, np.float32),
        np.array(right, np.int8),
    )


def _candidates(
    query: Query, speaker: Speaker, position: NDArray[np.float64], rng: Generator
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Viewpoints (K,) to tell apart: the true ones, the best of matching, and any others.

    Who trains does not see the tiles that are held out, not even as wrong places.
    """
    views = speaker.city.views
    asked = Request(speaker.city, query)
    found = score(asked, candidates(asked))
    best = np.argsort(-found.scores, kind="stable")
    best = best[speaker.may_see(views.positions_of(found.rows[best]))][:HARD]
    true = rng.permutation(views.near(position, AT))[:4]  # not the nearest: cells stand apart
    others = rng.integers(len(views), size=OTHERS)
    others = others[speaker.may_see(views.positions[others])]
    rows = np.concatenate([true, found.rows[best], others]).astype(np.int64)
    known = dict(zip(found.rows.tolist(), found.scores.tolist(), strict=True))
    rows = rows[np.sort(np.unique(rows, return_index=True)[1])]
    values = np.array([known.get(int(row), np.nan) for row in rows], np.float32)
    size = HARD + OTHERS + 4
    short = size - len(rows)
    return np.pad(rows, (0, short), constant_values=-1), np.pad(
        values, (0, short), constant_values=np.nan
    )
