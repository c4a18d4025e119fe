"""Inverted lists: vectors by the nearest of some thousand centres, so that most are never read.

Spherical k-means with about 2 sqrt(C) centres; a query opens the lists of the nearest ones. Why
this and no graph of neighbours (HNSW): `docs/benchmarks/vector-stores.md`, the table of vector stores.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

ROUNDS = 6
"""Rounds of k-means; more change the recall by less than 0.002."""
SAMPLE = 40
"""Vectors per centre that k-means sees."""
BLOCK = 1 << 14
"""Vectors compared with all centres at once."""


class Lists(NamedTuple):
    """An order of rows in which those of one list stand together."""

    order: NDArray[np.int64]
    """(C,) rows, list by list, ascending within a list."""
    starts: NDArray[np.int64]
    """(L + 1,) where the lists begin."""
    centers: NDArray[np.float32]
    """(L, D) of unit length."""


def make_lists(vectors: NDArray[np.float32]) -> Lists:
    """Lists of unit vectors (C, D); nothing in it is random."""
    count = max(1, int(2.0 * np.sqrt(len(vectors))))
    # Ids run row by row over the map, so that evenly spaced ones are spread over all of it.
    sample = vectors[
        np.linspace(0, len(vectors) - 1, min(len(vectors), SAMPLE * count)).astype(int)
    ]
    centers = sample[np.linspace(0, len(sample) - 1, count).astype(int)].copy()
    for _ in range(ROUNDS):
        nearest = _nearest(sample, centers)
        order = np.argsort(nearest, kind="stable")
        members, begins = np.unique(nearest[order], return_index=True)
        sums = np.add.reduceat(sample[order], begins, axis=0)
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        moved = lengths[:, 0] > 1e-6  # opposite vectors cancel: their centre stays
        centers[members[moved]] = (sums / np.maximum(lengths, 1e-6))[moved]
    nearest = _nearest(vectors, centers)
    starts = np.concatenate(([0], np.cumsum(np.bincount(nearest, minlength=count))))
    return Lists(np.argsort(nearest, kind="stable"), starts, centers)


def _nearest(vectors: NDArray[np.float32], centers: NDArray[np.float32]) -> NDArray[np.int64]:
    """Centre (N,) nearest to each vector."""
    blocks = [vectors[i : i + BLOCK] for i in range(0, len(vectors), BLOCK)]
    return np.concatenate([np.argmax(block @ centers.T, axis=1) for block in blocks])
