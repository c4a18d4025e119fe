"""What a shard can hold at most of what was said, by the table of words alone.

The likelihood ratio of a viewpoint is at most a product over statements of 1 + gain * p for a thing
and the speaker, or 1 + gain * q * p * p' for two things, where p is the share that a mention has of
all in sight. No share is larger than the largest in the shard. And since shares are of one whole, those
of labels together are no more than `spread`: without that, six common words would outweigh a rare
name. The largest product under both is bounded by Lagrange's dual, which separates the mentions.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np

from placegraph.outdoor.language.description import Relation
from placegraph.outdoor.likelihood.fit_kernels import ME
from placegraph.outdoor.likelihood.match_kernels import SLACK
from placegraph.outdoor.likelihood.statements import OPERATION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.outdoor.likelihood.query import Query
    from placegraph.world.shards.table import WordTable

_SHARES = np.concatenate(([0.0], np.geomspace(1e-4, 8.0, 48)))
"""Shares at which the parts of the dual are looked up ..."""
_PRICES = np.concatenate(([0.0], np.geomspace(0.25, 64.0, 17)))
"""... and prices of a share [nat]: every one gives a bound, and the least of them is taken."""


def most(query: Query, table: WordTable) -> NDArray[np.float64]:
    """Largest log-likelihood ratio (N,) that any viewpoint of each shard can have; -inf: none at all."""
    peaks = peaks_of(query, table)
    pairs = _statements(query)
    patterns, which = np.unique(peaks > 0.0, axis=0, return_inverse=True)
    found = np.full(len(peaks), -np.inf)
    for k, there in enumerate(patterns):
        rows = np.flatnonzero(which.ravel() == k)
        heard = [s for s in pairs if all(m == ME or there[m] for m in s[1:3])]
        if heard:
            found[rows] = _dual(query, table, peaks, rows, heard)
    return found + query.statements.floor + SLACK


def peaks_of(query: Query, table: WordTable) -> NDArray[np.float64]:
    """Largest share (N, M) that a mention can have of what is in sight of a viewpoint of each shard."""
    mentions = query.mentions
    peaks = np.zeros((len(table.viewpoints), len(mentions.starts) - 1))
    for m in range(peaks.shape[1]):
        for k in range(mentions.starts[m], mentions.starts[m + 1]):
            held = table.of(int(mentions.tokens[k]))
            peaks[held.shards, m] += mentions.weights[k] * held.peak
    labelled = _labelled(query, table)
    return np.where(labelled, np.minimum(peaks, table.spread[:, None]), peaks)


def _labelled(query: Query, table: WordTable) -> NDArray[np.bool_]:
    """Which mentions (M,) stand for labels alone."""
    starts, named = query.mentions.starts, query.mentions.tokens >= len(table.labels)
    return np.array([not named[a:b].any() for a, b in itertools.pairwise(starts.tolist())], bool)


def _statements(query: Query) -> list[tuple[float, int, int]]:
    """Gain of each statement that can speak for a place, and the two mentions that it is about."""
    columns, found = query.statements, []
    between = OPERATION[Relation.BETWEEN]
    for s, gain in enumerate(columns.gain.tolist()):
        a, b = int(columns.source[s]), int(columns.target[s])
        if columns.op[s] == between and a == ME:
            a = int(columns.target2[s])
        if not columns.negated[s] and a != b:
            found.append((gain, a, b))
    return found


def _dual(
    query: Query,
    table: WordTable,
    peaks: NDArray[np.float64],
    rows: NDArray[np.int64],
    heard: list[tuple[float, int, int]],
) -> NDArray[np.float64]:
    """Bounds of the shards in `rows`, all of which have the same mentions."""
    pull = float(table.pull[rows].max())
    of = np.zeros((peaks.shape[1], len(_SHARES)))
    for gain, a, b in heard:
        for m in (a, b):
            if ME in (a, b) and m != ME:
                of[m] += np.log1p(gain * np.minimum(1.0, _SHARES))
            elif m != ME:  # (1 + g p p')^2 <= (1 + g p^2) (1 + g p'^2)
                of[m] += 0.5 * np.log1p(gain * pull * _SHARES**2)
    labelled = _labelled(query, table)
    at = np.minimum(np.searchsorted(_SHARES, peaks[rows]), len(_SHARES) - 1)
    below = np.concatenate(([0.0], _SHARES[:-1]))  # a share between two steps pays for the lower
    budget = table.spread[rows] * _twice(query, table)
    best = np.full(len(rows), np.inf)
    for price in _PRICES:
        total = price * budget
        for m in range(len(of)):
            worth = np.maximum.accumulate(of[m] - price * below * labelled[m])
            total = total + worth[at[:, m]]
        best = np.minimum(best, total)
    return best


def _twice(query: Query, table: WordTable) -> float:
    """How often one label counts at most: several mentions may stand for it."""
    tokens, weights = query.mentions.tokens, query.mentions.weights
    labels = tokens < len(table.labels)
    total = np.bincount(tokens[labels], weights[labels]) if labels.any() else np.ones(1)
    return float(total.max())
