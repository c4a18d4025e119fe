"""What a shard can weigh at most for what was said, by the table of words alone.

The likelihood ratio of a viewpoint is at most a product over statements of 1 + gain * p for a thing
and the speaker, or 1 + gain * q * p * p' for two things, where p is the share that a mention has of
all in sight. No share is larger than the largest in the shard. And since shares are of one whole, those
of labels together are no more than `spread`: without that, six common words would outweigh a rare
name. The largest product under both is bounded by Lagrange's dual, which separates the mentions.

What counts is not the best viewpoint but what all of them weigh, and few have much of a rare thing in
sight: the table knows the mean share of each word. By Hölder's inequality the mean of a product of
functions, one of each mention, is at most the product of the k-norms of k of them and of the largest
values of all others; and the mean of a function of a share is at most that of a line above it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from time import monotonic
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.language.description import Relation
from placegraph.outdoor.likelihood.match_kernels import ME, SLACK
from placegraph.outdoor.likelihood.query import OPERATION
from placegraph.outdoor.map.index import REACH
from placegraph.outdoor.search.candidates import DRAWN, FAR_REACH, MOST_CANDIDATES, ranks
from placegraph.outdoor.search.posterior import CLOSER, ELSEWHERE, FEWEST, WITHIN, are_enough
from placegraph_scale.shards.steps import distance, joined_columns, own_bounds
from placegraph_scale.shards.workers import Crew, Lost, Source, Task

if TYPE_CHECKING:
    from placegraph.outdoor.likelihood.query import Query
    from placegraph_scale.shards.steps import (
        Asked,
        Compared,
        Fix,
        Proposed,
    )
    from placegraph_scale.shards.words import WordTable

_SHARES = np.concatenate(([0.0], np.geomspace(1e-6, 8.0, 64)))
"""Shares at which the parts of the dual are looked up ..."""
_BELOW = np.concatenate(([0.0], _SHARES[:-1]))
"""... a share between two of them pays for the lower ..."""
_PRICES = np.concatenate(([0.0], np.geomspace(0.25, 64.0, 17)))
"""... and prices of a share [nat]: every one gives a bound, and the least of them is taken."""
_NORMS = (1, 2, 3, 4, 6)
"""So many mentions are bounded by their means."""
_TOGETHER = 4096
"""Shards whose bounds are reckoned at once."""


class Held(NamedTuple):
    """What viewpoints of each shard have of each mention in sight."""

    peaks: NDArray[np.float64]
    """(N, M) largest share of all in sight ..."""
    means: NDArray[np.float64]
    """... and the mean share."""
    labelled: NDArray[np.bool_]
    """(M,) which mentions stand for labels alone."""
    budget: NDArray[np.float64]
    """(N,) largest sum of the shares of those."""


def most(query: Query, table: WordTable, *, even: bool) -> NDArray[np.float64]:
    """Log of what the mean viewpoint (N,) of each shard can weigh at most; -inf: nothing at all.

    Of the best viewpoint, where they are not all as likely beforehand (`even`).
    """
    held, pairs = _held(query, table), _statements(query)
    patterns, which = np.unique(held.peaks > 0.0, axis=0, return_inverse=True)
    found = np.full(len(table), -np.inf)
    for k, there in enumerate(patterns):
        rows = np.flatnonzero(which.ravel() == k)
        heard = [s for s in pairs if all(m == ME or there[m] for m in s[1:3])]
        if heard:
            pull = float(table.pull[rows].max())
            found[rows] = _dual(held, rows, _worth(heard, len(there), pull), even=even)
    return found + query.statements.floor + SLACK


def _held(query: Query, table: WordTable) -> Held:
    starts, tokens, weights = query.mentions
    peaks = np.zeros((len(table), len(starts) - 1))
    means = np.zeros_like(peaks)
    for m, (first, last) in enumerate(itertools.pairwise(starts.tolist())):
        for k in range(first, last):
            held = table.of(int(tokens[k]))
            peaks[held.shards, m] += weights[k] * held.peak
            means[held.shards, m] += weights[k] * held.shares
    labels = tokens < len(table.labels)
    labelled = np.array([labels[a:b].all() for a, b in itertools.pairwise(starts.tolist())], bool)
    peaks = np.where(labelled, np.minimum(peaks, table.spread[:, None]), peaks)
    means /= np.maximum(table.viewpoints, 1)[:, None]
    # how often one label counts at most: several mentions may stand for it
    twice = np.bincount(tokens[labels], weights[labels]) if labels.any() else np.ones(1)
    return Held(peaks, means, labelled, table.spread * float(twice.max()))


def _statements(query: Query) -> list[tuple[float, int, int]]:
    """Gain of each statement that can speak for a place, and the two mentions that it is about."""
    columns, found = query.statements, []
    between = OPERATION[Relation.BETWEEN]
    for s, gain in enumerate(columns.gain.tolist()):
        a, b = int(columns.source[s]), int(columns.target[s])
        if columns.op[s] == between and a == ME:
            a = int(columns.target2[s])
        if not columns.negated[s] and a != b:
            found.append((gain, a, b))
    return found


def _worth(heard: list[tuple[float, int, int]], mentions: int, pull: float) -> NDArray[np.float64]:
    """What each mention adds to the log (M, J) where it has a share of all in sight."""
    of = np.zeros((mentions, len(_SHARES)))
    for gain, a, b in heard:
        for m in (a, b):
            if ME in (a, b) and m != ME:
                of[m] += np.log1p(gain * np.minimum(1.0, _SHARES))
            elif m != ME:  # (1 + g p p')^2 <= (1 + g p^2) (1 + g p'^2)
                of[m] += 0.5 * np.log1p(gain * pull * _SHARES**2)
    return of


def _dual(
    held: Held, rows: NDArray[np.int64], of: NDArray[np.float64], *, even: bool
) -> NDArray[np.float64]:
    """Bounds of the shards in `rows`, all of which have the same mentions."""
    best = np.empty(len(rows))
    worth = of - _PRICES[:, None, None] * _BELOW * held.labelled[:, None]
    for part in (slice(k, k + _TOGETHER) for k in range(0, len(rows), _TOGETHER)):
        mine = rows[part]
        at = np.minimum(np.searchsorted(_SHARES, held.peaks[mine]), len(_SHARES) - 1).T
        largest = _upto(worth, at)
        total = _PRICES[:, None] * held.budget[mine] + largest.sum(axis=1)
        best[part] = total.min(axis=0)
        for k in _NORMS if even else ():
            saved = np.maximum(largest - _norms(worth, at, held.means[mine].T, k), 0.0)
            saved = np.sort(saved, axis=1)[:, -k:].sum(axis=1)
            best[part] = np.minimum(best[part], (total - saved).min(axis=0))
    return best


def _norms(
    worth: NDArray[np.float64], at: NDArray[np.int64], means: NDArray[np.float64], k: int
) -> NDArray[np.float64]:
    """Log of the k-norm (P, M, N) over viewpoints, at most, of e to what mentions are `worth` (P, M, J)."""
    slope = np.zeros_like(worth)
    with np.errstate(over="ignore", invalid="ignore"):  # a value too large bounds nothing
        value = np.exp(k * worth)
        first = np.maximum(1.0, value[..., :2].max(axis=2, keepdims=True))
        slope[..., 2:] = (value[..., 2:] - first) / _BELOW[2:]
        found = np.log(first + means * np.maximum(_upto(slope, at), 0.0)) / k
    return np.where(np.isfinite(found), found, np.inf)


def _upto(table: NDArray[np.float64], at: NDArray[np.int64]) -> NDArray[np.float64]:
    """Largest (P, M, N) of each row of a table (P, M, J) up to places (M, N)."""
    found: NDArray[np.float64] = np.maximum.accumulate(table, axis=2)[
        :, np.arange(len(at))[:, None], at
    ]
    return found


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
        bounds = joined_columns([p.bounds * s for (_, p), s in zip(given, scale, strict=True)])
        rows, stands = ranks(bounds, joined_columns([p.stands for _, p in given]), MOST_CANDIDATES)
        return Ranked(
            joined_columns([np.full(len(p.rows), r) for r, p in given], np.int64)[rows],
            joined_columns([np.arange(len(p.rows)) for _, p in given], np.int64)[rows],
            rows, joined_columns([p.log_prior for _, p in given])[rows], stands,
        )  # fmt: skip

    @property
    def highest(self) -> float:
        """Largest log prior of a viewpoint."""
        return max((p.highest for p in self.proposals.values()), default=-np.inf)

    @property
    def least(self) -> float:
        """Log of a bound times the prior from which on candidates count, however many more there are."""
        told = np.sort(joined_columns([own_bounds(p) for p in self.proposals.values()]))
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
        return joined_columns([columns[row] for row in sorted(columns)])[self.ranked.of_all]

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


NEGLIGIBLE = 0.002
"""Shards that together hold no more than this share of the posterior are not looked into."""
FIRST, GROWTH = 4, 16
"""Shards of the first round, and how many times as large every other one is at most."""
FEWEST_DRAWN, EVENLY = 64, 8.0
"""In each shard so many viewpoints at least stand for all others, and so many times its share of them."""
FAR_OFF = 6.0
"""A fix says nothing of shards that lie so many standard deviations away."""


@dataclass(eq=False)
class Search:
    """One query in the shards of a world."""

    sources: tuple[Source, ...]
    table: WordTable
    crew: Crew
    deadline: float | None = None
    lost: dict[int, str] = field(default_factory=dict)
    """Shards (rows) that did not answer, and why."""
    touched: set[int] = field(default_factory=set)
    """Shards that were looked into."""
    searched: set[int] = field(default_factory=set)
    """Shards whose candidates are known."""

    def again(self) -> Search:
        """One that begins anew."""
        return Search(self.sources, self.table, self.crew)

    def each(
        self, step: str, told: Iterable[tuple[int, tuple[Any, ...]]]
    ) -> Iterator[tuple[int, Any]]:
        """Results of a step by row of the shard, in their order; of those that answer in time."""
        for _, row, answer in self.all((step, *task) for task in told):
            yield row, answer

    def all(
        self, told: Iterable[tuple[str, int, tuple[Any, ...]]]
    ) -> Iterator[tuple[str, int, Any]]:
        """Results of several steps at once, each by its name and the row of the shard."""
        given = list(told)
        tasks = [Task(step, self.sources[row], args) for step, row, args in given]
        answers = self.crew.each(tasks, self.deadline) if tasks else {}
        for k, (step, row, _) in enumerate(given):
            answer = answers.get(k)
            if isinstance(answer, Lost):
                self.lost[row] = answer.reason
            elif answer is not None:
                self.touched.add(row)
                yield step, row, answer

    @property
    def late(self) -> bool:
        """Whether the time is over."""
        return self.deadline is not None and monotonic() >= self.deadline

    def run(
        self, asked: Asked, log_mass: NDArray[np.float64], cores: NDArray[np.float64]
    ) -> Merged:
        """Candidates of all shards that matter, scored; `log_mass` (N,) is the shards' prior."""
        self.reach = log_mass + most(asked.query, self.table, even=asked.fix is None)
        self.reach[self._near(asked, cores) & (log_mass > -np.inf)] = np.inf
        order = np.argsort(-self.reach, kind="stable")
        order = order[self.reach[order] > -np.inf]
        found, first, size = Merged(asked), 0, FIRST
        while first < len(order) and not self.late and not self.settled(found):
            last = min(first + size, self._enough(found, order))
            if last <= first:  # what is missing are shards that did not answer
                break
            rows, least = order[first:last], found.least
            drawn = self._drawn(found, rows)
            told = [(row, (asked, least, n)) for row, n in zip(rows.tolist(), drawn, strict=True)]
            for row, proposed in self.each("propose", told):
                found.add(row, proposed)
                self.searched.add(row)
            self._compare(found, dict(found.unscored(0)))
            first, size = last, GROWTH * size
        late, self.deadline = self.deadline, None
        self._compare(found, dict(found.unscored(found.told)), dict(found.best()))
        self.deadline = late
        while not self.late and found.more():
            self._compare(found, dict(found.unscored(found.told)))
        return found

    def _drawn(self, found: Merged, rows: NDArray[np.int64]) -> list[int]:
        """How many viewpoints of each shard stand for all others: more, the more it may weigh."""
        reach = self.reach[self.left()]
        total = np.logaddexp.reduce(reach[reach < np.inf], initial=found.weight)
        share = np.exp(np.minimum(self.reach[rows] - total, 0.0))
        drawn = np.clip(EVENLY * DRAWN * share, FEWEST_DRAWN, DRAWN)
        return [1 << k for k in np.ceil(np.log2(drawn)).astype(int).tolist()]

    def _compare(
        self, found: Merged, some: dict[int, NDArray[np.int64]],
        best: dict[int, NDArray[np.int64]] | None = None,
    ) -> None:  # fmt: skip
        """Score candidates by shard, and look more closely at the best."""
        steps = {"compare": some, "look": best or {}}
        told = [
            (step, row, (found.asked, found.proposals[row].part(at)))
            for step, rows in steps.items() for row, at in rows.items()
        ]  # fmt: skip
        for step, row, answer in self.all(told):
            if step == "compare":
                found.scored(row, some[row], answer)
            else:
                found.looks[row] = Look(steps[step][row], *answer)
        found.dropped(self.lost.keys() & {row for _, row, _ in told})

    def _enough(self, found: Merged, order: NDArray[np.int64]) -> int:
        """So many shards in `order` that all others are `NEGLIGIBLE`, as far as is known."""
        beyond = np.logaddexp.accumulate(self.reach[order[::-1]])[::-1]
        return int(np.count_nonzero(self._share(found, beyond) > np.log(NEGLIGIBLE)))

    def settled(self, found: Merged) -> bool:
        """Whether what was not looked into is `NEGLIGIBLE`."""
        return bool(self._share(found, self.remaining()) <= np.log(NEGLIGIBLE))

    def _share(self, found: Merged, weight: Any) -> Any:  # noqa: ANN401  # a number or an array of them
        """Log of the largest share of the posterior of what weighs so much beside what was found."""
        total = np.logaddexp(np.log1p(-ELSEWHERE) + found.weight, np.log(ELSEWHERE))
        return weight + np.log1p(-ELSEWHERE) - total

    def remaining(self) -> float:
        """Log of the most that shards not looked into weigh together."""
        return float(np.logaddexp.reduce(self.reach[self.left()], initial=-np.inf))

    def left(self) -> NDArray[np.int64]:
        """Shards that were not looked into, or did not answer."""
        looked = np.zeros(len(self.sources), np.bool_)
        looked[list(self.searched - self.lost.keys())] = True
        return np.flatnonzero(~looked)

    def missing(self, found: Merged, log_mass: NDArray[np.float64]) -> float:
        """Prior probability of shards that might matter and were not searched."""
        left = self.left()
        left = left[np.argsort(self.reach[left], kind="stable")]
        beyond = np.logaddexp.accumulate(self.reach[left]) if len(left) else np.zeros(0)
        matters = self._share(found, beyond) > np.log(NEGLIGIBLE)
        return min(1.0, float(np.exp(log_mass[left[matters]]).sum()))  # but for rounding

    def gap(self, missing: float) -> str:
        """What was not searched of what matters, and why; empty where that is nothing."""
        if missing <= 0.0:
            return ""
        lost = f"{len(self.lost)} of the shards did not answer"
        why = "The time was over" if self.late else lost
        share = f"{missing:.1%}" if missing >= 0.001 else "less than 0.1%"
        return f"{why}: {share} of the world, where it may be as well, was not searched."

    def _near(self, asked: Asked, cores: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Shards (N,) from which a rare thing out of sight may be spoken of."""
        near = np.zeros(len(cores), np.bool_)
        far = asked.query.far
        if far is None:
            return near
        reach = max(1.5 * FAR_REACH, 4.0 * float(far.scale.max(initial=0.0)))  # its corners count
        for row in np.unique(far.objects).tolist():
            thing = asked.things[row]
            center = np.broadcast_to(thing.center, (len(cores), 2))
            near |= distance(center, cores) <= reach + thing.extent
        return near

    def masses(
        self, fix: Fix | None, cores: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], Fix | None]:
        """Log prior mass (N,) of each shard, and the fix with its norm; None where it is off all."""
        with np.errstate(divide="ignore"):
            log_size = np.log(self.table.viewpoints.astype(np.float64))
        if fix is None:
            return log_size - np.logaddexp.reduce(log_size), None
        sigma = float(np.hypot(fix.radius / 1.1774, 10.0))
        place = np.broadcast_to([[fix.longitude, fix.latitude]], (len(cores), 2))
        away = distance(place, cores)
        near = np.flatnonzero(
            (away <= max(FAR_OFF * sigma, 4.0 * fix.radius + 2.0 * REACH)) & (log_size >= 0)
        )
        mass, highest, reached = np.full(len(cores), -np.inf), -np.inf, False
        silent = set(near.tolist())
        for row, (most_, total, there) in self.each("weigh", ((r, (fix,)) for r in near.tolist())):
            mass[row], highest, reached = total, max(highest, most_), reached or there
            silent.remove(row)
        for row in sorted(silent):  # it would have held about so much
            mass[row] = log_size[row] - 0.5 * (away[row] / sigma) ** 2
            reached, highest = True, max(highest, -0.5 * (away[row] / sigma) ** 2)
        if not reached:
            return mass, None
        norm = float(np.logaddexp.reduce(mass)) - highest
        return mass - norm, fix._replace(norm=norm)
