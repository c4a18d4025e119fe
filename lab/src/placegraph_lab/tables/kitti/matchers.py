"""Relational matching on KITTI360Pose: what was said, held against what stands where.

A generative reading, as of the outdoor wing: viewpoints are laid over the cells, and a statement is
as likely as the share of what is in sight there that serves it. A cell's score is the likelihood of
all viewpoints whose nearest cell it is, and the pose within it is their mean, weighted by theirs.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import cos, sin
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.graph import SceneGraph
from placegraph.outdoor.language.description import (
    SPEAKER,
    Description,
    Mention,
    Relation,
    Statement,
)
from placegraph.outdoor.likelihood.match_kernels import DIRECTION, INSIDE
from placegraph.outdoor.map.directions_kernels import direction_table
from placegraph.outdoor.network.label_graphs import LabelGraphs
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.outdoor.search.edit_distance import rank
from placegraph_lab.datasets.kitti360pose import Kitti360Pose
from placegraph_lab.tables.kitti.kitti_kernels import (
    find_visible,
    from_speaker,
    nearest_owner,
    score_pairs,
)
from placegraph_lab.tables.outdoor.nearby import DIRECTIONS as WINDS
from placegraph_lab.tables.outdoor.nearby import relations

SPACING = 2.5  # distance of viewpoints [m]
REACH = 15.0  # objects up to this far are spoken of [m]: half a cell, as in the published texts
SLIP = 0.02  # share of stated directions that are simply wrong
NOISE = (
    0.15  # share of statements about things that the cell does not hold: it was cut out elsewhere
)
OTHER_COLOUR = 0.15
"""Fit of an object of the right kind whose part in this cell has another colour."""
CROWD = 5.0  # added to the number of things in sight, so that lonely places are not preferred
FLOOR = 1e-6


@dataclass(frozen=True, eq=False)
class Relational:
    """Scores the cells of a split against statements; the columns are those of K cells."""

    data: Kitti360Pose
    cells: NDArray[np.int64]  # (K,) rows of the data
    object_starts: NDArray[np.int64]  # (K + 1,) objects of a cell, counted within the split
    objects: NDArray[np.int64]  # (N,) rows of the data
    points: Floats  # (V, 2) viewpoints [m], sorted by their cell
    owner: NDArray[np.int64]  # (V,) the cell, one of K, whose centre is nearest
    starts: NDArray[np.int64]  # (V + 1,)
    visible: NDArray[np.int64]  # objects in sight of a viewpoint, counted within the split
    offsets: NDArray[np.float32]  # where they are, seen from it [m]

    @classmethod
    def of(
        cls, data: Kitti360Pose, cells: NDArray[np.int64], *, spacing: float = SPACING
    ) -> Relational:
        """Lay viewpoints over cells (rows) and look around from each."""
        o = data.objects
        spans = [data.cells.objects(int(c)) for c in cells]
        objects = np.concatenate([np.zeros(0, np.int64), *(np.r_[span] for span in spans)])
        counts = [span.stop - span.start for span in spans]
        object_starts = np.concatenate(([0], np.cumsum(counts))).astype(np.int64)
        ground = [o.footprint(int(row)) for row in objects]
        footprint_starts = np.concatenate(([0], np.cumsum([len(g) for g in ground])))
        points, owner = _viewpoints(data, cells, spacing)
        starts, seen, offsets = find_visible(
            points,
            owner,
            object_starts,
            footprint_starts.astype(np.int64),
            np.concatenate([np.zeros((0, 2)), *ground]),
            REACH,
        )
        return cls(data, cells, object_starts, objects, points, owner, starts, seen, offsets)

    def scores(self, description: Description) -> Floats:
        """Log-likelihood (K,) of a description in each cell."""
        here, others = _split(description)
        total = np.zeros(len(self.cells))
        if others:
            total += self._between(description, others)
        if here:
            at = self._from_speaker(description, here)
            top = at.max(initial=-np.inf)
            mass = np.bincount(self.owner, np.exp(at - top), minlength=len(self.cells))
            with np.errstate(divide="ignore"):  # a cell of which no viewpoint is the nearest
                total += top + np.log(mass)
        return total

    def poses(self, description: Description, cells: NDArray[np.int64]) -> Floats:
        """Return the point of each cell where a description fits best (k, 2), east and north [m]."""
        here, _ = _split(description)
        found: Floats = self.data.cells.centers[self.cells[cells]]
        if here:
            at = self._from_speaker(description, here)
            for i, cell in enumerate(cells):
                first, last = np.searchsorted(self.owner, (cell, cell + 1))
                if first < last:
                    weight = np.exp(at[first:last] - at[first:last].max())
                    found[i] = np.average(self.points[first:last], axis=0, weights=weight)
        return found

    @cached_property
    def _prominence(self) -> Floats:
        """Share (N,) that each object has of what is in sight, averaged over viewpoints."""
        seen = np.diff(self.starts)
        share = np.repeat(1.0 / ((seen + CROWD) * max(1, len(seen))), seen)
        found: Floats = np.bincount(self.visible, share, minlength=len(self.objects)).astype(
            np.float64
        )
        return found

    def _from_speaker(self, description: Description, statements: Sequence[Statement]) -> Floats:
        fits = np.stack([self._match_objects(description.mentions[s.target]) for s in statements])
        shares = fits @ self._prominence
        return from_speaker(
            self.starts,
            self.visible,
            self.offsets,
            fits,
            np.array([DIRECTION if s.bearing is not None else INSIDE for s in statements]),
            direction_table(statements[0].bearing_sigma, SLIP),
            _bearings(statements),
            NOISE,
            np.maximum(0.25 * shares, FLOOR),
            CROWD,
        )

    def _between(self, description: Description, statements: Sequence[Statement]) -> Floats:
        source, target = (
            np.stack(
                [self._match_objects(description.mentions[getattr(s, end)]) for s in statements]
            )
            for end in ("source", "target")
        )
        shares = 0.25 * source.mean(axis=1) * target.mean(axis=1)
        return score_pairs(
            self.object_starts,
            self.data.objects.centers[self.objects, :2],
            source,
            target,
            direction_table(statements[0].bearing_sigma, SLIP),
            _bearings(statements),
            NOISE,
            np.maximum(shares, FLOOR),
            CROWD**2,
        )

    def _match_objects(self, mention: Mention) -> Floats:
        """Match objects (N,) with a mention: with its kind, and with its colour if it has one."""
        data, o = self.data, self.data.objects
        label, colour = _kind(data, mention)
        kind = o.labels[self.objects] == (data.labels.index(label) if label else -1)
        if colour not in data.colours:
            return kind.astype(np.float64)
        same = o.colours[self.objects] == data.colours.index(colour)
        return np.where(same, 1.0, OTHER_COLOUR) * kind


def _viewpoints(
    data: Kitti360Pose, cells: NDArray[np.int64], spacing: float
) -> tuple[Floats, NDArray[np.int64]]:
    """Viewpoints (V, 2) and the cell that owns each; a grid over each drive."""
    centers, half = data.cells.centers[cells], 0.5 * data.cells.sizes[cells]
    found, owners = [np.zeros((0, 2))], [np.zeros(0, np.int64)]
    for scene in np.unique(data.cells.scene[cells]):
        rows = np.flatnonzero(data.cells.scene[cells] == scene)
        reach = float(half[rows].max())
        ticks = np.arange(-reach, reach + spacing, spacing)
        square = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
        grid = np.unique(np.round((centers[rows, None] + square).reshape(-1, 2) / spacing), axis=0)
        owner = nearest_owner(spacing * grid, centers[rows], reach)
        found.append(spacing * grid[owner >= 0])
        owners.append(rows[owner[owner >= 0]])
    points, owner = np.concatenate(found), np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return points[order], owner[order]


def _split(description: Description) -> tuple[list[Statement], list[Statement]]:
    """Statements about the speaker, and directions between things; nothing else is understood."""
    told = [s for s in description.statements if not s.negated]
    here = [
        s for s in told if s.source == SPEAKER and s.relation in (Relation.DIRECTION, Relation.SAME)
    ]
    others = [
        s for s in told if SPEAKER not in (s.source, s.target) and s.relation is Relation.DIRECTION
    ]
    return here, others


def _bearings(statements: Sequence[Statement]) -> Floats:
    angles = [s.bearing or 0.0 for s in statements]
    return np.array([(sin(a), cos(a)) for a in angles])


def _kind(data: Kitti360Pose, mention: Mention) -> tuple[str, str]:
    words = mention.words.removeprefix("a ")
    label = max((x for x in data.labels if words.endswith(x)), key=len, default="")
    colour = words.removesuffix(label).strip()
    return label, colour if colour in data.colours else ""


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
        before = self.first.scores(description)
        chosen = np.argsort(-before, kind="stable")[: self.candidates]
        centers = None if self.centers is None else self.centers[chosen]
        graphs = [self.graphs[k] for k in chosen]
        found = rank(description, graphs, centers=centers, timeout=self.timeout, plain=self.plain)
        total = np.full(len(self.graphs), -np.inf)
        total[chosen[found.rows]] = -found.costs
        return total


CANDIDATES = 10
"""Number of cells that the transformer's embeddings propose (n of Eq. 12, Sec. IV-D)."""


@dataclass(frozen=True, eq=False)
class Transformer:
    """GOTLoc as printed: candidates by embedding, ranked by the cosine of joint embeddings (Eq. 9-16)."""

    cells: LabelGraphs
    network: GraphTransformer
    candidates: int = CANDIDATES

    @cached_property
    def vectors(self) -> NDArray[np.float32]:
        """Vectors (T, d) of the labels of the cells."""
        return self.network.word_vectors(self.cells.vocabulary)

    @cached_property
    def embeddings(self) -> NDArray[np.float32]:
        """Embeddings (K, D) of the cells (Eq. 10)."""
        return self.network.embed_places(self.cells, self.vectors)

    def scores(self, description: Description) -> Floats:
        """Cosine (K,) of the joint embeddings of a text and each candidate."""
        texts = LabelGraphs.of_texts([description])
        similarity = self.embeddings @ self.network.embed_texts(texts)[0]
        rows = np.argsort(-similarity, kind="stable")[: self.candidates]
        total = np.full(len(self.cells), -np.inf)
        found = self.network.match(texts, 0, self.cells, rows, None, self.vectors)
        total[rows] = found.cosine
        return total
