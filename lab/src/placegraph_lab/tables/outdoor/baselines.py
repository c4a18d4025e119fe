"""Triples (label, relation, label) between the objects around viewpoints (Eq. 5-6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, LocalPlane
from placegraph_lab.tables.outdoor.nearby import (
    DIRECTIONS,
    Around,
    Bins,
    Triples,
    encode,
    relations,
)
from placegraph_lab.tables.outdoor.outdoor_kernels import SHORTEST
from placegraph_lab.tables.outdoor.places import Ints
from placegraph_lab.tables.outdoor.queries import Query

Words = Literal["labels", "triples", "speaker"]
"""Content of a bag: labels, triples of two objects, or triples of an object and the speaker."""

CELL = 50.0  # edge of a cell [m]


@dataclass(frozen=True)
class Bag:
    """Inverted index from words (labels, or triples as one integer) to the cells that hold them."""

    kind: Words
    plane: LocalPlane
    label_number: dict[str, int]
    centers: Floats  # (C, 2) centres of the cells that hold anything; east, north [m]
    words: Ints  # (W,) distinct words, rising
    starts: Ints  # (W + 1,) cells of a word
    cells: NDArray[np.int32]  # (P,)
    idf: Floats  # (W,) log(cells / cells that hold the word)
    tie_breaks: Floats
    """(C,) random numbers below every idf; cells that score the same are ranked by them."""

    @classmethod
    def of(
        cls,
        bins: Bins,
        kind: Words,
        *,
        reach: float = 50.0,
        longest: float = 50.0,
        names: bool = False,
        seed: int = 0,
        centers: Floats | None = None,
    ) -> Bag:
        """Fill the bags of all 50 m cells of a city.

        `reach`: objects this near to a cell's centre belong to it [m]. The published generator has
        50 m; 30 m fits the texts best; `longest`: objects up to this far apart make a triple [m];
        `names`: A thing's label is its name where it has one; `centers`: centres (C, 2) of other
        cells, east and north [m] in the plane of the raw city.
        """
        city = bins.city
        centers = bins.centers(CELL) if centers is None else centers
        around = bins.around(centers, reach)
        kept = np.flatnonzero(np.diff(around.starts))
        label = city.named if names else city.label
        cell, word = words_around(kind, centers, around, label, len(city.labels), longest)
        number = np.full(len(centers), -1)
        number[kept] = np.arange(len(kept))
        pairs = np.unique(np.stack([word, number[cell]]), axis=1)
        words, starts = np.unique(pairs[0], return_index=True)
        starts = np.append(starts, pairs.shape[1])
        return cls(
            kind=kind,
            plane=city.plane,
            label_number={name: i for i, name in enumerate(city.labels)},
            centers=centers[kept],
            words=words,
            starts=starts,
            cells=pairs[1].astype(np.int32),
            idf=np.log(len(kept) / np.diff(starts)),
            tie_breaks=1e-9 * np.random.default_rng(seed).random(len(kept)),
        )

    def scores(self, query: Query) -> Floats:
        """Sum (C,) of the idf of the query's words that a cell holds."""
        total = self.tie_breaks.copy()
        words = list_words(query, self.kind, self.label_number)
        at = np.searchsorted(self.words, words)
        held = at < len(self.words)
        held[held] = self.words[at[held]] == words[held]
        for i in at[held]:
            total[self.cells[self.starts[i] : self.starts[i + 1]]] += self.idf[i]
        return total

    def locate(self, query: Query, top: int = 5) -> Floats:
        """Centres (top, 2) of the best cells, best first; longitude, latitude [deg]."""
        scores = self.scores(query)
        best = np.argpartition(-scores, min(top, len(scores) - 1))[:top]
        return self.plane.to_lonlat(self.centers[best[np.argsort(-scores[best])]])


def list_words(query: Query, kind: Words, number: dict[str, int]) -> Ints:
    """Distinct words of a query, rising; `number` counts the labels."""
    if kind == "labels":
        ends = {end for s in query.statements for end in (s.source, s.target) if end}
        return np.unique([number[end] for end in ends])
    speaker = labels = len(number)
    return np.unique(
        [
            encode(
                number[s.source],
                DIRECTIONS.index(s.direction),
                number[s.target] if s.target else speaker,
                labels + 1,
            )
            for s in query.statements
        ]
    )


def words_around(
    kind: Words,
    centers: Floats,
    around: Around,
    label: NDArray[np.int32],
    labels: int,
    longest: float,
    *,
    same_label: bool = True,
) -> tuple[Ints, Ints]:
    """Row of `centers` (C, 2) and word of everything around them.

    `longest` is how far apart the objects of a triple may be [m]; without `same_label` those of
    one label make none.
    """
    cell = np.repeat(np.arange(len(centers)), np.diff(around.starts))
    if kind == "labels":
        return cell, label[around.objects].astype(np.int64)
    if kind == "speaker":
        delta = around.points - centers[cell]
        seen = np.hypot(*delta.T) >= SHORTEST
        return cell[seen], encode(
            label[around.objects[seen]], relations(delta[seen]), labels, labels + 1
        )
    triples = Triples.of(around, longest)
    cell = np.repeat(np.arange(len(centers)), np.diff(triples.starts))
    word = triples.codes(around, label, labels + 1)
    if same_label:
        return cell, word
    ends = label[around.objects]
    told = ends[triples.source] != ends[triples.target]
    return cell[told], word[told]
