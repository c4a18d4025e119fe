# mypy: allow-untyped-defs, allow-incomplete-defs
"""Log-likelihood ratios of statements at viewpoints and at exact positions.

The geometry of one statement, the assignment of objects to mentions (one mention means one thing
throughout), all statements at a viewpoint, and what things out of sight add.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.outdoor.map.directions_kernels import direction_fit
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts, nearest_to_each
from placegraph.outdoor.map.index import POINT, SIGHT
from placegraph.outdoor.map.index_kernels import look, most_things, place_of, tile_of

DIRECTION, NEAR, INSIDE, ALONG, ACROSS, BETWEEN, VISIBLE, SAME = range(8)
"""Operations, one for each `Relation`, in its order."""
ME = -1
"""Stands for the viewpoint itself where a mention could stand."""
AREA = 2
BLUR = 1.5
"""Square of the distance below which directions blur [m^2]."""


@kernel(finite=True, inline="always")
def distance_fit(said, d):
    """Return how well a distance d fits the stated one [m]; 1 where none was stated.

    What is much nearer than was said fits by the ratio: nobody calls 5 m "about 60 m". A negative
    number is the most that it may be: "within 50 m", "on the same block".
    """
    if said == 0.0:
        return 1.0
    if said < 0.0:
        return 1.0 / (1.0 + np.exp((d + said) / (5.0 - 0.15 * said)))
    nearer = np.log((said + 5.0) / (d + 5.0)) / 0.5
    farther = (d - said) / (0.35 * said + 5.0)
    z = nearer if d < said else farther
    return np.exp(-0.5 * z * z)


@kernel(finite=True, inline="always")
def _close(said, d):
    """Return how well "near" fits a distance d [m]."""
    if said != 0.0:
        return distance_fit(said, d)
    return 1.0 / (1.0 + np.exp((d - 25.0) / 6.0))


@kernel(finite=True, _nrt=False)
def pair_fit(op, table, ux, uy, said, ax, ay, bx, by, kind_b):
    """P(geometry | source at a, target at b), seen from the viewpoint [m]."""
    dx, dy = ax - bx, ay - by
    d = np.sqrt(dx * dx + dy * dy)
    if op == DIRECTION:
        return direction_fit(table, ux, uy, dx, dy, BLUR) * distance_fit(said, d)
    if op == NEAR:
        return _close(said, d)
    if op == ACROSS:
        return _close(0.0, max(0.0, d - 25.0)) * min(1.0, d / 8.0)
    if op == INSIDE:
        return _close(0.0, 2.0 * d) if kind_b == AREA else 0.2 * _close(0.0, d)
    if op == ALONG:
        return _close(0.0, 1.5 * d) if kind_b != 0 else 0.3 * _close(0.0, d)
    return _close(0.0, d)


@kernel(finite=True, _nrt=False)
def me_fit(op, table, ux, uy, said, x, y, kind, forward, blurred):
    """P(geometry | the thing at (x, y) seen from v); `forward`: it is the source, v the target."""
    d = np.sqrt(x * x + y * y)
    if op == DIRECTION:
        if not forward:
            ux, uy = -ux, -uy
        return direction_fit(table, ux, uy, x, y, blurred) * distance_fit(said, d)
    if op == VISIBLE:
        return distance_fit(said, d)
    if op == NEAR:
        return _close(said, d)
    if op == SAME:
        return _close(0.0, 2.0 * d)
    if op == INSIDE:
        return (
            (1.0 if d < 1.0 else 0.3 * _close(0.0, 2.0 * d))
            if kind == AREA
            else 0.2 * _close(0.0, d)
        )
    if op == ALONG:
        return _close(0.0, 1.5 * d) if kind != 0 else 0.3 * _close(0.0, d)
    return _close(0.0, max(0.0, d - 25.0)) * min(1.0, d / 8.0)  # ACROSS


MOST = 96
"""At most this many objects in sight are weighed for one mention."""


@kernel(finite=True, _nrt=False)
def _posterior(statements, m, fits):
    """P(thing | all statements about mention m), unnormalised, into `fits`; returns the gain.

    The gain is how much more likely the statements are if one object serves them all than if each
    has its own: sum over objects of P(object) prod P(s | object) / P(s).
    """
    many, fit, given, posterior = fits.many[m], fits.fit[m], fits.given, fits.posterior[m]
    for i in range(many):
        posterior[i] = fit[i] / fits.mass[m]
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
                mean += fit[i] / fits.mass[m] * given[s, row, i]
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
def log_coherence(statements, fits, together):
    """Log of the gain that mentions mean one object throughout, with prior probability `together`."""
    log_gain = 0.0
    for m in range(len(fits.many)):
        if fits.many[m] > 1:
            gain = _posterior(statements, m, fits)
            log_gain += np.log(1.0 - together + together * gain)
    return log_gain


@kernel(finite=True, _nrt=False)
def assign(statements, scene, seen, fits, served):
    """One assignment for all statements: each mention its most probable object, then the best pairs."""
    weight = fits.posterior
    for m in range(len(fits.many)):
        if fits.many[m]:
            _posterior(statements, m, fits)
    for s in range(len(statements.op)):
        op, a, b = statements.op[s], statements.source[s], statements.target[s]
        served[s] = -1
        if op == BETWEEN:
            a, b = statements.target[s], statements.target2[s]
        if a == ME or b == ME:
            m = b if a == ME else a
            best = np.float32(0.0)
            for i in range(fits.many[m] if m != ME else 0):
                p = weight[m, i] * (fits.given[s, 0, i] + np.float32(1e-6))
                if p > best:
                    best = p
                    served[s, 0] = seen.objects[fits.who[m, i]]
            continue
        where = seen.stands if op == DIRECTION else seen.at
        ux, uy = statements.bearing[s]
        best = np.float32(0.0)
        for i in range(fits.many[a]):
            ea = fits.who[a, i]
            for j in range(fits.many[b]):
                eb = fits.who[b, j]
                if ea == eb or (op == DIRECTION and not (seen.lies[ea] and seen.lies[eb])):
                    continue
                p = weight[a, i] * weight[b, j]
                if op != BETWEEN:
                    p *= pair_fit(
                        op, statements.table[s], ux, uy, statements.distance[s],
                        where[ea, 0], where[ea, 1], where[eb, 0], where[eb, 1],
                        scene.kind[seen.objects[eb]],
                    )  # fmt: skip
                if p > best:
                    best = p
                    served[s, 0], served[s, 1] = seen.objects[ea], seen.objects[eb]


HOPELESS = -1e9
"""Score of a viewpoint that cannot matter: finite, since compiled code assumes finite numbers."""
SLACK = 1.5
"""By how much a bound of viewpoints may be short of what statements say [nat]."""


SMALL = 25.0
"""An area one stands in still lies in the direction of its centre, if that is this near [m]."""
LONELY = 0.5
"""Added to what is in sight, as `crowd` is to pairs."""


class InSight(NamedTuple):
    """Objects in sight of a viewpoint, one row each."""

    objects: NDArray[np.int32]
    """(n,) rows of the map's objects."""
    at: NDArray[np.float32]
    """(n, 2) nearest point seen from the viewpoint, east and north [m]."""
    stands: NDArray[np.float32]
    """(n, 2) where it stands for directions: `at`, or the centre of what one stands in [m]."""
    lies: NDArray[np.bool_]
    """(n,) whether it lies in any direction; what one stands in mostly does not."""
    sight: NDArray[np.float32]
    """(n,) how readily it is spoken of."""
    total: float
    """Sum of `sight`."""
    pairs: float
    """Sum of `sight` products over ordered pairs of things that one does not stand in."""
    blur: float
    """Square of how uncertain the viewpoint itself is [m^2]."""


