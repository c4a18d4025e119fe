# mypy: allow-untyped-defs, allow-incomplete-defs
"""Log-likelihood ratios of statements at viewpoints and at exact positions.

Holds the geometry of one statement, the assignment of objects to mentions (a mention means one object
throughout), scores of all statements at a viewpoint, and the share of objects out of sight.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.outdoor.map.directions_kernels import direction_fit
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts, nearest_to_each
from placegraph.outdoor.map.index import POINT, SIGHT
from placegraph.outdoor.map.index_kernels import list_visible, most_objects, place_of, tile_of

DIRECTION, NEAR, INSIDE, ALONG, ACROSS, BETWEEN, VISIBLE, SAME = range(8)
"""Operations, one for each `Relation`, in its order."""
ME = -1
"""The speaker, in place of the row of a mention."""
AREA = 2
BLUR = 1.5
"""Square of the distance below which directions blur [m^2]."""


@kernel(finite=True, _nrt=False)
def distance_fit(stated, d):
    """Return the agreement of a distance d with the stated one [m]; 1 where none is stated.

    Much smaller distances fit by their ratio: nobody calls 5 m "about 60 m". A negative stated
    distance is an upper limit: "within 50 m", "on the same block".
    """
    if stated == 0.0:
        return 1.0
    if stated < 0.0:
        return 1.0 / (1.0 + np.exp((d + stated) / (5.0 - 0.15 * stated)))
    nearer = np.log((stated + 5.0) / (d + 5.0)) / 0.5
    farther = (d - stated) / (0.35 * stated + 5.0)
    z = nearer if d < stated else farther
    return np.exp(-0.5 * z * z)


@kernel(finite=True, _nrt=False)
def place_fit(op, stated, d, kind, of_speaker):
    """Return the agreement of a distance d [m] from an object of a kind with a relation of no direction."""
    if (op == NEAR and stated != 0.0) or (op == VISIBLE and of_speaker):
        return distance_fit(stated, d)
    share, reach = 1.0, np.float64(d)
    if op == ACROSS:
        share, reach = min(1.0, d / 8.0), max(0.0, d - 25.0)
    elif op == INSIDE and kind == AREA:
        if of_speaker and d < 1.0:
            return 1.0
        share, reach = 0.3 if of_speaker else 1.0, 2.0 * d
    elif op == INSIDE:
        share = 0.2
    elif op == ALONG and kind == POINT:
        share = 0.3
    elif op == ALONG:
        reach = 1.5 * d
    elif op == SAME and of_speaker:
        reach = 2.0 * d
    return share * (1.0 / (1.0 + np.exp((reach - 25.0) / 6.0)))


@kernel(finite=True, _nrt=False)
def pair_fit(op, table, ux, uy, stated, ax, ay, bx, by, kind_b):
    """Return P(relation | source at a, target at b), seen from the viewpoint [m]."""
    dx, dy = ax - bx, ay - by
    d = np.sqrt(dx * dx + dy * dy)
    if op == DIRECTION:
        return direction_fit(table, ux, uy, dx, dy, BLUR) * distance_fit(stated, d)
    return place_fit(op, stated, d, kind_b, False)


@kernel(finite=True, _nrt=False)
def speaker_fit(op, table, ux, uy, stated, x, y, kind, forward, blurred):
    """Return P(relation | object at (x, y) [m] from the speaker); `forward`: the object is the source."""
    d = np.sqrt(x * x + y * y)
    if op == DIRECTION:
        if not forward:
            ux, uy = -ux, -uy
        return direction_fit(table, ux, uy, x, y, blurred) * distance_fit(stated, d)
    return place_fit(op, stated, d, kind, True)


MAX_OBJECTS = 96
"""Largest number of objects in sight that one mention may mean."""


@kernel(finite=True, _nrt=False)
def _object_posterior(statements, m, matches):
    """Compute P(object | all statements about mention m), unnormalized, in `matches`; return the gain.

    The gain is the likelihood ratio of one object for all statements against one for each:
    sum over objects of P(object) prod P(s | object) / P(s).
    """
    many, fit, given, posterior = (
        matches.counts[m],
        matches.fit[m],
        matches.given,
        matches.posterior[m],
    )
    for i in range(many):
        posterior[i] = fit[i] / matches.mass[m]
    n_about = 0
    for s in range(len(statements.op)):
        if statements.negated[s] or statements.op[s] == BETWEEN:
            continue
        for side in range(2):
            end = statements.source[s] if side == 0 else statements.target[s]
            other = statements.target[s] if side == 0 else statements.source[s]
            if end != m:
                continue
            row = 0 if other == ME else side
            mean = np.float32(0.0)
            for i in range(many):
                mean += fit[i] / matches.mass[m] * given[s, row, i]
            if mean < 1e-3:
                continue
            n_about += 1
            for i in range(many):
                posterior[i] *= (given[s, row, i] + np.float32(0.1) * mean) / (
                    np.float32(1.1) * mean
                )
    gain = np.float32(0.0)
    for i in range(many):
        gain += posterior[i]
    return gain if n_about > 1 else np.float32(1.0)


@kernel(finite=True, _nrt=False)
def log_coherence(statements, matches, together):
    """Return the log gain of mentions that mean one object throughout, with prior probability `together`."""
    log_gain = 0.0
    for m in range(len(matches.counts)):
        if matches.counts[m] > 1:
            gain = _object_posterior(statements, m, matches)
            log_gain += np.log(1.0 - together + together * gain)
    return log_gain


@kernel(finite=True, _nrt=False)
def assign_objects(statements, scene, visible, matches, served):
    """Assign objects to all statements: the most probable one to each mention, then the best pairs."""
    weight = matches.posterior
    for m in range(len(matches.counts)):
        if matches.counts[m]:
            _object_posterior(statements, m, matches)
    for s in range(len(statements.op)):
        op, a, b = statements.op[s], statements.source[s], statements.target[s]
        served[s] = -1
        if op == BETWEEN:
            a, b = statements.target[s], statements.target2[s]
        if a == ME or b == ME:
            m = b if a == ME else a
            best = np.float32(0.0)
            for i in range(matches.counts[m] if m != ME else 0):
                p = weight[m, i] * (matches.given[s, 0, i] + np.float32(1e-6))
                if p > best:
                    best = p
                    served[s, 0] = visible.objects[matches.who[m, i]]
            continue
        where = visible.stands if op == DIRECTION else visible.at
        ux, uy = statements.bearing[s]
        best = np.float32(0.0)
        for i in range(matches.counts[a]):
            ea = matches.who[a, i]
            for j in range(matches.counts[b]):
                eb = matches.who[b, j]
                if ea == eb or (op == DIRECTION and not (visible.lies[ea] and visible.lies[eb])):
                    continue
                p = weight[a, i] * weight[b, j]
                if op != BETWEEN:
                    p *= pair_fit(
                        op, statements.table[s], ux, uy, statements.distance[s],
                        where[ea, 0], where[ea, 1], where[eb, 0], where[eb, 1],
                        scene.kind[visible.objects[eb]],
                    )  # fmt: skip
                if p > best:
                    best = p
                    served[s, 0], served[s, 1] = visible.objects[ea], visible.objects[eb]


REJECTED = -1e9
"""Score of a viewpoint that cannot matter; finite, since compiled code assumes finite numbers."""
BOUND_SLACK = 1.5
"""Largest log-likelihood ratio by which a bound may fall short of the score."""
SMALL_AREA = 25.0
"""An area around the speaker still lies in the direction of its centre, if that is this near [m]."""
SINGLE_SMOOTHING = 0.5
"""Additive smoothing of the number of objects in sight, as `pair_smoothing` is of pairs."""


class InSight(NamedTuple):
    """Objects in sight of a viewpoint, one row each."""

    objects: NDArray[np.int32]
    """(n,) rows of the map's objects."""
    at: NDArray[np.float32]
    """(n, 2) nearest point, from the viewpoint, east and north [m]."""
    stands: NDArray[np.float32]
    """(n, 2) point that directions refer to: `at`, or the centre of an area around the speaker [m]."""
    lies: NDArray[np.bool_]
    """(n,) whether the object lies in any direction; an area around the speaker mostly does not."""
    visibility: NDArray[np.float32]
    """(n,) probability that the object is in sight."""
    total: float
    """Sum of `visibility`."""
    pairs: float
    """Sum of `visibility` products over ordered pairs of objects that are not around the speaker."""
    blur: float
    """Variance of the position of the viewpoint [m^2]."""


