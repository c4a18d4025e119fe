"""Input of the network: word vectors, graphs of texts and places, and padded batches of these.

Words are hashed subwords, whose vectors the network learns. Mentions arrive as senses, labels such as
``amenity=cafe``. The vector of a label is the sum over its parts: the whole, its key, its words, and
their sequences of 3 to 5 letters. Rare tags, unknown words and names thus resemble words of a similar
spelling. A network may also be trained with word vectors from a file (`WordVectors`, Sec. III-A of the
paper), and hashed subwords for the rest.

Node 0 of every graph is the speaker of a text, or the centre of a place. All others are objects.
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
    compute_agreement,
    gather_rows,
    place_relations,
    select_nearest,
    split_words,
    text_relations,
)


def split_label(label: str) -> tuple[str, ...]:
    """Split a label into words, in lower case: those of a name, or of the value of a tag.

    ``amenity=bicycle_parking`` becomes "bicycle", "parking". The key stands in for a value that means
    nothing: ``building=yes`` becomes "building".
    """
    key, _, value = (label, "", "") if label.startswith("~") else label.partition("=")
    return tuple(re.findall(r"[^\W_]+", (key if value in ("", "*", "yes") else value).lower()))


@dataclass(frozen=True, eq=False)
class WordVectors:
    """Vectors of single words from another training, such as word2vec's."""

    words: tuple[str, ...]
    """N words in lower case, each once."""
    vectors: NDArray[np.float32]
    """(N, n), rounded to 16 bits."""

    @cached_property
    def _rows(self) -> dict[str, int]:
        return {word: row for row, word in enumerate(self.words)}

    def means(self, labels: Sequence[str]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the mean vectors (W, n) of the known words of labels, and which labels have any (W,)."""
        found = np.zeros((len(labels), self.vectors.shape[1]), np.float32)
        known = np.zeros(len(labels), bool)
        for i, label in enumerate(labels):
            rows = [self._rows[word] for word in split_label(label) if word in self._rows]
            if rows:
                found[i], known[i] = self.vectors[rows].mean(axis=0), True
        return found, known


@dataclass(frozen=True, eq=False)
class SubwordBags:
    """Weighted parts of W words, as CSR, and means of word vectors where these are known."""

    starts: NDArray[np.int64]
    """(W + 1,)"""
    buckets: NDArray[np.int64]
    """(P,) rows of the table of vectors."""
    weights: NDArray[np.float32]
    """(P,) 0 for words that have a mean."""
    means: NDArray[np.float32] | None = None
    """(W, n) of `WordVectors`, 0 for unknown words."""

    @classmethod
    def of(
        cls, words: Sequence[str], subwords: float = 1.0, word_vectors: WordVectors | None = None
    ) -> SubwordBags:
        """Split labels (``key=value``), names (``~`` before them) and plain words into parts.

        `subwords` is the length of the sum of all subwords, against 1 of the whole word; `word_vectors` word
        vectors replace the parts of the words that they hold.
        """
        letters = [np.frombuffer(w.encode("utf-32-le", "surrogatepass"), np.uint32) for w in words]
        bounds = np.concatenate(([0], np.cumsum([len(x) for x in letters]))).astype(np.int64)
        parts = split_words(np.concatenate([np.zeros(0, np.uint32), *letters]), bounds, subwords)
        if word_vectors is None:
            return cls(*parts)
        starts, buckets, weights = parts
        means, found = word_vectors.means(words)
        return cls(starts, buckets, weights * ~np.repeat(found, np.diff(starts)), means)

    def vectors(
        self, table: NDArray[np.float32], meaning: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Compute the vectors (W, d) of words, from the table (BUCKETS, d) and the map (d, n) of means."""
        rows = table[self.buckets] * self.weights[:, None]
        sums = np.add.reduceat(rows, self.starts[:-1], axis=0) if len(rows) else rows[:0]
        return sums if self.means is None or meaning is None else sums + self.means @ meaning.T


MAX_MENTIONS, MAX_STATEMENTS = 24, 32
"""Largest numbers of objects and statements of a text; the rest is cut off."""


@dataclass(frozen=True, eq=False)
class TextGraphs:
    """Q text graphs (Eq. 3-4); their nodes and edges as CSR."""

    starts: NDArray[np.int64]
    """(Q + 1,) nodes of a text; the first one is the speaker."""
    mentions: NDArray[np.int64]
    """(N,) mention of the description that a node stands for."""
    word_starts: NDArray[np.int64]
    """(N + 1,) words of a node; a speaker has none."""
    words: NDArray[np.int64]
    """Rows of `vocabulary`."""
    weights: NDArray[np.float32]
    """Probability that the node is meant by the word."""
    counts: NDArray[np.float32]
    """(N,) log of the stated number, 0 for one or none."""
    edge_starts: NDArray[np.int64]
    """(Q + 1,) statements of a text."""
    ends: NDArray[np.int64]
    """(E, 2) source and target, counted within the text."""
    channels: NDArray[np.float32]
    """(E, R) degree to which each of `CHANNELS` is stated."""
    negated: NDArray[np.float32]
    """(E,) 1 where the statement is negated."""
    vocabulary: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.starts) - 1

    @classmethod
    def of(cls, descriptions: Sequence[Description]) -> TextGraphs:
        """Make the graphs of parsed descriptions; mentions and statements beyond the limits are cut off."""
        rows: dict[str, int] = {}
        mentions: list[int] = []
        nodes: list[list[tuple[int, float]]] = []
        counts: list[float] = []
        edges: list[tuple[int, int]] = []
        channels: list[NDArray[np.float32]] = []
        negated: list[bool] = []
        starts, edge_starts = [0], [0]
        for description in descriptions:
            local = _number_mentions(description)
            mentions += local
            for id_ in local:
                mention = description.mentions[id_]
                words = [] if id_ == SPEAKER else weigh_words(mention)
                nodes.append([(rows.setdefault(w, len(rows)), weight) for w, weight in words])
                counts.append(float(np.log(max(1, mention.count or 1))))
            for s in description.statements:
                if s.source not in local or s.target not in local:
                    continue
                if len(edges) - edge_starts[-1] == MAX_STATEMENTS:
                    break
                edges.append((local[s.source], local[s.target]))
                channels.append(_make_channels(s.relation, s.bearing))
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
            channels=np.array(channels, np.float32).reshape(-1, len(CHANNELS)),
            negated=np.array(negated, np.float32),
            vocabulary=tuple(rows),
        )

    def batch(self, rows: Rows) -> GraphBatch:
        """Pad the graphs of texts `rows` (B,)."""
        rows = np.asarray(rows, np.int64)
        counts = self.starts[rows + 1] - self.starts[rows]
        size = int(counts.max())
        node, at = list_nodes(self.starts[rows], counts, size)
        nodes = np.zeros((len(rows), size, 2), np.float32)
        nodes[:, 0, 0] = 1.0
        nodes.reshape(-1, 2)[at, 1] = self.counts[node]
        return GraphBatch(
            nodes,
            make_mask(counts, size),
            text_relations(self.edge_starts, self.ends, self.channels, self.negated, rows, size),
            _words(self.word_starts, self.words, self.weights, node, at),
        )


