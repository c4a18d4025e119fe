"""What a shard can weigh at most for what was said, by the table of words alone.

The likelihood ratio of a viewpoint is at most a product over statements of 1 + gain * p for a thing
and the speaker, or 1 + gain * q * p * p' for two things, where p is the share that a mention has of
all in sight. No share is larger than the largest in the shard. And since shares are of one whole, those
of labels together are no more than `spread`: without that, six common words would outweigh a rare
name. The largest product under both is bounded by Lagrange's dual, which separates the mentions.

What counts is not the best viewpoint but what all of them weigh, and few have much of a rare thing in
sight: the table knows the mean share of each word. By Hölder's inequality the mean of a product of
functions, one of each mention, is at most the product of the k-norms of k of them and of the largest
values of all others; and the mean of a function of a share is at most that of a line above it.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.outdoor.language.description import Relation
from placegraph.outdoor.likelihood.match_kernels import ME, SLACK
from placegraph.outdoor.likelihood.query import OPERATION

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.outdoor.likelihood.query import Query
    from placegraph_scale.shards.table import WordTable

_SHARES = np.concatenate(([0.0], np.geomspace(1e-6, 8.0, 64)))
"""Shares at which the parts of the dual are looked up ..."""
_BELOW = np.concatenate(([0.0], _SHARES[:-1]))
"""... a share between two of them pays for the lower ..."""
_PRICES = np.concatenate(([0.0], np.geomspace(0.25, 64.0, 17)))
"""... and prices of a share [nat]: every one gives a bound, and the least of them is taken."""
_NORMS = (1, 2, 3, 4, 6)
"""So many mentions are bounded by their means."""
_TOGETHER = 4096
"""Shards whose bounds are reckoned at once."""


class Held(NamedTuple):
    """What viewpoints of each shard have of each mention in sight."""

    peaks: NDArray[np.float64]
    """(N, M) largest share of all in sight ..."""
    means: NDArray[np.float64]
    """... and the mean share."""
    labelled: NDArray[np.bool_]
    """(M,) which mentions stand for labels alone."""
    budget: NDArray[np.float64]
    """(N,) largest sum of the shares of those."""


def most(query: Query, table: WordTable, *, even: bool) -> NDArray[np.float64]:
    """Log of what the mean viewpoint (N,) of each shard can weigh at most; -inf: nothing at all.

    Of the best viewpoint, where they are not all as likely beforehand (`even`).
    """
    held, pairs = _held(query, table), _statements(query)
    patterns, which = np.unique(held.peaks > 0.0, axis=0, return_inverse=True)
    found = np.full(len(table), -np.inf)
    for k, there in enumerate(patterns):
        rows = np.flatnonzero(which.ravel() == k)
        heard = [s for s in pairs if all(m == ME or there[m] for m in s[1:3])]
        if heard:
            pull = float(table.pull[rows].max())
            found[rows] = _dual(held, rows, _worth(heard, len(there), pull), even=even)
    return found + query.statements.floor + SLACK


def _held(query: Query, table: WordTable) -> Held:
    starts, tokens, weights = query.mentions
    peaks = np.zeros((len(table), len(starts) - 1))
    means = np.zeros_like(peaks)
    for m, (first, last) in enumerate(itertools.pairwise(starts.tolist())):
        for k in range(first, last):
            held = table.of(int(tokens[k]))
            peaks[held.shards, m] += weights[k] * held.peak
            means[held.shards, m] += weights[k] * held.shares
    labels = tokens < len(table.labels)
    labelled = np.array([labels[a:b].all() for a, b in itertools.pairwise(starts.tolist())], bool)
    peaks = np.where(labelled, np.minimum(peaks, table.spread[:, None]), peaks)
    means /= np.maximum(table.viewpoints, 1)[:, None]
    # how often one label counts at most: several mentions may stand for it
    twice = np.bincount(tokens[labels], weights[labels]) if labels.any() else np.ones(1)
    return Held(peaks, means, labelled, table.spread * float(twice.max()))


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


def _worth(heard: list[tuple[float, int, int]], mentions: int, pull: float) -> NDArray[np.float64]:
    """What each mention adds to the log (M, J) where it has a share of all in sight."""
    of = np.zeros((mentions, len(_SHARES)))
    for gain, a, b in heard:
        for m in (a, b):
            if ME in (a, b) and m != ME:
                of[m] += np.log1p(gain * np.minimum(1.0, _SHARES))
            elif m != ME:  # (1 + g p p')^2 <= (1 + g p^2) (1 + g p'^2)
                of[m] += 0.5 * np.log1p(gain * pull * _SHARES**2)
    return of


def _dual(
    held: Held, rows: NDArray[np.int64], of: NDArray[np.float64], *, even: bool
) -> NDArray[np.float64]:
    """Bounds of the shards in `rows`, all of which have the same mentions."""
    best = np.empty(len(rows))
    worth = of - _PRICES[:, None, None] * _BELOW * held.labelled[:, None]
    for part in (slice(k, k + _TOGETHER) for k in range(0, len(rows), _TOGETHER)):
        mine = rows[part]
        at = np.minimum(np.searchsorted(_SHARES, held.peaks[mine]), len(_SHARES) - 1).T
        largest = _upto(worth, at)
        total = _PRICES[:, None] * held.budget[mine] + largest.sum(axis=1)
        best[part] = total.min(axis=0)
        for k in _NORMS if even else ():
            saved = np.maximum(largest - _norms(worth, at, held.means[mine].T, k), 0.0)
            saved = np.sort(saved, axis=1)[:, -k:].sum(axis=1)
            best[part] = np.minimum(best[part], (total - saved).min(axis=0))
    return best


def _norms(
    worth: NDArray[np.float64], at: NDArray[np.int64], means: NDArray[np.float64], k: int
) -> NDArray[np.float64]:
    """Log of the k-norm (P, M, N) over viewpoints, at most, of e to what mentions are `worth` (P, M, J)."""
    slope = np.zeros_like(worth)
    with np.errstate(over="ignore", invalid="ignore"):  # a value too large bounds nothing
        value = np.exp(k * worth)
        first = np.maximum(1.0, value[..., :2].max(axis=2, keepdims=True))
        slope[..., 2:] = (value[..., 2:] - first) / _BELOW[2:]
        found = np.log(first + means * np.maximum(_upto(slope, at), 0.0)) / k
    return np.where(np.isfinite(found), found, np.inf)


def _upto(table: NDArray[np.float64], at: NDArray[np.int64]) -> NDArray[np.float64]:
    """Largest (P, M, N) of each row of a table (P, M, J) up to places (M, N)."""
    found: NDArray[np.float64] = np.maximum.accumulate(table, axis=2)[
        :, np.arange(len(at))[:, None], at
    ]
    return found
