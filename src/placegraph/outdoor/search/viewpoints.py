"""From candidates to a posterior over viewpoints: scoring, a closer look, Bayes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.outdoor.likelihood.match_kernels import HOPELESS
from placegraph.outdoor.likelihood.score_kernels import look_again, score_views
from placegraph.outdoor.search.candidates import FAR_CANDIDATES, candidates
from placegraph.outdoor.search.posterior import Posterior, posterior

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.outdoor.search.candidates import Candidates
    from placegraph.outdoor.search.request import Request

TOGETHER = 0.3
"""Prior probability that a mention means one and the same thing in all statements."""
MARGIN = 5.5
"""Viewpoints whose hope (`score_views`) lies so far below the best one are given up [nat]."""
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
    """(K,) log-likelihood ratios ..."""
    hopes: NDArray[np.float64]
    """(K,) ... and what they are without coherence, by which some are given up."""
    log_prior: NDArray[np.float64]
    """(K,)"""
    far: NDArray[np.float32]
    """(K, S) what things out of sight add."""
    rest: float
    """Log of what all other viewpoints weigh together, as estimated: bounds of some of them, lowered as
    those of the scored were."""


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
    """Score candidates; what must lie `margin` [nat] behind the best is left out."""
    statements, views = asked.query.statements, asked.city.views
    rows, bounds, far, left_out = chosen
    highest = -float(np.log(len(views)))
    relative, share = np.zeros(len(rows)), len(rows) / len(views)
    if asked.known.informative:
        highest = float(asked.log_prior.max())
        relative = asked.log_prior[rows] - highest
        share = np.exp(relative + highest).sum()
    scores, hopes = score_views(
        statements, asked.city.columns, views.columns, asked.words, rows, bounds, relative, far,
        TOGETHER, margin,
    )  # fmt: skip
    unscored = -np.inf
    if left_out > 0.0 and not asked.query.far:
        unscored = highest + kept(scores + relative, bounds) + np.log(left_out)
    unseen = statements.floor + np.log(max(1e-12, 1.0 - share))
    reached = scores > 0.5 * HOPELESS
    return Scored(
        rows[reached], scores[reached], (hopes - relative)[reached], relative[reached] + highest,
        far[reached], float(np.logaddexp(unscored, unseen)),
    )  # fmt: skip


def kept(weights: NDArray[np.float64], bounds: NDArray[np.float64]) -> float:
    """Log of what the lightest third of the scored keep of their bounds; what is not scored does too."""
    tail = slice(2 * len(weights) // 3, None)
    return float(np.logaddexp.reduce(weights[tail]) - np.log(bounds[tail].sum()))


def closer(asked: Request, found: Scored, reach: float = 1.0) -> Posterior:
    """Look more closely at the best of the scored viewpoints, and apply Bayes to all.

    The right one is among them with probability `reach`: together they weigh no more than that.
    """
    best = np.argsort(-(found.scores + found.log_prior), kind="stable")[:CLOSER]
    others = np.setdiff1d(np.arange(len(found.rows)), best)
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
    ratios, seen = np.empty(positions.shape[:2]), asked.city.in_sight(rows)
    for k in range(len(rows)):
        nearby = seen.objects[seen.starts[k] : seen.starts[k + 1]]
        ratios[k], _, _ = look_again(
            asked.query.statements, asked.city.columns, asked.words, positions[k], nearby,
            np.tile(far[k], (len(FINE), 1)), TOGETHER, False,
        )  # fmt: skip
    return positions, ratios


def by_whereabouts(asked: Request) -> Posterior:
    """Posterior where nothing but the way to the place was told."""
    views, log_prior = asked.city.views, asked.log_prior
    likely = np.argsort(-log_prior, kind="stable")[:FAR_CANDIDATES]
    norm = np.logaddexp.reduce(log_prior)
    rest = np.log(max(1e-12, 1.0 - np.exp(log_prior[likely] - norm).sum()))
    positions = views.positions_of(likely).astype(np.float64)
    return posterior(positions, np.zeros(len(likely)), log_prior[likely] - norm, float(rest))
