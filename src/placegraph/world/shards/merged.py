"""Candidates of many shards, ranked and scored together as those of one city."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.outdoor.likelihood.match_kernels import SLACK
from placegraph.outdoor.search.candidates import MOST_CANDIDATES
from placegraph.outdoor.search.viewpoints import MARGIN, kept

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from placegraph.world.shards.asked import Asked, Compared, Proposed


class Ranked(NamedTuple):
    """Candidates that count, the most promising first."""

    shard: NDArray[np.int64]
    """(K,)"""
    at: NDArray[np.int64]
    """(K,) row among the candidates of that shard."""
    bounds: NDArray[np.float64]
    """(K,) on the likelihood ratio, times the prior against the world's largest."""
    log_prior: NDArray[np.float64]
    """(K,)"""
    left_out: float
    """Sum of the bounds of all others."""


@dataclass(eq=False)
class Merged:
    """What shards proposed, and what became of it."""

    asked: Asked
    proposals: dict[int, Proposed] = field(default_factory=dict)
    scores: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """Of each candidate of a shard; NaN where it was not compared."""
    positions: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """(K, 2) of each candidate of a shard in its plane [m]; NaN where it was not compared."""

    def add(self, row: int, proposed: Proposed) -> None:
        """What a shard proposes."""
        self.proposals[row] = proposed
        self.scores[row] = np.full(len(proposed.rows), np.nan)
        self.positions[row] = np.full((len(proposed.rows), 2), np.nan)
        self.__dict__.pop("ranked", None)

    def dropped(self, rows: Iterable[int]) -> None:
        """Shards that are lost after all."""
        for row in rows:
            for of in (self.proposals, self.scores, self.positions):
                of.pop(row, None)
        self.__dict__.pop("ranked", None)

    @cached_property
    def ranked(self) -> Ranked:
        """Candidates of largest bound among those of all shards."""
        given = sorted(self.proposals.items())
        highest = self.highest
        shard = np.concatenate(
            [np.zeros(0, np.int64), *(np.full(len(p.rows), r) for r, p in given)]
        )
        at = np.concatenate([np.zeros(0, np.int64), *(np.arange(len(p.rows)) for _, p in given)])
        scale = [np.exp(p.highest - highest) for _, p in given]
        bounds = np.concatenate(
            [np.zeros(0), *(p.bounds * s for (_, p), s in zip(given, scale, strict=True))]
        )
        prior = np.concatenate([np.zeros(0), *(p.log_prior for _, p in given)])
        order = np.argsort(-bounds, kind="stable")
        best, others = order[:MOST_CANDIDATES], order[MOST_CANDIDATES:]
        left_out = sum(p.left_out * s for (_, p), s in zip(given, scale, strict=True))
        return Ranked(
            shard[best], at[best], bounds[best], prior[best],
            float(left_out + bounds[others].sum()),
        )  # fmt: skip

    @property
    def highest(self) -> float:
        """Largest log prior of a viewpoint."""
        return max((p.highest for p in self.proposals.values()), default=-np.inf)

    def unscored(self) -> list[tuple[int, Proposed]]:
        """Candidates that count and were not compared, by shard."""
        ranked, found = self.ranked, []
        for row in np.unique(ranked.shard).tolist():
            at = np.sort(ranked.at[ranked.shard == row])
            at = at[np.isnan(self.scores[row][at])]
            if len(at):
                found.append((row, self.proposals[row].part(at)))
        return found

    def scored(self, row: int, compared: Compared) -> None:
        """What comparing the `unscored` of a shard came to."""
        ranked = self.ranked
        at = np.sort(ranked.at[ranked.shard == row])
        at = at[np.isnan(self.scores[row][at])]
        self.scores[row][at], self.positions[row][at] = compared

    def values(self) -> NDArray[np.float64]:
        """Scores (K,) of the ranked, -inf of those that one city would not have compared.

        There it is given up where the bound, and after it the score, falls `MARGIN` below the best.
        """
        ranked = self.ranked
        scores = np.array(
            [
                self.scores[s][a]
                for s, a in zip(ranked.shard.tolist(), ranked.at.tolist(), strict=True)
            ]
        )
        scores = np.where(np.isnan(scores), -np.inf, scores)
        weights = scores + ranked.log_prior - self.highest
        best = np.maximum.accumulate(np.concatenate(([-np.inf], weights)))[:-1]
        with np.errstate(divide="ignore"):
            bounds = np.log(ranked.bounds) + self.asked.query.statements.floor + SLACK
        over = np.maximum.accumulate(bounds < best - MARGIN)
        return np.where(over | (weights < best - MARGIN - SLACK), -np.inf, scores)

    @property
    def weight(self) -> float:
        """Log of what all that was scored weighs together."""
        if not self.proposals:
            return -np.inf
        return float(np.logaddexp.reduce(self.values() + self.ranked.log_prior, initial=-np.inf))

    def rest(self) -> float:
        """Log of what all other viewpoints of these shards weigh; as `viewpoints.score` has it."""
        ranked, query = self.ranked, self.asked.query
        unscored = -np.inf
        if ranked.left_out > 0.0 and query.far is None:
            weights = self.values() + ranked.log_prior - self.highest
            unscored = self.highest + kept(weights, ranked.bounds) + np.log(ranked.left_out)
        share = float(np.exp(ranked.log_prior).sum())
        unseen = query.statements.floor + np.log(max(1e-12, 1.0 - share))
        return float(np.logaddexp(unscored, unseen))
