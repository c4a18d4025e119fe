# mypy: allow-untyped-defs, allow-incomplete-defs
"""How viewpoints, exact positions and things out of sight score: loops over `likelihoods`."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.likelihood.fit_kernels import (
    AREA,
    BETWEEN,
    DIRECTION,
    ME,
    direction_fit,
    distance_fit,
)
from placegraph.outdoor.likelihood.match_kernels import (
    HOPELESS,
    SLACK,
    in_sight,
    likelihoods,
    room,
)
from placegraph.outdoor.map.index import POINT, SIGHT
from placegraph.outdoor.map.index_kernels import look, most_things, place_of, tile_of
from placegraph.outdoor.map.raster_kernels import nearest_on_parts, nearest_to_each

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
    """As `look_again`, of one group, into `scores`, `each` and `served`."""
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
    """What things out of sight add to P(statement | position), (K, S) float32.

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
    """How well a thing out of sight fits a statement, that is d = (dx, dy) away [m]."""
    fit = np.exp(-d / scale) * distance_fit(statements.distance[s], d)
    if statements.op[s] == DIRECTION:
        ux, uy = statements.bearing[s] if forward else -statements.bearing[s]
        fit *= direction_fit(statements.table[s], ux, uy, dx, dy, COARSE)
    return fit
