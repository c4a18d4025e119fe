"""A library of thousands of scenes: what searching it takes, and whether the right one is found.

There are not so many homes on the disk: further scenes are variations of those there are. In each a
share of the objects look like, or are called as, objects of other homes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.evaluate.scene_retrieval import kilobytes, library_of
from placegraph.geometry import rotation_z
from placegraph.indoor.library.options import SearchOptions
from placegraph.indoor.library.signature import TURNS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from placegraph.evaluate.scene_retrieval_vectors import Encoded, Replay
    from placegraph.indoor.library.signature import Signature

SCENES = 10_000
VARIED = 0.5
"""Share of a variation's objects that are exchanged."""
MOVED = 0.2
"""Standard deviation of where its objects are [m]."""
LENGTHS = (1, 10, 25)


@dataclass(frozen=True)
class Scale:
    """One line of the table."""

    encoder: str
    scenes: int
    objects: float
    """Of a scene."""
    frames: int
    milliseconds: float
    """Of searching with the frames encoded; the median."""
    recall: float
    """At 1, of scenes beside which there are many like them."""
    kilobytes: float
    """Of a scene in the library's file."""


def varied(
    signatures: Mapping[str, Signature], key: str, count: int, rng: np.random.Generator
) -> dict[str, Signature]:
    """Further scenes by name: like those there are, but turned, and a share of their objects others."""
    known = list(signatures.values())
    stock = np.concatenate([s.vectors[key] for s in known])
    labels = [label for s in known for label in s.graph.labels]
    found = {}
    for i in range(count):
        base = turned(known[int(rng.integers(len(known)))], key, rng)
        vectors, named = base.vectors[key].copy(), list(base.graph.labels)
        rows = np.flatnonzero(rng.random(len(base)) < VARIED)
        others = rng.integers(len(stock), size=len(rows))
        vectors[rows] = stock[others]
        for row, other in zip(rows.tolist(), others.tolist(), strict=True):
            named[row] = labels[other]
        found[f"variation {i + 1}"] = replace(
            base, graph=replace(base.graph, labels=tuple(named)), vectors={key: vectors}
        )
    return found


def turned(signature: Signature, key: str, rng: np.random.Generator) -> Signature:
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
        vectors={key: signature.vectors[key][order]},
        share=signature.share[order],
        places=places.astype(np.float32),
        panoramas=np.roll(
            rank[signature.panoramas].astype(np.uint16), quarters * TURNS // 4, axis=2
        ),
    )


def measure(
    row: str,
    signatures: Mapping[str, Signature],
    replay: Replay,
    walks: Sequence[Encoded],
    rng: np.random.Generator,
    *,
    scenes: int = SCENES,
    queries: int = 20,
) -> list[Scale]:
    """Search a library of so many scenes with the first frames of some walks."""
    more = varied(signatures, replay.key, scenes - len(signatures), rng)
    library = library_of({**signatures, **more}, replay)
    objects = float(np.mean([len(library.entry(name).signature) for name in library]))
    size = kilobytes(library)
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
                float(np.mean(right)), size,
            )
        )  # fmt: skip
    return found