class MentionMatches(NamedTuple):
    """Objects in sight that each mention may mean."""

    counts: NDArray[np.int64]
    """(M,) number of objects."""
    who: NDArray[np.int32]
    """(M, MOST) rows of `InSight`."""
    fit: NDArray[np.float32]
    """(M, MOST) how well the words fit, times sight."""
    mass: NDArray[np.float32]
    """(M,) sum of `fit`."""
    given: NDArray[np.float32]
    """(S, 2, MOST) mass of a statement whose source, or target, is this object."""
    best: NDArray[np.float32]
    """(M,) how well the words of one object fit each mention; workspace."""
    posterior: NDArray[np.float32]
    """(M, MOST) P(object | all statements about the mention), unnormalized."""


@kernel(finite=True)
def gather_in_sight(scene, objects, at, visibility, total, pairs, blur, view):
    """Gather the objects in sight of a viewpoint `view` (2,) [m] as `InSight`."""
    stands = np.empty((len(objects), 2), np.float32)
    lies = np.ones(len(objects), np.bool_)
    for e in range(len(objects)):
        stands[e, 0], stands[e, 1] = at[e, 0], at[e, 1]
        if scene.kind[objects[e]] == AREA and at[e, 0] == 0.0 and at[e, 1] == 0.0:
            stands[e, 0] = scene.center[objects[e], 0] - view[0]
            stands[e, 1] = scene.center[objects[e], 1] - view[1]
            lies[e] = stands[e, 0] ** 2 + stands[e, 1] ** 2 < SMALL_AREA * SMALL_AREA
    return InSight(objects, at, stands, lies, visibility, total, pairs, blur)


