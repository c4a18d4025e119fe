# mypy: allow-untyped-defs, allow-incomplete-defs
"""Upper bounds on the likelihood of statements at viewpoints, from the view index alone."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.likelihood.match_kernels import BETWEEN, DIRECTION, ME
from placegraph.outdoor.map.directions_kernels import TABLE
from placegraph.outdoor.map.index_kernels import FINE, SLOTS, below, slot_of, unpack

TILES = 16
"""Tiles whose bounds are reckoned at once: what is known of them stays in the nearest cache."""
HERE = 8.0
"""The speaker may stand so far to each side of a viewpoint [m]."""
HIGHEST = 1e290
"""Bounds are cut here: texts of a hundred statements must not overflow."""
NOWHERE = 1e9
"""West and south end of a box of nothing; its east and north end are as far the other way [m]."""
MASS, WEST, SOUTH, EAST, NORTH = range(5)
"""How much of a mention is in sight, and the ends of the box that it lies in [m]."""


@kernel
def blank(n_mentions):
    """Room for what the viewpoints of `TILES` tiles have of each mention in sight, and of the speaker."""
    seen = np.empty((n_mentions + 1, 5, TILES * SLOTS), np.float32)
    for m in range(n_mentions):
        _forget(seen[m])
    seen[ME] = HERE  # the last row is the speaker's
    seen[ME, MASS] = 1.0
    seen[ME, WEST : SOUTH + 1] = -HERE
    return seen, np.ones(n_mentions + 1, np.bool_)


@kernel(finite=True)
def bounds_of(statements, mentions, views, tiles, at, seen, there, bound):
    """Bounds of the viewpoints of tiles (ascending, at most `TILES`), slot by slot, into `bound`.

    The bound is the likelihood ratio that the statements would have if every direction were right
    (less what `noise` grants them); 0 where not all things of at least one statement are in sight.
    `at` is where the runs of the mentions' tokens were left. Returns whether any is above 0.
    """
    n = SLOTS * len(tiles)
    for m in range(len(mentions.starts) - 1):
        there[m] = _fill(seen[m], mentions, views, at, m, tiles)
    worth = _bound(statements, seen, there, views, tiles, bound[:n])
    for m in range(len(mentions.starts) - 1):
        if there[m]:
            _forget(seen[m])
    return worth


@kernel(inline="always")
def _forget(seen):
    """Make a mention's masses nothing, and its boxes such that any box makes them its own."""
    seen[MASS] = 0.0
    seen[WEST : SOUTH + 1] = NOWHERE
    seen[EAST : NORTH + 1] = -NOWHERE


@kernel(finite=True, _nrt=False)
def skip(views, p, end, tile):
    """First of the runs from `p` on whose tile is not before `tile`."""
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
def _fill(seen, mentions, views, at, m, tiles):
    """Sum what viewpoints of tiles see of a mention; return whether any sees any."""
    there = False
    for k in range(mentions.starts[m], mentions.starts[m + 1]):
        end, weight = views.token_starts[mentions.tokens[k] + 1], mentions.weights[k]
        p = at[k]
        for i in range(len(tiles)):
            p = skip(views, p, end, tiles[i])
            if p == end:
                break
            if views.run_tiles[p] == tiles[i]:
                there = True
                _unfold(seen, views, p, i * SLOTS, views.present[tiles[i]], weight)
        at[k] = p
    return there


@kernel(finite=True, _nrt=False)
def _unfold(seen, views, p, base, present, weight):
    """Add the postings of a run to what is in sight of its tile's viewpoints."""
    bits, q = views.run_slots[p], np.int64(views.run_first[p])
    bits = bits & present  # of a forged map they may be others, and end early
    while bits != 0 and q < len(views.postings):
        i = base + slot_of(bits)
        grade, west, south, east, north = unpack(np.int64(views.postings[q]))
        seen[WEST, i] = min(seen[WEST, i], west)
        seen[SOUTH, i] = min(seen[SOUTH, i], south)
        seen[EAST, i] = max(seen[EAST, i], east)
        seen[NORTH, i] = max(seen[NORTH, i], north)
        seen[MASS, i] += weight * views.levels[grade]
        bits &= bits - 1
        q += 1


