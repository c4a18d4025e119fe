"""A library of thousands of scenes: what searching it takes, and whether the right one is found.

There are not so many homes on the disk: further scenes are variations of those there are. In each a
share of the objects look like, or are called as, objects of other homes; no two of them look
exactly alike (`APART`).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import rotation_z
from placegraph.indoor.encode import Encoder
from placegraph.indoor.library.search import SearchOptions
from placegraph.indoor.library.signature import TURNS, Signature
from placegraph_lab.tables.retrieval.retrieval import library_of

if TYPE_CHECKING:
    from placegraph_lab.tables.retrieval.retrieval_vectors import Encoded

SCENES = 10_000
VARIED = 0.5  # share of a variation's objects that are exchanged
MOVED = 0.2  # standard deviation of where its objects are [m]
APART = 0.2
"""Length of what is added to each vector of what things look like; the vectors of labels are few by
nature, and stay."""
LENGTHS = (1, 10, 25)


@dataclass(frozen=True)
class Scale:
    """One line of the table."""

    encoder: str
    scenes: int
    objects: float  # of a scene
    frames: int
    milliseconds: float  # of searching with the frames encoded; the median
    recall: float  # at 1, of scenes beside which there are many like them
    vectors: tuple[int, ...]  # distinct ones of the library, by encoder


def varied(
    signatures: Mapping[str, Signature], count: int, rng: np.random.Generator
) -> dict[str, Signature]:
    """Further scenes by name: like those there are, but turned, and a share of their objects others."""
    known = list(signatures.values())
    stock = Stock.of(known)
    return {
        f"variation {i + 1}": stock.variation(known[int(rng.integers(len(known)))], rng)
        for i in range(count)
    }


@dataclass(frozen=True)
class Stock:
    """All objects of some scenes, to be exchanged for those of others."""

    labels: tuple[str, ...]  # (M,)
    vectors: Mapping[str, NDArray[np.float32]]  # (M, d) by the key of the encoder

    @classmethod
    def of(cls, signatures: Sequence[Signature]) -> Stock:
        """Objects of these."""
        keys = signatures[0].vectors
        return cls(
            tuple(label for s in signatures for label in s.graph.labels),
            {key: np.concatenate([s.vectors[key] for s in signatures]) for key in keys},
        )

    def variation(self, signature: Signature, rng: np.random.Generator) -> Signature:
        """A scene like this, but turned, and a share of its objects others."""
        base = turned(signature, rng)
        named = list(base.graph.labels)
        rows = np.flatnonzero(rng.random(len(base)) < VARIED)
        others = rng.integers(len(self.labels), size=len(rows))
        vectors = {}
        for key, own in base.vectors.items():
            own[rows] = self.vectors[key][others]
            vectors[key] = own if key.startswith("labels") else _astray(own, rng)
        for row, other in zip(rows.tolist(), others.tolist(), strict=True):
            named[row] = self.labels[other]
        graph = replace(base.graph, labels=tuple(named))
        return replace(base, graph=graph, vectors=vectors)


def _astray(vectors: NDArray[np.float32], rng: np.random.Generator) -> NDArray[np.float32]:
    """Unit vectors (N, d) near these; what is zero stays."""
    size = APART / np.sqrt(vectors.shape[1])
    moved = vectors + rng.normal(0.0, size, vectors.shape) * vectors.any(axis=1, keepdims=True)
    lengths = np.linalg.norm(moved, axis=1, keepdims=True)
    return (moved / np.maximum(lengths, 1e-9)).astype(np.float32)


def turned(signature: Signature, rng: np.random.Generator) -> Signature:
    """Signature of the same scene turned by a quarter or more, its objects moved and in any order.

    A library's file that holds both can then not save what they have in common.
    """
    quarters, count, graph = int(rng.integers(4)), len(signature), signature.graph
    rotation = np.round(rotation_z(quarters * np.pi / 2))
    order = rng.permutation(count)
    rank = np.empty(count + 1, np.int64)
    rank[order], rank[count] = np.arange(count), count
    positions = graph.positions @ rotation.T + rng.normal(0.0, MOVED, (count, 3))
    extents = None if graph.extents is None else np.abs(graph.extents @ rotation.T)[order]
    places = signature.places @ rotation[:2, :2].T
    return replace(
        signature,
        graph=replace(
            graph,
            ids=tuple(graph.ids[k] for k in order),
            labels=tuple(graph.labels[k] for k in order),
            names=tuple(graph.names[k] for k in order),
            positions=positions[order],
            extents=extents,
            sources=rank[graph.sources],
            targets=rank[graph.targets],
        ),
        attributes=tuple(signature.attributes[k] for k in order),
        vectors={key: v[order] for key, v in signature.vectors.items()},
        part=signature.part[order],
        share=signature.share[order],
        places=places.astype(np.float32),
        panoramas=np.roll(
            rank[signature.panoramas].astype(np.uint16), quarters * TURNS // 4, axis=2
        ),
    )


def measure(
    row: str,
    signatures: Mapping[str, Signature],
    encoders: Sequence[Encoder],
    walks: Sequence[Encoded],
    rng: np.random.Generator,
    *,
    scenes: int = SCENES,
    queries: int = 20,
) -> list[Scale]:
    """Search a library of so many scenes with the first frames of some walks."""
    keys = [e.key for e in encoders]
    own = {
        name: replace(s, vectors={key: s.vectors[key] for key in keys})
        for name, s in signatures.items()
    }
    library = library_of({**own, **varied(own, scenes - len(own), rng)}, encoders)
    objects = float(np.mean([len(library.entry(name).signature) for name in library]))
    distinct = tuple(len(library.index.vocabularies[key].vectors) for key in keys)
    found = []
    chosen = [walks[i].walk for i in rng.permutation(len(walks))[:queries]]
    for length in LENGTHS:
        asked = [w for w in chosen if len(w.capture) >= length]
        if not asked:
            continue
        library.search(asked[0].capture[:length])  # columns are made, compiled code is loaded
        spent, right = [], []
        for walk in asked:
            start = time.perf_counter()
            estimate = library.search(walk.capture[:length], options=SearchOptions())
            spent.append(1e3 * (time.perf_counter() - start))
            right.append(estimate.best is not None and estimate.best.scene == walk.place)
        found.append(
            Scale(
                row, len(library), objects, length, float(np.median(spent)),
                float(np.mean(right)), distinct,
            )
        )  # fmt: skip
    return found