class MentionObjects(NamedTuple):
    """Which things in sight each mention may stand for."""

    many: NDArray[np.int64]
    """(M,) number of them."""
    who: NDArray[np.int32]
    """(M, MOST) rows of `InSight`."""
    fit: NDArray[np.float32]
    """(M, MOST) how well the words fit, times sight."""
    mass: NDArray[np.float32]
    """(M,) sum of `fit`."""
    given: NDArray[np.float32]
    """(S, 2, MOST) mass of a statement if its source, or its target, is this thing."""
    best: NDArray[np.float32]
    """(M,) how well the words of a thing fit each mention."""
    posterior: NDArray[np.float32]
    """(M, MOST) P(thing | all statements about the mention), unnormalised."""


@kernel(finite=True)
def in_sight(scene, objects, at, sight, total, pairs, blur, view):
    """`InSight` of the viewpoint `view` (2,) [m]."""
    stands = np.empty((len(objects), 2), np.float32)
    lies = np.ones(len(objects), np.bool_)
    for e in range(len(objects)):
        stands[e, 0], stands[e, 1] = at[e, 0], at[e, 1]
        if scene.kind[objects[e]] == AREA and at[e, 0] == 0.0 and at[e, 1] == 0.0:
            stands[e, 0] = scene.center[objects[e], 0] - view[0]
            stands[e, 1] = scene.center[objects[e], 1] - view[1]
            lies[e] = stands[e, 0] ** 2 + stands[e, 1] ** 2 < SMALL * SMALL
    return InSight(objects, at, stands, lies, sight, total, pairs, blur)


