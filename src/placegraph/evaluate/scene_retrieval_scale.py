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
from placegraph.indoor.library.options import SearchOptions

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from placegraph.evaluate.scene_retrieval_vectors import Encoded, Replay
    from placegraph.indoor.library.signature import Signature

SCENES = 10_000
VARIED = 0.3
"""Share of a variation's objects that are exchanged."""
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
    """Further scenes by name: like those there are, a share of their objects exchanged."""
    known = list(signatures.values())
    donors = [s for s in known if s.vectors[key].any()]
    stock = np.concatenate([s.vectors[key] for s in donors])
    labels = [label for s in donors for label in s.graph.labels]
    found = {}
    for i in range(count):
        base = known[int(rng.integers(len(known)))]
        vectors = base.vectors[key].copy()
        rows = np.flatnonzero(rng.random(len(base)) < VARIED)
        others = rng.integers(len(stock), size=len(rows))
        vectors[rows] = stock[others]
        named = list(base.graph.labels)
        for row, other in zip(rows.tolist(), others.tolist(), strict=True):
            named[row] = labels[other]
        found[f"variation {i + 1}"] = replace(
            base,
            graph=replace(base.graph, labels=tuple(named)),
            vectors={key: vectors},
        )
    return found


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
