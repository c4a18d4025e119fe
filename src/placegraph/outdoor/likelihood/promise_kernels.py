# mypy: allow-untyped-defs, allow-incomplete-defs
"""Which viewpoints are worth a look: tile by tile, those that promise most first."""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel
from placegraph.outdoor.likelihood.bound_kernels import (
    HIGHEST,
    TILES,
    blank,
    bounds_of,
    ends_of,
)
from placegraph.outdoor.likelihood.fit_kernels import ME
from placegraph.outdoor.map.index_kernels import SLOTS, below

FIRST = 64
"""So many tiles of largest bound are looked at first, then four times as many, and so on: what they
hold tells which others may matter."""
DRAWN = 512
"""About so many of the tiles that cannot matter tell what all of these weigh together."""
NOTHING = 1e-4
"""Tiles that together weigh less than this share of those looked at weigh nothing."""
EVERY = 1e300
"""No bound is as large: tiles are looked at however little they promise, and nothing is chosen."""
STRIP = 1024
"""Tiles whose bounds are reckoned at once."""


@kernel(fastmath=True)
def promising_views(statements, mentions, views, weights, most):
    """Viewpoints (K,) worth scoring, the most promising first, their bounds, and what is left out.

    Only viewpoints that have all things of at least one statement in sight are worth it. The bound
    (`bounds_of`) is of the likelihood ratio, times the prior `weights` (W,), all equal where empty.
    Those of largest bound are found among all of the map: a tile is passed over only where the bound
    of the whole tile is below that of `most` viewpoints. Left out is the sum of the bounds of the
    viewpoints that are worth it and were not returned; tiles that were passed over are estimated by
    `DRAWN` of them, each drawn as surely as it may weigh.
    """
    promise = _of_tiles(statements, mentions, views)
    if len(weights):
        for t in range(len(promise)):
            heaviest = 0.0
            for v in range(views.first[t], views.first[t + 1]):
                heaviest = max(heaviest, weights[v])
            promise[t] *= heaviest
    chosen = np.empty(2 * most + TILES * SLOTS, np.int32)
    bounds = np.empty(len(chosen))
    n, least, total = 0, 0.0, 0.0
    share = np.ones(len(promise))
    every, size = np.flatnonzero(promise > 0.0), FIRST
    while len(every) > size:
        bar = np.partition(promise[every], len(every) - size)[len(every) - size]
        first = every[promise[every] > bar]
        n, least, total = _visit(
            statements, mentions, views, weights, first, promise, share, most,
            chosen, bounds, n, least, total,
        )  # fmt: skip
        every = every[(promise[every] > least) & (promise[every] > 0.0)]
        size *= 4
    n, least, total = _visit(
        statements, mentions, views, weights, every, promise, share, most,
        chosen, bounds, n, least, total,
    )  # fmt: skip
    rest = _drawn(views, np.flatnonzero(promise > 0.0), promise, share, total)
    if len(rest):
        _, _, total = _visit(
            statements, mentions, views, weights, rest, promise, share, most,
            chosen[n:], bounds[n:], 0, EVERY, total,
        )  # fmt: skip
    order = np.argsort(-bounds[:n])
    return chosen[order], bounds[order], max(0.0, total - bounds[:n].sum())


@kernel(fastmath=True)
def _of_tiles(statements, mentions, views):
    """Bound (T,) of all viewpoints of each tile; 0 where none is worth a look."""
    n_mentions = len(mentions.starts) - 1
    out = np.zeros(len(views.tiles))
    at = views.token_starts[mentions.tokens]
    of_pairs = np.zeros((n_mentions + 1, STRIP), np.float32)
    of_total = np.zeros((n_mentions + 1, STRIP), np.float32)
    of_total[ME] = 1.0
    there = np.ones(n_mentions + 1, np.bool_)
    for first in range(0, len(out), STRIP):
        last = min(first + STRIP, len(out))
        for m in range(n_mentions):
            there[m] = _fill_tiles(of_pairs[m], of_total[m], mentions, views, at, m, first, last)
        bound = out[first:last]
        worth = False
        for s in range(len(statements.op)):
            a, b = ends_of(statements, s)
            if statements.negated[s] or a == b or not (there[a] and there[b]):
                continue
            if not worth:
                bound[:] = 1.0
                worth = True
            gain = (1.0 - statements.noise[s]) / (statements.noise[s] * statements.background[s])
            of_me = a == ME or b == ME
            of = of_total if of_me else of_pairs
            for i in range(last - first):
                part = min(of[a, i] * of[b, i], np.float32(1.0))
                bound[i] = min(HIGHEST, bound[i] * (1.0 + gain * part))
        for i in range(last - first):
            bound[i] = 0.0 if bound[i] == 1.0 else bound[i] * 1.001  # of rounding
        for m in range(n_mentions):
            if there[m]:
                of_pairs[m] = 0.0
                of_total[m] = 0.0
    return out