def _number_mentions(description: Description) -> dict[int, int]:
    """Number the mentions of statements; the speaker is always node 0."""
    local = {SPEAKER: 0}
    for s in description.statements:
        for end in (s.source, s.target):
            if end not in local and len(local) <= MAX_MENTIONS and end != 1:
                local[end] = len(local)
    return local


def weigh_words(mention: Mention) -> list[tuple[str, float]]:
    """Return words of a mention with their probability: senses and name, or its plain words."""
    found = [(sense.label, sense.weight) for sense in mention.senses]
    literal = [(label, w) for label, w in found if is_tag(mention.words, label)]
    found = literal or found
    total = sum(w for _, w in found)
    found = [(label, w / total) for label, w in found]
    if mention.name:
        found.append((of_name(mention.name), 1.0))
    return found or [(mention.words.casefold(), 1.0)]


_CHANNEL_OF = {
    Relation.NEAR: NEAR,
    Relation.INSIDE: INSIDE,
    Relation.ALONG: ALONG,
    Relation.ACROSS: PRESENT,
    Relation.BETWEEN: PRESENT,
    Relation.VISIBLE: PRESENT,
    Relation.SAME: NEAR,
}


def _make_channels(relation: Relation, bearing: float | None) -> NDArray[np.float32]:
    out = np.zeros(len(CHANNELS), np.float32)
    if relation is Relation.DIRECTION and bearing is not None:
        out[:4] = share_winds(np.float32(np.sin(bearing)), np.float32(np.cos(bearing)))
    else:
        out[_CHANNEL_OF.get(relation, PRESENT)] = 1.0
    return out


