"""Which objects of a map the things of a sentence may be, and which of its rooms are which."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.language.colours import with_colours
from placegraph.indoor.language.described import triples
from placegraph.indoor.language.likeness import (
    EXACT,
    fits,
    kind_by_name,
    kinds_of,
    likenesses,
    table,
)
from placegraph.indoor.language.looks_fit import ratios
from placegraph.indoor.language.score import sayings
from placegraph.indoor.language.seen import COLUMNS, seen
from placegraph.indoor.language.sentence import Kind, Sentence, Statement
from placegraph.indoor.map.scene import Scene

Floats = NDArray[np.float32]


_KIN_TOO = 0.3
"""How well kin fits where the thing itself is there."""
_UNRELATED = 0.2
"""How well a thing fits that does not lie as was said: maps do not know all relations."""
_UNLIKE = 0.2
"""How well a thing fits at least that looks otherwise than was said."""
_NO_ROOM = 0.1
"""A map has no such room where none is one with more than this probability."""


@dataclass(frozen=True, eq=False)
class Referents:
    """The objects that the things of a sentence may be, on a map of N of them."""

    sentence: Sentence
    scene: Scene

    @cached_property
    def weights(self) -> list[Floats]:
        """Of each mention how well (N,) the objects are it, as what is said of pairs narrows it."""
        labels = list(dict.fromkeys(self.scene.graph.labels))
        row = np.array([labels.index(label) for label in self.scene.graph.labels])
        out = [self._own(fits(m.label, labels)[row]) for m in self.sentence.mentions]
        for i, mention in enumerate(self.sentence.mentions):
            if mention.room and not (out[i] >= EXACT).any():
                out[i] = self._in_room(mention.room)
            elif mention.attributes:
                out[i] = self._looking(mention.attributes, out[i])
        for s in self.sentence.statements:
            if s.kind is Kind.RELATED and not s.negated:
                self._narrow(s, out)
        return out

    def _looking(self, attributes: tuple[str, ...], weights: Floats) -> Floats:
        """Weights (N,) of things that look as was said: the red one of two chairs."""
        spoken = weights > 0.0
        if not spoken.any():
            return weights
        told = ratios(attributes, self._seen, self._seen, weights.astype(np.float64))
        told /= told[spoken].max()
        return (weights * np.maximum(told, _UNLIKE)).astype(np.float32)

    @cached_property
    def _seen(self) -> NDArray[np.float64]:
        """(N, C) what the objects look like, and where in their rooms they stand."""
        out = np.empty((len(self.scene), len(COLUMNS)))
        attributes = with_colours(self.scene)
        of = self.rooms[0]
        for room in np.unique(of):
            rows = np.flatnonzero(of == room)
            out[rows] = seen(self.scene.graph, rows.tolist(), attributes)
        return out

    @staticmethod
    def _own(weights: Floats) -> Floats:
        exact = weights >= EXACT
        return np.where(exact, weights, _KIN_TOO * weights) if exact.any() else weights

    def _narrow(self, s: Statement, weights: list[Floats]) -> None:
        a, b = s.things
        pairs = self.pairs(s.relation, weights[a], weights[b])
        for mention, rows in ((a, pairs[:, 0]), (b, pairs[:, 1])):
            if len(rows):
                there = np.zeros(len(weights[mention]), np.bool_)
                there[rows] = True
                weights[mention] = np.where(
                    there, weights[mention], _UNRELATED * weights[mention]
                ).astype(np.float32)

    def pairs(self, relation: str, first: Floats, second: Floats) -> NDArray[np.int64]:
        """Objects (P, 2) that may be the two things, where edges of the map say the relation."""
        straight, other_way = sayings(relation)
        found = set()
        for s, name, t in triples(self.scene.graph):
            if name in straight and first[s] > 0 and second[t] > 0:
                found.add((s, t))
            if name in other_way and first[t] > 0 and second[s] > 0:
                found.add((t, s))
        return np.array(sorted(found), np.int64).reshape(-1, 2)

    # rooms
    @cached_property
    def rooms(self) -> tuple[NDArray[np.int32], list[str], NDArray[np.float64]]:
        """Room (N,) of each object, -1 none; names of the G rooms; their kinds (G, R)."""
        named = [
            f"{scene} {room}" if (room := a.get("room", "")) else ""
            for scene, a in zip(self.scene.scene_of.tolist(), self.scene.attributes, strict=True)
        ]
        names = list(dict.fromkeys(name for name in named if name))
        number = {name: i for i, name in enumerate(names)}
        of = np.array([number.get(name, -1) for name in named], np.int32)
        held = np.zeros((len(names), self.telling.shape[1]), np.float32)
        np.maximum.at(held, of[of >= 0], self.telling[of >= 0])
        kinds = kinds_of(held, np.False_)
        names = [name.partition(" ")[2] for name in names]
        for row, name in enumerate(names):
            kinds[row] = kind_by_name(name, kinds[row])
        return of, names, kinds

    @cached_property
    def telling(self) -> Floats:
        """(N, T) how well objects are the things by which rooms are told (`kinds.table`)."""
        labels = list(dict.fromkeys(self.scene.graph.labels))
        row = [labels.index(label) for label in self.scene.graph.labels]
        return likenesses(labels)[row]

    def _in_room(self, kind: str) -> Floats:
        """How well (N,) objects stand for a room of a kind: they are in it."""
        of, _, kinds = self.rooms
        share = np.append(kinds[:, table().kinds.index(kind)], 0.0)
        return np.where(share > _NO_ROOM, share, 0.0)[of].astype(np.float32)

    def missing(self, s: Statement) -> str:
        """Why a statement says nothing on this map, or an empty string."""
        if s.kind is Kind.ROOM:
            mention = self.sentence.mentions[s.things[0]]
            if not mention.room:
                return "says nothing of where you are"
            kinds = self.rooms[2]
            if not len(kinds):
                return "the map knows no rooms"
            if kinds[:, table().kinds.index(mention.room)].max() <= _NO_ROOM:
                return f"the map has no {mention.label}"
            return ""
        for t in s.things:
            if not self.weights[t].any():
                return f"the map has no {self.sentence.mentions[t].label}"
        if s.kind is Kind.RELATED and s.negated:
            return "says nothing of where you are"
        return ""