@kernel
def allocate_matches(statements, words):
    """Allocate `MentionMatches` that are used for one viewpoint after the other."""
    n = words.fit.shape[1]
    return MentionMatches(
        np.empty(n, np.int64), np.empty((n, MAX_OBJECTS), np.int32), np.empty((n, MAX_OBJECTS), np.float32),
        np.empty(n, np.float32), np.empty((len(statements.op), 2, MAX_OBJECTS), np.float32),
        np.empty(n, np.float32), np.empty((n, MAX_OBJECTS), np.float32),
    )  # fmt: skip


@kernel(finite=True, _nrt=False)
def _match_mentions(scene, words, visible, matches):
    """Match objects in sight with mentions, in `matches`."""
    many, who, fit, mass, given, best, _ = matches
    many[:], mass[:] = 0, 0.0
    given[:, :, : len(visible.objects)] = 0.0
    for e in range(len(visible.objects)):
        o, met = visible.objects[e], False
        for t in range(scene.token_starts[o], scene.token_starts[o + 1]):
            row, weight = words.row[scene.token_values[t]], scene.token_weights[t]
            for m in range(len(many) if row else 0):
                of = words.fit[row, m] * weight
                best[m] = max(best[m], of) if met else of
            met |= row > 0
        for m in range(len(many) if met else 0):
            if best[m] > 0.0 and many[m] < MAX_OBJECTS:
                who[m, many[m]], fit[m, many[m]] = e, best[m] * visible.visibility[e]
                mass[m] += fit[m, many[m]]
                many[m] += 1


@kernel(finite=True, _nrt=False)
def score_statements(statements, scene, words, visible, matches, far, together, least, out, served):
    """Compute the log-likelihood ratio of every statement at a viewpoint, in `out` (S,); return their sum.

    The sum also rewards one object for all statements about a mention (`log_coherence`). `words` are
    `TokenWeights`, `visible` is `InSight`, `matches` a workspace (`allocate_matches`), `far` (S,) the
    share of distant objects, `together` the prior probability that a mention means one object throughout.
    Returns `REJECTED` once the sum without coherence cannot reach `least`. `served` (S, 2) gets the best
    source and target object, -1 for none; pass an empty array to skip these.
    """
    _match_mentions(scene, words, visible, matches)
    total = 0.0
    for s in range(len(statements.op)):
        out[s] = _bound_statement(statements, s, visible, matches, far[s])
        total += out[s]
    for s in range(len(statements.op)):
        if total < least:
            return REJECTED
        total -= out[s]
        out[s] = _score_statement(statements, s, scene, visible, matches, far[s])
        total += out[s]
    if total < least:  # the last statement
        return REJECTED
    total += log_coherence(statements, matches, together)
    if len(served):
        assign_objects(statements, scene, visible, matches, served)
    return total


@kernel(finite=True, _nrt=False)
def _bound_statement(statements, s, visible, matches, far):
    """Bound the log-likelihood ratio of one statement: as if its geometry fitted."""
    a, b, noise = statements.source[s], statements.target[s], statements.noise[s]
    if statements.negated[s]:
        return 0.0
    if statements.op[s] == BETWEEN:
        return np.log((1.0 - noise) / statements.background[s] + noise)
    if a == ME or b == ME:
        m = b if a == ME else a
        p = 0.0 if m == ME else matches.mass[m] / (visible.total + SINGLE_SMOOTHING)
    else:
        p = matches.mass[a] * matches.mass[b] / (visible.pairs + statements.pair_smoothing)
    p = min(1.0, p + far) * (1.5 if statements.number[s] > 0.0 else 1.0)
    return np.log((1.0 - noise) * p / statements.background[s] + noise)