@dataclass(frozen=True, eq=False)
class PlaceGraphs:
    """K place graphs (Eq. 7-8): objects around a centre, nearest first, which determine the relations."""

    starts: NDArray[np.int64]
    """(K + 1,) objects of a place, without its centre."""
    offsets: NDArray[np.float32]
    """(N, 2) positions relative to the centre: east, north [m]."""
    kinds: NDArray[np.uint8]
    """(N,) point, line or area."""
    word_starts: NDArray[np.int64]
    """(N + 1,)"""
    words: NDArray[np.int32]
    """Rows of `vocabulary`: labels and names."""
    weights: NDArray[np.float32]
    """Weight of a word for its object."""
    vocabulary: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.starts) - 1

    @classmethod
    def of_cells(cls, city: City) -> PlaceGraphs:
        """Make graphs around all cells of a city, rows as `city.cells.points`.

        They reach beyond the edge of the cell, since speakers there mention what lies beyond.
        """
        o = city.objects
        seen = find_visible(
            o.kind, o.part_starts, o.point_starts, o.points, grid=city.cells.grid, radius=REACH
        )
        rows = np.searchsorted(seen.points, city.cells.points)
        return cls.of_visible(city, seen, rows)

    @classmethod
    def of_views(cls, city: City, rows: NDArray[np.int64]) -> PlaceGraphs:
        """Make graphs around viewpoints `rows` (K,) of a city."""
        seen = city.in_sight(rows)
        return cls.of_visible(city, seen, np.arange(len(seen.points)))

    @classmethod
    def of_visible(
        cls, city: City, visible: VisibleObjects, rows: NDArray[np.int64]
    ) -> PlaceGraphs:
        """Make graphs around the points `rows` (K,) of their visible objects."""
        chosen, kept = select_nearest(visible.starts, visible.offsets, np.asarray(rows, np.int64))
        things = visible.objects[kept]
        word_starts, words, weights = gather_rows(things, *city.tokens)
        return cls(
            chosen, visible.offsets[kept].astype(np.float32), city.objects.kind[things],
            word_starts, words, weights, city.words,
        )  # fmt: skip

    def batch(self, rows: Rows) -> GraphBatch:
        """Pad the graphs of places `rows` (B,)."""
        rows = np.asarray(rows, np.int64)
        counts = self.starts[rows + 1] - self.starts[rows]
        size = int(counts.max(initial=0)) + 1
        thing, at = list_nodes(self.starts[rows], counts, size, skip=1)
        nodes = np.zeros((len(rows), size, 7), np.float32)
        nodes[:, 0, 0] = 1.0
        flat = nodes.reshape(-1, 7)
        flat[at, 1 + self.kinds[thing]] = 1.0
        flat[at, 4:6] = self.offsets[thing] / 25.0
        flat[at, 6] = np.hypot(flat[at, 4], flat[at, 5])
        return GraphBatch(
            nodes,
            make_mask(counts + 1, size),
            place_relations(self.starts, self.offsets, self.kinds, rows, size),
            _words(self.word_starts, self.words, self.weights, thing, at),
        )


Floats = NDArray[np.float32]
Rows = NDArray[np.int64]


class NodeWords(NamedTuple):
    """Words of N nodes, as CSR, with the rows of the nodes in padded arrays."""

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


def list_nodes(starts: Rows, counts: Rows, size: int, *, skip: int = 0) -> tuple[Rows, Rows]:
    """List the nodes of graphs by first node and count, and their rows in padded arrays."""
    graph = np.repeat(np.arange(len(starts)), counts)
    within = np.arange(len(graph)) - np.repeat(np.cumsum(counts) - counts, counts)
    return starts[graph] + within, graph * size + within + skip


def make_mask(counts: Rows, size: int) -> Floats:
    """Make a mask (B, size) of the nodes of B graphs."""
    return (np.arange(size) < counts[:, None]).astype(np.float32)


def _words(
    starts: Rows, words: NDArray[np.integer[Any]], weights: Floats, nodes: Rows, at: Rows
) -> NodeWords:
    counts = starts[nodes + 1] - starts[nodes]
    some = counts > 0
    nodes, at, counts = nodes[some], at[some], counts[some]
    entry, _ = list_nodes(starts[nodes], counts, 0)
    return NodeWords(np.cumsum(counts) - counts, words[entry].astype(np.int64), weights[entry], at)


def compute_agreements(
    texts: TextGraphs,
    places: PlaceGraphs,
    text_rows: Rows,
    place_rows: Rows,
    words: WordFits,
    size: tuple[int, int],
) -> Floats:
    """Compute how well objects of places fit mentions of texts, (P, n, m); the speaker fits the centre."""
    return compute_agreement(
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


def find_word_weights(texts: TextGraphs, queries: Sequence[Query]) -> WordWeights:
    """Find the words of the map that each text node may mean, as relational matching has them."""
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
    """Weights of the map's words for N text nodes, as CSR, with the rarity of the nodes on the map."""

    starts: Rows
    """(N + 1,)"""
    tokens: NDArray[np.int32]
    """Rows of the places' vocabulary."""
    weights: Floats
    rarity: Floats
    """(N,) negative log share of the map's objects that a node may mean, / 10; 0 for the speaker."""


def make_word_fits(word_weights: WordWeights, counts: Rows, total: int) -> WordFits:
    """Make `WordFits` of weights; `counts` (T,) of the `total` objects bear each word."""
    starts, tokens, weights = word_weights
    mass = np.concatenate(([0.0], np.cumsum(weights * counts[tokens])))
    share = (mass[starts[1:]] - mass[starts[:-1]]) / max(1, total)
    rarity = -np.log(np.clip(share, 1e-5, 1.0)) / 10.0
    rarity[starts[1:] == starts[:-1]] = 0.0
    return WordFits(starts, tokens, weights, rarity.astype(np.float32))
