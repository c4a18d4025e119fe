"""From a compiled query to a posterior over viewpoints: candidates, scoring, a closer look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.geometry import angle_between, bearing
from placegraph.outdoor.likelihood import scan_kernels as scan
from placegraph.outdoor.likelihood.match_kernels import HOPELESS
from placegraph.outdoor.map.index import STRIDE
from placegraph.outdoor.search.posterior import Posterior, posterior

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from placegraph.outdoor.likelihood.query import Far, Query
    from placegraph.outdoor.map.city import City
    from placegraph.outdoor.map.index import ViewIndex
    from placegraph.outdoor.network.encoded import EncodedCity

MOST_CANDIDATES = 400
"""At most this many viewpoints are scored."""
TOGETHER = 0.3
"""Prior probability that a mention means one and the same thing in all statements."""
MARGIN = 4.0
"""Viewpoints that must lie this far behind the best are not scored [nat]."""
CLOSER = 8
"""This many of the best viewpoints are looked at more closely ..."""
FAR_CANDIDATES = 3000
"""At most this many where things out of sight are spoken of."""
FAR_REACH = 400.0
"""Viewpoints up to this far from a rare thing spoken of from afar are candidates [m]."""
MOST_ANCHORS = 40
"""At most this many such things give candidates."""
WALK = 800.0
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
    inside: Callable[[NDArray[np.float64]], NDArray[np.bool_]] | None = None
    """Whether the speaker may be at positions (K, 2) [m]; anywhere if not given."""

    @property
    def informative(self) -> bool:
        """Whether anything is known."""
        return not (self.near is None and self.listener is None and self.inside is None)

    def log(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log prior probability (W,) of all viewpoints of a map; uniform where nothing is known.

        It is -inf where the speaker cannot be. `near` shifts probability within the map; it puts
        none off the map but where the map ends before it.
        """
        allowed = (
            np.ones(len(positions), np.bool_) if self.inside is None else self.inside(positions)
        )
        n = int(allowed.sum())
        prior = np.where(allowed, -np.log(max(1, n)), -np.inf)
        if not n:
            return prior
        if self.near is not None:
            # of a round Gaussian, half lies within 1.1774 sigma; viewpoints stand in for their square
            sigma = np.hypot(self.radius / 1.1774, STRIDE / 2)
            off = -0.5 * (((positions - self.near) / sigma) ** 2).sum(axis=1)
            off = np.where(allowed, off, -np.inf)
            prior = off - np.logaddexp.reduce(off) + off.max()
        if self.listener is not None:
            delta = positions - self.listener
            area = n * STRIDE**2 / 1e6
            prior += np.log(_walk(np.hypot(*delta.T)) * area + 1e-3)
            for said, sigma, certainty in self.bearings:
                off = angle_between(bearing(delta), said)
                fits = np.exp(-0.5 * (off / (1.2 * sigma)) ** 2) * 2.0
                prior += np.log(certainty * fits + (1.0 - certainty) + 0.05)
        return prior


