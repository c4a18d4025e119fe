"""Graphs as the network reads them: columns of many text graphs, columns of many place graphs.

Node 0 of every graph is *here*: the speaker of a text, the centre of a place. All other nodes are
things; how they stand to each other is in `graphs_kernels`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.language.description import SPEAKER, Description, Mention, Relation
from placegraph.outdoor.likelihood.query import is_tag
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.objects import of_name
from placegraph.outdoor.map.raster import Sightings, sightings
from placegraph.outdoor.network.graphs_kernels import (
    ALONG,
    CHANNELS,
    INSIDE,
    NEAR,
    PRESENT,
    REACH,
    _gather,
    _nearest_things,
    winds,
)

MOST_MENTIONS = 24
"""At most this many things of a text are read."""


MOST_STATEMENTS = 32
"""At most this many statements of a text are read."""


@dataclass(frozen=True, eq=False)
class TextGraphs:
    """Q text graphs (Eq. 3-4); their nodes and edges as CSR."""

    starts: NDArray[np.int64]
    """(Q + 1,) nodes of a text; the first one is the speaker."""
    mentions: NDArray[np.int64]
    """(N,) mention of the description that a node is."""
    word_starts: NDArray[np.int64]
    """(N + 1,) words of a node, none of a speaker."""
    words: NDArray[np.int64]
    """Rows of `vocabulary`."""
    weights: NDArray[np.float32]
    """How likely the node is meant so."""
    counts: NDArray[np.float32]
    """(N,) log of the stated number, 0 where one or unsaid."""
    edge_starts: NDArray[np.int64]
    """(Q + 1,) statements of a text."""
    ends: NDArray[np.int64]
    """(E, 2) source and target, counted within the text."""
    channels: NDArray[np.float32]
    """(E, R) how far each of `CHANNELS` was said."""
    negated: NDArray[np.float32]
    """(E,) 1 where the statement says that it is not so."""
    vocabulary: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.starts) - 1

    @classmethod
    def of(cls, descriptions: Sequence[Description]) -> TextGraphs:
        """Text graphs of parsed descriptions; what exceeds the limits is cut off at the end."""
        rows: dict[str, int] = {}
        mentions: list[int] = []
        nodes: list[list[tuple[int, float]]] = []
        counts: list[float] = []
        edges: list[tuple[int, int]] = []
        said: list[NDArray[np.float32]] = []
        negated: list[bool] = []
        starts, edge_starts = [0], [0]
        for description in descriptions:
            local = _spoken_of(description)
            mentions += local
            for id_ in local:
                mention = description.mentions[id_]
                words = [] if id_ == SPEAKER else words_of(mention)
                nodes.append([(rows.setdefault(w, len(rows)), weight) for w, weight in words])
                counts.append(float(np.log(max(1, mention.count or 1))))
            for s in description.statements:
                if s.source not in local or s.target not in local:
                    continue
                if len(edges) - edge_starts[-1] == MOST_STATEMENTS:
                    break
                edges.append((local[s.source], local[s.target]))
                said.append(_channels(s.relation, s.bearing))
                negated.append(s.negated)
            starts.append(len(nodes))
            edge_starts.append(len(edges))
        return cls(
            starts=np.array(starts, np.int64),
            mentions=np.array(mentions, np.int64),
            word_starts=np.concatenate(([0], np.cumsum([len(n) for n in nodes]))).astype(np.int64),
            words=np.array([w for n in nodes for w, _ in n], np.int64),
            weights=np.array([x for n in nodes for _, x in n], np.float32),
            counts=np.array(counts, np.float32),
            edge_starts=np.array(edge_starts, np.int64),
            ends=np.array(edges, np.int64).reshape(-1, 2),
            channels=np.array(said, np.float32).reshape(-1, len(CHANNELS)),
            negated=np.array(negated, np.float32),
            vocabulary=tuple(rows),
        )


def _spoken_of(description: Description) -> dict[int, int]:
    """Node of each mention that a statement speaks of; the speaker is node 0, always there."""
    local = {SPEAKER: 0}
    for s in description.statements:
        for end in (s.source, s.target):
            if end not in local and len(local) <= MOST_MENTIONS and end != 1:
                local[end] = len(local)
    return local


def words_of(mention: Mention) -> list[tuple[str, float]]:
    """Words that stand for a mention, and how likely it is meant so: senses, name, or bare words."""
    found = [(sense.label, sense.weight) for sense in mention.senses]
    literal = [(label, w) for label, w in found if is_tag(mention.words, label)]
    found = literal or found
    total = sum(w for _, w in found)
    found = [(label, w / total) for label, w in found]
    if mention.name:
        found.append((of_name(mention.name), 1.0))
    return found or [(mention.words.casefold(), 1.0)]


_SAID = {
    Relation.NEAR: NEAR,
    Relation.INSIDE: INSIDE,
    Relation.ALONG: ALONG,
    Relation.ACROSS: PRESENT,
    Relation.BETWEEN: PRESENT,
    Relation.VISIBLE: PRESENT,
    Relation.SAME: NEAR,
}


def _channels(relation: Relation, bearing: float | None) -> NDArray[np.float32]:
    said = np.zeros(len(CHANNELS), np.float32)
    if relation is Relation.DIRECTION and bearing is not None:
        said[:4] = winds(np.float32(np.sin(bearing)), np.float32(np.cos(bearing)))
    else:
        said[_SAID.get(relation, PRESENT)] = 1.0
    return said


@dataclass(frozen=True, eq=False)
class PlaceGraphs:
    """K place graphs (Eq. 7-8): things around a centre, nearest first; relations follow from them."""

    starts: NDArray[np.int64]
    """(K + 1,) things of a place; *here* is not among them."""
    offsets: NDArray[np.float32]
    """(N, 2) where they stand, seen from the centre: east, north [m]."""
    kinds: NDArray[np.uint8]
    """(N,) point, line or area."""
    word_starts: NDArray[np.int64]
    """(N + 1,)"""
    words: NDArray[np.int32]
    """Rows of `vocabulary`: labels and names."""
    weights: NDArray[np.float32]
    """How readily the thing is called so."""
    vocabulary: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.starts) - 1

    @classmethod
    def of_cells(cls, city: City) -> PlaceGraphs:
        """Graphs around all cells of a city, rows as `city.cells.points`.

        They reach beyond the cell's edge: who stands at it speaks of what lies beyond.
        """
        o = city.objects
        seen = sightings(
            o.kind, o.part_starts, o.point_starts, o.points, grid=city.cells.grid, radius=REACH
        )
        rows = np.searchsorted(seen.points, city.cells.points)
        return cls.of_sightings(city, seen, rows)

    @classmethod
    def of_views(cls, city: City, rows: NDArray[np.int64]) -> PlaceGraphs:
        """Graphs around viewpoints `rows` (K,) of a city."""
        seen = city.in_sight(rows)
        return cls.of_sightings(city, seen, np.arange(len(seen.points)))

    @classmethod
    def of_sightings(cls, city: City, seen: Sightings, rows: NDArray[np.int64]) -> PlaceGraphs:
        """Graphs around the points `rows` (K,) of what is seen there."""
        return cls._gathered(city, seen.starts, seen.objects, seen.offsets, rows)

    @classmethod
    def _gathered(
        cls,
        city: City,
        starts: NDArray[np.int64],
        objects: NDArray[np.int32],
        offsets: NDArray[np.float32],
        rows: NDArray[np.int64],
    ) -> PlaceGraphs:
        chosen, kept = _nearest_things(starts, offsets, np.asarray(rows, np.int64))
        things = objects[kept]
        token_starts, token_values, token_weights = city.tokens
        word_starts, words, weights = _gather(things, token_starts, token_values, token_weights)
        return cls(
            chosen, offsets[kept].astype(np.float32), city.objects.kind[things],
            word_starts, words, weights, city.words,
        )  # fmt: skip
