"""Who does the work: one process that holds shards open, or workers of a Dask cluster that do."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple, Protocol

from placegraph.errors import MapError, PlacegraphError
from placegraph.world.shards import steps
from placegraph.world.shards.folder import same
from placegraph.world.shards.steps import Shard

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


class Task(NamedTuple):
    """A step in a shard, and what it is told."""

    source: Source
    told: tuple[Any, ...]


@dataclass(eq=False)
class Holder:
    """Shards that one process holds open; those that were not used for longest are closed first."""

    most: int = OPEN
    _open: OrderedDict[Path, tuple[str, Shard]] = field(default_factory=OrderedDict)

    def do(self, step: str, task: Task) -> Any:  # noqa: ANN401
        """Result of a step, or `Lost` where the shard is missing, damaged or of another version."""
        try:
            shard = self.shard(task.source)
        except PlacegraphError as error:
            return Lost(str(error))
        except MemoryError:
            return Lost(
                f"{task.source.path} does not fit into this process's memory; use less of it."
            )
        return STEPS[step](shard, *task.told)

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

    def each(
        self, step: str, tasks: Sequence[Task], deadline: float | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Row and result of tasks, in any order; those not done by the deadline are left out."""

    def close(self) -> None:
        """Let go of what is held."""


@dataclass(eq=False)
class Alone:
    """One process, one shard after the other."""

    holder: Holder = field(default_factory=Holder)

    def each(
        self, step: str, tasks: Sequence[Task], deadline: float | None = None
    ) -> Iterator[tuple[int, Any]]:
        """Row and result of tasks, in their order."""
        for row, task in enumerate(tasks):
            if deadline is not None and monotonic() >= deadline:
                return
            yield row, self.holder.do(step, task)

    def close(self) -> None:
        """Close all shards."""
        self.holder = Holder(self.holder.most)
