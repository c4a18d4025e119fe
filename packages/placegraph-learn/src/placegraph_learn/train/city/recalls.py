"""Recall of a network in training, for the curves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from placegraph.outdoor.search.rerank import HARD
from placegraph_learn.train.city.objective import NEVER
from placegraph_learn.train.city.torch_batches import Lessons, forward
from placegraph_learn.train.city.torch_network import Network

WITHIN = 50.0
"""A viewpoint this near to the truth is right [m]."""
TOGETHER = 40.0
"""Probability of viewpoints this near to each other is added up, as in `posterior.modes` [m]."""


class Judged(NamedTuple):
    """What is said of the viewpoints that relational matching finds best; -inf where of none."""

    relational: NDArray[np.float64]
    """(Q, K)"""
    logit: NDArray[np.float64]
    """(Q, K)"""
    cosine: NDArray[np.float64]
    """(Q, K) of the graph embeddings."""
    fused: NDArray[np.float64]
    """(Q, K) relational matching and what the network adds."""
    near: NDArray[np.bool_]
    """(Q, K) whether it is within 50 m of the truth."""
    together: NDArray[np.bool_]
    """(Q, K, K) which of them stand close to each other."""


def judge(network: Network, lessons: Lessons, device: str) -> Judged:
    """Let the network judge the viewpoints that relational matching found best."""
    pool, views = lessons.pool, lessons.city.views
    relational = np.where(np.isfinite(pool.scores), pool.scores, -np.inf)
    best = np.argsort(np.argsort(-relational, axis=1), axis=1) < HARD
    asked = best & np.isfinite(relational)
    relational = np.where(asked, relational, -np.inf)
    logit, cosine, fused = (np.full(asked.shape, -np.inf) for _ in range(3))
    scale, weight = network.prior[1:].tolist()
    with torch.no_grad():
        for at in range(0, len(pool), 64):
            rows = np.arange(at, min(at + 64, len(pool)))
            batch = lessons.batch(rows, asked[rows])
            scores = forward(network, lessons, batch, device)
            text = batch.pairs.text
            logit[rows[text], batch.slots] = scores.logit.cpu().numpy()
            added = scores.residual.cpu().numpy()
            fused[rows[text], batch.slots] = scale * batch.relational + weight * added
            dense = scores.embedding.cpu().numpy()
            cosine[rows[text], batch.slots] = dense[text, np.arange(len(text))]
    places = views.positions[pool.views]
    off = np.hypot(*(places - pool.positions[:, None]).transpose(2, 0, 1))
    apart = np.hypot(*(places[:, :, None] - places[:, None]).transpose(3, 0, 1, 2))
    return Judged(relational, logit, cosine, fused, (off <= WITHIN) & asked, apart <= TOGETHER)


def recalls(judged: Sequence[Judged]) -> dict[str, float]:
    """Recall@1 within 50 m among what relational matching finds, mean over cities."""
    found: dict[str, list[float]] = {}
    for j in judged:
        asked = np.isfinite(j.relational)
        for name, scores in (
            ("relational", j.relational),
            ("network", j.logit),
            ("dense", 15.0 * j.cosine),
            ("fused", j.fused),
        ):
            found.setdefault(name, []).append(recall(np.where(asked, scores, NEVER), j))
    return {name: float(np.mean(values)) for name, values in found.items()}


def recall(scores: NDArray[np.float64], judged: Judged) -> float:
    """Share of texts whose best place, of summed probability, is near the truth."""
    p = np.exp(scores - scores.max(axis=1, keepdims=True))
    summed = (judged.together @ p[..., None])[..., 0] * (scores > NEVER) + 1e-3 * p
    return float(judged.near[np.arange(len(p)), summed.argmax(axis=1)].mean())


SCALES, WEIGHTS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15), (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Of relational matching and of what the network adds, that are tried together."""


def best_prior(judged: Sequence[Judged], scale: float) -> tuple[float, float]:
    """Scale of relational matching, and weight of what the network adds, of greatest likelihood.

    `judged` are texts from where nothing was trained, with the weight still 1 and this `scale`.
    """
    best, found = -np.inf, (1.0, 0.0)  # nothing told: as relational matching has it
    if not any(j.near.any() for j in judged):
        return found
    for new in SCALES:
        for weight in WEIGHTS:
            likelihood = np.mean([_likelihood(j, scale, new, weight) for j in judged])
            if likelihood > best:
                best, found = float(likelihood), (new, weight)
    return found


def _likelihood(judged: Judged, scale: float, new: float, weight: float) -> float:
    """Mean log probability of being near the truth, where anything is."""
    asked = np.isfinite(judged.relational)
    relational = np.where(asked, judged.relational, 0.0)
    added = np.where(asked, judged.fused, 0.0) - scale * relational
    scores = np.where(asked, new * relational + weight * added, NEVER)
    near = judged.near.any(axis=1)
    right = np.where(judged.near, scores, NEVER)
    log_p = np.logaddexp.reduce(right, axis=1) - np.logaddexp.reduce(scores, axis=1)
    return float(log_p[near].mean()) if near.any() else 0.0
