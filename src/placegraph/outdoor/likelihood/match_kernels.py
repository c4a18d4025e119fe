# mypy: allow-untyped-defs, allow-incomplete-defs
"""How well what is in sight of a viewpoint explains all statements: their log-likelihood ratios."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.outdoor.likelihood.coherence_kernels import MOST, assign, log_coherence
from placegraph.outdoor.likelihood.fit_kernels import AREA, BETWEEN, DIRECTION, ME, me_fit, pair_fit

HOPELESS = -1e9
"""Score of a viewpoint that cannot matter: finite, since compiled code assumes finite numbers."""
SLACK = 1.5
"""By how much a bound of viewpoints may be short of what statements say [nat]."""


SMALL = 25.0
"""An area one stands in still lies in the direction of its centre, if that is this near [m]."""
LONELY = 0.5
"""Added to what is in sight, as `crowd` is to pairs."""


class InSight(NamedTuple):
    """What is in sight of a viewpoint, one row a thing."""

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


class Fits(NamedTuple):
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
    """`Fits` of viewpoints one after the other: nothing is allocated for each of them."""
    n = words.fit.shape[1]
    return Fits(
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
