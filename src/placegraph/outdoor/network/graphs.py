"""Graphs as the network reads them: words as vectors, texts and places as graphs, padded batches.

Words are hashed subwords, whose vectors the network learns; what a word means is decided by the
vocabulary, since a mention arrives as its senses, labels such as ``amenity=cafe``. A label is the sum
of the vectors of its parts: the whole, its key, its words and their letters in threes to fives. A rare
tag, an unknown word or a name resembles what is spelled alike. A network may also be trained with word
vectors from a file (`WordVectors`, Sec. III-A of the paper), and hashed subwords for the rest.

Node 0 of every graph is *here*: the speaker of a text, the centre of a place. All others are things.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.language.description import SPEAKER, Description, Mention, Relation
from placegraph.outdoor.likelihood.query import Query, is_tag
from placegraph.outdoor.map.cells import VisibleObjects, find_visible
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.directions_kernels import share_winds
from placegraph.outdoor.map.objects import of_name
from placegraph.outdoor.network.network_kernels import (
    ALONG,
    CHANNELS,
    INSIDE,
    NEAR,
    PRESENT,
    REACH,
    _gather,
    _nearest_things,
    _parts,
    agreement,
    place_relations,
    text_relations,
)


def split_label(label: str) -> tuple[str, ...]:
    """Words that stand for a label, in small letters: of a name, or of a tag's value.

    ``amenity=bicycle_parking`` is "bicycle", "parking"; a value that says nothing leaves the word to
    the key: ``building=yes`` is "building".
    """
    key, _, value = (label, "", "") if label.startswith("~") else label.partition("=")
    words = re.findall(r"[^\W_]+", (key if value in ("", "*", "yes") else value).lower())
    return tuple(words)


@dataclass(frozen=True, eq=False)
class WordVectors:
    """Vectors of single words that were trained elsewhere, such as word2vec's."""

    words: tuple[str, ...]
    """N words in small letters, each once."""
    vectors: NDArray[np.float32]
    """(N, n), as 16 bits hold them."""

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {word: row for row, word in enumerate(self.words)}

    def means(self, labels: Sequence[str]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Mean vectors (W, n) of the words of labels that are known, and which have any (W,)."""
        found = np.zeros((len(labels), self.vectors.shape[1]), np.float32)
        known = np.zeros(len(labels), bool)
        for i, label in enumerate(labels):
            rows = [self._rows[word] for word in split_label(label) if word in self._rows]
            if rows:
                found[i], known[i] = self.vectors[rows].mean(axis=0), True
        return found, known


@dataclass(frozen=True, eq=False)
class Bags:
    """Weighted parts of W words, as CSR, and where they are known the means of word vectors."""

    starts: NDArray[np.int64]
    """(W + 1,)"""
    buckets: NDArray[np.int64]
    """(P,) rows of the table of vectors."""
    weights: NDArray[np.float32]
    """(P,) 0 of words that have a mean."""
    means: NDArray[np.float32] | None = None
    """(W, n) of `WordVectors`, 0 where a word is not known to them."""

    @classmethod
    def of(
        cls, words: Sequence[str], subwords: float = 1.0, known: WordVectors | None = None
    ) -> Bags:
        """Parts of labels (``key=value``), names (``~`` before them) and plain words.

        `subwords` is the length of what all subwords add together, against 1 of the whole word;
        `known` are word vectors that stand for the words they know.
        """
        letters = [np.frombuffer(w.encode("utf-32-le", "surrogatepass"), np.uint32) for w in words]
        bounds = np.concatenate(([0], np.cumsum([len(x) for x in letters]))).astype(np.int64)
        parts = _parts(np.concatenate([np.zeros(0, np.uint32), *letters]), bounds, subwords)
        if known is None:
            return cls(*parts)
        starts, buckets, weights = parts
        means, found = known.means(words)
        return cls(starts, buckets, weights * ~np.repeat(found, np.diff(starts)), means)

    def vectors(
        self, table: NDArray[np.float32], meaning: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Vectors (W, d) of the words, from the table (BUCKETS, d) and the map (d, n) of means."""
        rows = table[self.buckets] * self.weights[:, None]
        sums = np.add.reduceat(rows, self.starts[:-1], axis=0) if len(rows) else rows[:0]
        return sums if self.means is None or meaning is None else sums + self.means @ meaning.T


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
                words = [] if id_ == SPEAKER else weigh_words(mention)
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


def weigh_words(mention: Mention) -> list[tuple[str, float]]:
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
        said[:4] = share_winds(np.float32(np.sin(bearing)), np.float32(np.cos(bearing)))
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
        seen = find_visible(
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
    def of_sightings(cls, city: City, seen: VisibleObjects, rows: NDArray[np.int64]) -> PlaceGraphs:
        """Graphs around the points `rows` (K,) of what is seen there."""
        chosen, kept = _nearest_things(seen.starts, seen.offsets, np.asarray(rows, np.int64))
        things = seen.objects[kept]
        word_starts, words, weights = _gather(things, *city.tokens)
        return cls(
            chosen, seen.offsets[kept].astype(np.float32), city.objects.kind[things],
            word_starts, words, weights, city.words,
        )  # fmt: skip


Floats = NDArray[np.float32]


Rows = NDArray[np.int64]


class NodeWords(NamedTuple):
    """Words of N nodes, as CSR; `at` says where the nodes stand in the padded arrays."""

    starts: Rows
    """(N,) first word of a node; the last one ends with the words."""
    words: Rows
    weights: Floats
    at: Rows
    """(N,) graph * size + node."""


class GraphBatch(NamedTuple):
    """B padded graphs of `size` nodes; node 0 is the speaker, or the centre."""

    nodes: Floats
    """(B, size, F): texts have (is here, log count), places (is here, kind (3), offset (2) and
    distance, all / 25 m)."""
    mask: Floats
    """(B, size) 1 where there is a node."""
    relations: Floats
    """(B, R, size, size) `CHANNELS` of node i to node j."""
    words: NodeWords


def text_batch(texts: TextGraphs, rows: Rows) -> GraphBatch:
    """Padded texts `rows` (B,)."""
    rows = np.asarray(rows, np.int64)
    counts = texts.starts[rows + 1] - texts.starts[rows]
    size = int(counts.max())
    node, at = entries(texts.starts[rows], counts, size)
    nodes = np.zeros((len(rows), size, 2), np.float32)
    nodes[:, 0, 0] = 1.0
    nodes.reshape(-1, 2)[at, 1] = texts.counts[node]
    return GraphBatch(
        nodes,
        mask_of(counts, size),
        text_relations(texts.edge_starts, texts.ends, texts.channels, texts.negated, rows, size),
        _words(texts.word_starts, texts.words, texts.weights, node, at),
    )


def place_batch(places: PlaceGraphs, rows: Rows) -> GraphBatch:
    """Padded places `rows` (B,)."""
    rows = np.asarray(rows, np.int64)
    counts = places.starts[rows + 1] - places.starts[rows]
    size = int(counts.max(initial=0)) + 1
    thing, at = entries(places.starts[rows], counts, size, skip=1)
    nodes = np.zeros((len(rows), size, 7), np.float32)
    nodes[:, 0, 0] = 1.0
    flat = nodes.reshape(-1, 7)
    flat[at, 1 + places.kinds[thing]] = 1.0
    flat[at, 4:6] = places.offsets[thing] / 25.0
    flat[at, 6] = np.hypot(flat[at, 4], flat[at, 5])
    return GraphBatch(
        nodes,
        mask_of(counts + 1, size),
        place_relations(places.starts, places.offsets, places.kinds, rows, size),
        _words(places.word_starts, places.words, places.weights, thing, at),
    )


def entries(starts: Rows, counts: Rows, size: int, *, skip: int = 0) -> tuple[Rows, Rows]:
    """Nodes of graphs with these first nodes and counts, and where they stand when padded."""
    graph = np.repeat(np.arange(len(starts)), counts)
    within = np.arange(len(graph)) - np.repeat(np.cumsum(counts) - counts, counts)
    return starts[graph] + within, graph * size + within + skip


def mask_of(counts: Rows, size: int) -> Floats:
    """Ones (B, size) where each of B graphs has a node."""
    return (np.arange(size) < counts[:, None]).astype(np.float32)


def _words(
    starts: Rows, words: NDArray[np.integer[Any]], weights: Floats, nodes: Rows, at: Rows
) -> NodeWords:
    counts = starts[nodes + 1] - starts[nodes]
    some = counts > 0
    nodes, at, counts = nodes[some], at[some], counts[some]
    entry, _ = entries(starts[nodes], counts, 0)
    return NodeWords(np.cumsum(counts) - counts, words[entry].astype(np.int64), weights[entry], at)


def agreements(
    texts: TextGraphs,
    places: PlaceGraphs,
    text_rows: Rows,
    place_rows: Rows,
    words: WordFits,
    size: tuple[int, int],
) -> Floats:
    """Return how well things of places fit mentions of texts, (P, n, m); the speaker fits the centre."""
    return agreement(
        texts.starts, text_rows, words.starts, words.tokens, words.weights,
        places.starts, place_rows, places.word_starts, places.words, places.weights,
        *size, len(places.vocabulary),
    )  # fmt: skip


class WordWeights(NamedTuple):
    """Weights of the map's words for N text nodes, as CSR."""

    starts: Rows
    """(N + 1,)"""
    tokens: NDArray[np.int32]
    weights: Floats


def fits_of(texts: TextGraphs, queries: Sequence[Query]) -> WordWeights:
    """Words of the map that each text node may stand for, as relational matching reads them."""
    starts, tokens, weights = [0], [], []
    for q, query in enumerate(queries):
        for mention in texts.mentions[texts.starts[q] : texts.starts[q + 1]]:
            a, b = query.mentions.starts[mention - 2 : mention] if mention >= 2 else (0, 0)
            tokens.append(query.mentions.tokens[a:b])
            weights.append(query.mentions.weights[a:b])
            starts.append(starts[-1] + int(b - a))
    return WordWeights(
        np.array(starts, np.int64),
        np.concatenate([np.zeros(0, np.int32), *tokens]),
        np.concatenate([np.zeros(0, np.float32), *weights]),
    )


class WordFits(NamedTuple):
    """Weights of a map's words for N text nodes, as CSR, and how rare the nodes are on the map."""

    starts: Rows
    """(N + 1,)"""
    tokens: NDArray[np.int32]
    """Rows of the places' vocabulary."""
    weights: Floats
    rarity: Floats
    """(N,) minus log share of the map's things that a node may be, / 10; 0 of the speaker."""


def word_fits(fits: WordWeights, counts: Rows, total: int) -> WordFits:
    """`WordFits` from how well words fit, and how many (counts (T,)) of the `total` things bear them."""
    starts, tokens, weights = fits
    mass = np.concatenate(([0.0], np.cumsum(weights * counts[tokens])))
    share = (mass[starts[1:]] - mass[starts[:-1]]) / max(1, total)
    rarity = -np.log(np.clip(share, 1e-5, 1.0)) / 10.0
    rarity[starts[1:] == starts[:-1]] = 0.0
    return WordFits(starts, tokens, weights, rarity.astype(np.float32))
