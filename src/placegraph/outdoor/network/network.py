"""Network in NumPy: graph embeddings (Eq. 9-10) and joint matching (Eq. 14-17).

Equations and names of weights are those of the PyTorch network of `placegraph_learn`; a test compares
the two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from os import PathLike
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.threads import multiply_matrices
from placegraph.errors import MapError
from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.network import network_kernels as kernels
from placegraph.outdoor.network.graphs import (
    Floats,
    GraphBatch,
    PlaceGraphs,
    Rows,
    SubwordBags,
    TextGraphs,
    WordFits,
    WordVectors,
    compute_agreements,
    find_word_weights,
    make_word_fits,
)
from placegraph.outdoor.network.label_graphs import LabelGraphs
from placegraph.outdoor.network.weights import (
    MEANING,
    Shape,
    find_shipped_weights,
    list_weight_shapes,
    read_weights,
)
from placegraph.vectors import EmbeddedStore, Origin, Vectors, VectorStore, load_store
from placegraph.vectors.stores import Address

NEVER = np.float32(-1e30)
"""Attention logit of a node that the printed network does not have."""
BATCH_SIZE = 1024
"""Number of places that are embedded or matched at once."""


class EncodedGraphs(NamedTuple):
    """Encoded graphs."""

    nodes: Floats
    """(N, d) node states, packed."""
    starts: Rows
    """(B + 1,)"""
    embeddings: Floats
    """(B, D) of unit length."""
    relations: Floats
    """(B, R, size, size)"""


class MatchScores(NamedTuple):
    """Scores of K places by the joint model."""

    logit: Floats
    """(K,) log odds that text and place match (Eq. 17)."""
    cosine: Floats
    """(K,) of the joint embeddings (Eq. 15)."""
    embedding: Floats
    """(K,) cosine of the graph embeddings (Eq. 11)."""
    residual: Floats
    """(K,) correction of the log-likelihood ratio of relational matching."""


class _Pairs(NamedTuple):
    """One text with each of K places: its nodes and statements, repeated."""

    t_starts: Rows
    """(K + 1,) text nodes of a pair."""
    m_starts: Rows
    """(K + 1,) place nodes of a pair."""
    agreement: Floats
    """(K, n, m) how well an object fits a mention by its words."""
    relations: Floats
    """(K, R, m, m)"""
    ends: Rows
    """(E, 2) source and target of a statement, counted within the text."""
    bounds: Rows
    """(K + 1,) statements of a pair."""
    inputs: Floats
    """(E, R + 3) channels, negation, and rarity of both ends on the map."""


def _pair(
    texts: TextGraphs | LabelGraphs,
    text: int,
    places: PlaceGraphs | LabelGraphs,
    rows: Rows,
    words: WordFits | None,
    encoded: EncodedGraphs,
) -> _Pairs:
    k = len(rows)
    nodes = slice(*texts.starts[text : text + 2])
    n, size = nodes.stop - nodes.start, encoded.relations.shape[3]
    t_starts, none = np.arange(k + 1) * n, np.zeros(k + 1, np.int64)
    if isinstance(texts, LabelGraphs) or isinstance(places, LabelGraphs) or words is None:
        return _Pairs(
            t_starts, encoded.starts, np.zeros((k, n, size), np.float32), encoded.relations,
            np.zeros((0, 2), np.int64), none, np.zeros((0, 0), np.float32),
        )  # fmt: skip
    edges = slice(*texts.edge_starts[text : text + 2])
    ends = texts.ends[edges]
    rarity = words.rarity[nodes][ends]
    inputs = np.column_stack([texts.channels[edges], texts.negated[edges], rarity])
    return _Pairs(
        t_starts,
        encoded.starts,
        compute_agreements(texts, places, np.full(k, text), rows, words, (n, size)),
        encoded.relations,
        np.tile(ends, (k, 1)),
        np.arange(k + 1) * len(ends),
        np.tile(inputs, (k, 1)),
    )


@dataclass(frozen=True, eq=False)
class GraphTransformer:
    """Graph encoders of both sides and the joint model, ready to run."""

    shape: Shape
    arrays: dict[str, Floats]
    """Weights by PyTorch's names."""
    digest: str
    """Digest of the weights: embeddings of two networks must not be compared."""
    word_table: WordVectors | None = None
    """Word vectors of the training, if any."""

    @staticmethod
    @lru_cache(maxsize=2)
    def default(*, printed: bool = False) -> GraphTransformer:
        """Return the network that comes with placegraph: ours, or the one that GOTLoc prints."""
        return GraphTransformer.open(find_shipped_weights(printed=printed))

    @classmethod
    def open(cls, path: str | PathLike[str]) -> GraphTransformer:
        """Open a weights file; raises `InputError` or `MapError` where it does not fit this version."""
        weights = read_weights(path)
        try:
            network = cls(weights.shape, weights.arrays, weights.digest, weights.words)
            network.check()
        except (KeyError, ValueError) as error:
            raise MapError(
                f"{path}: its weights do not fit together ({error}). Train or install them again."
            ) from error
        return network

    def check(self) -> None:
        """Raise `KeyError` or `ValueError` where a weight is missing or of another shape."""
        for name, wanted in list_weight_shapes(self.shape, self.word_table).items():
            if self.arrays[name].shape != wanted:
                raise ValueError(f"{name} has shape {self.arrays[name].shape} instead of {wanted}")

    def word_vectors(self, words: tuple[str, ...]) -> Floats:
        """Compute vectors (W, d) of labels, names (`of_name`) and any other words."""
        return self.bags(words).vectors(self.arrays["table"], self.arrays.get(MEANING))

    def bags(self, words: tuple[str, ...]) -> SubwordBags:
        """Split labels, names and any other words into parts."""
        return SubwordBags.of(words, self.shape.subwords, self.word_table)

    def embed_texts(self, texts: TextGraphs | LabelGraphs) -> Floats:
        """Embed text graphs (Eq. 9): (Q, D) of unit length."""
        return self.encode_texts(texts, np.arange(len(texts))).embeddings

    def embed_places(
        self, places: PlaceGraphs | LabelGraphs, vectors: Floats | None = None
    ) -> Floats:
        """Embed place graphs (Eq. 10): (K, D) of unit length."""
        vectors = self.word_vectors(places.vocabulary) if vectors is None else vectors
        order = np.argsort(np.diff(places.starts), kind="stable")  # similar sizes: little padding
        out = np.empty((len(places), self.shape.dimension), np.float32)
        for at in range(0, len(order), BATCH_SIZE):
            rows = order[at : at + BATCH_SIZE]
            out[rows] = self.encode_places(places, rows, vectors).embeddings
        return out

    def encode_texts(self, texts: TextGraphs | LabelGraphs, rows: Rows) -> EncodedGraphs:
        """Encode texts `rows`: node states and embeddings."""
        return self._encode(
            next(iter(self.shape.sides)), texts.batch(rows), self.word_vectors(texts.vocabulary)
        )

    def encode_places(
        self, places: PlaceGraphs | LabelGraphs, rows: Rows, vectors: Floats
    ) -> EncodedGraphs:
        """Encode places `rows`: node states and embeddings; `vectors` are those of their vocabulary."""
        return self._encode(next(reversed(self.shape.sides)), places.batch(rows), vectors)

    def match(
        self,
        texts: TextGraphs | LabelGraphs,
        text: int,
        places: PlaceGraphs | LabelGraphs,
        rows: Rows,
        words: WordFits | None = None,
        vectors: Floats | None = None,
        encoded: EncodedGraphs | None = None,
    ) -> MatchScores:
        """Match one text with places `rows` (K,), all at once (Eq. 14-17).

        `words` are the weights of words of the places for the nodes of all texts, which the network as
        printed does without; `encoded` are these places, if they were encoded before.
        """
        vectors = self.word_vectors(places.vocabulary) if vectors is None else vectors
        rows = np.asarray(rows, np.int64)
        if not len(rows):
            return MatchScores(*(np.zeros((4, 0), np.float32)))
        encoded_text = self.encode_texts(texts, np.array([text]))
        encoded_places = encoded or self.encode_places(places, rows, vectors)
        pairs = _pair(texts, text, places, rows, words, encoded_places)
        t, m = np.tile(encoded_text.nodes, (len(rows), 1)), encoded_places.nodes
        total = np.zeros((len(rows), 2), np.float32)
        for layer in range(self.shape.crossings):
            t, m, verdict = self._cross(f"cross.{layer}", t, m, pairs)
            total += verdict
        pools = ("graph.pool",) * 2 if self.shape.printed else ("pool_text", "pool_place")
        e_t = self._pool(pools[0], t, pairs.t_starts)
        e_m = self._pool(pools[1], m, pairs.m_starts)
        both = [e_t, e_m] if self.shape.printed else [e_t, e_m, e_t * e_m]
        hidden = self._linear("judge.0", np.column_stack(both))
        logit = self._linear("judge.2", np.maximum(hidden, 0.0))[:, 0]
        lengths = np.linalg.norm(e_t, axis=1) * np.linalg.norm(e_m, axis=1)
        cosine = (e_t * e_m).sum(axis=1) / np.maximum(lengths, 1e-5)
        if not self.shape.printed:
            literal = kernels.sum_literal_scores(
                pairs.agreement, pairs.t_starts, pairs.m_starts, pairs.relations, pairs.ends,
                pairs.inputs, pairs.bounds,
            )  # fmt: skip
            logit = self.arrays["prior"][0] * literal + total[:, 0] + logit
        embedding = encoded_places.embeddings @ encoded_text.embeddings[0]
        return MatchScores(logit, cosine, embedding, total[:, 1])

    def _cross(
        self, name: str, t: Floats, m: Floats, pairs: _Pairs
    ) -> tuple[Floats, Floats, Floats | float]:
        """Apply cross attention both ways; also return the scores (K, 2) of the statements."""
        if self.shape.printed:  # neither word fits nor a node for "nothing"
            word = np.zeros((2, self.shape.heads), np.float32)
            nothing = word + NEVER
        else:
            word, nothing = self.arrays[f"{name}.word"], self.arrays[f"{name}.nothing"]
        seen, meant, weights = kernels.cross_attention(
            (self._linear(f"{name}.query", t), self._linear(f"{name}.key", m)),
            (self._linear(f"{name}.of_place", m), self._linear(f"{name}.of_text", t)),
            pairs.t_starts, pairs.m_starts, pairs.agreement, word, nothing, self.shape.heads,
        )  # fmt: skip
        printed = self.shape.printed
        messages, verdict = (0.0, 0.0) if printed else self._score_statements(name, weights, pairs)
        t = self._norm(f"{name}.norm_text", t + self._linear(f"{name}.out_text", seen) + messages)
        m = self._norm(f"{name}.norm_place", m + self._linear(f"{name}.out_place", meant))
        t, m = self._feed(f"{name}.feed_text", t), self._feed(f"{name}.feed_place", m)
        return t, m, verdict

    def _score_statements(self, name: str, weights: Floats, pairs: _Pairs) -> tuple[Floats, Floats]:
        """Return the messages of statements to their ends (N, d), and the sums of their scores (K, 2)."""
        features = kernels.evaluate_statements(
            weights, pairs.agreement, pairs.t_starts, pairs.m_starts, pairs.relations,
            pairs.ends, pairs.inputs, pairs.bounds,
        )  # fmt: skip
        evidence = self._linear(f"{name}.evidence", np.column_stack([features, pairs.inputs]))
        evidence = np.maximum(evidence, 0.0)
        verdict = self._linear(f"{name}.verdict", evidence).reshape(len(pairs.bounds) - 1, -1, 2)
        messages = kernels.scatter_to_ends(
            self._linear(f"{name}.said", evidence), pairs.ends, pairs.bounds, pairs.t_starts
        )
        return messages, verdict.sum(axis=1)

    def _encode(self, side: str, batch: GraphBatch, vectors: Floats) -> EncodedGraphs:
        """Apply GPS layers: messages along labelled edges plus attention to the whole graph."""
        b, size = batch.mask.shape
        at = np.flatnonzero(batch.mask.reshape(-1))
        starts = np.concatenate(([0], np.cumsum(batch.mask.sum(axis=1)))).astype(np.int64)
        words = np.zeros((b * size, self.shape.width), np.float32)
        if len(batch.words.at):
            rows = vectors[batch.words.words] * batch.words.weights[:, None]
            words[batch.words.at] = np.add.reduceat(rows, batch.words.starts, axis=0)
        x = words[at]
        if batch.nodes.shape[2]:
            nodes = batch.nodes.reshape(b * size, -1)[at]
            x = x + self._linear(f"{side}.features", nodes)
        x = self._norm(f"{side}.norm", x)
        for layer in range(self.shape.layers):
            name = f"{side}.layers.{layer}"
            messages = kernels.pass_messages(
                self._linear(f"{name}.message", x), starts, batch.relations
            )
            seen = kernels.self_attention(self._linear(f"{name}.qkv", x), starts, self.shape.heads)
            x = self._norm(
                f"{name}.norm",
                x + self._linear(f"{name}.along", messages) + self._linear(f"{name}.out", seen),
            )
            x = self._feed(f"{name}.feed", x)
        pooled = self._pool(f"{side}.pool", x, starts)
        length = np.maximum(np.linalg.norm(pooled, axis=1, keepdims=True), 1e-12)
        return EncodedGraphs(x, starts, pooled / length, batch.relations)

    def _linear(self, name: str, x: NDArray[np.floating[Any]]) -> Floats:
        y = multiply_matrices(x, self.arrays[f"{name}.weight"].T)
        if f"{name}.bias" in self.arrays:
            y += self.arrays[f"{name}.bias"]
        return np.asarray(y, np.float32)

    def _norm(self, name: str, x: Floats) -> Floats:
        x = x - x.mean(axis=1, keepdims=True)
        x /= np.sqrt((x * x).mean(axis=1, keepdims=True) + 1e-5)
        x *= self.arrays[f"{name}.weight"]
        return np.asarray(x + self.arrays[f"{name}.bias"], np.float32)

    def _feed(self, name: str, x: Floats) -> Floats:
        hidden = np.maximum(self._linear(f"{name}.up", x), 0.0)
        return self._norm(f"{name}.norm", x + self._linear(f"{name}.down", hidden))

    def _pool(self, name: str, x: Floats, starts: NDArray[np.int64]) -> Floats:
        """Pool the nodes of each graph by a gated sum, projected."""
        gate = 1.0 / (1.0 + np.exp(-self._linear(f"{name}.gate", x)))
        total = np.add.reduceat(gate * x, starts[:-1], axis=0)
        return self._linear(f"{name}.out", total / np.sqrt(np.diff(starts))[:, None])


