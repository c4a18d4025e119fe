# mypy: allow-untyped-defs, allow-incomplete-defs
"""Which viewpoints are worth a look: bounds on their likelihood from the view index alone."""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel
from placegraph.outdoor.likelihood.fit_kernels import BETWEEN, DIRECTION, ME, TABLE
from placegraph.outdoor.map.index_kernels import unpack_box

STRIP = 1000
"""Viewpoints whose bounds are reckoned at once: what is known of them stays in the nearest cache."""
HERE = 8.0
"""The speaker may stand so far to each side of a viewpoint [m]."""
HIGHEST = 1e290
"""Bounds are cut here: texts of a hundred statements must not overflow."""
MASS, WEST, SOUTH, EAST, NORTH = range(5)
"""How much of a mention is in sight, and the ends of the box that it lies in [m]."""


@kernel(fastmath=True)
def promising_views(statements, mentions, views, weights, most):
    """Viewpoints (K,) worth scoring, the most promising first, their bounds, and what is left out.

    Only viewpoints that have all things of at least one statement in sight are worth it. The bound
    is the likelihood ratio that the statements would have if every direction were right (less what
    `noise` grants them), times the prior `weights` (W,), all equal where empty. Left out is the sum
    of the bounds of viewpoints that are worth it and were not returned.
    """
    n_mentions = len(mentions.starts) - 1
    at = views.posting_starts[mentions.tokens]
    seen = np.zeros((n_mentions + 1, 5, STRIP), np.float32)
    seen[ME] = HERE  # the last row is the speaker's
    seen[ME, MASS] = 1.0
    seen[ME, WEST : SOUTH + 1] = -HERE
    there = np.ones(n_mentions + 1, np.bool_)
    bound = np.empty(STRIP)
    chosen = np.empty(2 * most + STRIP, np.int32)
    bounds = np.empty(len(chosen))
    n, least, total = 0, 0.0, 0.0
    for first in range(0, len(views.total), STRIP):
        last = min(first + STRIP, len(views.total))
        for m in range(n_mentions):
            there[m] = _fill(seen[m], mentions, views, at, m, first, last)
        if _bound(statements, seen, there, views, first, bound[: last - first]):
            total += _weigh(bound[: last - first], weights[first:last])
            for i in range(last - first):
                if bound[i] > least:
                    chosen[n], bounds[n] = first + i, bound[i]
                    n += 1
            if n > 2 * most:
                n, least = _heaviest(chosen, bounds, n, most)
        for m in range(n_mentions):
            if there[m]:
                seen[m, MASS] = 0.0
    n, _ = _heaviest(chosen, bounds, n, most)
    order = np.argsort(-bounds[:n])
    return chosen[order], bounds[order], max(0.0, total - bounds[:n].sum())


@kernel(fastmath=True, _nrt=False)
def _fill(seen, mentions, views, at, m, first, last):
    """What viewpoints from `first` to `last` have of a mention in sight; whether any has any.

    `at` is where the lists of its tokens were left.
    """
    there = False
    for k in range(mentions.starts[m], mentions.starts[m + 1]):
        end, weight = views.posting_starts[mentions.tokens[k] + 1], mentions.weights[k]
        p = at[k]
        while p < end and views.posting_views[p] < last:
            i = views.posting_views[p] - first
            west, south, east, north = unpack_box(views.posting_boxes[p])
            if seen[MASS, i] == 0.0:
                seen[WEST, i], seen[SOUTH, i], seen[EAST, i], seen[NORTH, i] = (
                    west, south, east, north
                )  # fmt: skip
            else:
                seen[WEST, i] = min(seen[WEST, i], np.float32(west))
                seen[SOUTH, i] = min(seen[SOUTH, i], np.float32(south))
                seen[EAST, i] = max(seen[EAST, i], np.float32(east))
                seen[NORTH, i] = max(seen[NORTH, i], np.float32(north))
            seen[MASS, i] += weight * views.posting_mass[p]
            p += 1
        there |= p > at[k]
        at[k] = p
    return there


@kernel(fastmath=True)
def _bound(statements, seen, there, views, first, bound):
    """Bounds of viewpoints from `first` on, 0 where none is worth it; whether any may be."""
    worth = False
    last = first + len(bound)
    for s in range(len(statements.op)):
        a, b = _ends(statements, s)
        if statements.negated[s] or a == b or not (there[a] and there[b]):
            continue
        if not worth:
            bound[:] = 1.0
            worth = True
        gain = (1.0 - statements.noise[s]) / (statements.noise[s] * statements.background[s])
        of_me = a == ME or b == ME
        among = views.total[first:last] if of_me else views.pairs[first:last]
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


@kernel(fastmath=True, _nrt=False)
def _weigh(bound, weights):
    """Sum of bounds, once they are multiplied by their `weights` where there are any."""
    for i in range(len(weights)):
        bound[i] *= weights[i]
    total = 0.0
    for i in range(len(bound)):
        total += bound[i]
    return total


@kernel(inline="always")
def _ends(statements, s):
    """The two mentions that a bound looks for: of "I am between b and c" these are b and c."""
    a, b = statements.source[s], statements.target[s]
    return (statements.target2[s], b) if statements.op[s] == BETWEEN and a == ME else (a, b)


@kernel(fastmath=True, error_model="numpy")
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


@kernel(fastmath=True, _nrt=False)
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
