# mypy: allow-untyped-defs, allow-incomplete-defs
"""One thing for a mention throughout: what is gained if it serves all statements, and which it is."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.likelihood.fit_kernels import BETWEEN, DIRECTION, ME, pair_fit

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
