"""From candidates to scores, to a posterior over the whole city, to its modes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.likelihood.match_kernels import HOPELESS, look_again, score_views
from placegraph.outdoor.network.graphs import PlaceGraphs
from placegraph.outdoor.search.candidates import FAR_CANDIDATES, Candidates
from placegraph.outdoor.search.posterior_kernels import peaks
from placegraph.outdoor.search.request import Request

TEMPER = 1.0
"""Exponent of the likelihood: statements about one place are not independent."""
ELSEWHERE = 0.03
"""Prior probability that the place is not on the map."""
WITHIN = 50.0
"""A mode's probability is that of the true place lying within this distance [m]."""
APART = 40.0
"""Modes are at least this far apart [m]."""
LOOKED_AT = 8
"""Peaks that are compared at least: the first one found is not always the heaviest."""
HEAVIEST = 32
"""So many points are looked at for peaks."""


@dataclass(frozen=True)
class Posterior:
    """Probability of viewpoints; what is missing to 1 lies elsewhere, or was not scored."""

    positions: NDArray[np.float64]
    """(K, 2) east, north [m]."""
    probabilities: NDArray[np.float64]
    """(K,)"""
    elsewhere: float
    """Probability that the place is not on this map, or that the text is not about one."""

    def within(self, position: NDArray[np.float64], radius: float) -> float:
        """Probability of the place lying within `radius` [m] of a position (2,)."""
        return float(self.probabilities[_within(self.positions, position, radius)].sum())


def apply_bayes(
    positions: NDArray[np.float64],
    scores: NDArray[np.float64],
    log_prior: NDArray[np.float64],
    unscored: float,
) -> Posterior:
    """Bayes over viewpoints.

    `scores` (K,) are log-likelihood ratios against anywhere, `log_prior` (K,) log shares of the
    viewpoints, `unscored` the log of what all viewpoints together weigh that were not scored.
    """
    here = TEMPER * scores + log_prior
    log_total = np.logaddexp.reduce(
        np.concatenate((here, [TEMPER * unscored])) + np.log1p(-ELSEWHERE)
    )
    log_total = np.logaddexp(log_total, np.log(ELSEWHERE))
    probabilities = np.exp(here + np.log1p(-ELSEWHERE) - log_total)
    return Posterior(positions, probabilities, float(np.exp(np.log(ELSEWHERE) - log_total)))


@dataclass(frozen=True)
class Mode:
    """A peak of the posterior."""

    position: NDArray[np.float64]
    """(2,) east, north [m]."""
    covariance: NDArray[np.float64]
    """(2, 2) [m^2]."""
    probability: float


def find_modes(found: Posterior, top: int, spacing: float) -> list[Mode]:
    """Peaks of the posterior, heaviest first; positions lie on a grid of `spacing` [m]."""
    heavy = np.argsort(-found.probabilities, kind="stable")[:HEAVIEST]
    own = (spacing**2 / 12.0 + 1.0) * np.eye(2)
    places, covariances, masses = peaks(
        found.positions, found.probabilities, heavy, max(top, LOOKED_AT), APART, WITHIN
    )
    return [
        Mode(places[i], covariances[i] + own, min(1.0, float(masses[i])))
        for i in np.argsort(-masses, kind="stable")[:top].tolist()
    ]


def rank_modes(found: Posterior, top: int, spacing: float) -> list[Mode]:
    """Peaks of positions that stand best first, whatever they weigh; arguments as of `find_modes`."""
    # each outweighs all below it together
    weights = 0.5 ** np.arange(1.0, 1.0 + len(found.positions))
    best = find_modes(replace(found, probabilities=weights), top, spacing)
    return [replace(mode, probability=found.within(mode.position, WITHIN)) for mode in best]


def _within(
    positions: NDArray[np.float64], center: NDArray[np.float64], radius: float
) -> NDArray[np.bool_]:
    """Which positions (..., K) lie within a radius [m] of a center (..., 2)."""
    east, north = positions[:, 0] - center[..., 0], positions[:, 1] - center[..., 1]
    return east * east + north * north <= radius * radius


TOGETHER = 0.3
"""Prior probability that a mention means one and the same thing in all statements."""
MARGIN, ALL = 12.0, 1e8
"""Viewpoints that lie so far below the best one are left out [nat]; and none."""
FEWEST = 64
"""So many of the viewpoints that stand for others are scored at first, and then twice as many ..."""
SURE = 0.003
"""... until their chance alters the probability of the best place by no more than this."""
CLOSER = 8
"""This many of the best viewpoints are looked at more closely ..."""
SPACING = 6.67
"""... at positions this far apart [m] ..."""
FINE = np.array([(x, y) for x in (-SPACING, 0.0, SPACING) for y in (-SPACING, 0.0, SPACING)])
"""... around them, east and north [m]."""
HARD = 24
"""Viewpoints that relational matching finds best, which the network looks at."""
DENSE_REACH = 0.4
"""Probability that the place is near one of 50 cells that embeddings propose, in a large city (60 texts
each: Vancouver .40, Ankara .45, Liechtenstein .48): an estimate by these alone cannot be surer."""


class Scored(NamedTuple):
    """Scored candidates, and the weight of all other viewpoints."""

    rows: NDArray[np.int32]
    """(K,) rows of `city.views`."""
    scores: NDArray[np.float32]
    """(K,) log-likelihood ratios."""
    log_prior: NDArray[np.float64]
    """(K,)"""
    far: NDArray[np.float32]
    """(K, S) what things out of sight add."""
    rest: float = -np.inf
    """Log of what all other viewpoints weigh together, as estimated by some that stand for them."""

    def part(self, kept: NDArray[np.bool_]) -> Scored:
        """Return some of them."""
        rows, scores, log_prior, far, rest = self
        return Scored(rows[kept], scores[kept], log_prior[kept], far[kept], rest)


