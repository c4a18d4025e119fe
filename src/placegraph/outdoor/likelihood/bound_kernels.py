# mypy: allow-untyped-defs, allow-incomplete-defs
"""Upper bounds on the likelihood of statements at viewpoints, from the view index alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.outdoor.likelihood.match_kernels import BETWEEN, DIRECTION, ME
from placegraph.outdoor.map.index_kernels import (
    FALLS,
    JUMP,
    PULLS,
    SIDE,
    SLOTS,
    TOTALS,
    slot_of,
)

TILES_AT_ONCE = 16
"""Number of tiles whose viewpoints are bounded at once: their data fits into the nearest cache."""
MAX_BOUND = 1e290
"""Largest bound: texts of a hundred statements must not overflow."""


class Runs(NamedTuple):
    """Runs of the tokens of a query: where each of the tokens is in sight."""

    starts: NDArray[np.int64]
    """(K + 1,) first run of a token ..."""
    shift: NDArray[np.int64]
    """(K,) ... and how far its rows lie from those of the index."""
    tiles: NDArray[np.uint32]
    """(R,) tile, ascending within a token."""
    postings: NDArray[np.uint32]
    """(R,) first of its postings."""


@kernel
def list_runs(views, tokens):
    """List the runs of tokens (K,)."""
    starts, shift = np.zeros(len(tokens) + 1, np.int64), np.empty(len(tokens), np.int64)
    for k in range(len(tokens)):
        a, b = views.token_starts[tokens[k]], views.token_starts[tokens[k] + 1]
        starts[k + 1], shift[k] = starts[k] + b - a, a - starts[k]
    tiles, postings = np.empty(starts[-1], np.uint32), np.empty(starts[-1], np.uint32)
    for k in range(len(tokens)):
        tile, at = np.int64(-1), views.posting_starts[tokens[k]]
        for i in range(starts[k], starts[k + 1]):
            p = i + shift[k]
            tile += 1 + ((np.int64(views.run_tiles[p]) - tile - 1) & (JUMP - 1))
            tiles[i], postings[i] = tile, at
            at += views.run_sizes[p]
    return Runs(starts, shift, tiles, postings)


@kernel(finite=True)
def bound_views(statements, mentions, views, runs, tiles, at, shares, there, bound):
    """Bound the viewpoints of tiles (ascending, at most `TILES_AT_ONCE`), slot by slot, in `bound`.

    The bound is the likelihood ratio of the statements if all directions and distances were right; 0
    where not all objects of at least one statement are in sight. `at` (K,) holds the position in the runs
    of each token, `shares` (M + 1, n) has 0 for each mention, and 1 for the speaker, in the last row.
    Returns whether any bound is above 0.
    """
    n = SLOTS * len(tiles)
    for m in range(len(mentions.starts) - 1):
        there[m] = _sum_shares(shares[m], mentions, views, runs, at, m, tiles)
    is_possible = _bound_tiles(statements, shares, there, views, tiles, bound[:n])
    for m in range(len(mentions.starts) - 1):
        if there[m]:
            shares[m] = 0.0
    return is_possible


@kernel(finite=True, _nrt=False)
def skip_to_tile(tiles, p, end, tile):
    """Find the first of the runs from `p` on whose tile is not before `tile`."""
    if p >= end or tiles[p] >= tile:
        return p
    step = 1
    while p + step < end and tiles[p + step] < tile:
        p += step
        step += step
    high = min(end, p + step)
    while high - p > 1:
        middle = (p + high) >> 1
        if tiles[middle] < tile:
            p = middle
        else:
            high = middle
    return high


@kernel(finite=True, _nrt=False)
def _sum_shares(shares, mentions, views, runs, at, m, tiles):
    """Sum the shares of a mention in sight of the viewpoints of tiles; return whether there is any."""
    there = False
    for k in range(mentions.starts[m], mentions.starts[m + 1]):
        end, weight = runs.starts[k + 1], mentions.weights[k]
        p = at[k]
        for i in range(len(tiles)):
            p = skip_to_tile(runs.tiles, p, end, tiles[i])
            if p == end:
                break
            row = p + runs.shift[k]
            if runs.tiles[p] == tiles[i] and views.run_sizes[row]:
                there = True
                largest = weight * views.levels[views.run_total[row]]
                first = np.int64(runs.postings[p])
                last = min(len(views.postings), first + views.run_sizes[row])
                _add_run(
                    shares, views.postings, first, last, i * SLOTS, views.present[tiles[i]], largest
                )
        at[k] = p
    return there


@kernel(finite=True, _nrt=False)
def _add_run(shares, postings, q, end, base, present, largest):
    """Add the postings of a run, from `q` to `end`, to the shares of its tile's viewpoints."""
    if q >= end:  # a forged map
        return
    lines, bits, half = postings[q], present, 0
    q += 1
    if lines:
        bits = np.int64(0)
        for line in range(SIDE):
            if lines >> line & 1 and q < end:
                bits |= np.int64(postings[q]) << (SIDE * line)
                q += 1
        bits &= present
    while bits != 0 and q < end:
        shares[base + slot_of(bits)] += largest * FALLS[(postings[q] >> half) & 15]
        bits &= bits - 1
        q += half >> 2
        half ^= 4