@kernel
def room(statements, words):
    """`MentionObjects` of viewpoints one after the other: nothing is allocated for each of them."""
    n = words.fit.shape[1]
    return MentionObjects(
        np.empty(n, np.int64), np.empty((n, MOST), np.int32), np.empty((n, MOST), np.float32),
        np.empty(n, np.float32), np.empty((len(statements.op), 2, MOST), np.float32),
        np.empty(n, np.float32), np.empty((n, MOST), np.float32),
    )  # fmt: skip


@kernel(finite=True, _nrt=False)
def _recognise(scene, words, seen, fits):
    """Which things in sight each mention may stand for, into `fits`."""
    many, who, fit, mass, given, best, _ = fits
    many[:], mass[:] = 0, 0.0
    given[:, :, : len(seen.objects)] = 0.0
    for e in range(len(seen.objects)):
        o, met = seen.objects[e], False
        for t in range(scene.token_starts[o], scene.token_starts[o + 1]):
            row, weight = words.row[scene.token_values[t]], scene.token_weights[t]
            for m in range(len(many) if row else 0):
                of = words.fit[row, m] * weight
                best[m] = max(best[m], of) if met else of
            met |= row > 0
        for m in range(len(many) if met else 0):
            if best[m] > 0.0 and many[m] < MOST:
                who[m, many[m]], fit[m, many[m]] = e, best[m] * seen.sight[e]
                mass[m] += fit[m, many[m]]
                many[m] += 1


@kernel(finite=True, _nrt=False)
def likelihoods(statements, scene, words, seen, fits, far, together, least, out, served):
    """Log-likelihood ratio of every statement at a viewpoint, into `out` (S,); returns their sum.

    The sum also rewards that one object serves all statements about a mention. `words` are `Words`,
    `seen` is what is `InSight`, `fits` is `room`, `far` (S,) what distant objects add, `together` the
    prior probability that a mention means one and the same object throughout. Gives up, with
    `HOPELESS`, once the sum without that cannot reach `least`.
    `served` (S, 2) gets the best source and target, -1 for none; leave it empty to skip that.
    """
    _recognise(scene, words, seen, fits)
    hope = 0.0
    for s in range(len(statements.op)):
        out[s] = _ceiling(statements, s, seen, fits, far[s])
        hope += out[s]
    for s in range(len(statements.op)):
        if hope < least:
            return HOPELESS
        hope -= out[s]
        out[s] = _ratio(statements, s, scene, seen, fits, far[s])
        hope += out[s]
    if hope < least:  # as it would be found on the way, were this statement not the last
        return HOPELESS
    hope += log_coherence(statements, fits, together)
    if len(served):
        assign(statements, scene, seen, fits, served)
    return hope


