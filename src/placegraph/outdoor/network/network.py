"""Network in NumPy: graph embeddings (Eq. 9-10), joint matching (Eq. 14-17), and weights files.

Equations and names of weights are those of the PyTorch network of `placegraph_learn`; a test compares
the two. Weights files hold the sizes of a network and its numbers in 16 bits, with checksums.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, lru_cache
from importlib.resources import as_file, files
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.mapfile import (
    CONTENT_ERRORS,
    MapFile,
    pack_strings,
    read_header,
    read_map,
    write_map,
)
from placegraph.core.options import check_options, option
from placegraph.core.threads import multiply_matrices
from placegraph.core.weights import hash_weights, read_arrays, round_to_float16, to_float16
from placegraph.errors import InputError, MapError, OptionError
from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.directions_kernels import WINDS
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
from placegraph.outdoor.network.network_kernels import (
    BUCKETS,
    CHANNELS,
    LITERAL,
    LONGEST,
    MAX_OBJECTS,
    REACH,
    SHORTEST,
)
from placegraph.vectors import EmbeddedStore, Origin, Vectors, VectorStore, load_store
from placegraph.vectors.stores import Address

NETWORK = "The network and its losses"


@dataclass(frozen=True)
class Shape:
    """Sizes of the network."""

    width: int = option(48, "Size of node states.", minimum=1, maximum=4096)
    dimension: int = option(64, "Size of graph embeddings.", minimum=1, maximum=4096)
    heads: int = option(
        4, "Heads of attention.", minimum=1, maximum=4096, flag="--heads", panel=NETWORK
    )
    layers: int = option(
        2, "GPS layers of each side.", maximum=4096, flag="--layers", panel=NETWORK
    )
    crossings: int = option(
        2, "Layers of cross attention; 0: none.", maximum=4096, flag="--crossings", panel=NETWORK
    )
    evidence: int = option(32, "Size of the evidence of a statement.", minimum=1, maximum=4096)
    subwords: float = option(
        1.0, "Length of the sum of a word's subwords, against 1 of the whole word.", maximum=4096
    )
    printed: bool = option(
        False,
        "Train the network that GOTLoc prints: graphs of labels and four directions, one encoder for "
        "text and place, cross attention, and a perceptron on both embeddings (Eq. 5-17).",
        repr=False,  # digests are of the repr
        flag="--printed/--no-printed",
        panel=NETWORK,
    )

    def __post_init__(self) -> None:
        check_options(self)
        if self.width % self.heads or self.width % 2:
            raise OptionError(
                f"The width {self.width} does not fit {self.heads} heads; choose an even "
                "multiple of the number of heads."
            )

    @property
    def sides(self) -> dict[str, int]:
        """Encoders, and the number of features of their nodes beside words; one if `printed`."""
        return {"graph": 0} if self.printed else {"text": 2, "place": 7}

    @property
    def channels(self) -> tuple[str, ...]:
        """Relations of two nodes that are told apart."""
        return WINDS if self.printed else CHANNELS

    def arrays(self) -> dict[str, tuple[int, ...]]:  # noqa: C901  # one line a weight
        """List the shape of every weight, by PyTorch's names."""
        d, out, e, heads = self.width, self.dimension, self.evidence, self.heads
        found: dict[str, tuple[int, ...]] = {"table": (BUCKETS, d)}

        def linear(name: str, to: int, of: int, *, bias: bool = True) -> None:
            found[f"{name}.weight"] = (to, of)
            if bias:
                found[f"{name}.bias"] = (to,)

        def norm(name: str) -> None:
            found[f"{name}.weight"] = found[f"{name}.bias"] = (d,)

        def feed(name: str) -> None:
            linear(f"{name}.up", 2 * d, d)
            linear(f"{name}.down", d, 2 * d)
            norm(f"{name}.norm")

        def pool(name: str) -> None:
            linear(f"{name}.gate", 1, d)
            linear(f"{name}.out", out, d)

        for side, features in self.sides.items():
            if features:
                linear(f"{side}.features", d, features)
            norm(f"{side}.norm")
            pool(f"{side}.pool")
            for i in range(self.layers):
                layer = f"{side}.layers.{i}"
                linear(f"{layer}.message", d // 2, d, bias=False)
                linear(f"{layer}.along", d, len(self.channels) * (d // 2))
                linear(f"{layer}.qkv", 3 * d, d, bias=False)
                linear(f"{layer}.out", d, d, bias=False)
                norm(f"{layer}.norm")
                feed(f"{layer}.feed")
        for i in range(self.crossings):
            layer = f"cross.{i}"
            for name in ("query", "key", "of_place", "of_text"):
                linear(f"{layer}.{name}", d, d, bias=False)
            for side in ("text", "place"):
                linear(f"{layer}.out_{side}", d, d)
                norm(f"{layer}.norm_{side}")
                feed(f"{layer}.feed_{side}")
            if not self.printed:
                found[f"{layer}.nothing"] = found[f"{layer}.word"] = (2, heads)
                linear(f"{layer}.evidence", e, 3 * heads + LITERAL + len(CHANNELS) + 3)
                linear(f"{layer}.said", 2 * d, e, bias=False)
                linear(f"{layer}.verdict", 2, e, bias=False)
        linear("judge.0", out, (2 if self.printed else 3) * out)
        linear("judge.2", 1, out)
        if not self.printed:
            pool("pool_text")
            pool("pool_place")
            found["prior"] = (3,)
        return found

    def to_dict(self) -> dict[str, float]:
        """Return plain numbers."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: dict[str, float]) -> Shape:
        """Make a shape of plain numbers; raises `TypeError` or `ValueError` where they are none."""
        kinds, plain = {"subwords": float, "printed": bool}, dict(plain)
        if not plain.pop("statements", True):
            raise ValueError("statements is false, which `printed` replaced")
        return cls(**{k: kinds.get(k, int)(v) for k, v in plain.items()})  # type: ignore[arg-type]


KIND = "graph-transformer"
VERSION = 1
LABELS = {"buckets": BUCKETS, "subwords": [SHORTEST, LONGEST]}
"""Hashing of words to rows of the table; weights belong to one."""
GRAPHS = {"channels": list(CHANNELS), "reach": REACH, "things": MAX_OBJECTS}
PRINTED_GRAPHS = {"channels": list(WINDS)}
"""Construction of graphs, and as printed; weights belong to one."""
WORDS, VECTORS, MEANING = "words", "word_vectors", "meaning.weight"
"""Columns of a network with word vectors: the words, their vectors, and the map (d, n) of these."""


@dataclass(frozen=True, eq=False)
class Weights:
    """A trained network."""

    shape: Shape
    arrays: dict[str, NDArray[np.float32]]
    training: dict[str, Any]
    """Record of the training: cities, examples, seed, last losses."""
    words: WordVectors | None = None
    """Word vectors of the training, if any."""

    @property
    def digest(self) -> str:
        """Digest of shape, weights and word vectors: 16 hexadecimal digits."""
        if self.words is None:
            return hash_weights(self.shape, self.arrays)[:16]
        arrays = self.arrays | {VECTORS: self.words.vectors}
        return hash_weights((self.shape, self.words.words), arrays)[:16]


def list_weight_shapes(shape: Shape, words: WordVectors | None) -> dict[str, tuple[int, ...]]:
    """List the shapes of all weights that are learned."""
    of_words = {} if words is None else {MEANING: (shape.width, words.vectors.shape[1])}
    return shape.arrays() | of_words


def _labels(words: int) -> dict[str, Any]:
    return LABELS | {"word_vectors": words} if words else LABELS


def write_weights(path: str | PathLike[str], weights: Weights) -> None:
    """Write a weights file, atomically; raises `MapError` where it cannot be written."""
    meta = {
        "shape": weights.shape.to_dict(),
        "labels": _labels(0 if weights.words is None else len(weights.words.words)),
        "graphs": PRINTED_GRAPHS if weights.shape.printed else GRAPHS,
        "training": weights.training,
    }
    arrays: dict[str, NDArray[Any]] = {**to_float16(weights.arrays)}
    if weights.words is not None:
        arrays |= to_float16({VECTORS: weights.words.vectors})
        arrays[WORDS] = pack_strings(weights.words.words)
    write_map(path, KIND, VERSION, meta, arrays)


def read_weights(path: str | PathLike[str]) -> Weights:
    """Read a weights file.

    Raises
    ------
    InputError
        There is no such file.
    MapError
        It is damaged, no weights file, of a newer version, or made with other labels or graphs.

    """
    file = _open_weights(path)
    known = file.strings(WORDS) if WORDS in file.arrays else ()
    graphs = PRINTED_GRAPHS if file.meta.get("graphs") == PRINTED_GRAPHS else GRAPHS
    for part, here in (("labels", _labels(len(known))), ("graphs", graphs)):
        if file.meta.get(part) != here:
            raise MapError(
                f"{path}: the network was trained with different {part} ({file.meta.get(part)}) "
                f"from those of this version of placegraph ({here}). Train it again with "
                "`placegraph city train`."
            )
    try:
        shape = Shape.from_dict(file.meta["shape"])
        words = None
        if known:
            vectors = read_arrays(file, {VECTORS: (0, 0)})[VECTORS]
            if len(vectors) != len(known):
                raise ValueError(f"{len(known)} words with {len(vectors)} vectors")
            words = WordVectors(known, vectors)
        arrays = read_arrays(file, list_weight_shapes(shape, words))
        return Weights(shape, arrays, dict(file.meta["training"]), words)
    except MapError as error:
        why = str(error).removeprefix(f"{path}: ").partition("; ")[0]
        raise MapError(f"{path}: {why}; train or install the weights again.") from error
    except CONTENT_ERRORS as error:
        raise MapError(
            f"{path}: its weights do not fit together ({error}). Train or install them again."
        ) from error


def _open_weights(path: str | PathLike[str]) -> MapFile:
    """Read a weights file as a map file; errors are about weights."""
    mend = "train one with `placegraph city train`, or use the one that comes with placegraph."
    try:
        header = read_header(path)
        file = read_map(path, header.kind, header.version)
    except InputError as error:
        why = (
            "does not exist" if isinstance(error.__cause__, FileNotFoundError) else "cannot be read"
        )
        raise InputError(f"{path}: this weights file {why}; {mend}") from error
    except MapError as error:
        why = str(error).removeprefix(f"{path} ").partition("; ")[0].partition(". ")[0]
        raise MapError(f"{path}, as a weights file, {why}; {mend}") from error
    if header.kind != KIND:
        raise MapError(f"{path} is a {header.kind} map, not a weights file; {mend}")
    if header.version > VERSION:
        raise MapError(
            f"{path} is a weights file of version {header.version}, but this placegraph "
            f"reads up to {VERSION}; update placegraph, or train again with this version."
        )
    return file


def find_shipped_weights(*, printed: bool = False) -> Path:
    """Return the path of the weights that come with placegraph: ours, or of the network as printed."""
    name = "printed.weights" if printed else "city.weights"
    with as_file(files("placegraph.outdoor.network") / "data" / name) as path:
        return Path(path)


def round_weights(
    shape: Shape,
    state: Mapping[str, NDArray[Any]],
    training: dict[str, Any],
    words: WordVectors | None = None,
) -> Weights:
    """Make weights, rounded to 16 bits as files have them."""
    return Weights(
        shape, round_to_float16(list_weight_shapes(shape, words), state), training, words
    )


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