def _walk(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Density [1/km^2] of meeting places around a listener: mostly within a kilometre or so."""
    return np.exp(-distance / WALK) * 1e6 / (2.0 * np.pi * WALK**2)


class Candidates(NamedTuple):
    """Viewpoints that were scored, best bounds first, and what all others weigh."""

    rows: NDArray[np.int32]
    """(K,) rows of `city.views`."""
    scores: NDArray[np.float32]
    """(K,) log-likelihood ratios."""
    log_prior: NDArray[np.float64]
    """(K,)"""
    far: NDArray[np.float32]
    """(K, S) what things out of sight add."""
    rest: float
    """Log of what all other viewpoints weigh together."""


def search(
    query: Query,
    city: City,
    prior: Prior,
    *,
    rows: NDArray[np.int64] | None = None,
    reach: float = 1.0,
    encoded: EncodedCity | None = None,
) -> Posterior:
    """Score the viewpoints of a city, or those in `rows`; `encoded` lets the network judge the best.

    Around rare things out of sight others than those in `rows` are scored too; `reach` is the
    probability that `rows` hold the right one.
    """
    if not query.used:
        return _by_prior(city.views, _log_prior(city.views, prior))
    found = candidates(query, city, prior, rows=rows)
    if encoded is not None:
        from placegraph.outdoor.search.rerank import rerank

        found = rerank(found, query, encoded)
    return closer(query, city, found, reach)


def closer(query: Query, city: City, found: Candidates, reach: float = 1.0) -> Posterior:
    """Look more closely at the best of the scored viewpoints, and apply Bayes to all.

    The right one is among them with probability `reach`: together they weigh no more than that.
    """
    words = query.words(len(city.views.posting_starts) - 1)
    scored = _Scored(
        city.views.positions[found.rows].astype(np.float64),
        found.scores,
        found.log_prior,
        found.far,
    )
    scored = _closer(query, city, words, found.rows, scored)
    scores, rest = scored.scores.astype(np.float64), found.rest
    if reach < 1.0 and len(scores):
        here = np.logaddexp.reduce(scores + scored.log_prior)
        rest = max(rest, float(here + np.log(1.0 / reach - 1.0)))
    return posterior(scored.positions, scores, scored.log_prior, rest)


def _log_prior(views: ViewIndex, prior: Prior) -> NDArray[np.float64]:
    """Log prior (W,) of all viewpoints, or nothing where nothing is known."""
    if not prior.informative:
        return np.zeros(0)
    log_prior = prior.log(views.positions.astype(np.float64))
    # what is known of the way cannot lie off the map altogether
    mass = float(np.logaddexp.reduce(log_prior))
    return log_prior - (mass if prior.listener is not None else max(0.0, mass))


def touched(
    query: Query, city: City, most: int, within: NDArray[np.bool_] | None = None
) -> NDArray[np.int32]:
    """Viewpoints (at most `most`) of largest bound on their likelihood, best first.

    `within` (W,) says which of all are asked for.
    """
    weights = np.zeros(0) if within is None else within.astype(np.float64)
    chosen, _, _ = scan.candidates(
        query.statements, query.mentions, city.views.columns, weights, most
    )
    return chosen if within is None else chosen[within[chosen]]


def candidates(
    query: Query,
    city: City,
    prior: Prior,
    *,
    rows: NDArray[np.int64] | None = None,
    only: bool = False,
) -> Candidates:
    """Find and score the viewpoints that a query with statements may have been given at.

    Where `rows` are given these are scored instead, and unless `only` these, those around rare
    things out of sight.
    """
    views, statements = city.views, query.statements
    n_views = len(views.positions)
    log_prior = _log_prior(views, prior)
    highest = float(log_prior.max()) if prior.informative else -float(np.log(n_views))
    weights = np.exp(log_prior - highest)
    words = query.words(len(views.posting_starts) - 1)
    most = FAR_CANDIDATES if query.far else MOST_CANDIDATES
    if rows is None:
        chosen, bounds, left_out = scan.candidates(
            statements, query.mentions, views.columns, weights, most
        )
    else:
        chosen, left_out = rows.astype(np.int32), 0.0
        bounds = np.full(len(rows), scan.HIGHEST)
    far = np.zeros((len(chosen), len(statements.op)), np.float32)
    if query.far and only:
        far = scan.distant(statements, city.columns, query.far, views.positions[chosen])
    elif query.far:
        chosen, bounds, far = _with_far(query, query.far, city, weights, chosen, bounds)
    if prior.inside is not None:
        allowed = weights[chosen] > 0.0
        chosen, bounds, far = chosen[allowed], bounds[allowed], far[allowed]
    relative = log_prior[chosen] - highest if prior.informative else np.zeros(len(chosen))
    scores = scan.score_views(
        statements,
        city.columns,
        views.columns,
        words,
        chosen,
        bounds,
        relative,
        far,
        TOGETHER,
        MARGIN,
    )
    floor = float(np.log(statements.noise[~statements.negated]).sum())
    tail = slice(2 * len(chosen) // 3, None)
    # what was left out keeps of its bounds what the lightest third of the scored keep of theirs
    unscored = -np.inf
    if left_out > 0.0 and not query.far:
        kept = np.logaddexp.reduce(scores[tail] + relative[tail]) - np.log(bounds[tail].sum())
        unscored = highest + kept + np.log(left_out)
    reached = scores > 0.5 * HOPELESS
    share = np.exp(relative + highest).sum() if prior.informative else len(chosen) / n_views
    unseen = floor + np.log(max(1e-12, 1.0 - share))
    return Candidates(
        chosen[reached],
        scores[reached],
        relative[reached] + highest,
        far[reached],
        float(np.logaddexp(unscored, unseen)),
    )


class _Scored(NamedTuple):
    positions: NDArray[np.float64]
    """(K, 2) [m]"""
    scores: NDArray[np.float32]
    """(K,) log-likelihood ratios."""
    log_prior: NDArray[np.float64]
    """(K,)"""
    far: NDArray[np.float32]
    """(K, S) what things out of sight add."""


def _by_prior(views: ViewIndex, log_prior: NDArray[np.float64]) -> Posterior:
    """Posterior where nothing but the way to the place was told."""
    likely = np.argsort(-log_prior, kind="stable")[:FAR_CANDIDATES]
    rest = np.log(max(1e-12, 1.0 - np.exp(log_prior[likely]).sum() / np.exp(log_prior).sum()))
    norm = np.logaddexp.reduce(log_prior)
    positions = views.positions[likely].astype(np.float64)
    return posterior(positions, np.zeros(len(likely)), log_prior[likely] - norm, float(rest))


def _with_far(
    query: Query,
    far: Far,
    city: City,
    weights: NDArray[np.float64],
    chosen: NDArray[np.int32],
    bounds: NDArray[np.float64],
) -> tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float32]]:
    """Add viewpoints around rare things out of sight, and what those add to each statement."""
    views, statements = city.views, query.statements
    anchors = city.objects.center[far.anchors[:MOST_ANCHORS]]
    around = [views.near(anchor, FAR_REACH) for anchor in anchors]
    if around:
        extra = np.setdiff1d(np.concatenate(around), chosen).astype(np.int32)
        extra = extra[:: 1 + len(extra) // FAR_CANDIDATES]
        chosen = np.concatenate([chosen, extra])
        bounds = np.concatenate([bounds, weights[extra] if len(weights) else np.ones(len(extra))])
    added = scan.distant(statements, city.columns, far, views.positions[chosen])
    gain = (1.0 - statements.noise) / (statements.noise * statements.background)
    total = np.log(np.maximum(bounds, 1e-300)) + np.log1p(gain * added).sum(axis=1)
    order = np.argsort(-total, kind="stable")[:MOST_CANDIDATES]
    return chosen[order], np.exp(np.minimum(total[order], 690.0)), added[order]


def _closer(
    query: Query,
    city: City,
    words: NDArray[np.float32],
    chosen: NDArray[np.int32],
    found: _Scored,
) -> _Scored:
    """Replace the best viewpoints by finer positions around them."""
    views = city.views
    best = np.argsort(-(found.scores + found.log_prior), kind="stable")[:CLOSER]
    rest = np.setdiff1d(np.arange(len(chosen)), best)
    parts = [
        _Scored(found.positions[rest], found.scores[rest], found.log_prior[rest], found.far[rest])
    ]
    for k in best:
        v = chosen[k]
        nearby = views.objects[views.starts[v] : views.starts[v + 1]]
        at = found.positions[k] + FINE
        far = np.tile(found.far[k], (len(at), 1))
        scores, _, _ = scan.look_again(
            query.statements, city.columns, words, at, nearby, far, TOGETHER, False
        )
        parts.append(
            _Scored(at, scores, np.full(len(at), found.log_prior[k] - np.log(len(at))), far)
        )
    return _Scored(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.scores for part in parts]),
        np.concatenate([part.log_prior for part in parts]),
        np.concatenate([part.far for part in parts]),
    )