@kernel(finite=True)
def _bound(statements, seen, there, views, tiles, bound):
    """Bounds of the viewpoints of tiles, 0 where none is worth it; whether any may be."""
    worth = False
    total, pairs = np.ones(len(bound), np.float32), np.zeros(len(bound), np.float32)
    for s in range(len(statements.op)):
        a, b = ends_of(statements, s)
        if statements.negated[s] or a == b or not (there[a] and there[b]):
            continue
        if not worth:
            bound[:] = 1.0
            worth = True
            _crowds(views, tiles, total, pairs)
        gain = (1.0 - statements.noise[s]) / (statements.noise[s] * statements.background[s])
        of_me = a == ME or b == ME
        among = total if of_me else pairs
        crowd = np.float32(0.0 if of_me else statements.crowd)
        wrong = np.float32(1.0)
        if statements.op[s] == DIRECTION:
            wrong = statements.table[s, TABLE // 2]
        _raise(bound, seen[a], seen[b], among, crowd, gain, statements.bearing[s], wrong)
    if worth:
        for i in range(len(bound)):
            bound[i] = 0.0 if bound[i] == 1.0 else bound[i]
        for s in range(len(statements.op)):
            a = statements.source[s]
            if statements.negated[s] and statements.target[s] == ME and a != ME and there[a]:
                anyhow = statements.op[s] != DIRECTION
                _deny(bound, seen[a], statements.noise[s], statements.bearing[s], anyhow)
    return worth


@kernel(finite=True, _nrt=False)
def _crowds(views, tiles, total, pairs):
    """Sum what is in sight of the viewpoints of tiles, slot by slot: alone, and in pairs."""
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
def ends_of(statements, s):
    """The two mentions that a bound looks for: of "I am between b and c" these are b and c."""
    a, b = statements.source[s], statements.target[s]
    return (statements.target2[s], b) if statements.op[s] == BETWEEN and a == ME else (a, b)


@kernel(finite=True, error_model="numpy")
def _raise(bound, a, b, among, crowd, gain, towards, wrong):
    """Multiply bounds by what a statement of a and b would add if `among` viewpoints saw it hold.

    Where nothing of a may lie, seen from b, near the direction `towards`, it is `wrong`.
    """
    ux, uy = towards
    part = np.empty(len(among), np.float32)
    for i in range(len(among)):
        west, east = a[WEST, i] - b[EAST, i], a[EAST, i] - b[WEST, i]
        south, north = a[SOUTH, i] - b[NORTH, i], a[NORTH, i] - b[SOUTH, i]
        ahead = max(west * ux, east * ux) + max(south * uy, north * uy)
        left = min(-west * uy, -east * uy) + min(south * ux, north * ux)
        right = max(-west * uy, -east * uy) + max(south * ux, north * ux)
        aside = max(left, -right)
        may = (ahead > 0.0) & (aside < np.float32(1.4) * ahead + np.float32(2.0))
        of = a[MASS, i] * b[MASS, i] / (among[i] + crowd)
        part[i] = min(of if may else of * wrong, np.float32(1.0))
    for i in range(len(among)):  # of its own, since it is twice as wide
        bound[i] = min(HIGHEST, bound[i] * (1.0 + gain * part[i]))


@kernel(finite=True, _nrt=False)
def _deny(bound, seen, noise, towards, anyhow):
    """Lower the bounds of viewpoints that see what is said to be absent, or absent in a direction."""
    ux, uy = towards
    for i in range(len(bound)):
        west, south, east, north = seen[WEST, i], seen[SOUTH, i], seen[EAST, i], seen[NORTH, i]
        ahead = min(west * ux, east * ux) + min(south * uy, north * uy)
        left = min(-west * uy, -east * uy) + min(south * ux, north * ux)
        right = max(-west * uy, -east * uy) + max(south * ux, north * ux)
        if anyhow or (ahead > 8.0 and max(-left, right) < 0.7 * ahead):
            absent = np.exp(-2.0 * seen[MASS, i])
            bound[i] *= (1.0 - noise) * absent + noise


FIRST = 64
"""So many tiles of largest bound are looked at first, then four times as many, and so on: what they
hold tells which others may matter."""
A_TILE = 4
"""For about so many viewpoints that are drawn, a tile of those that cannot matter is looked at."""
NOTHING = 1e-4
"""Tiles that together weigh less than this share of those looked at weigh nothing."""
EVERY = 1e300
"""No bound is as large: tiles are looked at however little they promise, and nothing is chosen."""
STRIP = 1024
"""Tiles whose bounds are reckoned at once."""


@kernel(finite=True)
def promising_views(statements, mentions, views, weights, most, drawn, least):
    """Viewpoints (K,) worth scoring, their bounds, and how many others each stands for.

    Only viewpoints that have all things of at least one statement in sight are worth it. The bound
    (`bounds_of`) is of the likelihood ratio, times the prior `weights` (W,), all equal where empty.
    First come the `most` of largest bound of all the map that is `least` at least, the most promising
    first, which stand for none: a tile is passed over only where the bound of the whole tile is below
    theirs, or no larger than `least`. Then `drawn` others that stand for all others (`draw`); tiles that
    were passed over are represented by some of them, each drawn as surely as it may weigh.
    """
    promise = _of_tiles(statements, mentions, views)
    if len(weights):
        for t in range(len(promise)):
            heaviest = 0.0
            for v in range(views.first[t], views.first[t + 1]):
                heaviest = max(heaviest, weights[v])
            promise[t] *= heaviest
    highest, n, floor = np.empty(2 * most + TILES * SLOTS), 0, least
    seen = (np.empty(4096, np.int32), np.empty(4096), np.empty(4096))
    many = 0
    share = np.ones(len(promise))
    every, size = np.flatnonzero(promise > 0.0), FIRST
    while len(every) > 0:
        first = every
        if len(every) > size:
            bar = np.partition(promise[every], len(every) - size)[len(every) - size]
            first = every[promise[every] > bar]
        seen, many, n, least = _visit(
            statements, mentions, views, weights, first, promise, share, most,
            highest, n, least, seen, many,
        )  # fmt: skip
        if len(every) <= size:
            break
        every = every[(promise[every] > least) & (promise[every] > 0.0)]
        size *= 4
    if drawn:
        rest = _drawn(
            views,
            np.flatnonzero(promise > 0.0),
            promise,
            share,
            seen[1][:many].sum(),
            max(1, drawn // A_TILE),
        )
        seen, many, n, least = _visit(
            statements, mentions, views, weights, rest, promise, share, most,
            highest, n, EVERY, seen, many,
        )  # fmt: skip
    rows, bounds, stands = seen[0][:many], seen[1][:many], seen[2][:many]
    return _chosen(rows, bounds, stands, highest[:n], floor, most, drawn)


@kernel(finite=True)
def _chosen(rows, bounds, stands, highest, least, most, drawn):
    """Choose the best of all viewpoints looked at; see `promising_views`."""
    if len(highest) >= most:
        least = np.partition(highest, len(highest) - most)[len(highest) - most]
    ties = most
    for i in range(len(highest)):
        ties -= highest[i] > least
    best, n = np.empty(most, np.int64), 0
    for i in range(len(rows)):
        good = n < most and bounds[i] >= least and stands[i] == 1.0
        if good and (bounds[i] > least or ties > 0):
            ties -= bounds[i] == least
            best[n], stands[i] = i, 0.0
            n += 1
    best = best[:n]
    best = best[np.argsort(-bounds[best])]
    some, stand = draw(bounds, stands, drawn)
    every = np.concatenate((best, some))
    return rows[every], bounds[every], np.concatenate((np.zeros(n), stand))


@kernel(finite=True)
def draw(bounds, stands, drawn):
    """Rows (`drawn`,) of some that stand for all (N,) that stand for any, and how many each stands for.

    Those of larger bound are drawn more often. The first half, quarter and so on are drawn as evenly as
    all of them: they do as well, each standing for twice, or four times, as many.
    """
    weights, step = np.empty(len(bounds) if drawn else 0), 0.0
    for i in range(len(weights)):
        weights[i] = stands[i] * np.sqrt(bounds[i] * np.sqrt(bounds[i]))
        step += weights[i] / drawn
    if step <= 0.0:
        return np.zeros(0, np.int64), np.zeros(0)
    rows, upto, i = np.empty(drawn, np.int64), weights[0], 0
    for j in range(drawn):
        while upto < (j + 0.5) * step and i + 1 < len(weights):
            i += 1
            upto += weights[i]
        at, left, half = 0, j, drawn // 2  # `j` with its bits reversed
        while half:
            at += half * (left & 1)
            left >>= 1
            half //= 2
        rows[at] = i
    return rows, stands[rows] * step / np.maximum(weights[rows], 1e-300)


@kernel(finite=True)
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


@kernel(finite=True, _nrt=False)
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


@kernel(finite=True)
def _visit(
    statements, mentions, views, weights, tiles, promise, share, most, highest, n, least, seen, many
):  # fmt: skip
    """Look at the viewpoints of tiles that promise more than `least`, and add them to those `seen`.

    Of these there are `many`: their rows, bounds, and the `share` of their tile. Of tiles that were
    drawn (`least` is then `EVERY`) all are added, and else the `n` `highest` bounds are kept. The
    promise of tiles looked at becomes 0.
    """
    at = views.token_starts[mentions.tokens]
    sight, there = blank(len(mentions.starts) - 1)
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
        if many + TILES * SLOTS > len(seen[0]):
            seen = (
                np.concatenate((seen[0], np.empty_like(seen[0]))),
                np.concatenate((seen[1], np.empty_like(seen[1]))),
                np.concatenate((seen[2], np.empty_like(seen[2]))),
            )
        if size and bounds_of(statements, mentions, views, strip[:size], at, sight, there, bound):
            rows, bounds, stands = seen
            for i in range(size):
                of_tile = bound[i * SLOTS : (i + 1) * SLOTS]
                bits, row = views.present[strip[i]], views.first[strip[i]]
                if len(weights):
                    _weigh(of_tile, bits, row, weights)
                for slot in range(SLOTS):
                    if of_tile[slot] > 0.0:
                        rows[many] = row + below(bits, slot)
                        bounds[many], stands[many] = of_tile[slot], share[strip[i]]
                        many += 1
                        if of_tile[slot] > least:
                            highest[n] = of_tile[slot]
                            n += 1
            if n > 2 * most:
                highest[:most] = np.partition(highest[:n], n - most)[n - most : n]
                n, least = most, highest[:most].min()
        for i in range(size):
            promise[strip[i]] = 0.0
        size = 0
    return seen, many, n, least


@kernel(finite=True, _nrt=False)
def _weigh(bound, bits, row, weights):
    """Multiply the bounds of a tile's viewpoints by their weights."""
    for slot in range(SLOTS):
        if (bits >> slot) & 1:
            bound[slot] *= weights[row]
            row += 1


@kernel(finite=True)
def _drawn(views, tiles, promise, share, known, most):
    """Tiles (ascending), `most`, that stand for all; their `share` becomes how many each stands for."""
    heights = np.empty(len(tiles))
    rest = 0.0
    for i in range(len(tiles)):
        heights[i] = promise[tiles[i]] * (views.first[tiles[i] + 1] - views.first[tiles[i]])
        rest += heights[i]
    if rest <= NOTHING * known:
        return tiles[:0]
    if len(tiles) <= most:
        return tiles
    taken, n = np.empty(most + 1, np.int64), 0
    step = rest / most
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
