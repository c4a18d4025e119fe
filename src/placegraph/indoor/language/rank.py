"""Scenes ranked by a text: one alone, or many side by side, where rare things count more."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Evidence, ObjectRef
from placegraph.core.graph import SceneGraph
from placegraph.errors import OptionError
from placegraph.indoor.language.colours import with_colours
from placegraph.indoor.language.described import Described, units
from placegraph.indoor.language.index import Columns, columns_of
from placegraph.indoor.language.likeness import EXACT, fits
from placegraph.indoor.language.read import read
from placegraph.indoor.language.score import compared, of_scenes, scene_scores
from placegraph.indoor.language.sentence import Kind, Mention, Sentence, Statement
from placegraph.indoor.map.scene import Scene

_TOLD = 0.05  # evidence that says anything [nat]


@dataclass(frozen=True, slots=True)
class Score:
    """How well a scene answers a text."""

    log_likelihood: float
    """Log-likelihood ratio against an average scene [nat]."""
    evidence: tuple[Evidence, ...]
    """What each statement says of the scene, or of the room of it that fits best."""


def rank_scenes(
    text: str | Sentence,
    graphs: Iterable[SceneGraph | Scene],
    rooms: Iterable[Sequence[str]] | None = None,
) -> NDArray[np.float64]:
    """How well each of n scenes answers a text, rare things counting more.

    Parameters
    ----------
    text
        English, as "a kitchen with two sinks"; or what `read` made of it.
    graphs
        Scene graphs of rooms or homes; labels, relations, counts, sizes and places in the room are
        compared. Of maps (`SceneMap`) also colours, and attributes as 3DSSG has them (material,
        shape, color, texture).
    rooms
        Of each graph the names (N,) of its objects' rooms, empty where unknown; without, relations
        "same room" say what is together.

    Returns
    -------
        (n,) float64, log-likelihood ratio of each scene against the average of them [nat]; all zero
        for a text that says nothing of a place. A `SceneLibrary` ranks its scenes by the same.

    Raises
    ------
    DescriptionError
        The text is empty, too long, or no text.
    OptionError
        There is not one room for each object.

    """
    return TextIndex(graphs, rooms).scores(read(text) if isinstance(text, str) else text)


class TextIndex:
    """Finds scenes by text; scenes have rows as in a list.

    Parameters
    ----------
    rooms
        Of each graph the names of its objects' rooms (`score`); of none if not given.
    """

    def __init__(
        self,
        graphs: Iterable[SceneGraph | Scene] = (),
        rooms: Iterable[Sequence[str]] | None = None,
    ) -> None:
        self._scenes: list[list[Described]] = []
        self._columns: Columns | None = None
        given = iter(rooms) if rooms is not None else None
        for graph in graphs:
            self.add(graph, next(given, ()) if given is not None else ())

    def __len__(self) -> int:
        return len(self._scenes)

    def add(
        self,
        graph: SceneGraph | Scene,
        rooms: Sequence[str] = (),
        attributes: Sequence[Mapping[str, str]] = (),
    ) -> int:
        """Add a scene at the end and return its row; raises `OptionError` as `score`.

        `attributes`: (N,) what else is known of the objects, as `colours.with_colours` says it of a
        map; a map itself has its own.
        """
        return self.add_units(_units(graph, rooms, attributes))

    def add_units(self, described: Sequence[Described]) -> int:
        """Add a scene by what may be described of it (`units`, `TextIndex.units`)."""
        self._scenes.append(list(described))
        self._columns = None
        return len(self._scenes) - 1

    def units(self, row: int) -> tuple[Described, ...]:
        """What may be described of a scene: its rooms, and where there are several all of it."""
        return tuple(self._scenes[row])

    def remove(self, row: int) -> None:
        """Take a scene out; those after it move up. `OptionError` where there is none."""
        if not 0 <= row < len(self._scenes):
            raise OptionError(f"row is {row}; the index has {len(self._scenes)} scenes.")
        del self._scenes[row]
        self._columns = None

    def scores(self, sentence: Sentence) -> NDArray[np.float64]:
        """Log-likelihood ratio (n,) of each scene against the average of them [nat].

        All zero for a sentence that says nothing.
        """
        return scene_scores(sentence, self.columns)

    def search(self, sentence: Sentence, most: int = 10) -> list[tuple[int, float]]:
        """Rows and scores of the best scenes, best first, the first of equal ones before."""
        scores = self.scores(sentence)
        order = np.argsort(-scores, kind="stable")[:most]
        return [(int(row), float(scores[row])) for row in order]

    @property
    def columns(self) -> Columns:
        """All scenes as arrays; made anew after `add` and `remove`."""
        if self._columns is None:
            self._columns = columns_of(self._scenes)
        return self._columns


def _units(
    graph: SceneGraph | Scene,
    rooms: Sequence[str] = (),
    attributes: Sequence[Mapping[str, str]] = (),
) -> list[Described]:
    """What may be described of a graph, or of a map, which knows its rooms and colours."""
    if not isinstance(graph, Scene):
        return units(graph, rooms, attributes)
    own = [a.get("room", "") for a in graph.attributes]
    return units(graph.graph, rooms or own, attributes or with_colours(graph))


def score(
    sentence: Sentence,
    graph: SceneGraph | Scene,
    rooms: Sequence[str] = (),
    library: TextIndex | None = None,
    attributes: Sequence[Mapping[str, str]] = (),
) -> Score:
    """How well a scene answers a text, as a log-likelihood ratio against an average scene.

    Parameters
    ----------
    sentence
        What `read` made of the text.
    graph
        Scene graph of a room, or of a home; or a map, which knows its rooms and colours.
    rooms
        (N,) name or number of the room of each object, empty where unknown, as attribute `room`
        of a map's objects; without, relations "same room" say what is together.
    library
        Index that says how rare things are; else they are as rare as in homes (`rooms.toml`), and
        sizes and colours, of which nobody knows what is usual, say nothing.
    attributes
        (N,) what else is known of the objects; see `TextIndex.add`.

    Raises
    ------
    OptionError
        There is not one room for each object.

    """
    columns = columns_of([_units(graph, rooms, attributes)])
    ratios = compared(sentence, columns, None if library is None else library.columns)
    total, best = of_scenes(sentence, columns, ratios.sum(axis=0))
    evidence = tuple(
        _evidence(
            s, sentence.mentions, graph.graph if isinstance(graph, Scene) else graph, float(ratio)
        )
        for s, ratio in zip(sentence.statements, ratios[:, best[0]], strict=True)
    )
    return Score(float(total[0]), evidence)


def _evidence(
    s: Statement, mentions: Sequence[Mention], graph: SceneGraph, ratio: float
) -> Evidence:
    labels = list(dict.fromkeys(graph.labels))
    serving = {
        label
        for t in s.things
        for label, fit in zip(labels, fits(mentions[t].label, labels), strict=True)
        if fit >= EXACT
    }
    verdict = "for" if ratio > _TOLD else "against" if ratio < -_TOLD else "silent"
    refs = tuple(
        ObjectRef(id_, label, name)
        for id_, label, name in zip(graph.ids, graph.labels, graph.names, strict=True)
        if label in serving and s.kind is not Kind.ROOM
    )
    return Evidence(s.text, verdict, ratio, refs)
