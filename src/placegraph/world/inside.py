"""What the inside of a sentence says of scenes, and of the rooms in each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence
from placegraph.indoor.language import Sentence
from placegraph.indoor.language.index import Columns
from placegraph.indoor.language.likeness import table
from placegraph.indoor.language.score import compared, of_scenes, score
from placegraph.indoor.language.sentence import Kind

if TYPE_CHECKING:
    from placegraph.indoor.library import SceneLibrary

MISTAKEN = 0.05
"""How often somebody is not in such a room as they say: "in the kitchen"."""


@dataclass(frozen=True, eq=False)
class Inside:
    """What was said of rooms, compared with all scenes."""

    library: SceneLibrary
    sentence: Sentence
    scenes: Mapping[str, float]
    """Log-likelihood ratio of each scene against their average [nat]."""
    rooms: Mapping[str, Mapping[str, float]]
    """Of each scene the probability of each of its rooms, by name."""

    @classmethod
    def hear(cls, library: SceneLibrary, sentence: Sentence) -> Inside:
        """Compare what was said with the rooms of all scenes."""
        columns = library.texts.columns
        usual = columns if library.usual is None else library.usual
        totals = compared(sentence, columns, usual).sum(axis=0)
        best, _ = of_scenes(sentence, columns, totals)
        kinds = _kinds(sentence, columns)
        rooms: dict[str, dict[str, float]] = {}
        for row, name in enumerate(library.names):
            units = np.flatnonzero((columns.scene == row) & ~columns.whole)
            share = np.exp(totals[units] - totals[units].max()) * kinds[units]
            told: dict[str, float] = {}
            names = [u.name for u in library.texts.units(row) if not u.whole]
            for room, p in zip(names, (share / share.sum()).tolist(), strict=True):
                told[room] = told.get(room, 0.0) + p
            rooms[name] = told
        return cls(library, sentence, dict(zip(library.names, best.tolist(), strict=True)), rooms)

    def evidence(self, name: str) -> tuple[Evidence, ...]:
        """What each statement says of a scene."""
        signature = self.library.entry(name).signature
        rooms = [a.get("room", "") for a in signature.attributes]
        return score(
            self.sentence, signature.graph, rooms, self.library.texts, signature.attributes
        ).evidence


def _kinds(sentence: Sentence, columns: Columns) -> NDArray[np.float64]:
    """How well (U,) units are such a room as one is said to be in; within a scene its rooms differ."""
    out = np.ones(len(columns.scene))
    for s in sentence.statements:
        named = sentence.mentions[s.things[0]].room
        if s.kind is Kind.ROOM and named and not s.negated:
            fits = np.minimum(columns.rooms[:, table().kinds.index(named)], 1.0)
            out *= MISTAKEN + (1.0 - MISTAKEN) * fits
    return out


def rooms_of(library: SceneLibrary, name: str) -> tuple[str, ...]:
    """Names of a scene's rooms; of one that nobody divided a single empty one."""
    units = library.texts.units(library.names.index(name))
    return tuple(dict.fromkeys(u.name for u in units if not u.whole))


def things_of(library: SceneLibrary) -> tuple[str, ...]:
    """Labels of all things in all scenes, and names of their rooms."""
    things: dict[str, None] = {}
    for name in library:
        signature = library.entry(name).signature
        things |= dict.fromkeys(signature.graph.labels)
        things |= dict.fromkeys(a["room"] for a in signature.attributes if a.get("room"))
    return tuple(things)
