"""Candidates of many shards, ranked and scored together as those of one city."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from placegraph.outdoor.likelihood.match_kernels import SLACK
from placegraph.outdoor.search.candidates import MOST_CANDIDATES
from placegraph.outdoor.search.viewpoints import MARGIN, kept

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from placegraph.world.shards.steps import Asked, Compared, Proposed


class Ranked(NamedTuple):
    """Candidates that count, the most promising first."""

    shard: NDArray[np.int64]
    """(K,)"""
    at: NDArray[np.int64]
    """(K,) row among the candidates of that shard ..."""
    of_all: NDArray[np.int64]
    """(K,) ... and among those of all shards, in order of the shards."""
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
    """Of each candidate of a shard; -inf where it was not compared, or cannot matter in its shard ..."""
    hopes: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """... and its hope."""
    positions: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """(K, 2) of each candidate of a shard in its plane [m]; NaN where it was not compared."""

    def add(self, row: int, proposed: Proposed) -> None:
        """What a shard proposes."""
        self.proposals[row] = proposed
        self.scores[row], self.hopes[row] = np.full((2, len(proposed.rows)), -np.inf)
        self.positions[row] = np.full((len(proposed.rows), 2), np.nan)
        self.__dict__.pop("ranked", None)

    def dropped(self, rows: Iterable[int]) -> None:
        """Shards that are lost after all."""
        for row in rows:
            for of in (self.proposals, self.scores, self.hopes, self.positions):
                of.pop(row, None)
        self.__dict__.pop("ranked", None)

    @cached_property
    def ranked(self) -> Ranked:
        """Candidates of largest bound among those of all shards."""
        given, highest = sorted(self.proposals.items()), self.highest
        scale = [np.exp(p.highest - highest) for _, p in given]
        shard = _joined([np.full(len(p.rows), r) for r, p in given], np.int64)
        at = _joined([np.arange(len(p.rows)) for _, p in given], np.int64)
        bounds = _joined([p.bounds * s for (_, p), s in zip(given, scale, strict=True)])
        order = np.argsort(-bounds, kind="stable")
        best, others = order[:MOST_CANDIDATES], order[MOST_CANDIDATES:]
        left_out = sum(p.left_out * s for (_, p), s in zip(given, scale, strict=True))
        return Ranked(
            shard[best], at[best], best, bounds[best], _joined([p.log_prior for _, p in given])[best],
            float(left_out + bounds[others].sum()),
        )  # fmt: skip

    @property
    def highest(self) -> float:
        """Largest log prior of a viewpoint."""
        return max((p.highest for p in self.proposals.values()), default=-np.inf)

    def unscored(self) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Shards, and rows among their candidates, that may count and were not compared."""
        ranked = self.ranked
        with np.errstate(divide="ignore"):
            bounds = np.log(ranked.bounds) + self.asked.query.statements.floor + SLACK
        counts = bounds >= self._hopes().max(initial=-np.inf) - MARGIN
        for row in np.unique(ranked.shard[counts]).tolist():
            at = np.sort(ranked.at[counts & (ranked.shard == row)])
            at = at[np.isnan(self.positions[row][at, 0])]
            if len(at):
                yield row, at

    def scored(self, row: int, at: NDArray[np.int64], compared: Compared) -> None:
        """What comparing candidates of a shard came to."""
        self.scores[row][at], self.hopes[row][at], self.positions[row][at] = compared

    def values(self) -> NDArray[np.float64]:
        """Scores (K,) of the ranked; -inf where the hope lies `MARGIN` below the best, as in one city."""
        hopes = self._hopes()
        return np.where(hopes < hopes.max(initial=-np.inf) - MARGIN, -np.inf, self._of(self.scores))

    def _hopes(self) -> NDArray[np.float64]:
        """Hopes (K,) of the ranked, times the prior against the largest."""
        return self._of(self.hopes) + self.ranked.log_prior - self.highest

    def _of(self, columns: dict[int, NDArray[np.float64]]) -> NDArray[np.float64]:
        """A column (K,) of the ranked."""
        return _joined([columns[row] for row in sorted(columns)])[self.ranked.of_all]

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


def _joined(parts: list[NDArray[Any]], kind: type = np.float64) -> NDArray[Any]:
    return np.concatenate([np.zeros(0, kind), *parts])
