"""What edit distances are taken between: text graphs (Eq. 3-4) and scene graphs of cells (Eq. 7-8)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.graph import SceneGraph
from placegraph.errors import DescriptionError, OptionError
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Mention,
    Relation,
    Statement,
)
from placegraph.outdoor.map.cells import compass

UNNAMED = 0.4
"""How well a thing without a name fits a mention by name of its kind."""
HERE = "<speaker>"
"""Label of the node that stands for whoever speaks; no map has it."""
BEARINGS = {"north": 0.0, "east": 0.5 * math.pi, "south": math.pi, "west": 1.5 * math.pi}
SECTOR = math.radians(50.0)
"""A direction of Eq. 6 serves bearings this near; "north-east" is served by north and by east."""
PLACED = {Relation.NEAR: "near", Relation.INSIDE: "inside", Relation.ALONG: "along"}


class Node(NamedTuple):
    """A thing of either graph."""

    labels: Mapping[str, float]
    """What it may be called and how well that fits, in (0, 1]."""
    name: str = ""
    """Proper name, in lower case, or empty."""


class Edge(NamedTuple):
    """A relation: the source is one of `relations` of the target."""

    source: int
    target: int
    relations: frozenset[str]


@dataclass(frozen=True, slots=True)
class LabelledGraph:
    """What the distance is taken between: a text graph (Eq. 4) or a scene graph (Eq. 7)."""

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]

    @classmethod
    def of_description(cls, description: Description, *, speaker: bool = False) -> LabelledGraph:
        """Graph of what a text says of things; without `speaker`, only of things among themselves.

        Directions, "near", "inside" and "along" are edges. What is denied, counted or far away,
        and relations of three things, have no counterpart in a scene graph and are left out.

        Raises
        ------
        DescriptionError
            Where nothing of that kind is said.
        """
        row: dict[int, int] = {}
        nodes: list[Node] = []
        told = [s for s in description.statements if not s.negated and not s.far]
        seen = {n for s in told for n in (s.source, s.target)}
        for mention in description.mentions:
            if mention.id in seen and mention.id not in (SPEAKER, LISTENER):
                row[mention.id] = len(nodes)
                nodes.append(_spoken(mention))
        if not nodes:
            raise DescriptionError(
                "The text names no thing that a scene graph could hold; say what stands where."
            )
        if speaker and any(SPEAKER in (s.source, s.target) for s in told if _relations(s)):
            row[SPEAKER] = len(nodes)
            nodes.append(Node({HERE: 1.0}))
        edges = {
            Edge(row[s.source], row[s.target], _relations(s)): None
            for s in told
            if s.source in row and s.target in row and s.source != s.target and _relations(s)
        }
        return cls(tuple(nodes), tuple(edges))

    @classmethod
    def of_scene_graph(cls, graph: SceneGraph, center: ArrayLike | None = None) -> LabelledGraph:
        """Graph of a cell; with its `center` (2,) [m], the speaker stands there.

        Raises
        ------
        OptionError
            Where the centre is not two numbers.
        """
        nodes = [
            Node({label: 1.0}, name.casefold())
            for label, name in zip(graph.labels, graph.names, strict=True)
        ]
        edges = [
            Edge(s, t, frozenset((relation,)))
            for s, t, relation in zip(
                graph.sources.tolist(), graph.targets.tolist(), graph.relations, strict=True
            )
        ]
        if center is not None:
            edges += _from_here(graph, center)
            nodes.append(Node({HERE: 1.0}))
        return cls(tuple(nodes), tuple(edges))

    def of_relations(self, kinds: Iterable[str]) -> LabelledGraph:
        """The same nodes with the edges of these relations only."""
        kept = frozenset(kinds)
        return LabelledGraph(self.nodes, tuple(e for e in self.edges if e.relations & kept))


def fit(a: Node, b: Node) -> float:
    """How well node b is what node a is called, 0 to 1."""
    if a.name and a.name == b.name:
        return 1.0
    fits = max((w * _called(b, label) for label, w in a.labels.items()), default=0.0)
    if a.name:  # another thing of its kind has another name; one without may be it
        fits *= 0.0 if b.name else UNNAMED
    return fits


def _called(node: Node, label: str) -> float:
    """How well a label, or ``key=*``, fits a node."""
    if label.endswith("=*"):
        return max((w for own, w in node.labels.items() if own.startswith(label[:-1])), default=0.0)
    return node.labels.get(label, 0.0)


def _spoken(mention: Mention) -> Node:
    labels: dict[str, float] = {}
    for sense in mention.senses:
        labels[sense.label] = max(sense.weight, labels.get(sense.label, 0.0))
    return Node(labels, mention.name.casefold())


def _relations(statement: Statement) -> frozenset[str]:
    """Relations of a scene graph that a statement may mean; none where there is no such relation."""
    here = SPEAKER in (statement.source, statement.target)
    if statement.relation is Relation.DIRECTION and statement.bearing is not None:
        said = statement.bearing
        turns = ((r, abs((b - said + math.pi) % math.tau - math.pi)) for r, b in BEARINGS.items())
        return frozenset(r for r, turn in turns if turn <= SECTOR)
    # nobody knows how near the speaker of a cell is to anything
    kind = None if here else PLACED.get(statement.relation)
    return frozenset((kind,)) if kind else frozenset()


def _from_here(graph: SceneGraph, center: ArrayLike) -> list[Edge]:
    """Directions (Eq. 6) between all things and the speaker in the middle."""
    here, edges = len(graph), []
    for i, delta in enumerate(graph.positions[:, :2] - check_center(center)):
        if delta.any():
            edges.append(Edge(i, here, frozenset((compass(delta),))))
            edges.append(Edge(here, i, frozenset((compass(-delta),))))
    return edges


def check_center(center: ArrayLike) -> NDArray[np.float64]:
    """East and north (2,) [m]; raises `OptionError` where it is something else."""
    at = np.asarray(center, np.float64)
    if at.shape != (2,) or not np.isfinite(at).all():
        raise OptionError(f"center is {center!r}; give east and north in metres.")
    return at
