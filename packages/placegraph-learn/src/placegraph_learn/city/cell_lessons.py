"""Examples for the network as GOTLoc prints it: texts, each with its cell and the other cells of a batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.outdoor.network.graphs import Rows, SubwordBags, WordVectors
from placegraph.outdoor.network.label_graphs import LabelGraphs
from placegraph.outdoor.network.network import GraphTransformer
from placegraph_learn.city.batches import Batch, PairBatch
from placegraph_learn.city.descriptions import Speaker
from placegraph_learn.city.network import Network

CANDIDATES = 10
"""Number of cells that embeddings propose (n of Eq. 12)."""


@dataclass(frozen=True, eq=False)
class CellLessons:
    """Graphs of Q texts, and of the cells that they may be about."""

    texts: LabelGraphs
    cells: LabelGraphs
    truth: Rows
    """(Q,) row of `cells` that a text is about."""
    subwords: float = 1.0
    """Weight of subwords of the network's `Shape`."""
    word_vectors: WordVectors | None = None
    """Word vectors that stand for the words they know."""

    @cached_property
    def text_bags(self) -> SubwordBags:
        """Parts of the labels of the texts."""
        return SubwordBags.of(self.texts.vocabulary, self.subwords, self.word_vectors)

    @cached_property
    def place_bags(self) -> SubwordBags:
        """Parts of the labels of the cells."""
        return SubwordBags.of(self.cells.vocabulary, self.subwords, self.word_vectors)

    def draw(self, n: int, share: float, rng: Generator) -> tuple[Rows, float]:
        """Draw rows (n,) of texts; `share` is of other networks' candidates."""
        return np.sort(rng.choice(len(self.texts), min(n, len(self.texts)), replace=False)), share

    def batch(self, rows: Rows, _: float = 1.0) -> Batch:
        """Pair all texts `rows` (Q,) with all of their cells: one is right, the others are wrong."""
        cells, own = np.unique(self.truth[rows], return_inverse=True)
        right = (own[:, None] == np.arange(len(cells))).astype(np.int64)
        text, place = (axis.ravel() for axis in np.indices(right.shape))
        none: Any = (np.zeros((len(text), 0), np.float32),) * (len(PairBatch._fields) - 2)
        return Batch(
            self.texts.batch(rows),
            self.cells.batch(cells),
            PairBatch(text, place, *none),
            place,
            right.ravel().astype(np.int8),
            right,
            np.full(len(text), np.nan, np.float32),
        )


def make_cell_lessons(
    speaker: Speaker, cells: LabelGraphs, n: int, rng: Generator, tick: Callable[[], None]
) -> CellLessons:
    """Make `n` examples of one city, of which `cells` are the graphs (`LabelGraphs.of_cells`)."""
    descriptions, truth = [], []
    for example in speaker.examples(rng):
        row = int(speaker.city.cells.rows_at(example.position[None])[0])
        if row >= 0:
            descriptions.append(example.description)
            truth.append(row)
            tick()
        if len(truth) == n:
            break
    return CellLessons(LabelGraphs.of_texts(descriptions), cells, np.array(truth, np.int64))


def cell_recalls(network: Network, held_out: Sequence[CellLessons]) -> dict[str, float]:
    """Return recall@1 of the texts' own cells among each other, mean over cities.

    ``dense`` is by the embeddings (Eq. 11), ``network`` the pipeline: ten candidates by embedding, ranked
    by the cosine of their joint embeddings (Eq. 12-16).
    """
    arrays = {name: p.detach().cpu().numpy() for name, p in network.named_parameters()}
    found = []
    for lessons in held_out:
        ours = GraphTransformer(network.shape, arrays, "", lessons.word_vectors)
        cells = np.unique(lessons.truth)
        vectors = ours.word_vectors(lessons.cells.vocabulary)
        encoded = ours.encode_places(lessons.cells, cells, vectors)
        cosine: NDArray[np.float32] = ours.embed_texts(lessons.texts) @ encoded.embeddings.T
        near = cells[np.argsort(-cosine, axis=1, kind="stable")[:, :CANDIDATES]]
        best = [
            rows[np.argmax(ours.match(lessons.texts, q, lessons.cells, rows, None, vectors).cosine)]
            for q, rows in enumerate(near)
        ]
        found.append([np.mean(near[:, 0] == lessons.truth), np.mean(best == lessons.truth)])
    return dict(zip(("dense", "network"), np.mean(found, axis=0).tolist(), strict=True))
