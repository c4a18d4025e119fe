"""How well a viewpoint explains a description: a generative reading, compiled.

A speaker at viewpoint v picks things in sight and says how they lie. A statement s then has

    P(s | v) = (1 - noise) * sum over map objects that serve s of sight * word * geometry / normaliser
               + noise * P(s | anywhere)

and its log-likelihood ratio log P(s | v) / P(s | anywhere) is the evidence it brings. Directions are
soft: a little wrong costs little, the opposite costs all that `noise` leaves. What no map object in
sight serves may still be served from afar, if the thing is rare enough to be spoken of from there.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from placegraph.outdoor.raster import nearest_on_parts

DIRECTION, NEAR, INSIDE, ALONG, ACROSS, BETWEEN, VISIBLE, SAME = range(8)
"""Operations, one for each `Relation`, in its order."""
ME = -1
"""Stands for the viewpoint itself where a mention could stand."""
TABLE = 256
"""Entries of a direction table, over the cosine from -1 to 1."""
MOST = 96
"""At most this many objects in sight are weighed for one mention."""
AREA = 2
SMALL = 25.0
"""An area one stands in still lies in the direction of its centre, if that is this near [m]."""
BOTH = False
SOFT = 0.1


class Statements(NamedTuple):
    """Columns of a compiled query, one row a statement."""

    op: NDArray[np.int64]
    source: NDArray[np.int64]
    """Mention, or ME."""
    target: NDArray[np.int64]
    """Mention, or ME."""
    target2: NDArray[np.int64]
    """Mention, or ME; of BETWEEN only."""
    bearing: NDArray[np.float32]
    """(S, 2) unit vector east, north."""
    table: NDArray[np.float32]
    """(S, TABLE) P(the direction was said | cosine of the angle to it)."""
    distance: NDArray[np.float32]
    """Stated distance [m], 0 where unsaid."""
    negated: NDArray[np.bool_]
    count: NDArray[np.float32]
    """Stated number of sources, 0 where unsaid."""
    noise: NDArray[np.float32]
    """Share of statements of this kind that are wrong or about something else."""
    background: NDArray[np.float32]
    """P(statement | anywhere)."""
    crowd: float
    """Added to the number of pairs in sight: who sees few things is no more likely to be heard."""


class Scene(NamedTuple):
    """Columns of the map that kernels read."""

    kind: NDArray[np.uint8]
    part_starts: NDArray[np.int32]
    point_starts: NDArray[np.int32]
    points: NDArray[np.float32]
    center: NDArray[np.float32]
    token_starts: NDArray[np.int32]
    token_values: NDArray[np.int32]
    token_weights: NDArray[np.float32]


def direction_table(sigma: float, slip: float) -> NDArray[np.float32]:
    """P(direction said | cosine of the angle between truth and what is said), (TABLE,) float32.

    Eq. 6 softened: near 1 within the word's sector, falling around its edge; `slip` is the share of
    directions that are simply wrong. `sigma` [rad] is 0.5 for the four winds, whose sectors are 45
    degrees to either side.
    """
    angle = np.arccos(np.linspace(-1.0, 1.0, TABLE))
    half = np.pi / 4 * sigma / 0.5
    inside = 1.0 / (1.0 + np.exp((angle - half) / (SOFT * half)))
    return ((1.0 - slip) * inside + slip * 0.25).astype(np.float32)


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _direction(table, ux, uy, dx, dy):
    """P(direction said) for a vector; vectors shorter than a few metres have no clear direction."""
    d2 = dx * dx + dy * dy
    if d2 < 0.25:
        return np.float32(0.25)
    d = np.sqrt(d2)
    index = int(((dx * ux + dy * uy) / d + 1.0) * (0.5 * (TABLE - 1)) + 0.5)
    blur = d2 / (d2 + 4.0)
    return blur * table[min(TABLE - 1, max(0, index))] + (1.0 - blur) * np.float32(0.25)


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _distance(said, d):
    """How well a distance d fits what was said [m]; 1 where nothing was said."""
    if said <= 0.0:
        return 1.0
    z = (d - said) / (0.35 * said + 5.0)
    return np.exp(-0.5 * z * z)


@njit(cache=True, nogil=True, fastmath=True, inline="always")
def _close(said, d):
    """How well "near" fits a distance d [m]."""
    if said > 0.0:
        return _distance(said, d)
    return 1.0 / (1.0 + np.exp((d - 25.0) / 6.0))


@njit(cache=True, nogil=True, fastmath=True)
def serve_pair(op, table, ux, uy, said, ax, ay, ac, kind_a, bx, by, bc, kind_b):
    """P(geometry | source at a, target at b); `ac` and `bc` are their centres, all seen from v.

    Objects with an extent have two readings, their nearest point and their centre; both count.
    """
    dx, dy = ax - bx, ay - by
    d = np.sqrt(dx * dx + dy * dy)
    if op == DIRECTION:
        p = _direction(table, ux, uy, dx, dy)
        if BOTH and (kind_a != 0 or kind_b != 0):
            cx, cy = ac[0] - bc[0], ac[1] - bc[1]
            p = 0.5 * (p + _direction(table, ux, uy, cx, cy))
        return p * _distance(said, d)
    if op == NEAR:
        return _close(said, d)
    if op == ACROSS:
        return _close(0.0, max(0.0, d - 25.0)) * min(1.0, d / 8.0)
    if op == INSIDE:
        return _close(0.0, 2.0 * d) if kind_b == AREA else 0.2 * _close(0.0, d)
    if op == ALONG:
        return _close(0.0, 1.5 * d) if kind_b != 0 else 0.3 * _close(0.0, d)
    return _close(0.0, d)


@njit(cache=True, nogil=True, fastmath=True)
def serve_me(op, table, ux, uy, said, x, y, center, kind, forward):
    """P(geometry | the thing at (x, y) seen from v); `forward`: it is the source, v the target."""
    d = np.sqrt(x * x + y * y)
    if op == DIRECTION:
        if not forward:
            ux, uy = -ux, -uy
        p = _direction(table, ux, uy, x, y)
        if BOTH and kind != 0:
            p = 0.5 * (p + _direction(table, ux, uy, center[0], center[1]))
        return p * _distance(said, d)
    if op == VISIBLE:
        return _distance(said, d)
    if op == NEAR:
        return _close(said, d)
    if op == SAME:
        return _close(0.0, 2.0 * d)
    if op == INSIDE:
        return (1.0 if d < 1.0 else 0.3 * _close(0.0, 2.0 * d)) if kind == AREA else 0.2 * _close(0.0, d)
    if op == ALONG:
        return _close(0.0, 1.5 * d) if kind != 0 else 0.3 * _close(0.0, d)
    return _close(0.0, max(0.0, d - 25.0)) * min(1.0, d / 8.0)  # ACROSS


@njit(cache=True, nogil=True, fastmath=True)
def likelihoods(statements, scene, words, objects, at, sight, total, pairs, view, far, out, served):
    """Log-likelihood ratio of every statement at a viewpoint, into `out` (S,).

    `objects` (n,) are in sight, `at` (n, 2) where they stand seen from the viewpoint `view` (2,)
    [m], `sight` (n,) how readily they are spoken of, `words` (T, M) how well a token fits a mention.
    `far` (S,) is what distant objects add. `served` (S, 2) gets the best pair of objects, -1 for none.
    """
    n_mentions = words.shape[1]
    n = len(objects)
    who = np.empty((n_mentions, MOST), np.int32)
    fit = np.empty((n_mentions, MOST), np.float32)
    many = np.zeros(n_mentions, np.int64)
    for e in range(n):
        for m in range(n_mentions):
            best = np.float32(0.0)
            for t in range(scene.token_starts[objects[e]], scene.token_starts[objects[e] + 1]):
                w = words[scene.token_values[t], m] * scene.token_weights[t]
                best = max(best, w)
            if best > 0.0 and many[m] < MOST:
                who[m, many[m]], fit[m, many[m]] = e, best * sight[e]
                many[m] += 1
    stands = np.empty((n, 2), np.float32)
    lies = np.ones(n, np.bool_)  # what one stands in lies in no direction, unless its centre does
    for e in range(n):
        stands[e] = at[e]
        if scene.kind[objects[e]] == AREA and at[e, 0] == 0.0 and at[e, 1] == 0.0:
            stands[e] = scene.center[objects[e]] - view
            lies[e] = stands[e, 0] ** 2 + stands[e, 1] ** 2 < SMALL * SMALL
    for s in range(len(statements.op)):
        op, a, b = statements.op[s], statements.source[s], statements.target[s]
        where = stands if op == DIRECTION else at
        ux, uy = statements.bearing[s]
        table, said = statements.table[s], statements.distance[s]
        mass, expected, best = 0.0, 0.0, 0.0
        served[s] = -1
        if op == BETWEEN:
            mass, normaliser = _between(statements, s, who, fit, many, at, objects, served), pairs * total
        elif a == ME or b == ME:
            m = b if a == ME else a
            normaliser = total
            if m != ME:
                for i in range(many[m]):
                    e = who[m, i]
                    o = objects[e]
                    if op == DIRECTION and not lies[e]:
                        continue
                    c = scene.center[o] - view
                    p = fit[m, i] * serve_me(
                        op, table, ux, uy, said, where[e, 0], where[e, 1], c, scene.kind[o], b == ME
                    )
                    mass += p
                    expected += p / max(fit[m, i], np.float32(1e-6)) * min(np.float32(1.0), 2 * sight[e])
                    if p > best:
                        best = p
                        served[s, 0] = o
        else:
            normaliser = pairs
            for i in range(many[a]):
                ea = who[a, i]
                oa = objects[ea]
                if op == DIRECTION and not lies[ea]:
                    continue
                ca = scene.center[oa]
                for j in range(many[b]):
                    eb = who[b, j]
                    ob = objects[eb]
                    if oa == ob or (op == DIRECTION and not lies[eb]):
                        continue
                    p = (
                        fit[a, i]
                        * fit[b, j]
                        * serve_pair(
                            op, table, ux, uy, said,
                            where[ea, 0], where[ea, 1], ca, scene.kind[oa],
                            where[eb, 0], where[eb, 1], scene.center[ob], scene.kind[ob],
                        )
                    )  # fmt: skip
                    mass += p
                    if p > best:
                        best = p
                        served[s, 0], served[s, 1] = oa, ob
        if a == ME or b == ME:
            p = mass / normaliser
        else:
            p = mass / (pairs + statements.crowd)
        p = min(1.0, p + far[s])
        noise, background = statements.noise[s], statements.background[s]
        if statements.negated[s]:
            # what was denied should be absent: 1 - P(at least one in sight)
            absent = np.exp(-max(mass, expected))
            out[s] = np.log(((1.0 - noise) * absent + noise * background) / background)
            continue
        if statements.count[s] > 0.0 and expected > 0.0:
            k = statements.count[s]
            z = (expected - k) / (0.4 * k + 0.6)
            p *= 0.2 + 0.8 * np.exp(-0.5 * z * z)
        out[s] = np.log((1.0 - noise) * p / background + noise)


@njit(cache=True, nogil=True, fastmath=True)
def _between(statements, s, who, fit, many, at, objects, served):
    """Sum over triples of how well the source lies between two targets; the source may be the viewpoint."""
    a, b, c = statements.source[s], statements.target[s], statements.target2[s]
    if b == ME or c == ME:
        return 0.0
    mass, best = 0.0, 0.0
    for k in range(1 if a == ME else many[a]):
        ax = ay = np.float32(0.0)
        wa = np.float32(1.0)
        if a != ME:
            ax, ay = at[who[a, k], 0], at[who[a, k], 1]
            wa = fit[a, k]
        for i in range(many[b]):
            bx, by = at[who[b, i], 0] - ax, at[who[b, i], 1] - ay
            for j in range(many[c]):
                if objects[who[b, i]] == objects[who[c, j]]:
                    continue
                cx, cy = at[who[c, j], 0] - ax, at[who[c, j], 1] - ay
                lengths = np.sqrt((bx * bx + by * by) * (cx * cx + cy * cy)) + np.float32(1.0)
                opposite = 0.5 - 0.5 * (bx * cx + by * cy) / lengths
                p = wa * fit[b, i] * fit[c, j] * opposite**4
                mass += p
                if p > best:
                    best = p
                    served[s, 0], served[s, 1] = objects[who[b, i]], objects[who[c, j]]
    return mass


@njit(cache=True, nogil=True, fastmath=True)
def candidates(statements, mention_starts, mention_tokens, mention_weights, posting_starts, posting_views, posting_mass, total, pairs, most):  # fmt: skip
    """Viewpoints (K,) worth scoring, the most promising first, and their bounds.

    Only viewpoints that have all things of at least one statement in sight are touched. The bound
    is the likelihood ratio that the statements would have if every direction were right.
    """
    n_views, n_mentions = len(total), len(mention_starts) - 1
    mass = np.zeros((n_mentions, n_views), np.float32)
    length = np.zeros(n_mentions, np.int64)
    for m in range(n_mentions):
        for k in range(mention_starts[m], mention_starts[m + 1]):
            token, weight = mention_tokens[k], mention_weights[k]
            for p in range(posting_starts[token], posting_starts[token + 1]):
                mass[m, posting_views[p]] += weight * posting_mass[p]
            length[m] += posting_starts[token + 1] - posting_starts[token]
    bound = np.zeros(n_views, np.float32)
    touched = np.empty(n_views, np.int32)
    n_touched = 0
    for s in range(len(statements.op)):
        if statements.negated[s]:
            continue
        a, b = statements.source[s], statements.target[s]
        if statements.op[s] == BETWEEN and a == ME:
            a = statements.target2[s]
        if a == ME and b == ME:
            continue
        if a == ME or (b != ME and length[b] < length[a]):
            a, b = b, a
        gain = (1.0 - statements.noise[s]) / (statements.noise[s] * statements.background[s])
        for k in range(mention_starts[a], mention_starts[a + 1]):
            token = mention_tokens[k]
            for p in range(posting_starts[token], posting_starts[token + 1]):
                view = posting_views[p]
                part = mention_weights[k] * posting_mass[p]
                if b == ME:
                    part /= total[view]
                elif mass[b, view] > 0.0:
                    part *= mass[b, view] / (pairs[view] + statements.crowd)
                else:
                    continue
                if bound[view] == 0.0:
                    bound[view] = 1.0
                    touched[n_touched] = view
                    n_touched += 1
                bound[view] *= 1.0 + gain * min(part, np.float32(1.0))
    return _heaviest(bound, touched[:n_touched], most)


@njit(cache=True, nogil=True)
def _heaviest(bound, touched, most):
    """The `most` touched views of largest bound, largest first (buckets by the exponent's bits)."""
    bits = bound.view(np.int32)
    histogram = np.zeros(1 << 12, np.int64)
    for view in touched:
        histogram[bits[view] >> 19] += 1
    floor, kept = len(histogram) - 1, histogram[-1]
    while floor > 0 and kept + histogram[floor - 1] <= most:
        floor -= 1
        kept += histogram[floor]
    if kept == 0 and floor > 0:  # one bucket holds more than may be kept: keep the first of it
        floor -= 1
        kept = min(histogram[floor], most)
    chosen = np.empty(kept, np.int32)
    n = 0
    for view in touched:
        if n < kept and bits[view] >> 19 >= floor:
            chosen[n] = view
            n += 1
    order = np.argsort(-bound[chosen[:n]])
    return chosen[:n][order], bound[chosen[:n]][order]


@njit(cache=True, nogil=True, fastmath=True)
def score_views(statements, scene, words, views, bounds, starts, objects, offsets, sight, total, pairs, positions, far, margin):  # fmt: skip
    """Log-likelihood ratios (K, S) of candidates, best bounds first.

    Stops where a bound lies more than `margin` [nat] below the best score so far: nothing behind it
    can matter. Rows not reached are -inf.
    """
    n_statements = len(statements.op)
    scores = np.full((len(views), n_statements), -np.inf, np.float32)
    served = np.empty((n_statements, 2), np.int64)
    best = -np.inf
    for k in range(len(views)):
        ceiling = np.log(bounds[k])
        for s in range(n_statements):
            ceiling += np.log(statements.noise[s]) if not statements.negated[s] else 0.0
        if ceiling + 2.0 < best - margin:
            break
        v = views[k]
        a, b = starts[v], starts[v + 1]
        likelihoods(
            statements, scene, words, objects[a:b], offsets[a:b], sight[a:b],
            total[v], pairs[v], positions[v], far[k], scores[k], served,
        )  # fmt: skip
        best = max(best, scores[k].sum())
    return scores


@njit(cache=True, nogil=True, fastmath=True)
def look_again(statements, scene, words, at, nearby, sight_at, fade, far):
    """Score exact positions `at` (K, 2) [m] among `nearby` (n,) objects; likelihood ratios (K, S).

    Nearest points are computed anew from the geometry, so that a position between viewpoints sees
    roads and walls where they are. Also returns the best pair of objects of each statement (K, S, 2).
    """
    n_statements = len(statements.op)
    scores = np.empty((len(at), n_statements), np.float32)
    served = np.empty((len(at), n_statements, 2), np.int64)
    where = np.empty((len(nearby), 2), np.float32)
    sight = np.empty(len(nearby), np.float32)
    for k in range(len(at)):
        total = apart = squares = np.float32(0.0)
        for i in range(len(nearby)):
            o = nearby[i]
            e, n, d2 = nearest_on_parts(
                scene.part_starts, scene.point_starts, scene.points, scene.kind[o], o, at[k, 0], at[k, 1]
            )
            where[i, 0], where[i, 1] = e, n
            sight[i] = 1.0 / (1.0 + np.exp((np.sqrt(d2) - sight_at) / fade))
            total += sight[i]
            if scene.kind[o] != AREA or d2 > 0.0:
                apart += sight[i]
                squares += sight[i] * sight[i]
        pairs = max(apart * apart - squares, np.float32(0.0))
        likelihoods(
            statements, scene, words, nearby, where, sight, total, pairs, at[k], far[k], scores[k], served[k]
        )
    return scores, served


@njit(cache=True, nogil=True, fastmath=True)
def distant(statements, scale, share, scene, mention_starts, mention_objects, mention_fits, positions):  # fmt: skip
    """What things out of sight add to P(statement | position), (K, S) float32.

    `mention_objects` (CSR by mention) lists all objects of mentions rare enough to be spoken of from
    afar; `scale` (S,) is how far that reaches [m], `share` (S,) how often it happens. In a relation
    of two things the one that is not listed stands where the speaker stands, nearly enough.
    """
    out = np.zeros((len(positions), len(statements.op)), np.float32)
    for s in range(len(statements.op)):
        a, b = statements.source[s], statements.target[s]
        n_a = mention_starts[a + 1] - mention_starts[a] if a != ME else 0
        n_b = mention_starts[b + 1] - mention_starts[b] if b != ME else 0
        if statements.op[s] == BETWEEN or statements.negated[s] or n_a + n_b == 0:
            continue
        forward = n_b == 0 or (0 < n_a <= n_b)
        m = a if forward else b
        ux, uy = statements.bearing[s]
        for i in range(mention_starts[m], mention_starts[m + 1]):
            o = mention_objects[i]
            for k in range(len(positions)):
                cx = scene.center[o, 0] - positions[k, 0]
                cy = scene.center[o, 1] - positions[k, 1]
                # extents beyond 1 km are walked in sight, not from afar
                if max(abs(cx), abs(cy)) > 4.0 * scale[s] + 1000.0:
                    continue
                x, y, d2 = cx, cy, cx * cx + cy * cy
                if scene.kind[o] != 0:
                    x, y, d2 = nearest_on_parts(
                        scene.part_starts, scene.point_starts, scene.points, scene.kind[o], o,
                        positions[k, 0], positions[k, 1],
                    )  # fmt: skip
                d = np.sqrt(d2)
                if d > 4.0 * scale[s]:
                    continue
                p = np.exp(-d / scale[s])
                if statements.op[s] == DIRECTION:
                    wx, wy = (ux, uy) if forward else (-ux, -uy)
                    p *= _direction(statements.table[s], wx, wy, x, y)
                p *= _distance(statements.distance[s], d)
                out[k, s] += share[s] * mention_fits[i] * p
    return out
