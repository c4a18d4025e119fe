"""From candidates to a posterior over viewpoints: scoring, a closer look, Bayes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.likelihood.match_kernels import HOPELESS
from placegraph.outdoor.likelihood.score_kernels import look_again, score_views
from placegraph.outdoor.search.candidates import FAR_CANDIDATES, Candidates, candidates
from placegraph.outdoor.search.posterior import WITHIN, Posterior, posterior
from placegraph.outdoor.search.request import Request

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
DENSE_REACH = 0.4
"""Probability that the place is near one of 50 cells that embeddings propose, in a large city (60 texts
each: Vancouver .40, Ankara .45, Liechtenstein .48): an estimate by these alone cannot be surer."""


class Scored(NamedTuple):
    """What became of the candidates, and what all other viewpoints weigh."""

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
        """Some of them."""
        rows, scores, log_prior, far, rest = self
        return Scored(rows[kept], scores[kept], log_prior[kept], far[kept], rest)


def search(asked: Request) -> Posterior:
    """Posterior over viewpoints: candidates, scores, the network's word on the best, a closer look."""
    if not asked.query.used:
        return by_whereabouts(asked)
    found = score(asked, candidates(asked))
    if asked.matching.matcher == "fused":
        from placegraph.outdoor.search.rerank import rerank

        found = rerank(asked, found)
    return closer(asked, found, DENSE_REACH if asked.matching.way == "dense" else 1.0)


def score(asked: Request, chosen: Candidates, margin: float = MARGIN) -> Scored:
    """Score candidates, and of those that stand for others as many as it takes to be sure.

    Left out is whose hope (`score_views`) lies `margin` [nat] below the best.
    """
    own, others = chosen.part(chosen.stands == 0.0), chosen.part(chosen.stands > 0.0)
    found = _scored(asked, own, margin)
    mass = (
        np.exp(found.log_prior).sum()
        + np.exp(asked.relative(others.rows) + asked.highest) @ others.stands
    )
    rest = asked.query.statements.floor + float(np.log(max(1e-12, 1.0 - mass)))
    found = found.part(found.scores > 0.5 * HOPELESS)
    if len(found.rows):
        rest = float(np.logaddexp(rest, _of_others(asked, others, found)))
    return found._replace(rest=rest)


def _scored(asked: Request, some: Candidates, margin: float) -> Scored:
    relative = asked.relative(some.rows)
    scores, _ = score_views(
        asked.query.statements, asked.city.columns, asked.city.views.columns, asked.words,
        some.rows, some.bounds, relative, some.far, TOGETHER, margin,
    )  # fmt: skip
    return Scored(some.rows, scores, relative + asked.highest, some.far)


def _of_others(asked: Request, others: Candidates, found: Scored) -> float:
    """Log of what all viewpoints weigh that are not among the found, as told by some of the `others`."""
    here = found.scores + found.log_prior
    total, best = float(np.logaddexp.reduce(here)), int(np.argmax(here))
    positions = asked.city.views.positions_of(found.rows)
    near = float(np.exp(here - total) @ (np.hypot(*(positions - positions[best]).T) <= WITHIN))
    weights, rest = np.zeros(0), 0.0
    while not sure(weights, len(others.rows), near):
        some = others.part(slice(len(weights), max(FEWEST, 2 * len(weights))))
        more = _scored(asked, some, ALL)
        shares = np.exp(more.scores + more.log_prior - total) * some.stands
        weights = np.concatenate([weights, shares])
        rest = weights.mean() * len(others.rows)
    return total + float(np.log(max(1e-300, rest)))


def sure(weights: NDArray[np.float64], drawn: int, near: float) -> bool:
    """Whether chance alters the probability of the best place by no more than `SURE`.

    `weights` (K,) are those of the first of so many drawn that stand for all others, as shares of
    what was scored for itself; of that the best place has the share `near`.
    """
    if not 0 < len(weights) < drawn:
        return len(weights) == drawn
    off, rest = weights.std() / np.sqrt(len(weights)) * drawn, weights.mean() * drawn
    return bool(near * off <= SURE * (1.0 + rest) ** 2)


def closer(asked: Request, found: Scored, reach: float = 1.0) -> Posterior:
    """Look more closely at the best of the scored viewpoints, and apply Bayes to all.

    The right one is among them with probability `reach`: together they weigh no more than that.
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
    if reach < 1.0 and len(scores):
        here = np.logaddexp.reduce(scores + log_prior)
        rest = max(rest, float(here + np.log(1.0 / reach - 1.0)))
    return posterior(positions, scores, log_prior, rest)


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


def by_whereabouts(asked: Request) -> Posterior:
    """Posterior where nothing but the way to the place was told."""
    views, log_prior = asked.city.views, asked.log_prior
    likely = np.argsort(-log_prior, kind="stable")[:FAR_CANDIDATES]
    norm = np.logaddexp.reduce(log_prior)
    rest = np.log(max(1e-12, 1.0 - np.exp(log_prior[likely] - norm).sum()))
    positions = views.positions_of(likely).astype(np.float64)
    return posterior(positions, np.zeros(len(likely)), log_prior[likely] - norm, float(rest))
