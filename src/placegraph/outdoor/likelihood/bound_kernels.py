# mypy: allow-untyped-defs, allow-incomplete-defs
"""Upper bounds on the likelihood of statements at viewpoints, from the view index alone."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.likelihood.match_kernels import BETWEEN, DIRECTION, ME
from placegraph.outdoor.map.directions_kernels import TABLE
from placegraph.outdoor.map.index_kernels import FINE, SLOTS, count_lower_bits, slot_of, unpack

TILES_AT_ONCE = 16
"""Number of tiles whose viewpoints are bounded at once: their data fits into the nearest cache."""
VIEW_HALF_WIDTH = 8.0
"""Largest distance of the speaker from a viewpoint along each axis [m]."""
MAX_BOUND = 1e290
"""Largest bound: texts of a hundred statements must not overflow."""
FAR_AWAY = 1e9
"""West and south end of an empty box, whose east and north end are its negatives [m]."""
MASS, WEST, SOUTH, EAST, NORTH = range(5)
"""Columns: mass of a mention in sight, and the ends of the box that holds its objects [m]."""


@kernel
def allocate_sight(n_mentions):
    """Allocate mass and box of each mention, and of the speaker, for viewpoints of `TILES_AT_ONCE` tiles."""
    extents = np.empty((n_mentions + 1, 5, TILES_AT_ONCE * SLOTS), np.float32)
    for m in range(n_mentions):
        _clear(extents[m])
    extents[ME] = VIEW_HALF_WIDTH  # the last row is the speaker's
    extents[ME, MASS] = 1.0
    extents[ME, WEST : SOUTH + 1] = -VIEW_HALF_WIDTH
    return extents, np.ones(n_mentions + 1, np.bool_)


@kernel(finite=True)
def bound_views(statements, mentions, views, tiles, at, extents, there, bound):
    """Bound the viewpoints of tiles (ascending, at most `TILES_AT_ONCE`), slot by slot, in `bound`.

    The bound is the likelihood ratio of the statements if every direction were right (less the share
    that `noise` grants); 0 where not all objects of at least one statement are in sight. `at` holds
    the position in the runs of each token. Returns whether any bound is above 0.
    """
    n = SLOTS * len(tiles)
    for m in range(len(mentions.starts) - 1):
        there[m] = _sum_masses(extents[m], mentions, views, at, m, tiles)
    is_possible = _bound_tiles(statements, extents, there, views, tiles, bound[:n])
    for m in range(len(mentions.starts) - 1):
        if there[m]:
            _clear(extents[m])
    return is_possible


@kernel(inline="always")
def _clear(extents):
    """Set the masses of a mention to 0, and its boxes to empty ones."""
    extents[MASS] = 0.0
    extents[WEST : SOUTH + 1] = FAR_AWAY
    extents[EAST : NORTH + 1] = -FAR_AWAY


@kernel(finite=True, _nrt=False)
def skip_to_tile(views, p, end, tile):
    """Find the first of the runs from `p` on whose tile is not before `tile`."""
    if p >= end or views.run_tiles[p] >= tile:
        return p
    step = 1
    while p + step < end and views.run_tiles[p + step] < tile:
        p += step
        step += step
    high = min(end, p + step)
    while high - p > 1:
        middle = (p + high) >> 1
        if views.run_tiles[middle] < tile:
            p = middle
        else:
            high = middle
    return high


@kernel(finite=True, _nrt=False)
def _sum_masses(extents, mentions, views, at, m, tiles):
    """Sum the masses of a mention in sight of the viewpoints of tiles; return whether there is any."""
    there = False
    for k in range(mentions.starts[m], mentions.starts[m + 1]):
        end, weight = views.token_starts[mentions.tokens[k] + 1], mentions.weights[k]
        p = at[k]
        for i in range(len(tiles)):
            p = skip_to_tile(views, p, end, tiles[i])
            if p == end:
                break
            if views.run_tiles[p] == tiles[i]:
                there = True
                _add_run(extents, views, p, i * SLOTS, views.present[tiles[i]], weight)
        at[k] = p
    return there


@kernel(finite=True, _nrt=False)
def _add_run(extents, views, p, base, present, weight):
    """Add the postings of a run to the masses and boxes of its tile's viewpoints."""
    bits, q = views.run_slots[p], np.int64(views.run_first[p])
    bits = bits & present  # a forged map may have others, or too few postings
    while bits != 0 and q < len(views.postings):
        i = base + slot_of(bits)
        grade, west, south, east, north = unpack(np.int64(views.postings[q]))
        extents[WEST, i] = min(extents[WEST, i], west)
        extents[SOUTH, i] = min(extents[SOUTH, i], south)
        extents[EAST, i] = max(extents[EAST, i], east)
        extents[NORTH, i] = max(extents[NORTH, i], north)
        extents[MASS, i] += weight * views.levels[grade]
        bits &= bits - 1
        q += 1