@kernel(fastmath=True, _nrt=False)
def _fill_tiles(of_pairs, of_total, mentions, views, at, m, first, last):
    """Largest masses of a mention in tiles from `first` to `last`; whether there is any."""
    there = False
    for k in range(mentions.starts[m], mentions.starts[m + 1]):
        end, weight = views.token_starts[mentions.tokens[k] + 1], mentions.weights[k]
        p = at[k]
        while p < end and views.run_tiles[p] < last:
            i = np.int64(views.run_tiles[p]) - first
            if i >= 0:  # of a forged map they may not ascend
                of_pairs[i] += weight * views.levels[views.run_pairs[p]]
                of_total[i] += weight * views.levels[views.run_total[p]]
            p += 1
        there |= p > at[k]
        at[k] = p
    return there


@kernel(fastmath=True)
def _visit(
    statements, mentions, views, weights, tiles, promise, share, most, chosen, bounds, n, least, total
):  # fmt: skip
    """Look at the viewpoints of tiles that promise more than `least`.

    Adds those worth it to `chosen` and `bounds`, and all of them to the `total`, by the `share` of
    their tile. The promise of tiles looked at becomes 0. Returns how many were chosen, the least
    bound that still counts, and the total.
    """
    at = views.token_starts[mentions.tokens]
    seen, there = blank(len(mentions.starts) - 1)
    bound = np.empty(TILES * SLOTS)
    strip = np.empty(TILES, np.int64)
    drawn = least >= EVERY
    k = size = 0
    while k < len(tiles) or size > 0:
        if k < len(tiles):
            if promise[tiles[k]] > least or drawn:
                strip[size] = tiles[k]
                size += 1
            k += 1
            if size < TILES and k < len(tiles):
                continue
        if size and bounds_of(statements, mentions, views, strip[:size], at, seen, there, bound):
            for i in range(size):
                of_tile = bound[i * SLOTS : (i + 1) * SLOTS]
                bits, row = views.present[strip[i]], views.first[strip[i]]
                if len(weights):
                    _weigh(of_tile, bits, row, weights)
                sum_ = best = 0.0
                for slot in range(SLOTS):
                    sum_ += of_tile[slot]
                    best = max(best, of_tile[slot])
                total += sum_ * share[strip[i]]
                for slot in range(SLOTS if best > least else 0):
                    if of_tile[slot] > least:
                        chosen[n], bounds[n] = row + below(bits, slot), of_tile[slot]
                        n += 1
            if n > 2 * most:
                n, least = _heaviest(chosen, bounds, n, most)
        for i in range(size):
            promise[strip[i]] = 0.0
        size = 0
    if n > most:
        n, least = _heaviest(chosen, bounds, n, most)
    return n, least, total


@kernel(fastmath=True, _nrt=False)
def _weigh(bound, bits, row, weights):
    """Multiply the bounds of a tile's viewpoints by their weights."""
    for slot in range(SLOTS):
        if (bits >> slot) & 1:
            bound[slot] *= weights[row]
            row += 1


@kernel(fastmath=True)
def _drawn(views, tiles, promise, share, known):
    """Tiles (ascending) that stand for all `tiles`; their `share` becomes how many each stands for."""
    heights = np.empty(len(tiles))
    rest = 0.0
    for i in range(len(tiles)):
        heights[i] = promise[tiles[i]] * (views.first[tiles[i] + 1] - views.first[tiles[i]])
        rest += heights[i]
    if rest <= NOTHING * known:
        return tiles[:0]
    if len(tiles) <= DRAWN:
        return tiles
    taken, n = np.empty(DRAWN + 1, np.int64), 0
    step = rest / DRAWN
    upto, mark = 0.0, 0.5 * step
    for i in range(len(tiles)):
        upto += heights[i]
        times = 0
        while mark <= upto and n + 1 < len(taken):
            mark += step
            times += 1
        if times:
            share[tiles[i]] = times * step / heights[i]
            taken[n] = tiles[i]
            n += 1
    return taken[:n]


@kernel
def _heaviest(chosen, bounds, n, most):
    """Move the `most` viewpoints of largest bound to the front; how many, and the least bound."""
    if n <= most:
        return n, 0.0
    least = np.partition(bounds[:n], n - most)[n - most]
    ties = most
    for i in range(n):
        ties -= bounds[i] > least
    kept = 0
    for i in range(n):
        if bounds[i] == least:
            ties -= 1
        if bounds[i] > least or (bounds[i] == least and ties >= 0):
            chosen[kept], bounds[kept] = chosen[i], bounds[i]
            kept += 1
    return kept, least
