"""From a compiled query to a posterior over viewpoints: candidates, scoring, a closer look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.geometry import angle_between, bearing
from placegraph.outdoor import scan
from placegraph.outdoor.index import STRIDE
from placegraph.outdoor.match import HOPELESS
from placegraph.outdoor.posterior import Posterior, posterior

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.query import Far, Query

MOST_CANDIDATES = 800
"""At most this many viewpoints are scored."""
TOGETHER = 0.3
"""Prior probability that a mention means one and the same thing in all statements."""
MARGIN = 4.0
"""Viewpoints that must lie this far behind the best are not scored [nat]."""
CLOSER = 10
"""This many of the best viewpoints are looked at more closely ..."""
FAR_CANDIDATES = 3000
"""At most this many where things out of sight are spoken of."""
FAR_REACH = 400.0
"""Viewpoints up to this far from a rare thing spoken of from afar are candidates [m]."""
MOST_ANCHORS = 40
"""At most this many such things give candidates."""
WALK = 600.0
"""Scale of the distance from a listener to the place they are told of [m]."""
FINE = np.array([(x, y) for x in (-6.67, 0.0, 6.67) for y in (-6.67, 0.0, 6.67)])
"""... at these positions around them, east and north [m]."""


@dataclass(frozen=True)
class Prior:
    """What is known of the place before a word is heard; both parts are optional."""

    near: NDArray[np.float64] | None = None
    """(2,) east, north [m] the speaker is near ..."""
    radius: float = 1000.0
    """... and the radius that holds half of the probability [m]."""
    listener: NDArray[np.float64] | None = None
    """(2,) east, north [m] of "you" ..."""
    bearings: tuple[tuple[float, float, float], ...] = ()
    """... and what was said of the way from there: bearing [rad], sigma [rad], certainty."""

    def log(self, positions: NDArray[np.float64], n_views: int) -> NDArray[np.float64]:
        """Log prior probability (K,) of viewpoints; uniform where nothing is known."""
        prior = np.full(len(positions), -np.log(n_views))
        if self.near is not None:
            sigma = self.radius / 1.1774  # of a round Gaussian, half lies within 1.1774 sigma
            density = STRIDE**2 / (2.0 * np.pi * sigma**2)
            prior = np.log(density) - 0.5 * (((positions - self.near) / sigma) ** 2).sum(axis=1)
        if self.listener is not None:
            delta = positions - self.listener
            distance = np.hypot(*delta.T)
            prior += np.log(_walk(distance) * n_views * STRIDE**2 / 1e6 + 1e-3)
            for said, sigma, certainty in self.bearings:
                off = angle_between(bearing(delta), said)
                fits = np.exp(-0.5 * (off / (1.2 * sigma)) ** 2) * 2.0
                prior += np.log(certainty * fits + (1.0 - certainty) + 0.05)
        return prior


def _walk(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Density [1/km^2] of meeting places around a listener: mostly within a kilometre or so."""
    return np.exp(-distance / WALK) * 1e6 / (2.0 * np.pi * WALK**2)


def search(query: Query, city: CityMap, prior: Prior) -> Posterior:
    """Score the viewpoints of a city."""
    views, scene = city.views, city.scene
    statements = query.statements
    words = query.words(len(views.posting_starts) - 1)
    most = FAR_CANDIDATES if query.far else MOST_CANDIDATES
    columns = views.columns
    chosen, bounds = scan.candidates(statements, query.mentions, columns, most)
    far = np.zeros((len(chosen), len(statements.op)), np.float32)
    if query.far:
        chosen, bounds, far = _with_far(query, query.far, city, prior, chosen, bounds)
    scores = scan.score_views(
        statements, scene, columns, words, chosen, bounds, far, TOGETHER, MARGIN
    )
    reached = scores > 0.5 * HOPELESS
    chosen, scores, far = chosen[reached], scores[reached], far[reached]
    positions = views.positions[chosen].astype(np.float64)
    log_prior = prior.log(positions, len(views.positions))
    best = np.argsort(-(scores + log_prior), kind="stable")[:CLOSER]
    rest = 1.0 - len(chosen) / len(views.positions)
    positions, scores, log_prior = _closer(query, city, words, chosen, far, scores, log_prior, best)
    floor = float(np.log(statements.noise[~statements.negated]).sum())
    return posterior(positions, scores.astype(np.float64), log_prior, floor, rest)


def _with_far(
    query: Query,
    far: Far,
    city: CityMap,
    prior: Prior,
    chosen: NDArray[np.int32],
    bounds: NDArray[np.float32],
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """Add viewpoints around rare things out of sight, and what those add to each statement."""
    views, statements = city.views, query.statements
    anchors = city.objects.center[far.anchors[:MOST_ANCHORS]]
    around = [views.near(anchor, FAR_REACH) for anchor in anchors]
    if around:
        extra = np.setdiff1d(np.concatenate(around), chosen).astype(np.int32)
        extra = extra[:: 1 + len(extra) // FAR_CANDIDATES]
        chosen = np.concatenate([chosen, extra])
        bounds = np.concatenate([bounds, np.ones(len(extra), np.float32)])
    added = scan.distant(statements, city.scene, far, views.positions[chosen])
    gain = (1.0 - statements.noise) / (statements.noise * statements.background)
    total = np.log(bounds) + np.log1p(gain * added).sum(axis=1)
    rank = total + prior.log(views.positions[chosen].astype(np.float64), len(views.positions))
    order = np.argsort(-rank, kind="stable")[:MOST_CANDIDATES]
    order = order[np.argsort(-total[order], kind="stable")]
    return chosen[order], np.exp(np.minimum(total[order], 80.0)).astype(np.float32), added[order]


def _closer(
    query: Query,
    city: CityMap,
    words: NDArray[np.float32],
    chosen: NDArray[np.int32],
    far: NDArray[np.float32],
    scores: NDArray[np.float32],
    log_prior: NDArray[np.float64],
    best: NDArray[np.int64],
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float64]]:
    """Replace the best viewpoints by finer positions around them."""
    positions = city.views.positions[chosen].astype(np.float64)
    views, scene = city.views, city.scene
    fine_at, fine_scores, fine_prior = [], [], []
    for k in best:
        v = chosen[k]
        nearby = views.objects[views.starts[v] : views.starts[v + 1]]
        at = positions[k] + FINE
        again, _, _ = scan.look_again(
            query.statements,
            scene,
            words,
            at,
            nearby,
            np.tile(far[k], (len(at), 1)),
            TOGETHER,
            False,
        )
        fine_at.append(at)
        fine_scores.append(again)
        fine_prior.append(np.full(len(at), log_prior[k] - np.log(len(at))))
    rest = np.setdiff1d(np.arange(len(chosen)), best)
    return (
        np.concatenate([positions[rest], *fine_at]),
        np.concatenate([scores[rest], *fine_scores]),
        np.concatenate([log_prior[rest], *fine_prior]),
    )
