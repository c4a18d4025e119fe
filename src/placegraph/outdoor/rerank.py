"""Re-ranking: the network looks at the viewpoints that relational matching finds best.

Its matching logit, weighted as training found best, shifts probability among them; how much all of
them together weigh against the rest of the city and against elsewhere stays as it was.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.outdoor.learn.graphs import PlaceGraphs

if TYPE_CHECKING:
    from placegraph.outdoor.learn.encoded import EncodedCity
    from placegraph.outdoor.query import Query
    from placegraph.outdoor.search import Candidates

MOST = 24
"""At most this many viewpoints are judged."""


def rerank(found: Candidates, query: Query, encoded: EncodedCity) -> Candidates:
    """Candidates whose log prior holds what the network says of them."""
    weight = encoded.network.fusion
    log_posterior = found.scores + found.log_prior
    best = np.argsort(-log_posterior, kind="stable")[:MOST]
    if weight == 0.0 or len(best) < 2:
        return found
    places = PlaceGraphs.of_views(encoded.city, found.rows[best].astype(np.int64))
    match = encoded.match(encoded.text(query), places, np.arange(len(best)))
    shift = weight * match.logit.astype(np.float64)
    before = np.logaddexp.reduce(log_posterior[best])
    shift -= np.logaddexp.reduce(log_posterior[best] + shift) - before
    log_prior = found.log_prior.copy()
    log_prior[best] += shift
    return found._replace(log_prior=log_prior)