@kernel(finite=True, _nrt=False)
def _ceiling(statements, s, seen, fits, far):
    """Log-likelihood ratio that a statement has if geometry is on its side."""
    a, b, noise = statements.source[s], statements.target[s], statements.noise[s]
    if statements.negated[s]:
        return 0.0
    if statements.op[s] == BETWEEN:
        return np.log((1.0 - noise) / statements.background[s] + noise)
    if a == ME or b == ME:
        m = b if a == ME else a
        p = 0.0 if m == ME else fits.mass[m] / (seen.total + LONELY)
    else:
        p = fits.mass[a] * fits.mass[b] / (seen.pairs + statements.crowd)
    p = min(1.0, p + far) * (1.5 if statements.number[s] > 0.0 else 1.0)
    return np.log((1.0 - noise) * p / statements.background[s] + noise)


@kernel(finite=True, _nrt=False)
def _ratio(statements, s, scene, seen, fits, far):
    """Log-likelihood ratio of one statement."""
    op, a, b = statements.op[s], statements.source[s], statements.target[s]
    expected = 0.0
    if op == BETWEEN:
        p = _between(statements, s, seen, fits) / (seen.pairs * seen.total + statements.crowd)
    elif a == ME or b == ME:
        expected = _of_me(statements, s, scene, seen, fits)
        p = expected / (seen.total + LONELY)
    else:
        expected = _of_pair(statements, s, scene, seen, fits)
        p = expected / (seen.pairs + statements.crowd)
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
def _of_me(statements, s, scene, seen, fits):
    """Mass of a statement about a thing and the speaker: how many such things are expected."""
    op, forward = statements.op[s], statements.target[s] == ME
    m = statements.source[s] if forward else statements.target[s]
    ux, uy = statements.bearing[s]
    where = seen.stands if op == DIRECTION else seen.at
    mass = 0.0
    for i in range(fits.many[m] if m != ME else 0):
        e = fits.who[m, i]
        if op == DIRECTION and not seen.lies[e]:
            continue
        p = me_fit(
            op, statements.table[s], ux, uy, statements.distance[s],
            where[e, 0], where[e, 1], scene.kind[seen.objects[e]], forward, seen.blur,
        )  # fmt: skip
        fits.given[s, 0, i] = p
        mass += fits.fit[m, i] * p
    return mass


@kernel(finite=True, _nrt=False)
def _of_pair(statements, s, scene, seen, fits):
    """Mass of a statement about two things."""
    op, a, b = statements.op[s], statements.source[s], statements.target[s]
    ux, uy = statements.bearing[s]
    table, said = statements.table[s], statements.distance[s]
    where = seen.stands if op == DIRECTION else seen.at
    mass = 0.0
    for i in range(fits.many[a]):
        ea = fits.who[a, i]
        if op == DIRECTION and not seen.lies[ea]:
            continue
        for j in range(fits.many[b]):
            eb = fits.who[b, j]
            if ea == eb or (op == DIRECTION and not seen.lies[eb]):
                continue
            kind = scene.kind[seen.objects[eb]]
            p = pair_fit(
                op,
                table,
                ux,
                uy,
                said,
                where[ea, 0],
                where[ea, 1],
                where[eb, 0],
                where[eb, 1],
                kind,
            )
            fits.given[s, 0, i] += fits.fit[b, j] * p
            fits.given[s, 1, j] += fits.fit[a, i] * p
            mass += fits.fit[a, i] * fits.fit[b, j] * p
    return mass