@kernel(finite=True, _nrt=False)
def _score_statement(statements, s, scene, visible, matches, far):
    """Compute the log-likelihood ratio of one statement."""
    op, a, b = statements.op[s], statements.source[s], statements.target[s]
    expected = 0.0
    if op == BETWEEN:
        p = _mass_between(statements, s, visible, matches) / (
            visible.pairs * visible.total + statements.pair_smoothing
        )
    elif a == ME or b == ME:
        expected = _mass_with_speaker(statements, s, scene, visible, matches)
        p = expected / (visible.total + SINGLE_SMOOTHING)
    else:
        expected = _mass_of_pairs(statements, s, scene, visible, matches)
        p = expected / (visible.pairs + statements.pair_smoothing)
    p = min(1.0, p + far)
    noise = statements.noise[s]
    if statements.negated[s]:
        absent = 1.0 - p if op == BETWEEN else np.exp(-2.0 * expected)
        return np.log((1.0 - noise) * absent + noise)
    if statements.number[s] > 0.0 and expected > 0.0:
        k = statements.number[s]
        z = (expected - k) / (0.4 * k + 0.6)
        p *= 0.3 + 1.2 * np.exp(-0.5 * z * z)
    return np.log((1.0 - noise) * p / statements.background[s] + noise)


@kernel(finite=True, _nrt=False)
def _mass_with_speaker(statements, s, scene, visible, matches):
    """Sum the mass of a statement about an object and the speaker: how many such objects are expected."""
    op, forward = statements.op[s], statements.target[s] == ME
    m = statements.source[s] if forward else statements.target[s]
    ux, uy = statements.bearing[s]
    where = visible.stands if op == DIRECTION else visible.at
    mass = 0.0
    for i in range(matches.counts[m] if m != ME else 0):
        e = matches.who[m, i]
        if op == DIRECTION and not (visible.lies[e] or statements.distance[s] < 0.0):
            continue
        p = speaker_fit(
            op, statements.table[s], ux, uy, statements.distance[s],
            where[e, 0], where[e, 1], scene.kind[visible.objects[e]], forward, visible.blur,
        )  # fmt: skip
        matches.given[s, 0, i] = p
        mass += matches.fit[m, i] * p
    return mass


@kernel(finite=True, _nrt=False)
def _mass_of_pairs(statements, s, scene, visible, matches):
    """Sum the mass of a statement about two objects."""
    op, a, b = statements.op[s], statements.source[s], statements.target[s]
    ux, uy = statements.bearing[s]
    table, stated = statements.table[s], statements.distance[s]
    where = visible.stands if op == DIRECTION else visible.at
    outside = op == DIRECTION and stated >= 0.0  # "on the north side of the park" may be in it
    mass = 0.0
    for i in range(matches.counts[a]):
        ea = matches.who[a, i]
        if outside and not visible.lies[ea]:
            continue
        for j in range(matches.counts[b]):
            eb = matches.who[b, j]
            if ea == eb or (outside and not visible.lies[eb]):
                continue
            kind = scene.kind[visible.objects[eb]]
            p = pair_fit(
                op, table, ux, uy, stated, where[ea, 0], where[ea, 1], where[eb, 0], where[eb, 1], kind
            )  # fmt: skip
            matches.given[s, 0, i] += matches.fit[b, j] * p
            matches.given[s, 1, j] += matches.fit[a, i] * p
            mass += matches.fit[a, i] * matches.fit[b, j] * p
    return mass


