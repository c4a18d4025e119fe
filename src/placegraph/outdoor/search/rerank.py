"""Re-ranking: the network looks at the viewpoints that relational matching finds best.

What it adds to their log-likelihood ratios shifts probability among these viewpoints; how much all
of them together weigh against the rest of the city and against elsewhere stays as it was.
"""

from __future__ import annotations

import numpy as np

from placegraph.outdoor.network.graphs import PlaceGraphs
from placegraph.outdoor.search.request import Request
from placegraph.outdoor.search.viewpoints import Scored

HARD = 24
"""Viewpoints that relational matching finds best, which the network looks at."""


def rerank(asked: Request, found: Scored) -> Scored:
    """Viewpoints whose log prior holds what the network says of them."""
    before = found.scores + found.log_prior
    best = np.argsort(-before, kind="stable")[:HARD]
    if len(best) < 2:
        return found
    encoded = asked.encoded
    places = PlaceGraphs.of_views(encoded.city, found.rows[best].astype(np.int64))
    match = encoded.match(asked.text, places, np.arange(len(best)))
    _, scale, weight = encoded.network.arrays["prior"]
    after = scale * found.scores[best] + weight * match.residual + found.log_prior[best]
    after += np.logaddexp.reduce(before[best]) - np.logaddexp.reduce(after)
    log_prior = found.log_prior.copy()
    log_prior[best] += after - before[best]
    return found._replace(log_prior=log_prior)
