"""Candidates of many shards, ranked and scored together as those of one city."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from placegraph.outdoor.search.candidates import MOST_CANDIDATES, ranks
from placegraph.outdoor.search.posterior import CLOSER, FEWEST, WITHIN, are_enough

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from numpy.typing import NDArray

    from placegraph_scale.shards.steps import Asked, Compared, Proposed


class Look(NamedTuple):
    """A closer look around some candidates of a shard."""

    at: NDArray[np.int64]
    """(B,) rows among its candidates."""
    positions: NDArray[np.float64]
    """(B, 9, 2) in its plane [m]."""
    scores: NDArray[np.float64]
    """(B, 9) log-likelihood ratios."""


class Ranked(NamedTuple):
    """Candidates that count: the most promising first, then those that stand for all others."""

    shard: NDArray[np.int64]
    """(K,)"""
    at: NDArray[np.int64]
    """(K,) row among the candidates of that shard ..."""
    of_all: NDArray[np.int64]
    """(K,) ... and among those of all shards, in order of the shards."""
    log_prior: NDArray[np.float64]
    """(K,)"""
    stands: NDArray[np.float64]
    """(K,) as of `Candidates`."""


def counting(proposals: Sequence[Proposed]) -> list[tuple[int, NDArray[np.int64]]]:
    """Which proposals, and rows of each, count for themselves among all of these.

    Among more proposals no others count.
    """
    told = _joined([_own(p) for p in proposals])
    which = _joined([np.full(len(p.rows), i) for i, p in enumerate(proposals)], np.int64)
    least = max((p.least for p in proposals), default=-np.inf)
    best = np.argsort(-told, kind="stable")[:MOST_CANDIDATES]
    best = best[(told[best] >= least) & (told[best] > -np.inf)]
    first = np.concatenate(([0], np.cumsum([len(p.rows) for p in proposals]))).astype(np.int64)
    return [
        (i, np.sort(best[which[best] == i]) - first[i]) for i in np.unique(which[best]).tolist()
    ]


def _own(proposed: Proposed) -> NDArray[np.float64]:
    """Log of bounds times the prior (K,), -inf of what stands for others."""
    with np.errstate(divide="ignore"):
        told = np.log(proposed.bounds) + proposed.highest
    return np.where(proposed.stands == 0.0, told, -np.inf)


@dataclass(eq=False)
class Merged:
    """What shards proposed, and what became of it."""

    asked: Asked
    proposals: dict[int, Proposed] = field(default_factory=dict)
    scores: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """Of each candidate of a shard; -inf where it was not compared."""
    positions: dict[int, NDArray[np.float64]] = field(default_factory=dict)
    """(K, 2) of each candidate of a shard in its plane [m]; NaN where it was not compared."""
    told: int = FEWEST
    """So many of those that stand for others are compared."""
    looks: dict[int, Look] = field(default_factory=dict)
    """The closer look that was taken in a shard."""

    def add(self, row: int, proposed: Proposed) -> None:
        """What a shard proposes."""
        self.proposals[row] = proposed
        self.scores[row] = np.full(len(proposed.rows), -np.inf)
        self.positions[row] = np.full((len(proposed.rows), 2), np.nan)
        if proposed.scored is not None:
            self.scored(row, *proposed.scored)
        self.__dict__.pop("ranked", None)

    def dropped(self, rows: Iterable[int]) -> None:
        """Shards that are lost after all."""
        for row in rows:
            of: dict[int, Any]
            for of in (self.proposals, self.scores, self.positions, self.looks):
                of.pop(row, None)
        self.__dict__.pop("ranked", None)

    @cached_property
    def ranked(self) -> Ranked:
        """Candidates of largest bound among those of all shards, and some that stand for all others."""
        given, highest = sorted(self.proposals.items()), self.highest
        scale = [np.exp(p.highest - highest) for _, p in given]
        bounds = _joined([p.bounds * s for (_, p), s in zip(given, scale, strict=True)])
        rows, stands = ranks(bounds, _joined([p.stands for _, p in given]), MOST_CANDIDATES)
        return Ranked(
            _joined([np.full(len(p.rows), r) for r, p in given], np.int64)[rows],
            _joined([np.arange(len(p.rows)) for _, p in given], np.int64)[rows],
            rows, _joined([p.log_prior for _, p in given])[rows], stands,
        )  # fmt: skip

    @property
    def highest(self) -> float:
        """Largest log prior of a viewpoint."""
        return max((p.highest for p in self.proposals.values()), default=-np.inf)

    @property
    def least(self) -> float:
        """Log of a bound times the prior from which on candidates count, however many more there are."""
        told = np.sort(_joined([_own(p) for p in self.proposals.values()]))
        return float(told[-MOST_CANDIDATES]) if len(told) >= MOST_CANDIDATES else -np.inf

    def unscored(self, told: int) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Shards, and rows among their candidates, that count and were not compared.

        Of those that stand for others so many are `told`.
        """
        count = np.count_nonzero(self.ranked.stands == 0.0) + told
        shard, rows = self.ranked.shard[:count], self.ranked.at[:count]
        for row in np.unique(shard).tolist():
            at = np.unique(rows[shard == row])
            at = at[np.isnan(self.positions[row][at, 0])]
            if len(at):
                yield row, at

    def best(self) -> Iterator[tuple[int, NDArray[np.int64]]]:
        """Shards, and rows among their candidates, that a closer look is worth."""
        weights = self.values() + self.ranked.log_prior
        order = np.argsort(-weights, kind="stable")[:CLOSER]
        order = order[weights[order] > -np.inf]
        for row in dict.fromkeys(self.ranked.shard[order].tolist()):
            yield row, self.ranked.at[order[self.ranked.shard[order] == row]]

    def more(self) -> bool:
        """Whether chance has its say as yet: four times as many for others are to be `told` then."""
        here = self.values() + self.ranked.log_prior
        if self.weight == -np.inf:
            return False
        best = int(np.argmax(here))
        row = int(self.ranked.shard[best])
        mine = (self.ranked.shard == row) & (here > -np.inf)
        positions = self.positions[row][self.ranked.at[mine]]
        delta = positions - self.positions[row][self.ranked.at[best]]
        near = np.exp(here[mine] - self.weight) @ (np.hypot(*delta.T) <= WITHIN)
        weights, drawn = self._others()
        if are_enough(np.exp(weights - self.weight), drawn, float(near)):
            return False
        self.told *= 4
        return True

    def _others(self) -> tuple[NDArray[np.float64], int]:
        """What those that stand for others weigh, as far as they are told (log), and how many there are."""
        ranked, others = self.ranked, self.ranked.stands > 0.0
        scores = self._of(self.scores)[others][: self.told]
        weights = (
            scores
            + (ranked.log_prior + np.log(np.maximum(ranked.stands, 1e-300)))[others][: self.told]
        )
        return weights[scores > -np.inf], int(np.count_nonzero(others))

    def scored(self, row: int, at: NDArray[np.int64], compared: Compared) -> None:
        """What comparing candidates of a shard came to."""
        self.scores[row][at], self.positions[row][at] = compared

    def values(self) -> NDArray[np.float64]:
        """Scores (K,) of the ranked; -inf of those that stand for others."""
        return np.where(self.ranked.stands > 0.0, -np.inf, self._of(self.scores))

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
        weights, drawn = self._others()
        scale = np.log(drawn / max(1, len(weights))) if drawn else 0.0
        ranked = self.ranked
        share = float(np.exp(ranked.log_prior) @ np.where(ranked.stands > 0.0, ranked.stands, 1.0))
        unseen = self.asked.query.statements.floor + np.log(max(1e-12, 1.0 - share))
        return float(np.logaddexp.reduce(weights + scale, initial=unseen))


def _joined(parts: list[NDArray[Any]], kind: type = np.float64) -> NDArray[Any]:
    return np.concatenate([np.zeros(0, kind), *parts])
