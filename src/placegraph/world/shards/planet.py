"""A world in shards, and one question to all of them."""

from __future__ import annotations

from functools import partial
from time import monotonic
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import MapError, OptionError
from placegraph.estimate import Status
from placegraph.outdoor.language.description import LISTENER
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.likelihood.query import read as read_text
from placegraph.outdoor.likelihood.statements import ends
from placegraph.outdoor.locate import why_nothing
from placegraph.outdoor.search.ask import Answer
from placegraph.world.estimate import WorldEstimate
from placegraph.world.maps import Maps
from placegraph.world.shards.answer import estimate, weigh
from placegraph.world.shards.folder import WORDS, WorldFile, same
from placegraph.world.shards.lexicon import Gathering, Things, Words, distance
from placegraph.world.shards.search import Search
from placegraph.world.shards.steps import Asked, Fix
from placegraph.world.shards.table import WordTable
from placegraph.world.shards.workers import Alone, Source
from placegraph.world.split import Understood
from placegraph.world.world import World

if TYPE_CHECKING:
    from os import PathLike

    from numpy.typing import NDArray

    from placegraph.evidence import Evidence
    from placegraph.outdoor.language.description import Description
    from placegraph.world.known import Known
    from placegraph.world.shards.lexicon import Thing
    from placegraph.world.shards.workers import Crew


class Planet(World):
    """A folder of shards, asked as one map; made by `open_world`.

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
        from placegraph.outdoor.city import CityMap

        opener = partial(CityMap.open, shard=True)
        super().__init__(Maps({s.key: file.path(s) for s in file.shards}, opener))
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
        self.sources = tuple(Source(s.key, file.path(s), s.digest) for s in file.shards)

    @classmethod
    def open(cls, folder: str | PathLike[str], scheduler: str | None = None) -> Planet:
        """Open a folder, to be searched by this process or by the workers of a Dask scheduler."""
        file = WorldFile.read(folder)
        if scheduler is None:
            return cls(file)
        from placegraph.world.shards.cluster import Cluster

        return cls(file, Cluster.at(scheduler))

    def _ask(self, known: Known) -> WorldEstimate:
        """As of `World.locate`; shards that do not answer are named in `notes`."""
        if known.capture is not None or known.text is None:
            raise OptionError(
                "text: a world in shards is asked by what is said of a place; give a text, and no "
                "capture. Frames are localized in a scene map, or in a folder of maps."
            )
        self.words.table.watch.check()
        deadline = None if known.budget is None else monotonic() + known.budget
        search = Search(self.sources, self.words.table, self.crew, deadline)
        return self._located(known, known.text, search)

    def _located(self, known: Known, text: str, search: Search) -> WorldEstimate:
        description = read_text(self.words, text, heading=known.heading, language=known.language)
        for answer in known.answers:
            if not isinstance(answer, Answer):
                raise OptionError(
                    f"answers holds {answer!r}; answer questions by `question.answer(option)`."
                )
            description = answer.added_to(description)
        things = Things(self.words.table.labels, [])
        lexicon = Gathering(self.words, partial(self._gathered, search), things)
        on_a_way = any(LISTENER in ends(s) for s in description.statements)
        query = compile_query(description, lexicon, on_a_way=on_a_way)
        if reason := why_nothing(query, description):
            return self._nothing(reason, description, search)
        fix = None
        if known.near is not None:
            fix = Fix(float(known.near[0]), float(known.near[1]), float(known.radius))
        log_mass, fixed = search.masses(fix, self.cores)
        if fix is not None and fixed is None:
            return self._nothing(self._off(fix), description, search)
        words = tuple(self.words.table.reads(int(token)) for token in query.mentions.tokens)
        size = int(self.words.table.viewpoints.sum())
        asked = Asked(query, words, tuple(things.rows), size, fixed)
        found = search.run(asked, log_mass, self.cores)
        return self._answered(known, description, search, found, log_mass)

    def _answered(
        self, known: Known, description: Description, search: Search, found: Any,  # noqa: ANN401
        log_mass: NDArray[np.float64],
    ) -> WorldEstimate:  # fmt: skip
        missing = search.missing(found, log_mass)
        late, search.deadline = search.late and missing > 0.0, None
        beyond = -np.inf if missing > 0.0 else search.remaining()
        weighed = weigh(search, found, beyond, 1.0 - missing)
        whole = ""
        if missing > 0.0:
            why = (
                "The time was over" if late else f"{len(search.lost)} of the shards did not answer"
            )
            whole = f"{why}: {1.0 - missing:.1%} of the world was searched."
        explain = partial(self._explained, found.asked)
        return estimate(search, found, weighed, description, known.top, explain, whole)

    def _gathered(self, search: Search, tokens: NDArray[np.int64]) -> list[Thing]:
        """Things that bear tokens, from the shards that hold them."""
        table = self.words.table
        wanted: dict[int, list[str]] = {}
        for token in tokens.tolist():
            held = table.of(token)
            for row in held.shards[held.objects > 0].tolist():
                wanted.setdefault(row, []).append(table.reads(token))
        told = [(row, (tuple(words),)) for row, words in sorted(wanted.items())]
        return [thing for _, found in search.each("gather", told) for thing in found]

    def _explained(
        self, asked: Asked, row: int, lonlat: tuple[float, float]
    ) -> tuple[Evidence, ...]:
        """Evidence for a place, from its shard."""
        search = Search(self.sources, self.words.table, self.crew)
        return next((found for _, found in search.each("explain", [(row, (asked, lonlat))])), ())

    def _nothing(self, reason: str, description: Description, search: Search) -> WorldEstimate:
        understood = Understood(description.text, {"": description}, None, description.ignored)
        notes = tuple(search.lost.values())
        return WorldEstimate(
            Status.LOST, (), reason, elsewhere=1.0, understood=understood, notes=notes
        )

    def _off(self, fix: Fix) -> str:
        """Why a fix is on no shard."""
        hint = ""
        if abs(fix.longitude) <= 90.0:
            swapped = np.broadcast_to([[fix.latitude, fix.longitude]], (len(self.cores), 2))
            if (distance(swapped, self.cores) == 0.0).any():
                hint = (
                    " Swapped, it lies on one: longitude comes first, "
                    f"{fix.latitude},{fix.longitude}."
                )
        return f"No shard reaches the surroundings of ({fix.longitude}, {fix.latitude}).{hint}"

    def close(self) -> None:
        """Let go of shards and of the cluster."""
        self.crew.close()

    def __repr__(self) -> str:
        return f"Planet({len(self.file.shards):,} shards, {self.words.table.viewpoints.sum():,} viewpoints)"