def score(asked: Request, chosen: Candidates, margin: float = MARGIN) -> Scored:
    """Score candidates, and of those that stand for others as many as it takes to be sure.

    Viewpoints whose hope (`score_views`) lies `margin` [nat] below the best are left out.
    """
    own, others = chosen.part(chosen.stands == 0.0), chosen.part(chosen.stands > 0.0)
    found = _score(asked, own, margin)
    mass = (
        np.exp(found.log_prior).sum()
        + np.exp(asked.relative(others.rows) + asked.highest) @ others.stands
    )
    rest = asked.query.statements.floor + float(np.log(max(1e-12, 1.0 - mass)))
    found = found.part(found.scores > 0.5 * HOPELESS)
    if len(found.rows):
        rest = float(np.logaddexp(rest, _weigh_others(asked, others, found)))
    return found._replace(rest=rest)


def _score(asked: Request, some: Candidates, margin: float) -> Scored:
    """Score candidates one by one."""
    relative = asked.relative(some.rows)
    scores, _ = score_views(
        asked.query.statements, asked.city.columns, asked.city.views.columns, asked.words,
        some.rows, some.bounds, relative, some.far, TOGETHER, margin,
    )  # fmt: skip
    return Scored(some.rows, scores, relative + asked.highest, some.far)


def _weigh_others(asked: Request, others: Candidates, found: Scored) -> float:
    """Estimate the log weight of all viewpoints that were not found, by some of the `others`."""
    here = found.scores + found.log_prior
    total, best = float(np.logaddexp.reduce(here)), int(np.argmax(here))
    positions = asked.city.views.positions_of(found.rows)
    near = float(np.exp(here - total) @ (np.hypot(*(positions - positions[best]).T) <= WITHIN))
    weights, rest = np.zeros(0), 0.0
    while not are_enough(weights, len(others.rows), near):
        some = others.part(slice(len(weights), max(FEWEST, 2 * len(weights))))
        more = _score(asked, some, ALL)
        shares = np.exp(more.scores + more.log_prior - total) * some.stands
        weights = np.concatenate([weights, shares])
        rest = weights.mean() * len(others.rows)
    return total + float(np.log(max(1e-300, rest)))


def are_enough(weights: NDArray[np.float64], drawn: int, near: float) -> bool:
    """Whether chance alters the probability of the best place by no more than `SURE`.

    `weights` (K,) are those of the first of so many drawn that stand for all others, as shares of
    what was scored for itself; of that the best place has the share `near`.
    """
    if not 0 < len(weights) < drawn:
        return len(weights) == drawn
    off, rest = weights.std() / np.sqrt(len(weights)) * drawn, weights.mean() * drawn
    return bool(near * off <= SURE * (1.0 + rest) ** 2)


def rerank(asked: Request, found: Scored) -> Scored:
    """Add to the log prior of the best viewpoints what the network says of them (Eq. 14-17).

    Probability shifts among these viewpoints; all of them together weigh against the rest of the city
    and against elsewhere as before.
    """
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


def compute_posterior(asked: Request, found: Scored) -> Posterior:
    """Score the best viewpoints once more at finer positions, and apply Bayes' rule to all.

    Candidates by embeddings alone hold the right one with probability `DENSE_REACH`, and together
    weigh no more than that.
    """
    order = np.argsort(-(found.scores + found.log_prior), kind="stable")
    best, others = order[:CLOSER], np.sort(order[CLOSER:])
    fine, ratios = look_around(asked, found.rows[best], found.far[best])
    share = np.repeat(found.log_prior[best] - np.log(len(FINE)), len(FINE))
    positions = asked.city.views.positions_of(found.rows[others]).astype(np.float64)
    positions = np.concatenate([positions, fine.reshape(-1, 2)])
    scores = np.concatenate([found.scores[others], ratios.ravel()]).astype(np.float64)
    log_prior = np.concatenate([found.log_prior[others], share])
    rest = found.rest
    if asked.matching.way == "dense" and len(scores):
        here = np.logaddexp.reduce(scores + log_prior)
        rest = max(rest, float(here + np.log(1.0 / DENSE_REACH - 1.0)))
    return apply_bayes(positions, scores, log_prior, rest)


def look_around(
    asked: Request, rows: NDArray[np.int32], far: NDArray[np.float32]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fine positions (B, 9, 2) [m] around viewpoints (B,), and their log-likelihood ratios (B, 9)."""
    positions = asked.city.views.positions_of(rows).astype(np.float64)[:, None] + FINE
    seen = asked.city.in_sight(rows)
    ratios, _, _ = look_again(
        asked.query.statements, asked.city.columns, asked.words, positions,
        (seen.starts, seen.objects), np.repeat(far[:, None], len(FINE), axis=1), TOGETHER, False,
    )  # fmt: skip
    return positions, ratios.astype(np.float64)


def spread_prior(asked: Request) -> Posterior:
    """Return the posterior where the text tells nothing but the way to the place: the prior."""
    views, log_prior = asked.city.views, asked.log_prior
    likely = np.argsort(-log_prior, kind="stable")[:FAR_CANDIDATES]
    norm = np.logaddexp.reduce(log_prior)
    rest = np.log(max(1e-12, 1.0 - np.exp(log_prior[likely] - norm).sum()))
    positions = views.positions_of(likely).astype(np.float64)
    return apply_bayes(positions, np.zeros(len(likely)), log_prior[likely] - norm, float(rest))
