"""From a query to a posterior over all viewpoints of a world, shard after shard.

Shards come in the order of what they can hold. The search ends where all that were not looked into
cannot together change the answer, or where the time is over. Candidates of all shards are ranked
together, scored, looked at more closely and weighed, as those of one city are.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.map.index import REACH
from placegraph.outdoor.search.candidates import DRAWN, FAR_REACH
from placegraph.outdoor.search.posterior import ELSEWHERE
from placegraph_scale.shards.bounds import most
from placegraph_scale.shards.lexicon import distance
from placegraph_scale.shards.merged import Look, Merged
from placegraph_scale.shards.workers import Lost, Task

if TYPE_CHECKING:
    from placegraph_scale.shards.steps import Asked, Fix
    from placegraph_scale.shards.table import WordTable
    from placegraph_scale.shards.workers import Crew, Source


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
