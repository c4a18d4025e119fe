"""A world in shards: one town to the world that it is part of, searched as one map."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from os import PathLike
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import MapError
from placegraph.outdoor.language.description import LISTENER
from placegraph.outdoor.likelihood.query import compile_query, ends
from placegraph.outdoor.map.objects import LINE
from placegraph.outdoor.search.status import find_obstacle
from placegraph_scale.shards.answer import InShards, estimate, weigh
from placegraph_scale.shards.folder import WORDS, WorldFile, same
from placegraph_scale.shards.lexicon import Gathering, Things, Words, distance
from placegraph_scale.shards.search import Search
from placegraph_scale.shards.steps import Asked, Fix
from placegraph_scale.shards.table import WordTable
from placegraph_scale.shards.workers import Alone, Source

if TYPE_CHECKING:
    from placegraph.core.estimate import CityEstimate
    from placegraph.outdoor.language.description import Description
    from placegraph.outdoor.search.ask import Question
    from placegraph.world.known import Known
    from placegraph.world.outside import Outside
    from placegraph_scale.shards.lexicon import Thing
    from placegraph_scale.shards.workers import Crew


MOST_STREETS = 8
"""Shards that are looked into at most to see whether a name means streets."""


class Planet:
    """A folder of shards, asked as one map; a `Town` of the world that `open_world` makes.

    Parameters
    ----------
    file
        What its `world.json` says.
    crew
        Who looks into shards; this process where not given.

    Raises
    ------
    InputError, MapError
        `words.table` is missing, damaged, newer, or not the one that the world was finished with.

    """

    def __init__(self, file: WorldFile, crew: Crew | None = None) -> None:
        self.file = file
        self.crew: Crew = crew or Alone()
        same(file.folder / WORDS, file.words)
        self.words = Words(WordTable.open(file.folder / WORDS))
        if len(self.words.table.viewpoints) != len(file.shards):
            raise MapError(
                f"{file.folder / WORDS} is of {len(self.words.table.viewpoints)} shards, world.json of "
                f"{len(file.shards)}; finish the world again with `placegraph world build`."
            )
        self.cores: NDArray[np.float64] = np.array([s.core for s in file.shards])
        self.sources = sources_of(file)

    @classmethod
    def open(cls, folder: str | PathLike[str], scheduler: str | None = None) -> Planet:
        """Open a folder, to be searched by this process or by the workers of a Dask scheduler."""
        file = WorldFile.read(folder)
        if scheduler is None:
            return cls(file)
        from placegraph_scale.shards.cluster import Cluster

        return cls(file, Cluster.at(scheduler, sources_of(file)))

    @property
    def name(self) -> str:
        """Of its folder."""
        return self.file.folder.resolve().name

    def is_street(self, name: str) -> bool:
        """As `Town.is_street`, by what a few of the shards hold that have the name."""
        table = self.words.table
        tokens = [len(table.labels) + token for token in self.words.name_index.named(name)]
        things = self._gathered(self._search(), np.array(tokens, np.int64), MOST_STREETS)
        return bool(things) and all(
            t.kind == LINE and t.label.startswith("highway") for t in things
        )

    def hear(self, said: Description, known: Known) -> Outside | str:
        """As `Town.hear`; shards that do not answer are named in the `notes` of what is returned."""
        self.words.table.watch.check()
        search, description = self._search(known.budget), said
        for answer in known.answers:
            description = answer.added_to(description)
        things = Things(self.words.table.labels, [])
        lexicon = Gathering(self.words, partial(self._gathered, search), things)
        on_a_way = any(LISTENER in ends(s) for s in description.statements)
        query = compile_query(description, lexicon, on_a_way=on_a_way)
        if reason := find_obstacle(query, description):
            return reason
        fix = (
            None
            if known.near is None
            else Fix(float(known.near[0]), float(known.near[1]), float(known.radius))
        )
        log_mass, fixed = search.masses(fix, self.cores)
        if fix is not None and fixed is None:
            return ""
        words = tuple(self.words.table.reads(int(token)) for token in query.mentions.tokens)
        size = int(self.words.table.viewpoints.sum())
        asked = Asked(query, words, tuple(things.rows), size, fixed)
        found = search.run(asked, log_mass, self.cores)
        missing = search.missing(found, log_mass)
        gap = search.gap(missing)
        search.deadline = None
        beyond = -np.inf if missing > 0.0 else search.remaining()
        weighed = weigh(found, beyond, 1.0 - missing)
        told, parts = estimate(search, asked, weighed, known.top)
        named = {f"{self.name}//{key}": part for key, part in parts.items()}
        return InShards(query, weighed.posterior, told, named, gap, search, asked, self.cores)

    def off(self, near: Sequence[float], radius: float) -> str | None:
        """As `Town.off`."""
        longitude, latitude = map(float, near)
        place = np.array([[longitude, latitude]])
        if (distance(place, self.cores) <= 4.0 * radius).any():
            return None
        if abs(longitude) > 90.0 or not (distance(place[:, ::-1], self.cores) == 0.0).any():
            return ""
        return f" Swapped, it lies on the map: longitude comes first, {latitude},{longitude}."

    def ask(self, part: str, found: CityEstimate) -> Question | None:
        """As `Town.ask`."""
        key = part.partition("//")[2]
        rows = [row for row, source in enumerate(self.sources) if source.key == key]
        asked = self._search().each("ask", [(row, (found,)) for row in rows])
        return next((question for _, question in asked), None)

    def _search(self, budget: float | None = None) -> Search:
        deadline = None if budget is None else monotonic() + budget
        return Search(self.sources, self.words.table, self.crew, deadline)

    def _gathered(
        self, search: Search, tokens: NDArray[np.int64], most: int | None = None
    ) -> list[Thing]:
        """Things that bear tokens, from the shards that hold them."""
        table = self.words.table
        wanted: dict[int, list[str]] = {}
        for token in tokens.tolist():
            held = table.of(token)
            for row in held.shards[held.objects > 0].tolist():
                wanted.setdefault(row, []).append(table.reads(token))
        told = [(row, (tuple(words),)) for row, words in sorted(wanted.items())]
        return [thing for _, found in search.each("gather", told[:most]) for thing in found]

    def close(self) -> None:
        """Let go of shards and of the cluster."""
        self.crew.close()

    def __repr__(self) -> str:
        shards, viewpoints = len(self.file.shards), self.words.table.viewpoints.sum()
        return f"Planet({shards:,} shards, {viewpoints:,} viewpoints)"


def sources_of(file: WorldFile) -> tuple[Source, ...]:
    """Where the shards of a world lie."""
    return tuple(Source(s.key, file.path(s), s.digest, s.bytes) for s in file.shards)