@dataclass(frozen=True, eq=False)
class EncodedCity:
    """City encoded by a network; everything is computed on first use."""

    city: City
    network: GraphTransformer

    @classmethod
    def of_city(cls, city: City, *, printed: bool = False) -> Self:
        """Encode a city by a network that comes with placegraph: ours, or the one that GOTLoc prints."""
        return cls(city, GraphTransformer.default(printed=printed))

    @property
    def printed(self) -> bool:
        """Whether the network is the one that GOTLoc prints."""
        return self.network.shape.printed

    @cached_property
    def words(self) -> NDArray[np.float32]:
        """Vectors (T, d) of `city.words`, or of the labels of `cells` if `printed`."""
        return self.network.word_vectors(self.cells.vocabulary if self.printed else self.city.words)

    @cached_property
    def cells(self) -> PlaceGraphs | LabelGraphs:
        """Graphs of all cells, rows as `city.cells.points`."""
        return (LabelGraphs if self.printed else PlaceGraphs).of_cells(self.city)

    @cached_property
    def embeddings(self) -> NDArray[np.float32]:
        """Embeddings (C, D) of all cells (Eq. 10), rows as `city.cells.points`."""
        return self.network.embed_places(self.cells, self.words)

    @cached_property
    def origin(self) -> Origin:
        """Map and network of the embeddings."""
        return Origin(self.city.digest, self.network.digest)

    @cached_property
    def store(self) -> VectorStore:
        """Store of the embeddings, in memory."""
        return EmbeddedStore.of_rows(self._rows(), origin=self.origin)

    def save_embeddings(
        self,
        where: Address,
        *,
        name: str,
        bits: int = 16,
        resume: bool = False,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> VectorStore:
        """Embed the cells and save the vectors in a store; for arguments and errors see `load_store`."""
        if progress is not None:
            progress("embedding", 0, len(self.city.cells))
        return load_store(
            where, self._rows(), name=name, origin=self.origin,
            bits=bits, resume=resume, progress=progress,
        )  # fmt: skip

    def _rows(self) -> Vectors:
        cells = self.city.cells
        return Vectors.of(cells.points, self.embeddings, cells.lonlat)

    def text(self, query: Query) -> EncodedText:
        """Encode a query for the network."""
        # each statement once: repetition makes it no surer
        statements = (*query.used, *(statement for statement, _ in query.unused))
        description = replace(query.description, statements=statements)
        if self.printed:
            return EncodedText(LabelGraphs.of_texts([description]), None)
        texts = TextGraphs.of([description])
        fits = find_word_weights(texts, [query])
        counts, total = self.city.word_counts
        return EncodedText(texts, make_word_fits(fits, counts, total))

    def match(
        self, text: EncodedText, places: PlaceGraphs | LabelGraphs, rows: NDArray[np.int64]
    ) -> MatchScores:
        """Match a text with places of this city (Eq. 14-17), some at a time: large cells take memory."""
        found = [
            self.network.match(
                text.graphs, 0, places, rows[at : at + BATCH_SIZE], text.words, self.words
            )
            for at in range(0, max(1, len(rows)), BATCH_SIZE)
        ]
        return MatchScores(*map(np.concatenate, zip(*found, strict=True)))


@dataclass(frozen=True, eq=False)
class EncodedText:
    """Query as input of a network."""

    graphs: TextGraphs | LabelGraphs
    """Graph of the text."""
    words: WordFits | None
    """Weights of the map's words for its nodes; the network as printed has none."""
