"""Who does the work: one process that holds shards open, or workers of a Dask cluster that do."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from time import monotonic
from typing import Any, NamedTuple, Protocol

from placegraph.errors import MapError, PlacegraphError
from placegraph_scale.shards import steps
from placegraph_scale.shards.folder import same
from placegraph_scale.shards.merged import counting
from placegraph_scale.shards.steps import Proposed, Shard

OPEN = 256
"""Shards that a process holds open at most."""
STEPS: dict[str, Callable[..., Any]] = {
    "gather": steps.gathered,
    "weigh": steps.weighed,
    "propose": steps.proposed,
    "compare": steps.compared,
    "look": steps.looked,
    "explain": steps.explained,
    "name": steps.named,
    "judge": steps.judged,
    "ask": steps.asked_back,
}
"""What can be done in a shard."""


class Lost(NamedTuple):
    """Why a shard did not answer."""

    reason: str


class Source(NamedTuple):
    """Where a shard lies, and which file it is."""

    key: str
    path: Path
    digest: str
    size: int
    """[bytes]"""


class Task(NamedTuple):
    """A step in a shard, and what it is told."""

    step: str
    source: Source
    told: tuple[Any, ...]


@dataclass(eq=False)
class Holder:
    """Shards that one process holds open; those that were not used for longest are closed first.

    Several threads may ask for steps: one is done after the other.
    """

    most: int = OPEN
    _open: OrderedDict[Path, tuple[str, Shard]] = field(default_factory=OrderedDict)
    _lock: Lock = field(default_factory=Lock)

    def work(self, tasks: Sequence[Task], deadline: float | None = None) -> list[Any]:
        """Results of tasks, in their order; fewer where the time is over.

        What shards propose is compared at once, as far as it counts among all that these propose.
        """
        done: list[Any] = []
        for task in tasks:
            if deadline is not None and monotonic() >= deadline:
                break
            done.append(self._do(task))
        proposed = [k for k, result in enumerate(done) if isinstance(result, Proposed)]
        for i, at in counting([done[k] for k in proposed]):
            k = proposed[i]
            asked, told = tasks[k].told[0], done[k]
            scored = self._do(Task("compare", tasks[k].source, (asked, told.part(at))))
            done[k] = scored if isinstance(scored, Lost) else told._replace(scored=(at, scored))
        return done

    def _do(self, task: Task) -> Any:  # noqa: ANN401
        """Result of a step, or `Lost` where the shard is missing, damaged or of another version."""
        with self._lock:
            try:
                return STEPS[task.step](self.shard(task.source), *task.told)
            except PlacegraphError as error:
                return Lost(str(error))
            except MemoryError:
                return Lost(
                    f"{task.source.path} does not fit into this process's memory; use less of it."
                )

    def shard(self, source: Source) -> Shard:
        """Open a shard; raises `InputError` or `MapError`."""
        from placegraph.outdoor.city import CityMap

        held = self._open.get(source.path)
        if held is not None and held[0] == source.digest:
            self._open.move_to_end(source.path)
            return held[1]
        same(source.path, source.digest)
        city = CityMap.open(source.path, shard=True)
        if not len(city.objects):  # pragma: no cover  # which `open` refuses
            raise MapError(f"{source.path} is empty; build it again.")
        shard = Shard(source.key, city)
        self._open[source.path] = source.digest, shard
        while len(self._open) > self.most:
            self._open.popitem(last=False)
        return shard


class Crew(Protocol):
    """Does steps in shards."""

    def each(self, tasks: Sequence[Task], deadline: float | None = None) -> dict[int, Any]:
        """Results of tasks by their rows; those not done by the deadline are left out."""

    def close(self) -> None:
        """Let go of what is held."""


@dataclass(eq=False)
class Alone:
    """One process, one shard after the other."""

    holder: Holder = field(default_factory=Holder)

    def each(self, tasks: Sequence[Task], deadline: float | None = None) -> dict[int, Any]:
        """Results of tasks by their rows."""
        return dict(enumerate(self.holder.work(tasks, deadline)))

    def close(self) -> None:
        """Close all shards."""
        self.holder = Holder(self.holder.most)