@kernel(finite=True)
def _bound_tiles(statements, shares, there, views, tiles, bound):
    """Bound the viewpoints of tiles, 0 where no statement can hold; return whether any can."""
    is_possible = False
    total, pull = np.empty(len(bound), np.float32), np.empty(len(bound), np.float32)
    part, ones = np.empty(len(bound), np.float32), np.ones(len(bound), np.float32)
    for s in range(len(statements.op)):
        a, b = find_bounded_ends(statements, s)
        if statements.negated[s] or a == b or not (there[a] and there[b]):
            continue
        if not is_possible:
            bound[:] = 1.0
            is_possible = True
            _read_density(views, tiles, total, pull)
        gain = (1.0 - statements.noise[s]) / (statements.noise[s] * statements.background[s])
        of = ones if a == ME or b == ME else pull
        one, other = shares[a], shares[b]
        for i in range(len(bound)):
            part[i] = min(one[i] * other[i] * of[i], np.float32(1.0))
        for i in range(len(bound)):  # a loop of its own, since its numbers are twice as wide
            bound[i] = min(MAX_BOUND, bound[i] * (1.0 + gain * part[i]))
    if is_possible:
        for i in range(len(bound)):
            bound[i] = 0.0 if bound[i] == 1.0 else bound[i]
        for s in range(len(statements.op)):
            a, noise = statements.source[s], statements.noise[s]
            is_denied = statements.negated[s] and statements.op[s] != DIRECTION
            if is_denied and statements.target[s] == ME and a != ME and there[a]:
                for i in range(len(bound)):
                    absent = np.exp(-2.0 * shares[a, i] * total[i])
                    bound[i] *= (1.0 - noise) * absent + noise
    return is_possible


@kernel(finite=True, _nrt=False)
def _read_density(views, tiles, total, pull):
    """Read how much is in sight of the viewpoints of tiles, and its square against pairs, slot by slot."""
    for k in range(len(tiles)):
        bits, row = views.present[tiles[k]], views.first[tiles[k]]
        for i in range(k * SLOTS, (k + 1) * SLOTS):
            total[i], pull[i] = np.float32(0.0), np.float32(0.0)
            if bits & 1:
                density = views.density[row]
                total[i], pull[i] = TOTALS[density], PULLS[density] * PULLS[density]
                row += 1
            bits >>= 1


@kernel(inline=True)
def find_bounded_ends(statements, s):
    """Return the two mentions that bound a statement: b and c for "I am between b and c"."""
    a, b = statements.source[s], statements.target[s]
    return (statements.target2[s], b) if statements.op[s] == BETWEEN and a == ME else (a, b)