@kernel(finite=True, _nrt=False)
def _mass_between(statements, s, visible, matches):
    """Sum the mass of "the source lies between two targets"; the source may be the speaker."""
    a, b, c = statements.source[s], statements.target[s], statements.target2[s]
    mass = 0.0
    if b == ME or c == ME:
        return mass
    for k in range(1 if a == ME else matches.counts[a]):
        ax = ay = np.float32(0.0)
        wa = np.float32(1.0)
        if a != ME:
            ax, ay = visible.at[matches.who[a, k], 0], visible.at[matches.who[a, k], 1]
            wa = matches.fit[a, k]
        for i in range(matches.counts[b]):
            bx, by = visible.at[matches.who[b, i], 0] - ax, visible.at[matches.who[b, i], 1] - ay
            for j in range(matches.counts[c]):
                if matches.who[b, i] == matches.who[c, j]:
                    continue
                cx, cy = (
                    visible.at[matches.who[c, j], 0] - ax,
                    visible.at[matches.who[c, j], 1] - ay,
                )
                lengths = np.sqrt((bx * bx + by * by) * (cx * cx + cy * cy)) + np.float32(1.0)
                opposite = 0.5 - 0.5 * (bx * cx + by * cy) / lengths
                mass += wa * matches.fit[b, i] * matches.fit[c, j] * opposite**4
    return mass


VIEW_BLUR, POSITION_BLUR = 20.0, 5.0
"""Variance of the speaker's position around a viewpoint, and around a fine position [m^2]."""
SIGHT_WIDTH = 2.0
"""Width of the sigmoid around `SIGHT` for exact positions [m]."""


@kernel(finite=True)
def score_views(statements, scene, views, words, chosen, bounds, relative, far, together, margin):
    """Score candidates: log-likelihood ratios (K,), and sums (K,) over statements and log prior.

    `relative` (K,) is the log prior against the largest. Sums leave out the coherence of statements,
    of which there is no bound. Candidates whose sum lies more than `margin` below the best are
    `REJECTED`, whatever their order; with the best bounds first most of them are rejected early.
    """
    n_statements = len(statements.op)
    scores, sums = np.empty(len(chosen), np.float32), np.empty(len(chosen))
    scores[:] = sums[:] = REJECTED
    each = np.empty(n_statements, np.float32)
    nothing = np.empty((0, 2), np.int64)
    noise = 0.0
    for s in range(n_statements):
        noise += 0.0 if statements.negated[s] else np.log(statements.noise[s])
    best = REJECTED
    most = most_objects(views)
    matches = allocate_matches(statements, words)
    objects, visibility = np.empty(most, np.int32), np.empty(most, np.float32)
    offsets, place = np.empty((most, 2), np.float32), np.empty(2, np.float32)
    for k in range(len(chosen)):
        if np.log(bounds[k]) + noise + BOUND_SLACK < best - margin:
            continue
        tile, slot = tile_of(views, chosen[k])
        place[0], place[1] = place_of(views, tile, slot)
        n, total, pairs = list_visible(scene, views, tile, slot, objects, offsets, visibility)
        visible = gather_in_sight(
            scene, objects[:n], offsets[:n], visibility[:n], total, pairs, VIEW_BLUR, place
        )
        scores[k] = score_statements(
            statements, scene, words, visible, matches, far[k], together, best - margin - relative[k],
            each, nothing,
        )  # fmt: skip
        if scores[k] > REJECTED:
            sums[k] = each.sum() + relative[k]
            best = max(best, sums[k])
    for k in range(len(chosen)):
        if sums[k] < best - margin:
            scores[k] = REJECTED
    return scores, sums


@kernel(finite=True)
def score_exact(statements, scene, words, at, visible, far, together, with_objects):
    """Score exact positions `at` (B, K, 2) [m]: log-likelihood ratios (B, K).

    `visible` are the objects near each group of positions: starts (B + 1,) and rows. Nearest points are
    computed from the geometry of each position. `far` (B, K, S) is the share of distant objects. Also
    returns the ratio of each statement (B, K, S) and, if `with_objects`, its best source and target
    (B, K, S, 2).
    """
    n_statements = len(statements.op)
    groups, k = at.shape[:2]
    scores = np.empty((groups, k), np.float32)
    each = np.empty((groups, k, n_statements), np.float32)
    served = np.empty((groups, k, n_statements if with_objects else 0, 2), np.int64)
    matches = allocate_matches(statements, words)
    starts, objects = visible
    for b in range(groups):
        _score_group(
            statements, scene, words, at[b], objects[starts[b] : starts[b + 1]], matches, far[b],
            together, scores[b], each[b], served[b],
        )  # fmt: skip
    return scores, each, served


