"""Graphs as GOTLoc prints them (Eq. 1-8): nodes are labels alone, edges one of four directions.

Texts, cells of a map and any other scene graphs become the same arrays, which one encoder reads. There is
no node for the speaker or a cell's centre, and no position: these only make the edges (Eq. 5-6).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.graph import SceneGraph
from placegraph.core.mapfile import gather_spans
from placegraph.outdoor.language.description import LISTENER, Description, Mention, Relation
from placegraph.outdoor.likelihood.query import is_tag
from placegraph.outdoor.map.cells import find_in_cells
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.directions_kernels import WINDS, find_wind, relate_pairs
from placegraph.outdoor.network.graphs import (
    GraphBatch,
    NodeWords,
    Rows,
    list_nodes,
    make_mask,
    split_label,
)

Edge = tuple[int, int, int]
"""Source and target, counted within the graph, and row of `WINDS`: the source is <wind> of the target."""


@dataclass(frozen=True, eq=False)
class LabelGraphs:
    """K graphs of labels and directions; their nodes and edges as CSR."""

    starts: Rows
    """(K + 1,) nodes of a graph; at least one, with an empty label where nothing is there."""
    labels: Rows
    """(N,) rows of `vocabulary`."""
    edge_starts: Rows
    """(K + 1,)"""
    ends: NDArray[np.int32]
    """(E, 2) source and target of an edge, counted within the graph."""
    winds: NDArray[np.uint8]
    """(E,) rows of `WINDS`: the source is <wind> of the target."""
    vocabulary: tuple[str, ...]
    """Labels, as words (`split_label`)."""

    def __len__(self) -> int:
        return len(self.starts) - 1

    @classmethod
    def of_cells(cls, city: City) -> Self:
        """Make the graphs of all cells of a city, rows as `city.cells.points` (Eq. 7-8).

        Their nodes, labels and directions are those of `cell_graph`.
        """
        objects, cells = city.objects, city.cells
        seen = find_in_cells(objects, cells.grid, cells.size)
        rows = np.searchsorted(seen.points, cells.points)
        starts, entries = gather_spans(seen.starts, rows)
        things = seen.objects[entries]
        at = seen.offsets[entries].astype(np.float64)
        edge_starts, ends, winds = relate_pairs(starts, at, cells.edge_distance)
        labels = objects.label_values[objects.label_starts[things]].astype(np.int64)
        vocabulary = tuple(map(name_label, objects.labels))
        return cls(starts, labels, edge_starts, ends, winds, vocabulary)

    @classmethod
    def of_texts(cls, descriptions: Sequence[Description]) -> Self:
        """Make the graphs of parsed descriptions (Eq. 3-4).

        Objects of statements that are not negated are nodes. Directions between two of them are edges, each
        with its inverse, as on the map. The observer is not a node (Sec. IV-D); its directions are lost.
        """
        return cls._of(map(_read_text, descriptions))

    @classmethod
    def of_graphs(cls, graphs: Iterable[SceneGraph]) -> Self:
        """Make graphs of scene graphs: labels, and relations that are one of `WINDS`."""
        row = {wind: i for i, wind in enumerate(WINDS)}
        return cls._of(
            (
                [name_label(label) for label in graph.labels],
                [
                    (int(s), int(t), row[relation])
                    for s, t, relation in zip(
                        graph.sources, graph.targets, graph.relations, strict=True
                    )
                    if relation in row
                ],
            )
            for graph in graphs
        )

    @classmethod
    def _of(cls, graphs: Iterable[tuple[list[str], list[Edge]]]) -> Self:
        rows: dict[str, int] = {}
        labels: list[int] = []
        edges: list[Edge] = []
        starts, edge_starts = [0], [0]
        for named, related in graphs:
            labels += [rows.setdefault(label, len(rows)) for label in named or [""]]
            edges += related
            starts.append(len(labels))
            edge_starts.append(len(edges))
        columns = np.array(edges, np.int64).reshape(-1, 3)
        return cls(
            np.array(starts, np.int64), np.array(labels, np.int64), np.array(edge_starts, np.int64),
            columns[:, :2].astype(np.int32), columns[:, 2].astype(np.uint8), tuple(rows),
        )  # fmt: skip

    def batch(self, rows: Rows) -> GraphBatch:
        """Pad the graphs `rows` (B,): nodes have labels and no other features."""
        rows = np.asarray(rows, np.int64)
        counts = self.starts[rows + 1] - self.starts[rows]
        size = int(counts.max())
        node, at = list_nodes(self.starts[rows], counts, size)
        edge_counts = self.edge_starts[rows + 1] - self.edge_starts[rows]
        edge, _ = list_nodes(self.edge_starts[rows], edge_counts, 0)
        graph = np.repeat(np.arange(len(rows)), edge_counts)
        relations = np.zeros((len(rows), len(WINDS), size, size), np.float32)
        relations[graph, self.winds[edge], *self.ends[edge].T] = 1.0
        words = NodeWords(
            np.arange(len(node)), self.labels[node], np.ones(len(node), np.float32), at
        )
        return GraphBatch(
            np.zeros((len(rows), size, 0), np.float32), make_mask(counts, size), relations, words
        )


def name_label(label: str) -> str:
    """Return a label as words: ``amenity=bicycle_parking`` becomes "bicycle parking"."""
    return " ".join(split_label(label))


def choose_label(mention: Mention) -> str:
    """Return the label of a mention as words (Eq. 3): of its tag, or likeliest sense, else as written."""
    literal = [sense for sense in mention.senses if is_tag(mention.words, sense.label)]
    best = max(literal or mention.senses, key=lambda sense: sense.weight, default=None)
    return name_label(best.label if best else mention.name or mention.words)


def _read_text(description: Description) -> tuple[list[str], list[Edge]]:
    nodes: dict[int, int] = {}
    edges: dict[Edge, None] = {}
    for s in description.statements:
        if s.negated:
            continue
        for end in (s.source, s.target):
            if end > LISTENER:
                nodes.setdefault(end, len(nodes))
        between = s.source in nodes and s.target in nodes and s.source != s.target
        if between and s.relation is Relation.DIRECTION and s.bearing is not None:
            edges |= dict.fromkeys(_both_ways(nodes[s.source], nodes[s.target], s.bearing))
    return [choose_label(description.mentions[id_]) for id_ in nodes], list(edges)


def _both_ways(source: int, target: int, bearing: float) -> Iterator[Edge]:
    # rounded, so that a diagonal is one for Eq. 6
    east, north = round(float(np.sin(bearing)), 9), round(float(np.cos(bearing)), 9)
    yield source, target, int(find_wind(east, north))
    yield target, source, int(find_wind(-east, -north))
