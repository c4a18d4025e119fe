# mypy: allow-untyped-defs, allow-incomplete-defs
"""How likely the statements can be at viewpoints at best: bounds from the view index alone."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.likelihood.fit_kernels import BETWEEN, DIRECTION, ME, TABLE
from placegraph.outdoor.map.index_kernels import FINE, SLOTS, slot_of, unpack

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
    """What the viewpoints of tiles have of a mention in sight; whether any has any."""
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
    """How much is in sight of the viewpoints of tiles, slot by slot: alone, and in pairs."""
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
