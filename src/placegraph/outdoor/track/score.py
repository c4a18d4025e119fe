"""How well every viewpoint explains what was said at a stop, given a belief.

`search` asks where the best places are; a filter must also know how the rest compares, since motion
may lead there. So the places that matter by belief and bound are scored as `search` scores them, the
others keep their bound, calibrated by those, and what sees nothing of what was said keeps the noise.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.outdoor.likelihood.match_kernels import HOPELESS
from placegraph.outdoor.likelihood.promise_kernels import promising_views
from placegraph.outdoor.likelihood.score_kernels import distant, score_views
from placegraph.outdoor.search.candidates import FAR_CANDIDATES, around_far
from placegraph.outdoor.search.request import Request
from placegraph.outdoor.search.viewpoints import CLOSER, TOGETHER, kept, look_around

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.geometry import Floats
    from placegraph.outdoor.likelihood.query import Query
    from placegraph.outdoor.map.city import City

MOST_SCORED = 2500
"""At most this many viewpoints are scored."""
MARGIN = 12.0
"""Viewpoints that must lie this far behind the best are not scored [nat]."""


class Scores(NamedTuple):
    """Log-likelihood ratios against being elsewhere [nat]."""

    views: Floats
    """(W,) of the viewpoints."""
    nothing: float
    """Of a place from which nothing is in sight."""
    closer: NDArray[np.int64]
    """(B,) viewpoints looked at more closely ..."""
    positions: Floats
    """(B, 9, 2) ... at these positions [m] ..."""
    ratios: Floats
    """(B, 9) ... and the ratios there."""


def score(query: Query, city: City, weights: Floats) -> Scores:
    """Score what was said under a belief: `weights` (W,) of the viewpoints, any scale."""
    statements, views = query.statements, city.views
    relative = weights / max(float(weights.max()), 1e-300)
    asked, nothing = Request(city, query), statements.floor
    ratios = np.full(len(weights), nothing)
    chosen, bounds, far = _candidates(query, city, relative)
    if not len(chosen):
        none = np.zeros(0)
        return Scores(ratios, nothing, none.astype(np.int64), none.reshape(0, 9, 2), none[:, None])
    prior = np.log(relative[chosen])
    first = slice(MOST_SCORED)
    found, _ = score_views(
        statements, city.columns, views.columns, asked.words, chosen[first], bounds[first], prior[first],
        far[first], TOGETHER, MARGIN,
    )  # fmt: skip
    found = found.astype(np.float64)
    reached = np.flatnonzero(found > 0.5 * HOPELESS)
    last = int(reached[-1]) + 1 if len(reached) else 0
    left = kept((found + prior[first])[:last], bounds[:last]) if last else nothing
    least = float(np.log(statements.noise).sum())
    ratios[chosen] = np.maximum(np.log(bounds) - prior + left, least)
    ratios[chosen[reached]] = found[reached]
    best = reached[np.argsort(-(found + prior[first])[reached], kind="stable")[:CLOSER]]
    positions, close = look_around(asked, chosen[best], far[best])
    ratios[chosen[best]] = np.logaddexp.reduce(close, axis=1) - np.log(close.shape[1])
    return Scores(ratios, nothing, chosen[best].astype(np.int64), positions, close)


def _candidates(
    query: Query, city: City, relative: Floats
) -> tuple[NDArray[np.int32], Floats, NDArray[np.float32]]:
    """Viewpoints that matter (K,), the most promising first, their bounds, and what far things add."""
    statements, views = query.statements, city.views
    if statements.negated.all():
        chosen = np.argsort(-relative, kind="stable")[:MOST_SCORED].astype(np.int32)
        bounds = relative[chosen]
    else:
        chosen, bounds, _ = promising_views(
            statements, query.mentions, views.columns, relative, len(relative)
        )
    chosen, bounds = chosen[bounds > 0.0], bounds[bounds > 0.0]
    far = np.zeros((min(len(chosen), MOST_SCORED), len(statements.op)), np.float32)
    if query.far is None:
        return chosen, bounds, far
    extra = around_far(city, query.far, chosen)
    extra = extra[relative[extra] > 0.0]
    chosen = np.concatenate([chosen, extra])
    bounds = np.concatenate([bounds, relative[extra]])
    heavy = np.argsort(-bounds, kind="stable")[:FAR_CANDIDATES]
    heavy = np.union1d(heavy, np.arange(len(chosen) - len(extra), len(chosen)))
    added = distant(statements, city.columns, query.far, views.positions_of(chosen[heavy]))
    log_bounds = np.log(bounds)
    log_bounds[heavy] += np.log1p(statements.gain * added).sum(axis=1)
    order = np.argsort(-log_bounds, kind="stable")
    row = np.full(len(chosen), -1)
    row[heavy] = np.arange(len(heavy))
    row = row[order[:MOST_SCORED]]
    far = np.where(row[:, None] >= 0, added[row], np.float32(0.0)).astype(np.float32)
    return chosen[order], np.exp(np.minimum(log_bounds[order], 690.0)), far