@kernel(finite=True, _nrt=False)
def _between(statements, s, seen, fits):
    """Mass of "the source lies between two targets"; the source may be the viewpoint."""
    a, b, c = statements.source[s], statements.target[s], statements.target2[s]
    mass = 0.0
    if b == ME or c == ME:
        return mass
    for k in range(1 if a == ME else fits.many[a]):
        ax = ay = np.float32(0.0)
        wa = np.float32(1.0)
        if a != ME:
            ax, ay = seen.at[fits.who[a, k], 0], seen.at[fits.who[a, k], 1]
            wa = fits.fit[a, k]
        for i in range(fits.many[b]):
            bx, by = seen.at[fits.who[b, i], 0] - ax, seen.at[fits.who[b, i], 1] - ay
            for j in range(fits.many[c]):
                if fits.who[b, i] == fits.who[c, j]:
                    continue
                cx, cy = seen.at[fits.who[c, j], 0] - ax, seen.at[fits.who[c, j], 1] - ay
                lengths = np.sqrt((bx * bx + by * by) * (cx * cx + cy * cy)) + np.float32(1.0)
                opposite = 0.5 - 0.5 * (bx * cx + by * cy) / lengths
                mass += wa * fits.fit[b, i] * fits.fit[c, j] * opposite**4
    return mass


COARSE, FINE = 20.0, 5.0
"""Square of how far a position may be from the viewpoint scored for it, and once it is fine [m^2]."""
SHARP = 2.0
"""Width of the fall around `SIGHT` where positions are exact [m]."""


@kernel(finite=True)
def score_views(statements, scene, views, words, chosen, bounds, relative, far, together, margin):
    """Log-likelihood ratios (K,) of candidates, and the hope (K,) of each; quickest best bounds first.

    `relative` (K,) is their log prior, against the largest. The hope is what statements say one by
    one, without their coherence, times the prior. Those are `HOPELESS` whose hope lies more than
    `margin` [nat] below the best hope, in whichever order they come: coherence, of which there is no
    bound, is not asked. Where that shows early, no more is reckoned.
    """
    n_statements = len(statements.op)
    scores = np.full(len(chosen), HOPELESS, np.float32)
    hopes = np.full(len(chosen), HOPELESS)
    each = np.empty(n_statements, np.float32)
    nothing = np.empty((0, 2), np.int64)
    noise = 0.0
    for s in range(n_statements):
        noise += 0.0 if statements.negated[s] else np.log(statements.noise[s])
    best = HOPELESS
    most = most_things(views)
    fits = room(statements, words)
    objects, sight = np.empty(most, np.int32), np.empty(most, np.float32)
    offsets, place = np.empty((most, 2), np.float32), np.empty(2, np.float32)
    for k in range(len(chosen)):
        if np.log(bounds[k]) + noise + SLACK < best - margin:
            continue
        tile, slot = tile_of(views, chosen[k])
        place[0], place[1] = place_of(views, tile, slot)
        n, total, pairs = look(scene, views, tile, slot, objects, offsets, sight)
        seen = in_sight(scene, objects[:n], offsets[:n], sight[:n], total, pairs, COARSE, place)
        scores[k] = likelihoods(
            statements, scene, words, seen, fits, far[k], together, best - margin - relative[k],
            each, nothing,
        )  # fmt: skip
        if scores[k] > HOPELESS:
            hopes[k] = each.sum() + relative[k]
            best = max(best, hopes[k])
    for k in range(len(chosen)):
        if hopes[k] < best - margin:
            scores[k] = HOPELESS
    return scores, hopes


@kernel(finite=True)
def look_again(statements, scene, words, at, seen, far, together, assign):
    """Score exact positions `at` (B, K, 2) [m]; log-likelihood ratios (B, K).

    Near the positions of each group lie the objects that are `seen`: starts (B + 1,) and rows.
    Nearest points are computed anew from the geometry, so that a position between viewpoints sees
    roads and walls where they are. `far` (B, K, S) is what distant objects add. Also returns the ratios
    of each statement (B, K, S) and, if `assign`, the objects that serve it (B, K, S, 2).
    """
    n_statements = len(statements.op)
    groups, k = at.shape[:2]
    scores = np.empty((groups, k), np.float32)
    each = np.empty((groups, k, n_statements), np.float32)
    served = np.empty((groups, k, n_statements if assign else 0, 2), np.int64)
    fits = room(statements, words)
    starts, objects = seen
    for b in range(groups):
        _look_again(
            statements, scene, words, at[b], objects[starts[b] : starts[b + 1]], fits, far[b],
            together, scores[b], each[b], served[b],
        )  # fmt: skip
    return scores, each, served