FIRST_TILES = 64
"""Number of tiles of largest bound whose viewpoints are bounded first; then 16 times as many, and so
on, as long as others may matter."""
TILE_SLACK = 2.7
"""Bound of a tile, against the least of the `most` best, from which on its viewpoints are bounded: tiles
hold none of these mostly, but 1 % of their weight, where they promise less than 1 nat more."""
SAMPLES_PER_TILE = 4
"""Number of samples for each tile that is sampled from those that cannot matter."""
NEGLIGIBLE = 1e-4
"""Share of the weight of bounded viewpoints below which all other tiles together are ignored."""
INFINITE = 1e300
"""Larger than any bound: tiles are bounded however low their own bound is, and no viewpoint is kept."""
TILES_PER_STRIP = 1024
"""Number of whole tiles that are bounded at once."""


def find_views_by_bound(statements, mentions, views, weights, most, drawn, least):
    """Find viewpoints (K,) by upper bound: their rows, bounds, and how many viewpoints each represents.

    Viewpoints need all objects of at least one statement in sight. The bound (`bound_views`) is of the
    likelihood ratio, times the prior `weights` (W,), all equal where empty. First come the `most`
    viewpoints of largest bound, if it is at least `least`; these represent none. A tile is skipped where
    its bound is no larger than `TILE_SLACK` times theirs, or `least`. Then come `drawn` samples of all
    others (`sample_systematic`); skipped tiles are represented by samples of tiles, drawn in proportion to
    their bounds.
    """
    runs = list_runs(views, mentions.tokens)
    query = statements, mentions, views, runs, weights
    tile_bound = _bound_whole_tiles(*query)
    highest, n, floor = np.empty(2 * most + TILES_AT_ONCE * SLOTS), 0, least
    bounded = [(np.zeros(0, np.int32), np.zeros(0), np.zeros(0))]
    share = np.ones(len(tile_bound))
    every, size = np.flatnonzero(tile_bound > 0.0), FIRST_TILES
    while len(every) > 0:
        first = every
        if len(every) > size:
            bar = np.partition(tile_bound[every], len(every) - size)[len(every) - size]
            first = every[tile_bound[every] > bar]
        found, n, least = _bound_single_views(
            *query, first, tile_bound, share, most, highest, n, least
        )
        bounded.append(found)
        if len(every) <= size:
            break
        every = every[(tile_bound[every] > TILE_SLACK * least) & (tile_bound[every] > 0.0)]
        size *= 16
    if drawn:
        rest = _sample_tiles(
            views, np.flatnonzero(tile_bound > 0.0), tile_bound, share,
            sum(bounds.sum() for _, bounds, _ in bounded), max(1, drawn // SAMPLES_PER_TILE),
        )  # fmt: skip
        found, n, _ = _bound_single_views(
            *query, rest, tile_bound, share, most, highest, n, INFINITE
        )
        bounded.append(found)
    rows, bounds, multiplicity = map(np.concatenate, zip(*bounded, strict=True))
    return _select_best(rows, bounds, multiplicity, highest[:n], floor, most, drawn)


def _select_best(rows, bounds, multiplicity, highest, least, most, drawn):
    """Select the best of all bounded viewpoints, and samples of the others; see `find_views_by_bound`."""
    if len(highest) >= most:
        least = np.partition(highest, len(highest) - most)[len(highest) - most]
    single = multiplicity == 1.0
    better = np.flatnonzero(single & (bounds > least))
    ties = np.flatnonzero(single & (bounds == least))[: max(0, most - (highest > least).sum())]
    best = np.sort(np.concatenate([better, ties]))[:most]
    multiplicity[best] = 0.0
    best = best[np.argsort(-bounds[best], kind="stable")]
    some, stand = sample_systematic(bounds, multiplicity, drawn)
    every = np.concatenate([best, some])
    return rows[every], bounds[every], np.concatenate([np.zeros(len(best)), stand])


def sample_systematic(bounds, multiplicity, drawn):
    """Sample rows (`drawn`,) systematically; return these, and how many each represents.

    `multiplicity` (N,) are the numbers that rows represent before. Rows of larger bound are drawn more often.
    The first half, quarter and so on of the sample, a power of two, are as even as all of it: each then
    represents twice, or four times, as many.
    """
    root = np.sqrt(bounds)  # bounds of hundreds of statements are huge
    weights = multiplicity * (root * np.sqrt(root))
    cumulative = np.cumsum(weights)
    if not drawn or not len(weights) or cumulative[-1] <= 0.0:
        return np.zeros(0, np.int64), np.zeros(0)
    step = cumulative[-1] / drawn
    ascending = np.searchsorted(cumulative, step * (np.arange(drawn) + 0.5))
    order = np.zeros(1, np.int64)
    while len(order) < drawn:  # the bits of 0, 1, 2 and so on reversed
        order = np.concatenate([2 * order, 2 * order + 1])
    rows = np.empty(drawn, np.int64)
    rows[order] = np.minimum(ascending, len(weights) - 1)
    return rows, multiplicity[rows] * step / np.maximum(weights[rows], 1e-300)


@kernel(finite=True)
def _bound_whole_tiles(statements, mentions, views, runs, weights):
    """Bound all viewpoints of each tile (T,), times its largest weight; 0 where no statement can hold."""
    n_mentions = len(mentions.starts) - 1
    out = np.zeros(len(views.tiles))
    at = runs.starts[:-1].copy()
    of_pairs = np.zeros((n_mentions + 1, TILES_PER_STRIP), np.float32)
    of_total = np.zeros((n_mentions + 1, TILES_PER_STRIP), np.float32)
    of_total[ME] = 1.0
    there = np.ones(n_mentions + 1, np.bool_)
    for first in range(0, len(out), TILES_PER_STRIP):
        last = min(first + TILES_PER_STRIP, len(out))
        for m in range(n_mentions):
            there[m] = _sum_tile_shares(
                of_pairs[m], of_total[m], mentions, views, runs, at, m, first, last
            )
        bound = out[first:last]
        is_possible = False
        for s in range(len(statements.op)):
            a, b = find_bounded_ends(statements, s)
            if statements.negated[s] or a == b or not (there[a] and there[b]):
                continue
            if not is_possible:
                bound[:] = 1.0
                is_possible = True
            gain = (1.0 - statements.noise[s]) / (statements.noise[s] * statements.background[s])
            is_of_speaker = a == ME or b == ME
            of = of_total if is_of_speaker else of_pairs
            for i in range(last - first):
                part = min(of[a, i] * of[b, i], np.float32(1.0))
                bound[i] = min(MAX_BOUND, bound[i] * (1.0 + gain * part))
        for i in range(last - first):
            bound[i] = 0.0 if bound[i] == 1.0 else bound[i] * 1.001  # of rounding
        for m in range(n_mentions):
            if there[m]:
                of_pairs[m] = 0.0
                of_total[m] = 0.0
    if len(weights):
        for t in range(len(out)):
            heaviest = 0.0
            for v in range(views.first[t], views.first[t + 1]):
                heaviest = max(heaviest, weights[v])
            out[t] *= heaviest
    return out


@kernel(finite=True, _nrt=False)
def _sum_tile_shares(of_pairs, of_total, mentions, views, runs, at, m, first, last):
    """Sum the largest shares of a mention in tiles from `first` to `last`; return whether there is any."""
    there = False
    for k in range(mentions.starts[m], mentions.starts[m + 1]):
        weight, p = mentions.weights[k], at[k]
        while p < runs.starts[k + 1] and runs.tiles[p] < last:
            i, row = np.int64(runs.tiles[p]) - first, p + runs.shift[k]
            of_pairs[i] += weight * views.levels[views.run_pairs[row]]
            of_total[i] += weight * views.levels[views.run_total[row]]
            p += 1
        there |= p > at[k]
        at[k] = p
    return there


@kernel(finite=True)
def _bound_single_views(
    statements, mentions, views, runs, weights, tiles, tile_bound, share, most, highest, n, least
):
    """Bound the viewpoints of tiles whose own bound exceeds `least`: rows, bounds, `share` of their tile.

    All tiles are bounded if they are samples (`least` is then `INFINITE`); else the `n` `highest` bounds
    are kept. The bound (`tile_bound`) of tiles that were bounded becomes 0. Also returns `n` and `least`.
    """
    at, bound = runs.starts[:-1].copy(), np.empty(TILES_AT_ONCE * SLOTS)
    shares = np.zeros((len(mentions.starts), TILES_AT_ONCE * SLOTS), np.float32)
    shares[ME] = 1.0
    there = np.ones(len(mentions.starts), np.bool_)
    strip = np.empty(TILES_AT_ONCE, np.int64)
    drawn = least >= INFINITE
    n_views = k = size = count = 0
    for t in tiles:
        n_views += max(0, views.first[t + 1] - views.first[t])
    rows = np.empty(n_views, np.int32)
    bounds, multiplicity = np.empty(n_views), np.empty(n_views)
    while k < len(tiles) or size > 0:
        if k < len(tiles):
            if tile_bound[tiles[k]] > TILE_SLACK * least or drawn:
                strip[size] = tiles[k]
                size += 1
            k += 1
            if size < TILES_AT_ONCE and k < len(tiles):
                continue
        if size and bound_views(
            statements, mentions, views, runs, strip[:size], at, shares, there, bound
        ):
            for i in range(size):
                of_tile = bound[i * SLOTS : (i + 1) * SLOTS]
                bits, row = views.present[strip[i]], views.first[strip[i]]
                if len(weights):
                    _multiply_by_prior(of_tile, bits, row, weights)
                for slot in range(SLOTS):
                    if of_tile[slot] > 0.0 and count < n_views:  # a forged map may have more
                        rows[count], bounds[count] = row, of_tile[slot]
                        multiplicity[count] = share[strip[i]]
                        count += 1
                        if of_tile[slot] > least:
                            highest[n] = of_tile[slot]
                            n += 1
                    row += (bits >> slot) & 1
            if n > 2 * most:
                n, least = most, keep_largest(highest[:n], most)
        for i in range(size):
            tile_bound[strip[i]] = 0.0
        size = 0
    return (rows[:count], bounds[:count], multiplicity[:count]), n, least


@kernel(finite=True, _nrt=False)
def keep_largest(values, most):
    """Move the `most` largest of values (n,) to the front, and return the least of these (quickselect)."""
    low, high = 0, len(values) - 1
    while low < high:
        pivot, i, j = values[(low + high) >> 1], low, high
        while i <= j:
            while values[i] > pivot:
                i += 1
            while values[j] < pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if most <= j + 1:
            high = j
        elif most > i:
            low = i
        else:
            break
    return values[most - 1]


@kernel(finite=True, _nrt=False)
def _multiply_by_prior(bound, bits, row, weights):
    """Multiply the bounds of a tile's viewpoints by their prior weights."""
    for slot in range(SLOTS):
        if (bits >> slot) & 1:
            bound[slot] *= weights[row]
            row += 1


def _sample_tiles(views, tiles, tile_bound, share, bounded_weight, most):
    """Sample `most` tiles, ascending, that represent all; `share` becomes how many each represents."""
    heights = tile_bound[tiles] * (views.first[tiles + 1] - views.first[tiles])
    cumulative = np.cumsum(heights)
    if not len(tiles) or cumulative[-1] <= NEGLIGIBLE * bounded_weight:
        return tiles[:0]
    if len(tiles) <= most:
        return tiles
    step = cumulative[-1] / most
    times = np.diff(np.floor(cumulative / step + 0.5), prepend=0.0)
    taken = times > 0.0
    share[tiles[taken]] = times[taken] * step / heights[taken]
    return tiles[taken]
