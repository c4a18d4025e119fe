"""Matchers of cells by one protocol: a query graph goes in, a score for every cell comes out."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.graph import SceneGraph
from placegraph.outdoor.language.description import SPEAKER, Description, Relation
from placegraph.outdoor.map.objects import of_name
from placegraph.outdoor.network.graphs import PlaceGraphs
from placegraph.outdoor.network.network_kernels import MOST_THINGS
from placegraph_lab.tables.outdoor.nearby import DIRECTIONS as WINDS
from placegraph_lab.tables.outdoor.nearby import relations


def places_of_graphs(graphs: Sequence[SceneGraph], centers: NDArray[np.float64]) -> PlaceGraphs:
    """Graphs of any scene graphs with positions in a plane, around `centers` (K, 2) [m]."""
    rows: dict[str, int] = {}
    offsets, words, starts = [], [], [0]
    for graph, center in zip(graphs, centers, strict=True):
        off = graph.positions[:, :2] - center
        nearest = np.argsort(np.hypot(*off.T), kind="stable")[:MOST_THINGS]
        offsets.append(off[nearest])
        for i in nearest:
            called = [graph.labels[i]]
            called += [of_name(graph.names[i])] if graph.names[i] else []
            words.append([rows.setdefault(word, len(rows)) for word in called])
        starts.append(len(words))
    flat = [word for thing in words for word in thing]
    return PlaceGraphs(
        np.array(starts, np.int64),
        np.concatenate([np.zeros((0, 2)), *offsets]).astype(np.float32),
        np.zeros(len(words), np.uint8),
        np.concatenate(([0], np.cumsum([len(thing) for thing in words]))).astype(np.int64),
        np.array(flat, np.int32),
        np.ones(len(flat), np.float32),
        tuple(rows),
    )


Word = tuple[str, str, str]
HERE = "<speaker>"  # stands for the speaker in a word of a bag; no label is called so


class Matcher(Protocol):
    """Scores K cells, the larger the better; -inf where it did not look."""

    def scores(self, description: Description) -> Floats:
        """Score (K,) of every cell."""


@dataclass(frozen=True, eq=False)
class TripleBag:
    """The bare baseline: words (label, relation, label), weighted by how few cells hold them.

    What is said of the speaker is compared with the directions from a cell's centre.
    """

    rows: dict[Word, Any]  # cells that hold a word, as an array
    idf: dict[Word, float]
    tie_breaks: Floats  # (K,) below every weight; equals are ranked by them

    @classmethod
    def of(
        cls, graphs: Sequence[SceneGraph], centers: Floats, rng: np.random.Generator
    ) -> TripleBag:
        """Fill the bags of K scene graphs around centres (K, 2) [m]."""
        found: dict[Word, list[int]] = defaultdict(list)
        for k, (graph, center) in enumerate(zip(graphs, centers, strict=True)):
            for word in {*graph.triples(), *_from_here(graph, center)}:
                found[word].append(k)
        rows = {word: np.array(cells) for word, cells in found.items()}
        idf = {word: float(np.log(len(graphs) / len(cells))) for word, cells in rows.items()}
        return cls(rows, idf, 1e-9 * rng.random(len(graphs)))

    def scores(self, description: Description) -> Floats:
        """Sum (K,) of the weights of the words that a cell holds."""
        total = self.tie_breaks.copy()
        for word in set(_spoken(description)):
            if word in self.rows:
                total[self.rows[word]] += self.idf[word]
        return total


def _from_here(graph: SceneGraph, center: Floats) -> Iterator[Word]:
    """Where a cell's centre lies, seen from its things; and that they are there."""
    for label, delta in zip(graph.labels, center - graph.positions[:, :2], strict=True):
        yield HERE, WINDS[int(relations(delta))], label
        yield HERE, "by", label


def _spoken(description: Description) -> Iterator[Word]:
    called = {m.id: m.senses[0].label if m.senses else m.words for m in description.mentions}
    called[SPEAKER] = HERE
    for s in description.statements:
        if s.relation is Relation.DIRECTION and s.bearing is not None:
            delta = (np.sin(s.bearing), np.cos(s.bearing))
            yield called[s.source], WINDS[int(relations(delta))], called[s.target]
        elif s.source == SPEAKER:
            yield HERE, "by", called[s.target]


@dataclass(frozen=True, eq=False)
class EditDistance:
    """The rules of the paper: minus the edit distance, of the first candidates of another matcher."""

    graphs: Sequence[SceneGraph]
    centers: (
        Floats | None
    )  # (K, 2) [m]: the speaker stands there. Without them the speaker is left out.
    first: Matcher
    candidates: int = 20
    timeout: float = 0.1
    plain: bool = False  # every edit costs 1, as in the paper

    def scores(self, description: Description) -> Floats:
        """Minus the distance (K,); equals in the order of the first matcher."""
        from placegraph.outdoor.search.edit_distance import rank

        before = self.first.scores(description)
        chosen = np.argsort(-before, kind="stable")[: self.candidates]
        centers = None if self.centers is None else self.centers[chosen]
        graphs = [self.graphs[k] for k in chosen]
        found = rank(description, graphs, centers=centers, timeout=self.timeout, plain=self.plain)
        total = np.full(len(self.graphs), -np.inf)
        total[chosen[found.rows]] = -found.costs
        return total


@dataclass(frozen=True, eq=False)
class Transformer:
    """The joint network (Eq. 9-17): log odds of the candidates nearest by embedding."""

    graphs: Sequence[SceneGraph]
    centers: Floats  # (K, 2) [m]
    network: Any  # A `GraphTransformer`
    candidates: int | None = None  # how many are looked at closely; all where None

    @cached_property
    def places(self) -> Any:  # noqa: ANN401  # `PlaceGraphs`
        """The cells as the network reads them."""
        return places_of_graphs(self.graphs, self.centers)

    @cached_property
    def embeddings(self) -> Any:  # noqa: ANN401  # (K, D) float32
        """Of all cells."""
        return self.network.embed_places(self.places)

    @cached_property
    def vectors(self) -> Any:  # noqa: ANN401  # (T, d) float32
        """Of the cells' vocabulary."""
        return self.network.word_vectors(self.places.vocabulary)

    def scores(self, description: Description) -> Floats:
        """Log odds (K,) that a cell is meant."""
        from placegraph.outdoor.network.graphs import TextGraphs

        texts = TextGraphs.of([description])
        rows = np.arange(len(self.graphs))
        if self.candidates is not None and self.candidates < len(rows):
            cosine = self.embeddings @ self.network.embed_texts(texts)[0]
            rows = np.argsort(-cosine, kind="stable")[: self.candidates]
        total = np.full(len(self.graphs), -np.inf)
        words = self._fits(texts)
        total[rows] = self.network.match(texts, 0, self.places, rows, words, self.vectors).logit
        return total

    def _fits(self, texts: Any) -> Any:  # noqa: ANN401  # `TextGraphs`, `WordFits`
        """Which of the cells' words are a text's own: here both sides call things alike."""
        from placegraph.outdoor.network.graphs import Fits, word_fits

        own = {word: row for row, word in enumerate(self.places.vocabulary)}
        row = np.array([own.get(word, -1) for word in texts.vocabulary], np.int64)
        tokens = row[texts.words]
        known = tokens >= 0
        starts = np.concatenate(([0], np.cumsum(known)))[texts.word_starts]
        borne = np.bincount(self.places.words, minlength=len(own))
        fits = Fits(starts.astype(np.int64), tokens[known].astype(np.int32), texts.weights[known])
        return word_fits(fits, borne, len(self.places.offsets))
