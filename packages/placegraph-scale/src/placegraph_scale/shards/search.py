"""From a query to a posterior over all viewpoints of a world, shard after shard.

Shards come in the order of their upper bounds. The search ends where all that were not looked into
cannot together change the answer, or where the time is over. Candidates of all shards are ranked
together, scored, looked at more closely and weighed, as those of one city are.

The likelihood ratio of a viewpoint is at most a product over statements of 1 + gain * p for an object
and the speaker, or 1 + gain * q * p * p' for two objects, where p is the share that a mention has of
all in sight. No share is larger than the largest in the shard. And since shares are of one whole, those
of labels together are no more than `spread`: without that, six common words would outweigh a rare
name. The largest product under both is bounded by Lagrange's dual, which separates the mentions.

What counts is not the best viewpoint but the weight of all of them, and few have much of a rare object
in sight: the table knows the mean share of each word. By Hölder's inequality the mean of a product of
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
from placegraph.outdoor.likelihood.match_kernels import BOUND_SLACK, ME
from placegraph.outdoor.likelihood.query import OPERATION
from placegraph.outdoor.map.index import REACH
from placegraph.outdoor.search.posterior import (
    DISTANT_REACH,
    MAX_CANDIDATES,
    MAX_SAMPLES,
    MIN_SAMPLES,
    MODE_RADIUS,
    NUM_REFINED,
    PRIOR_ELSEWHERE,
    are_samples_enough,
    select_by_bound,
)
from placegraph_scale.shards.steps import ShardSource, distance, join_columns
from placegraph_scale.shards.workers import Failure, ShardTask, WorkerPool

if TYPE_CHECKING:
    from placegraph.outdoor.likelihood.query import Query
    from placegraph_scale.shards.steps import CandidateScores, Fix, Proposal, ShardQuery
    from placegraph_scale.shards.words import WordTable

Floats = NDArray[np.float64]

_SHARES = np.concatenate(([0.0], np.geomspace(1e-6, 8.0, 64)))
"""Shares at which the parts of the dual are looked up ..."""
_BELOW = np.concatenate(([0.0], _SHARES[:-1]))
"""... a share between two of them pays for the lower ..."""
_PRICES = np.concatenate(([0.0], np.geomspace(0.25, 64.0, 17)))
"""... and log prices of a share: every one gives a bound, and the least of them is taken."""
_NORMS = (1, 2, 3, 4, 6)
"""Numbers of mentions that are bounded by their means."""
_TOGETHER = 4096
"""Shards whose bounds are computed at once."""
NEGLIGIBLE = 0.002
"""Shards that together hold no more than this share of the posterior are not looked into."""
FIRST, GROWTH = 4, 16
"""Shards of the first round, and how many times as large every other one is at most."""
BUDGET = 2.0
"""Time after which a search without a budget ends [s]; half of it is left after the first round."""
PROPOSED = 0.6
"""Share of a budget in which shards propose candidates; in the rest the best of these are compared."""
FEWEST_DRAWN, EVENLY = 64, 8.0
"""Viewpoints of each shard that stand for all others: so many at least, or so many times its share."""
FAR_OFF = 6.0
"""A location prior says nothing of shards that lie so many standard deviations away."""


class Visibility(NamedTuple):
    """Shares that mentions have of all that viewpoints of each shard have in sight."""

    peaks: Floats
    """(N, M) largest share ..."""
    means: Floats
    """... and the mean share."""
    labelled: NDArray[np.bool_]
    """(M,) which mentions stand for labels alone."""
    budget: Floats
    """(N,) largest sum of the shares of those."""

    @classmethod
    def of_query(cls, query: Query, table: WordTable) -> Visibility:
        """Look up the mentions of a query in the table of words."""
        starts, tokens, weights = query.mentions
        peaks = np.zeros((len(table), len(starts) - 1))
        means = np.zeros_like(peaks)
        for m, (first, last) in enumerate(itertools.pairwise(starts.tolist())):
            for k in range(first, last):
                found = table.entries(int(tokens[k]))
                peaks[found.shards, m] += weights[k] * found.peak
                means[found.shards, m] += weights[k] * found.shares
        labels = tokens < len(table.labels)
        labelled = np.array(
            [labels[a:b].all() for a, b in itertools.pairwise(starts.tolist())], bool
        )
        peaks = np.where(labelled, np.minimum(peaks, table.spread[:, None]), peaks)
        means /= np.maximum(table.viewpoints, 1)[:, None]
        # how often one label counts at most: several mentions may stand for it
        twice = np.bincount(tokens[labels], weights[labels]) if labels.any() else np.ones(1)
        return cls(peaks, means, labelled, table.spread * float(twice.max()))


def bound_weights(query: Query, table: WordTable, *, even: bool) -> Floats:
    """Return an upper bound of the log weight of the mean viewpoint (N,) of each shard; -inf: none.

    Of the best viewpoint, where they are not all as likely beforehand (`even`).
    """
    visibility, columns, pairs = Visibility.of_query(query, table), query.statements, []
    for s, gain in enumerate(columns.gain.tolist()):  # statements that can speak for a place
        a, b = int(columns.source[s]), int(columns.target[s])
        if columns.op[s] == OPERATION[Relation.BETWEEN] and a == ME:
            a = int(columns.target2[s])
        if not columns.negated[s] and a != b:
            pairs.append((gain, a, b))
    patterns, which = np.unique(visibility.peaks > 0.0, axis=0, return_inverse=True)
    found = np.full(len(table), -np.inf)
    for k, there in enumerate(patterns):
        rows = np.flatnonzero(which.ravel() == k)
        used = [s for s in pairs if all(m == ME or there[m] for m in s[1:3])]
        if used:
            pull = float(table.pull[rows].max())
            found[rows] = _bound_dual(visibility, rows, _gains(used, len(there), pull), even=even)
    return found + query.statements.floor + BOUND_SLACK


def _gains(used: list[tuple[float, int, int]], mentions: int, pull: float) -> Floats:
    """Return the log-likelihood (M, J) of each mention at each share of all in sight."""
    out = np.zeros((mentions, len(_SHARES)))
    for gain, a, b in used:
        for m in (a, b):
            if ME in (a, b) and m != ME:
                out[m] += np.log1p(gain * np.minimum(1.0, _SHARES))
            elif m != ME:  # (1 + g p p')^2 <= (1 + g p^2) (1 + g p'^2)
                out[m] += 0.5 * np.log1p(gain * pull * _SHARES**2)
    return out


def _bound_dual(
    visibility: Visibility, rows: NDArray[np.int64], gains: Floats, *, even: bool
) -> Floats:
    """Return bounds of the shards in `rows`, all of which have the same mentions."""
    best = np.empty(len(rows))
    paid = gains - _PRICES[:, None, None] * _BELOW * visibility.labelled[:, None]
    for part in (slice(k, k + _TOGETHER) for k in range(0, len(rows), _TOGETHER)):
        mine = rows[part]
        at = np.minimum(np.searchsorted(_SHARES, visibility.peaks[mine]), len(_SHARES) - 1).T
        largest = _take_largest(paid, at)
        total = _PRICES[:, None] * visibility.budget[mine] + largest.sum(axis=1)
        best[part] = total.min(axis=0)
        for k in _NORMS if even else ():
            saved = np.maximum(largest - _bound_norms(paid, at, visibility.means[mine].T, k), 0.0)
            saved = np.sort(saved, axis=1)[:, -k:].sum(axis=1)
            best[part] = np.minimum(best[part], (total - saved).min(axis=0))
    return best


def _bound_norms(gains: Floats, at: NDArray[np.int64], means: Floats, k: int) -> Floats:
    """Return bounds of the log of the k-norm (P, M, N) over viewpoints of e to the gains (P, M, J)."""
    slope = np.zeros_like(gains)
    with np.errstate(over="ignore", invalid="ignore"):  # a value too large bounds nothing
        value = np.exp(k * gains)
        first = np.maximum(1.0, value[..., :2].max(axis=2, keepdims=True))
        slope[..., 2:] = (value[..., 2:] - first) / _BELOW[2:]
        found = np.log(first + means * np.maximum(_take_largest(slope, at), 0.0)) / k
    return np.where(np.isfinite(found), found, np.inf)


def _take_largest(table: Floats, at: NDArray[np.int64]) -> Floats:
    """Return the largest (P, M, N) of each row of a table (P, M, J) up to places (M, N)."""
    found: Floats = np.maximum.accumulate(table, axis=2)[:, np.arange(len(at))[:, None], at]
    return found


class CloserLook(NamedTuple):
    """A closer look around some candidates of a shard."""

    at: NDArray[np.int64]
    """(B,) rows among its candidates."""
    positions: Floats
    """(B, 9, 2) in its plane [m]."""
    scores: Floats
    """(B, 9) log-likelihood ratios."""


class CandidateRanking(NamedTuple):
    """Candidates that count: the most promising first, then those that stand for all others."""

    shard: NDArray[np.int64]
    """(K,)"""
    at: NDArray[np.int64]
    """(K,) row among the candidates of that shard ..."""
    of_all: NDArray[np.int64]
    """(K,) ... and among those of all shards, in order of the shards."""
    log_prior: Floats
    """(K,)"""
    multiplicity: Floats
    """(K,) as of `Candidates`."""


@dataclass(eq=False)
class CandidatePool:
    """Candidates of many shards, ranked and scored together as those of one city."""

    shard_query: ShardQuery
    proposals: dict[int, Proposal] = field(default_factory=dict)
    scores: dict[int, Floats] = field(default_factory=dict)
    """Scores of the candidates of each shard; -inf where not computed."""
    positions: dict[int, Floats] = field(default_factory=dict)
    """(K, 2) of each candidate of a shard in its plane [m]; NaN where it was not scored."""
    drawn: int = MIN_SAMPLES
    """Number of candidates that stand for others and are scored."""
    refinements: dict[int, CloserLook] = field(default_factory=dict)
    """Closer look in each shard."""

    def add(self, row: int, proposal: Proposal) -> None:
        """Add the proposal of a shard."""
        self.proposals[row] = proposal
        self.scores[row] = np.full(len(proposal.rows), -np.inf)
        self.positions[row] = np.full((len(proposal.rows), 2), np.nan)
        if proposal.scored is not None:
            self.set_scores(row, *proposal.scored)
        self.__dict__.pop("ranked", None)

    def drop(self, rows: Iterable[int]) -> None:
        """Drop shards that are lost after all."""
        for row in rows:
            of: dict[int, Any]
            for of in (self.proposals, self.scores, self.positions, self.refinements):
                of.pop(row, None)
        self.__dict__.pop("ranked", None)

    def set_scores(self, row: int, at: NDArray[np.int64], scores: CandidateScores) -> None:
        """Store the scores of candidates of a shard."""
        self.scores[row][at], self.positions[row][at] = scores

    @cached_property
    def ranked(self) -> CandidateRanking:
        """Candidates of largest bound among those of all shards, and some that stand for all others."""
        given = sorted(self.proposals.items())
        highest = max((p.highest for _, p in given), default=-np.inf)
        bounds = join_columns([p.bounds * np.exp(p.highest - highest) for _, p in given])
        rows, multiplicity = select_by_bound(
            bounds, join_columns([p.multiplicity for _, p in given]), MAX_CANDIDATES
        )
        return CandidateRanking(
            join_columns([np.full(len(p.rows), r) for r, p in given], np.int64)[rows],
            join_columns([np.arange(len(p.rows)) for _, p in given], np.int64)[rows],
            rows, join_columns([p.log_prior for _, p in given])[rows], multiplicity,
        )  # fmt: skip

    @property
    def least(self) -> float:
        """Log of a bound times the prior from which on candidates count, however many more there are."""
        logs = np.sort(join_columns([p.log_bounds for p in self.proposals.values()]))
        return float(logs[-MAX_CANDIDATES]) if len(logs) >= MAX_CANDIDATES else -np.inf

    def list_unscored(self, drawn: int) -> dict[int, NDArray[np.int64]]:
        """Return rows of candidates that count and have no score, by shard.

        `drawn`: how many of those that stand for others count.
        """
        count = np.count_nonzero(self.ranked.multiplicity == 0.0) + drawn
        shard, rows = self.ranked.shard[:count], self.ranked.at[:count]
        every = {row: np.unique(rows[shard == row]) for row in np.unique(shard).tolist()}
        left = {row: at[np.isnan(self.positions[row][at, 0])] for row, at in every.items()}
        return {row: at for row, at in left.items() if len(at)}

    def list_best(self) -> dict[int, NDArray[np.int64]]:
        """Return rows of the candidates that are worth a closer look, by shard."""
        weights = self.values() + self.ranked.log_prior
        order = np.argsort(-weights, kind="stable")[:NUM_REFINED]
        order = order[weights[order] > -np.inf]
        shard, at = self.ranked.shard[order], self.ranked.at[order]
        return {row: at[shard == row] for row in dict.fromkeys(shard.tolist())}

    def needs_more(self) -> bool:
        """Return whether chance still matters; four times as many are `drawn` then."""
        here = self.values() + self.ranked.log_prior
        if self.weight == -np.inf:
            return False
        best = int(np.argmax(here))
        row = int(self.ranked.shard[best])
        mine = (self.ranked.shard == row) & (here > -np.inf)
        positions = self.positions[row][self.ranked.at[mine]]
        delta = positions - self.positions[row][self.ranked.at[best]]
        near = np.exp(here[mine] - self.weight) @ (np.hypot(*delta.T) <= MODE_RADIUS)
        weights, count = self._represented()
        if are_samples_enough(np.exp(weights - self.weight), count, float(near)):
            return False
        self.drawn *= 4
        return True

    def _represented(self) -> tuple[Floats, int]:
        """Return log weights of scored candidates that stand for others, and how many there are."""
        ranked, others = self.ranked, self.ranked.multiplicity > 0.0
        scores = self._join_ranked(self.scores)[others][: self.drawn]
        logs = ranked.log_prior + np.log(np.maximum(ranked.multiplicity, 1e-300))
        weights = scores + logs[others][: self.drawn]
        return weights[scores > -np.inf], int(np.count_nonzero(others))

    def values(self) -> Floats:
        """Return scores (K,) of the ranked; -inf of those that stand for others."""
        return np.where(self.ranked.multiplicity > 0.0, -np.inf, self._join_ranked(self.scores))

    def _join_ranked(self, columns: dict[int, Floats]) -> Floats:
        """Return a column (K,) of the ranked."""
        return join_columns([columns[row] for row in sorted(columns)])[self.ranked.of_all]

    @property
    def weight(self) -> float:
        """Log of the total weight of all that was scored."""
        if not self.proposals:
            return -np.inf
        return float(np.logaddexp.reduce(self.values() + self.ranked.log_prior, initial=-np.inf))

    def unscored_weight(self) -> float:
        """Return the log weight of all other viewpoints of these shards; as of `viewpoints.score`."""
        weights, count = self._represented()
        scale = np.log(count / max(1, len(weights))) if count else 0.0
        ranked = self.ranked
        counts = np.where(ranked.multiplicity > 0.0, ranked.multiplicity, 1.0)
        share = float(np.exp(ranked.log_prior) @ counts)
        unseen = self.shard_query.query.statements.floor + np.log(max(1e-12, 1.0 - share))
        return float(np.logaddexp.reduce(weights + scale, initial=unseen))


@dataclass(eq=False)
class Search:
    """One query in the shards of a world."""

    sources: tuple[ShardSource, ...]
    table: WordTable
    pool: WorkerPool
    deadline: float | None = None
    lost: dict[int, str] = field(default_factory=dict)
    """Shards (rows) that did not answer, and why."""
    touched: set[int] = field(default_factory=set)
    """Shards that were looked into."""
    searched: set[int] = field(default_factory=set)
    """Shards whose candidates are known."""
    is_cut: bool = False
    """Whether the time was over before all shards that matter were searched."""

    def restart(self) -> Search:
        """Return a search of the same shards that begins anew."""
        return Search(self.sources, self.table, self.pool)

    def run_step(
        self, step: str, tasks: Iterable[tuple[int, tuple[Any, ...]]]
    ) -> Iterator[tuple[int, Any]]:
        """Yield the results of a step by shard, in order, from the shards that answer in time."""
        for _, row, answer in self.run_steps((step, *task) for task in tasks):
            yield row, answer

    def run_steps(
        self, given: Iterable[tuple[str, int, tuple[Any, ...]]]
    ) -> Iterator[tuple[str, int, Any]]:
        """Yield results of several steps at once, each by its name and the row of the shard."""
        every = list(given)
        tasks = [ShardTask(step, self.sources[row], args) for step, row, args in every]
        answers = self.pool.run_tasks(tasks, self.deadline) if tasks else {}
        for k, (step, row, _) in enumerate(every):
            answer = answers.get(k)
            if isinstance(answer, Failure):
                self.lost[row] = answer.reason
            elif answer is not None:
                self.touched.add(row)
                yield step, row, answer

    @property
    def late(self) -> bool:
        """Whether the time is over."""
        return self.deadline is not None and monotonic() >= self.deadline

    def run(self, shard_query: ShardQuery, log_mass: Floats, cores: Floats) -> CandidatePool:
        """Score candidates of all shards that matter; `log_mass` (N,) is the shards' prior."""
        begun, end = monotonic(), self.deadline
        if end is not None:
            self.deadline = begun + PROPOSED * (end - begun)
        self.reach = log_mass + bound_weights(
            shard_query.query, self.table, even=shard_query.fix is None
        )
        self.reach[self._near_rare(shard_query, cores) & (log_mass > -np.inf)] = np.inf
        order = np.argsort(-self.reach, kind="stable")
        order = order[self.reach[order] > -np.inf]
        candidates, first, size = CandidatePool(shard_query), 0, FIRST
        while first < len(order) and not self.late:
            if self._log_share(candidates, self.remaining()) <= np.log(NEGLIGIBLE):
                break
            last = min(first + size, self._enough(candidates, order))
            if last <= first:  # what is missing are shards that did not answer
                break
            rows, least = order[first:last], candidates.least
            # the more a shard may weigh, the more of its viewpoints stand for all others
            reach = self.reach[self.list_unsearched()]
            total = np.logaddexp.reduce(reach[reach < np.inf], initial=candidates.weight)
            share = np.exp(np.minimum(self.reach[rows] - total, 0.0))
            drawn = np.clip(EVENLY * MAX_SAMPLES * share, FEWEST_DRAWN, MAX_SAMPLES)
            counts = [1 << k for k in np.ceil(np.log2(drawn)).astype(int).tolist()]
            tasks = [
                (row, (shard_query, least, n)) for row, n in zip(rows.tolist(), counts, strict=True)
            ]
            for row, proposal in self.run_step("propose", tasks):
                candidates.add(row, proposal)
                self.searched.add(row)
            self._compare(candidates, candidates.list_unscored(0))
            first, size = last, GROWTH * size
            if end is None:  # the first round may have compiled what others need
                end = max(begun, monotonic() - BUDGET / 2) + BUDGET
                self.deadline = end - (1.0 - PROPOSED) * BUDGET
        self.is_cut, self.deadline = self.late, None
        some, best = candidates.list_unscored(candidates.drawn), candidates.list_best()
        if self.is_cut:
            self._compare(candidates, {}, best)
            best, self.deadline = {}, end
        self._compare(candidates, some, best)
        self.deadline = end
        while not self.late and candidates.needs_more():
            self._compare(candidates, candidates.list_unscored(candidates.drawn))
        return candidates

    def _compare(
        self, candidates: CandidatePool, some: dict[int, NDArray[np.int64]],
        best: dict[int, NDArray[np.int64]] | None = None,
    ) -> None:  # fmt: skip
        """Score candidates by shard, and look more closely at the best."""
        steps = {"compare": some, "look": best or {}}
        tasks = [
            (step, row, (candidates.shard_query, candidates.proposals[row].part(at)))
            for step, rows in steps.items() for row, at in rows.items()
        ]  # fmt: skip
        for step, row, answer in self.run_steps(tasks):
            if step == "compare":
                candidates.set_scores(row, some[row], answer)
            else:
                candidates.refinements[row] = CloserLook(steps[step][row], *answer)
        candidates.drop(self.lost.keys() & {row for _, row, _ in tasks})

    def _enough(self, candidates: CandidatePool, order: NDArray[np.int64]) -> int:
        """Return so many shards in `order` that all others are `NEGLIGIBLE`, as far as is known."""
        beyond = np.logaddexp.accumulate(self.reach[order[::-1]])[::-1]
        return int(np.count_nonzero(self._log_share(candidates, beyond) > np.log(NEGLIGIBLE)))

    def _log_share(self, candidates: CandidatePool, weight: Any) -> Any:  # noqa: ANN401  # a number or an array
        """Return the log of the largest share of the posterior of a log weight beside what was found."""
        total = np.logaddexp(
            np.log1p(-PRIOR_ELSEWHERE) + candidates.weight, np.log(PRIOR_ELSEWHERE)
        )
        return weight + np.log1p(-PRIOR_ELSEWHERE) - total

    def remaining(self) -> float:
        """Return an upper bound of the log weight of all shards that were not looked into."""
        return float(np.logaddexp.reduce(self.reach[self.list_unsearched()], initial=-np.inf))

    def list_unsearched(self) -> NDArray[np.int64]:
        """Return rows of shards that were not looked into, or did not answer."""
        looked = np.zeros(len(self.sources), np.bool_)
        looked[list(self.searched - self.lost.keys())] = True
        return np.flatnonzero(~looked)

    def estimate_missing(self, candidates: CandidatePool, log_mass: Floats) -> float:
        """Return the prior probability of shards that might matter and were not searched."""
        left = self.list_unsearched()
        left = left[np.argsort(self.reach[left], kind="stable")]
        beyond = np.logaddexp.accumulate(self.reach[left]) if len(left) else np.zeros(0)
        matters = self._log_share(candidates, beyond) > np.log(NEGLIGIBLE)
        return min(1.0, float(np.exp(log_mass[left[matters]]).sum()))  # but for rounding

    def explain_gap(self, missing: float) -> str:
        """Return a sentence on what matters and was not searched; empty where that is nothing."""
        if missing <= 0.0:
            return ""
        lost = f"{len(self.lost)} of the shards did not answer"
        why = "The time limit was reached" if self.is_cut else lost
        share = f"{missing:.1%}" if missing >= 0.001 else "less than 0.1%"
        return f"{why}: {share} of the world was not searched, and the place may be there."

    def _near_rare(self, shard_query: ShardQuery, cores: Floats) -> NDArray[np.bool_]:
        """Return shards (N,) from which a rare object out of sight may be mentioned."""
        near = np.zeros(len(cores), np.bool_)
        far = shard_query.query.distant
        if far is None:
            return near
        reach = max(
            1.5 * DISTANT_REACH, 4.0 * float(far.scale.max(initial=0.0))
        )  # its corners count
        for row in np.unique(far.objects).tolist():
            thing = shard_query.rare_objects[row]
            center = np.broadcast_to(thing.center, (len(cores), 2))
            near |= distance(center, cores) <= reach + thing.extent
        return near

    def masses(self, fix: Fix | None, cores: Floats) -> tuple[Floats, Fix | None]:
        """Return the log prior mass (N,) of each shard, and the fix with its norm; None: it is off all."""
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
        for row, (top, total, there) in self.run_step(
            "weigh", ((r, (fix,)) for r in near.tolist())
        ):
            mass[row], highest, reached = total, max(highest, top), reached or there
            silent.remove(row)
        for row in sorted(silent):  # it would have held about so much
            mass[row] = log_size[row] - 0.5 * (away[row] / sigma) ** 2
            reached, highest = True, max(highest, -0.5 * (away[row] / sigma) ** 2)
        if not reached:
            return mass, None
        norm = float(np.logaddexp.reduce(mass)) - highest
        return mass - norm, fix._replace(norm=norm)
