"""Weights files: sizes of a network and its numbers; 16 bits each, checksummed, no pickle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from importlib.resources import as_file, files
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.mapfile import (
    SENSELESS,
    MapFile,
    pack_strings,
    read_header,
    read_map,
    write_map,
)
from placegraph.core.networks import arrays_of, digest, halves, rounded
from placegraph.errors import InputError, MapError
from placegraph.outdoor.network.graphs import WordVectors
from placegraph.outdoor.network.network_kernels import (
    BUCKETS,
    CHANNELS,
    LITERAL,
    LONGEST,
    MOST_THINGS,
    REACH,
    SHORTEST,
)


@dataclass(frozen=True)
class Shape:
    """Sizes of the network."""

    width: int = 48
    """Of node states."""
    dimension: int = 64
    """Of graph embeddings."""
    heads: int = 4
    layers: int = 2
    """GPS layers of each side."""
    crossings: int = 2
    """Layers in which the two graphs see each other; 0 leaves the sides alone."""
    evidence: int = 32
    """Numbers by which a statement is judged."""
    subwords: float = 1.0
    """Length of what a word's subwords add together, against 1 of the whole word (`labels`)."""
    statements: bool = field(default=True, repr=False)  # the weights' names tell it in the print
    """Whether statements are judged by what their ends have found, beginning with what they say
    literally. Without, the joint model is the paper's: cross attention, and a perceptron on the two
    joint embeddings (Eq. 14-17)."""

    def arrays(self) -> dict[str, tuple[int, ...]]:  # noqa: C901  # one line a weight
        """Shape of every weight, by PyTorch's names."""
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

        for side, features in (("text", 2), ("place", 7)):
            linear(f"{side}.features", d, features)
            norm(f"{side}.norm")
            pool(f"{side}.pool")
            for i in range(self.layers):
                layer = f"{side}.layers.{i}"
                linear(f"{layer}.message", d // 2, d, bias=False)
                linear(f"{layer}.along", d, len(CHANNELS) * (d // 2))
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
            found[f"{layer}.nothing"] = found[f"{layer}.word"] = (2, heads)
            if self.statements:
                linear(f"{layer}.evidence", e, 3 * heads + LITERAL + len(CHANNELS) + 3)
                linear(f"{layer}.said", 2 * d, e, bias=False)
                linear(f"{layer}.verdict", 2, e, bias=False)
        pool("pool_text")
        pool("pool_place")
        linear("judge.0", out, (3 if self.statements else 2) * out)
        linear("judge.2", 1, out)
        found["prior"] = (3,)
        return found

    def to_dict(self) -> dict[str, float]:
        """Plain numbers."""
        return asdict(self)

    @classmethod
    def from_dict(cls, plain: dict[str, float]) -> Shape:
        """Undo `to_dict`; raises `TypeError` or `ValueError` where it is no shape."""
        kinds = {"subwords": float, "statements": bool}
        shape = cls(**{k: kinds.get(k, int)(v) for k, v in dict(plain).items()})  # type: ignore[arg-type]
        numbers = asdict(shape)
        del numbers["statements"]
        least = {"layers": 0, "crossings": 0, "subwords": 0.0}
        if any(not least.get(k, 1) <= v <= 4096 for k, v in numbers.items()):
            raise ValueError(f"sizes {numbers}")
        if shape.width % shape.heads or shape.width % 2:
            raise ValueError(f"width {shape.width} for {shape.heads} heads")
        return shape


KIND = "graph-transformer"
VERSION = 1
LABELS = {"buckets": BUCKETS, "subwords": [SHORTEST, LONGEST]}
"""How words become rows of the table; weights made otherwise mean something else."""
GRAPHS = {"channels": list(CHANNELS), "reach": REACH, "things": MOST_THINGS}
"""What graphs are made of."""
WORDS, VECTORS, MEANING = "words", "word_vectors", "meaning.weight"
"""Columns of a network with word vectors: the words, their vectors, and the map (d, n) of these."""


@dataclass(frozen=True, eq=False)
class Weights:
    """A trained network."""

    shape: Shape
    arrays: dict[str, NDArray[np.float32]]
    training: dict[str, Any]
    """How it was trained: cities, examples, seed, curves' last points."""
    words: WordVectors | None = None
    """Word vectors it was trained with."""

    @property
    def fingerprint(self) -> str:
        """Digest of shape, weights and word vectors: sixteen hexadecimal digits."""
        if self.words is None:
            return digest(self.shape, self.arrays)[:16]
        arrays = self.arrays | {VECTORS: self.words.vectors}
        return digest((self.shape, self.words.words), arrays)[:16]


def sizes(shape: Shape, words: WordVectors | None) -> dict[str, tuple[int, ...]]:
    """Shape of every weight that is learned."""
    of_words = {} if words is None else {MEANING: (shape.width, words.vectors.shape[1])}
    return shape.arrays() | of_words


def _labels(words: int) -> dict[str, Any]:
    return LABELS | {"word_vectors": words} if words else LABELS


def write_weights(path: str | PathLike[str], weights: Weights) -> None:
    """Write a weights file, atomically; raises `MapError` where it cannot be written."""
    meta = {
        "shape": weights.shape.to_dict(),
        "labels": _labels(0 if weights.words is None else len(weights.words.words)),
        "graphs": GRAPHS,
        "training": weights.training,
    }
    arrays: dict[str, NDArray[Any]] = {**halves(weights.arrays)}
    if weights.words is not None:
        arrays |= halves({VECTORS: weights.words.vectors})
        arrays[WORDS] = pack_strings(weights.words.words)
    write_map(path, KIND, VERSION, meta, arrays)


def read_weights(path: str | PathLike[str]) -> Weights:
    """Read a weights file.

    Raises
    ------
    InputError
        There is no such file.
    MapError
        It is damaged, none, of a newer version, or made with another label set or other graphs.

    """
    file = _open(path)
    known = file.strings(WORDS) if WORDS in file.arrays else ()
    for part, here in (("labels", _labels(len(known))), ("graphs", GRAPHS)):
        if file.meta.get(part) != here:
            raise MapError(
                f"{path}: the network was trained with other {part} ({file.meta.get(part)}) than "
                f"this version of placegraph has ({here}). Train it again by `placegraph city train`."
            )
    try:
        shape = Shape.from_dict(file.meta["shape"])
        words = _word_vectors(file, known) if known else None
        arrays = arrays_of(file, sizes(shape, words))
        return Weights(shape, arrays, dict(file.meta["training"]), words)
    except MapError as error:
        why = str(error).removeprefix(f"{path}: ").partition("; ")[0]
        raise MapError(f"{path}: {why}; train or install the weights again.") from error
    except SENSELESS as error:
        raise MapError(
            f"{path}: its weights do not fit together ({error}). Train or install them again."
        ) from error


def _word_vectors(file: MapFile, known: tuple[str, ...]) -> WordVectors:
    vectors = arrays_of(file, {VECTORS: (0, 0)})[VECTORS]
    if len(vectors) != len(known):
        raise ValueError(f"{len(known)} words with {len(vectors)} vectors")
    return WordVectors(known, vectors)


def _open(path: str | PathLike[str]) -> MapFile:
    """Columns of a weights file; errors speak of weights where the map reader speaks of maps."""
    mend = "train one by `placegraph city train`, or use the one that comes with placegraph."
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
            f"{path} is a weights file of version {header.version}, this placegraph reads up to "
            f"{VERSION}; update placegraph, or train again with this one."
        )
    return file


def shipped() -> Path:
    """Weights that come with placegraph."""
    with as_file(files("placegraph.outdoor.network") / "data" / "city.weights") as path:
        return Path(path)


def trained(
    shape: Shape,
    state: Mapping[str, NDArray[Any]],
    training: dict[str, Any],
    words: WordVectors | None = None,
) -> Weights:
    """Weights as they will be read again: rounded to 16 bits."""
    return Weights(shape, rounded(sizes(shape, words), state), training, words)