@kernel(finite=True)
def _score_group(
    statements, scene, words, at, nearby, matches, far, together, scores, each, served
):  # fmt: skip
    """Score the positions of one group, in `scores`, `each` and `served`; see `score_exact`."""
    where = np.empty((len(at), len(nearby), 2), np.float32)
    distance2 = np.empty((len(at), len(nearby)), np.float32)
    visibility = np.empty(len(nearby), np.float32)
    points, near, squares = at.T.copy(), np.empty((2, len(at))), np.empty(len(at))
    for i in range(len(nearby)):
        nearest_to_each(
            scene.part_starts, scene.point_starts, scene.points, scene.kind[nearby[i]], nearby[i],
            points, near, squares,
        )  # fmt: skip
        for k in range(len(at)):
            where[k, i, 0], where[k, i, 1], distance2[k, i] = near[0, k], near[1, k], squares[k]
    for k in range(len(at)):
        total = np.float32(1e-30)  # not 0 where nothing is in sight
        apart = squared = np.float32(0.0)
        for i in range(len(nearby)):
            d2 = distance2[k, i]
            visibility[i] = 1.0 / (1.0 + np.exp((np.sqrt(d2) - SIGHT) / SIGHT_WIDTH))
            total += visibility[i]
            if scene.kind[nearby[i]] != AREA or d2 > 0.0:
                apart += visibility[i]
                squared += visibility[i] * visibility[i]
        pairs = max(apart * apart - squared, np.float32(0.0))
        visible = gather_in_sight(
            scene,
            nearby,
            where[k],
            visibility,
            total,
            pairs,
            POSITION_BLUR,
            at[k].astype(np.float32),
        )
        scores[k] = score_statements(
            statements,
            scene,
            words,
            visible,
            matches,
            far[k],
            together,
            REJECTED,
            each[k],
            served[k],
        )


@kernel(finite=True)
def score_distant(statements, scene, far, positions):
    """Compute the share of objects out of sight in P(statement | position), (K, S) float32.

    `far` are the `DistantObjects` of a query. In a relation of two objects, the one that is not among
    them is taken to be at the position itself.
    """
    out = np.zeros((len(positions), len(statements.op)), np.float32)
    mention, forward = np.empty(len(out[0]), np.int64), np.zeros(len(out[0]), np.bool_)
    for s in range(len(mention)):
        mention[s] = ME
        a, b = statements.source[s], statements.target[s]
        n_a = far.starts[a + 1] - far.starts[a] if a != ME else 0
        n_b = far.starts[b + 1] - far.starts[b] if b != ME else 0
        if statements.op[s] != BETWEEN and not statements.negated[s] and n_a + n_b > 0:
            forward[s] = n_b == 0 or (0 < n_a <= n_b)
            mention[s] = a if forward[s] else b
    for m in range(len(far.starts) - 1):
        reach = np.float32(0.0)
        for s in range(len(mention)):
            reach = max(reach, np.float32(4.0) * far.scale[s] if mention[s] == m else reach)
        for i in range(far.starts[m], far.starts[m + 1] if reach > 0.0 else 0):
            o = far.objects[i]
            site = o - len(scene.kind)
            if site >= 0:
                west, south = far.sites[site]
                east, north = west, south
                middle = far.sites[site]
            else:
                west, south, east, north = scene.box[o]
                middle = scene.center[o]
            for k in range(len(positions)):
                x, y = positions[k]
                aside = max(west - x, x - east, np.float32(0.0))
                ahead = max(south - y, y - north, np.float32(0.0))
                if aside * aside + ahead * ahead > reach * reach:
                    continue
                dx, dy = middle[0] - x, middle[1] - y
                # extents beyond 1 km are walked in sight, not from afar
                if max(abs(dx), abs(dy)) > reach + np.float32(1000.0):
                    continue
                d2 = dx * dx + dy * dy
                if site < 0 and scene.kind[o] != POINT:
                    dx, dy, d2 = nearest_on_parts(
                        scene.part_starts, scene.point_starts, scene.points, scene.kind[o], o, x, y
                    )
                d = np.sqrt(d2)
                for s in range(len(mention)):
                    if mention[s] == m and d <= 4.0 * far.scale[s]:
                        fit = _distant_fit(statements, s, d, dx, dy, far.scale[s], forward[s])
                        out[k, s] += far.share[s] * far.weights[i] * fit
    return out


@kernel(finite=True, inline=True)
def _distant_fit(statements, s, d, dx, dy, scale, forward):
    """Return the agreement of an object out of sight, d = (dx, dy) away [m], with a statement."""
    fit = np.exp(-d / scale) * distance_fit(statements.distance[s], d)
    if statements.op[s] == DIRECTION:
        ux, uy = statements.bearing[s]
        if not forward:
            ux, uy = -ux, -uy
        fit *= direction_fit(statements.table[s], ux, uy, dx, dy, VIEW_BLUR)
    return fit
