"""Sizes and weights of the network, and weights files: numbers in 16 bits, with checksums."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.resources import as_file, files
from os import PathLike
from pathlib import Path
from typing import Any

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
from placegraph.core.weights import hash_weights, read_arrays, round_to_float16, to_float16
from placegraph.errors import InputError, MapError, OptionError
from placegraph.outdoor.map.directions_kernels import WINDS
from placegraph.outdoor.network.graphs import WordVectors
from placegraph.outdoor.network.network_kernels import (
    BUCKETS,
    CHANNELS,
    LITERAL,
    LONGEST,
    MAX_OBJECTS,
    REACH,
    SHORTEST,
)

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