@kernel(finite=True)
def _look_again(
    statements, scene, words, at, nearby, fits, far, together, scores, each, served
):  # fmt: skip
    """Score the positions of one group, into `scores`, `each` and `served`; see `look_again`."""
    where = np.empty((len(at), len(nearby), 2), np.float32)
    distance2 = np.empty((len(at), len(nearby)), np.float32)
    sight = np.empty(len(nearby), np.float32)
    points, near, squares = at.T.copy(), np.empty((2, len(at))), np.empty(len(at))
    for i in range(len(nearby)):
        nearest_to_each(
            scene.part_starts, scene.point_starts, scene.points, scene.kind[nearby[i]], nearby[i],
            points, near, squares,
        )  # fmt: skip
        for k in range(len(at)):
            where[k, i, 0], where[k, i, 1], distance2[k, i] = near[0, k], near[1, k], squares[k]
    for k in range(len(at)):
        total = np.float32(1e-30)  # of a position from which nothing of them is in sight
        apart = squared = np.float32(0.0)
        for i in range(len(nearby)):
            d2 = distance2[k, i]
            sight[i] = 1.0 / (1.0 + np.exp((np.sqrt(d2) - SIGHT) / SHARP))
            total += sight[i]
            if scene.kind[nearby[i]] != AREA or d2 > 0.0:
                apart += sight[i]
                squared += sight[i] * sight[i]
        pairs = max(apart * apart - squared, np.float32(0.0))
        seen = in_sight(
            scene, nearby, where[k], sight, total, pairs, FINE, at[k].astype(np.float32)
        )
        scores[k] = likelihoods(
            statements, scene, words, seen, fits, far[k], together, HOPELESS, each[k], served[k]
        )


@kernel(finite=True)
def distant(statements, scene, far, positions):
    """Return what things out of sight add to P(statement | position), (K, S) float32.

    `far` (`Far`) lists all objects of mentions rare enough to be spoken of from
    afar; and how far a statement reaches. In a relation
    of two things the one that is not listed stands where the speaker stands, nearly enough.
    """
    out = np.zeros((len(positions), len(statements.op)), np.float32)
    mention, forward = np.full(len(out[0]), ME), np.zeros(len(out[0]), np.bool_)
    for s in range(len(mention)):
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
            west, south, east, north = scene.box[o]
            for k in range(len(positions)):
                x, y = positions[k]
                aside = max(west - x, x - east, np.float32(0.0))
                ahead = max(south - y, y - north, np.float32(0.0))
                if aside * aside + ahead * ahead > reach * reach:
                    continue
                dx, dy = scene.center[o, 0] - x, scene.center[o, 1] - y
                # extents beyond 1 km are walked in sight, not from afar
                if max(abs(dx), abs(dy)) > reach + np.float32(1000.0):
                    continue
                d2 = dx * dx + dy * dy
                if scene.kind[o] != POINT:
                    dx, dy, d2 = nearest_on_parts(
                        scene.part_starts, scene.point_starts, scene.points, scene.kind[o], o, x, y
                    )
                d = np.sqrt(d2)
                for s in range(len(mention)):
                    if mention[s] == m and d <= 4.0 * far.scale[s]:
                        fit = _fit_afar(statements, s, d, dx, dy, far.scale[s], forward[s])
                        out[k, s] += far.share[s] * far.fits[i] * fit
    return out


@kernel(finite=True, inline="always")
def _fit_afar(statements, s, d, dx, dy, scale, forward):
    """Return how well a thing out of sight, d = (dx, dy) away [m], fits a statement."""
    fit = np.exp(-d / scale) * distance_fit(statements.distance[s], d)
    if statements.op[s] == DIRECTION:
        ux, uy = statements.bearing[s] if forward else -statements.bearing[s]
        fit *= direction_fit(statements.table[s], ux, uy, dx, dy, COARSE)
    return fit