@kernel(finite=True)
def _bound_tiles(statements, extents, there, views, tiles, bound):
    """Bound the viewpoints of tiles, 0 where no statement can hold; return whether any can."""
    is_possible = False
    total, pairs = np.ones(len(bound), np.float32), np.zeros(len(bound), np.float32)
    for s in range(len(statements.op)):
        a, b = find_bounded_ends(statements, s)
        if statements.negated[s] or a == b or not (there[a] and there[b]):
            continue
        if not is_possible:
            bound[:] = 1.0
            is_possible = True
            _count_in_sight(views, tiles, total, pairs)
        gain = (1.0 - statements.noise[s]) / (statements.noise[s] * statements.background[s])
        is_of_speaker = a == ME or b == ME
        in_sight = total if is_of_speaker else pairs
        smoothing = np.float32(0.0 if is_of_speaker else statements.pair_smoothing)
        opposite = np.float32(1.0)
        if statements.op[s] == DIRECTION and statements.distance[s] >= 0.0:
            opposite = statements.table[s, TABLE // 2]
        _multiply_by_gain(
            bound,
            extents[a],
            extents[b],
            in_sight,
            smoothing,
            gain,
            statements.bearing[s],
            opposite,
        )
    if is_possible:
        for i in range(len(bound)):
            bound[i] = 0.0 if bound[i] == 1.0 else bound[i]
        for s in range(len(statements.op)):
            a = statements.source[s]
            if statements.negated[s] and statements.target[s] == ME and a != ME and there[a]:
                in_any_direction = statements.op[s] != DIRECTION
                _multiply_by_absence(
                    bound, extents[a], statements.noise[s], statements.bearing[s], in_any_direction
                )
    return is_possible


@kernel(finite=True, _nrt=False)
def _count_in_sight(views, tiles, total, pairs):
    """Read how many objects, and pairs of them, are in sight of the viewpoints of tiles, slot by slot."""
    grain = np.float32(1.0 / FINE)
    for k in range(len(tiles)):
        bits, row = views.present[tiles[k]], views.first[tiles[k]]
        for i in range(k * SLOTS, (k + 1) * SLOTS):
            if bits & 1:
                total[i] = views.levels[views.total[row]]
                root = np.float32(views.pairs[row]) * grain
                pairs[i] = root * root
                row += 1
            bits >>= 1


@kernel(inline="always")
def find_bounded_ends(statements, s):
    """Return the two mentions that bound a statement: b and c for "I am between b and c"."""
    a, b = statements.source[s], statements.target[s]
    return (statements.target2[s], b) if statements.op[s] == BETWEEN and a == ME else (a, b)


@kernel(finite=True, error_model="numpy")
def _multiply_by_gain(bound, a, b, in_sight, smoothing, gain, towards, opposite):
    """Multiply bounds by the largest likelihood ratio of a statement of mentions a and b.

    `in_sight` counts the objects, or pairs, in sight. Where no object of a can lie near the direction
    `towards` seen from b, the share is multiplied by `opposite`.
    """
    ux, uy = towards
    part = np.empty(len(in_sight), np.float32)
    for i in range(len(in_sight)):
        west, east = a[WEST, i] - b[EAST, i], a[EAST, i] - b[WEST, i]
        south, north = a[SOUTH, i] - b[NORTH, i], a[NORTH, i] - b[SOUTH, i]
        ahead = max(west * ux, east * ux) + max(south * uy, north * uy)
        left = min(-west * uy, -east * uy) + min(south * ux, north * ux)
        right = max(-west * uy, -east * uy) + max(south * ux, north * ux)
        aside = max(left, -right)
        may = (ahead > 0.0) & (aside < np.float32(1.4) * ahead + np.float32(2.0))
        of = a[MASS, i] * b[MASS, i] / (in_sight[i] + smoothing)
        part[i] = min(of if may else of * opposite, np.float32(1.0))
    for i in range(len(in_sight)):  # a loop of its own, since its numbers are twice as wide
        bound[i] = min(MAX_BOUND, bound[i] * (1.0 + gain * part[i]))


@kernel(finite=True, _nrt=False)
def _multiply_by_absence(bound, extents, noise, towards, in_any_direction):
    """Lower the bounds of viewpoints that have an object in sight, or in a direction, that is denied."""
    ux, uy = towards
    for i in range(len(bound)):
        west, south, east, north = (
            extents[WEST, i],
            extents[SOUTH, i],
            extents[EAST, i],
            extents[NORTH, i],
        )
        ahead = min(west * ux, east * ux) + min(south * uy, north * uy)
        left = min(-west * uy, -east * uy) + min(south * ux, north * ux)
        right = max(-west * uy, -east * uy) + max(south * ux, north * ux)
        if in_any_direction or (ahead > 8.0 and max(-left, right) < 0.7 * ahead):
            absent = np.exp(-2.0 * extents[MASS, i])
            bound[i] *= (1.0 - noise) * absent + noise


FIRST_TILES = 64
"""Number of tiles of largest bound whose viewpoints are bounded first; then four times as many, and so
on, as long as others may matter."""
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
    viewpoints of largest bound of the whole map, if it is at least `least`; these represent none. A tile
    is skipped only where the bound of the whole tile is below theirs, or no larger than `least`. Then
    come `drawn` samples of all others (`sample_systematic`); skipped tiles are represented by samples of
    tiles, drawn in proportion to their bounds.
    """
    tile_bound = _bound_whole_tiles(statements, mentions, views, weights)
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
            statements, mentions, views, weights, first, tile_bound, share, most, highest, n, least
        )
        bounded.append(found)
        if len(every) <= size:
            break
        every = every[(tile_bound[every] > least) & (tile_bound[every] > 0.0)]
        size *= 4
    if drawn:
        rest = _sample_tiles(
            views, np.flatnonzero(tile_bound > 0.0), tile_bound, share,
            sum(bounds.sum() for _, bounds, _ in bounded), max(1, drawn // SAMPLES_PER_TILE),
        )  # fmt: skip
        found, n, _ = _bound_single_views(
            statements,
            mentions,
            views,
            weights,
            rest,
            tile_bound,
            share,
            most,
            highest,
            n,
            INFINITE,
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


@kernel(finite=True)
def sample_systematic(bounds, multiplicity, drawn):
    """Sample rows (`drawn`,) systematically; return these, and how many each represents.

    `multiplicity` (N,) are the numbers that rows represent before. Rows of larger bound are drawn more often.
    The first half, quarter and so on of the sample are as even as all of it: each then represents twice,
    or four times, as many.
    """
    weights, step = np.empty(len(bounds) if drawn else 0), 0.0
    for i in range(len(weights)):
        weights[i] = multiplicity[i] * np.sqrt(bounds[i] * np.sqrt(bounds[i]))
        step += weights[i] / drawn
    if step <= 0.0:
        return np.zeros(0, np.int64), np.zeros(0)
    rows, cumulative, i = np.empty(drawn, np.int64), weights[0], 0
    for j in range(drawn):
        while cumulative < (j + 0.5) * step and i + 1 < len(weights):
            i += 1
            cumulative += weights[i]
        at, left, half = 0, j, drawn // 2  # `j` with its bits reversed
        while half:
            at += half * (left & 1)
            left >>= 1
            half //= 2
        rows[at] = i
    return rows, multiplicity[rows] * step / np.maximum(weights[rows], 1e-300)


@kernel(finite=True)
def _bound_whole_tiles(statements, mentions, views, weights):
    """Bound all viewpoints of each tile (T,), times its largest weight; 0 where no statement can hold."""
    n_mentions = len(mentions.starts) - 1
    out = np.zeros(len(views.tiles))
    at = views.token_starts[mentions.tokens]
    of_pairs = np.zeros((n_mentions + 1, TILES_PER_STRIP), np.float32)
    of_total = np.zeros((n_mentions + 1, TILES_PER_STRIP), np.float32)
    of_total[ME] = 1.0
    there = np.ones(n_mentions + 1, np.bool_)
    for first in range(0, len(out), TILES_PER_STRIP):
        last = min(first + TILES_PER_STRIP, len(out))
        for m in range(n_mentions):
            there[m] = _sum_tile_masses(
                of_pairs[m], of_total[m], mentions, views, at, m, first, last
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
def _sum_tile_masses(of_pairs, of_total, mentions, views, at, m, first, last):
    """Find the largest masses of a mention in tiles from `first` to `last`; return whether there is any."""
    there = False
    for k in range(mentions.starts[m], mentions.starts[m + 1]):
        end, weight = views.token_starts[mentions.tokens[k] + 1], mentions.weights[k]
        p = at[k]
        while p < end and views.run_tiles[p] < last:
            i = np.int64(views.run_tiles[p]) - first
            if i >= 0:  # tiles of a forged map may not ascend
                of_pairs[i] += weight * views.levels[views.run_pairs[p]]
                of_total[i] += weight * views.levels[views.run_total[p]]
            p += 1
        there |= p > at[k]
        at[k] = p
    return there


@kernel(finite=True)
def _bound_single_views(
    statements, mentions, views, weights, tiles, tile_bound, share, most, highest, n, least
):
    """Bound the viewpoints of tiles whose own bound exceeds `least`: rows, bounds, `share` of their tile.

    All tiles are bounded if they are samples (`least` is then `INFINITE`); else the `n` `highest` bounds
    are kept. The bound (`tile_bound`) of tiles that were bounded becomes 0. Also returns `n` and `least`.
    """
    at = views.token_starts[mentions.tokens]
    extents, there = allocate_sight(len(mentions.starts) - 1)
    bound = np.empty(TILES_AT_ONCE * SLOTS)
    strip = np.empty(TILES_AT_ONCE, np.int64)
    drawn = least >= INFINITE
    n_views = k = size = count = 0
    for t in tiles:
        n_views += max(0, views.first[t + 1] - views.first[t])
    rows = np.empty(n_views, np.int32)
    bounds, multiplicity = np.empty(n_views), np.empty(n_views)
    while k < len(tiles) or size > 0:
        if k < len(tiles):
            if tile_bound[tiles[k]] > least or drawn:
                strip[size] = tiles[k]
                size += 1
            k += 1
            if size < TILES_AT_ONCE and k < len(tiles):
                continue
        if size and bound_views(
            statements, mentions, views, strip[:size], at, extents, there, bound
        ):
            for i in range(size):
                of_tile = bound[i * SLOTS : (i + 1) * SLOTS]
                bits, row = views.present[strip[i]], views.first[strip[i]]
                if len(weights):
                    _multiply_by_prior(of_tile, bits, row, weights)
                for slot in range(SLOTS):
                    if of_tile[slot] > 0.0 and count < n_views:  # a forged map may have more
                        rows[count] = row + count_lower_bits(bits, slot)
                        bounds[count], multiplicity[count] = of_tile[slot], share[strip[i]]
                        count += 1
                        if of_tile[slot] > least:
                            highest[n] = of_tile[slot]
                            n += 1
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
