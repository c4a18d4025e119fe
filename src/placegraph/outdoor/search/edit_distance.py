"""Graph edit distance between text graphs (Eq. 3-4) and scene graphs of cells (Eq. 7-8)."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Floats
from placegraph.core.graph import SceneGraph
from placegraph.errors import DescriptionError, MissingExtraError, OptionError
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Relation,
    Statement,
)
from placegraph.outdoor.map.directions_kernels import name_direction

UNNAMED = 0.4
"""Fit of an object without a name to a mention with one, of its kind."""
HERE = "<speaker>"
"""Label of the node of the speaker; no map has it."""
BEARINGS = {"north": 0.0, "east": 0.5 * math.pi, "south": math.pi, "west": 1.5 * math.pi}
SECTOR = math.radians(50.0)
"""Largest error of a direction of Eq. 6: both north and east fit "north-east"."""
RELATIONS = {Relation.NEAR: "near", Relation.INSIDE: "inside", Relation.ALONG: "along"}


class Node(NamedTuple):
    """Object of either graph."""

    labels: Mapping[str, float]
    """Labels with their weights, in (0, 1]."""
    name: str = ""
    """Proper name in lower case, or empty."""


class Edge(NamedTuple):
    """Relations of a source to a target, any of which may be meant."""

    source: int
    target: int
    relations: frozenset[str]


@dataclass(frozen=True, slots=True)
class LabelledGraph:
    """Graph with labels: a text graph (Eq. 4) or a scene graph (Eq. 7)."""

    nodes: tuple[Node, ...]
    edges: tuple[Edge, ...]

    @classmethod
    def of_description(cls, description: Description, *, speaker: bool = False) -> LabelledGraph:
        """Make the graph of a description, with the speaker as a node if `speaker` is set.

        Directions, "near", "inside" and "along" become edges. Negated and distant statements, and
        those of three objects, have no counterpart in a scene graph. Raises `DescriptionError` where
        nothing is left.
        """
        row: dict[int, int] = {}
        nodes: list[Node] = []
        statements = [s for s in description.statements if not s.negated and not s.far]
        used = {n for s in statements for n in (s.source, s.target)} - {SPEAKER, LISTENER}
        for mention in description.mentions:
            if mention.id in used:
                labels: dict[str, float] = {}
                for sense in mention.senses:
                    labels[sense.label] = max(sense.weight, labels.get(sense.label, 0.0))
                row[mention.id] = len(nodes)
                nodes.append(Node(labels, mention.name.casefold()))
        if not nodes:
            raise DescriptionError(
                "The text mentions no object that a scene graph could contain; describe objects "
                "and their relations."
            )
        related = [(s, _relations(s)) for s in statements if _relations(s)]
        if speaker and any(SPEAKER in (s.source, s.target) for s, _ in related):
            row[SPEAKER] = len(nodes)
            nodes.append(Node({HERE: 1.0}))
        edges = {
            Edge(row[s.source], row[s.target], relations): None
            for s, relations in related
            if s.source in row and s.target in row and s.source != s.target
        }
        return cls(tuple(nodes), tuple(edges))

    @classmethod
    def of_scene_graph(cls, graph: SceneGraph, center: ArrayLike | None = None) -> LabelledGraph:
        """Make the graph of a cell; with its `center` (2,) [m], the speaker is a node there."""
        nodes = [
            Node({label: 1.0}, name.casefold())
            for label, name in zip(graph.labels, graph.names, strict=True)
        ]
        ends = zip(graph.sources.tolist(), graph.targets.tolist(), graph.relations, strict=True)
        edges = [Edge(s, t, frozenset((relation,))) for s, t, relation in ends]
        if center is not None:
            here = len(graph)
            nodes.append(Node({HERE: 1.0}))
            for i, delta in enumerate(graph.positions[:, :2] - np.asarray(center, np.float64)):
                if delta.any():  # directions (Eq. 6) between each object and the speaker
                    edges.append(Edge(i, here, frozenset((name_direction(delta),))))
                    edges.append(Edge(here, i, frozenset((name_direction(-delta),))))
        return cls(tuple(nodes), tuple(edges))


def compute_fit(a: Node, b: Node) -> float:
    """Compute how well node b fits the labels and name of node a, 0 to 1."""
    if a.name and a.name == b.name:
        return 1.0
    fit = 0.0
    for label, weight in a.labels.items():
        own = b.labels.get(label, 0.0)
        if label.endswith("=*"):
            own = max((w for x, w in b.labels.items() if x.startswith(label[:-1])), default=0.0)
        fit = max(fit, weight * own)
    if a.name:  # another object of its kind has another name; one without may be it
        fit *= 0.0 if b.name else UNNAMED
    return fit


def _relations(statement: Statement) -> frozenset[str]:
    """Return the relations of a scene graph that a statement may mean."""
    if statement.relation is Relation.DIRECTION and statement.bearing is not None:
        stated = statement.bearing
        turns = ((r, abs((b - stated + math.pi) % math.tau - math.pi)) for r, b in BEARINGS.items())
        return frozenset(r for r, turn in turns if turn <= SECTOR)
    # distances of the speaker from objects are unknown
    is_of_speaker = SPEAKER in (statement.source, statement.target)
    kind = None if is_of_speaker else RELATIONS.get(statement.relation)
    return frozenset((kind,)) if kind else frozenset()


DELETED = -1


@dataclass(frozen=True)
class Problem:
    """Assignment of text nodes (rows) to cell nodes (columns), each to at most one."""

    cost: Floats
    """(M, N) cost of matching a text node with a cell node; infinite where that is impossible."""
    text_edges: tuple[Edge, ...]
    cell_edges: tuple[Edge, ...]
    node_insertion: float
    edge_insertion: float
    base: float = 0.0
    """Cost of nodes and edges that were removed."""


def reduce_problem(problem: Problem) -> Problem:
    """Remove nodes and edges that do not change the distance where inserted cell edges are free.

    Cell nodes without a matching text node are inserted, and text nodes without one are deleted with
    their edges. A cell edge counts only where it fits a text edge between nodes that may match: a wrong
    edge costs as much as a deleted one.
    """
    possible = np.isfinite(problem.cost)
    rows, columns = np.flatnonzero(possible.any(1)), np.flatnonzero(possible.any(0))
    row = {int(r): i for i, r in enumerate(rows)}
    column = {int(c): i for i, c in enumerate(columns)}
    may = [frozenset(np.flatnonzero(p).tolist()) for p in possible]
    by_relation: dict[str, list[Edge]] = defaultdict(list)
    for c in problem.cell_edges:
        for relation in c.relations:
            by_relation[relation].append(c)
    served = {
        e: [
            c
            for relation in e.relations
            for c in by_relation[relation]
            if c.source in may[e.source] and c.target in may[e.target]
        ]
        for e in problem.text_edges
    }
    text = [e for e, by in served.items() if by]
    cell = dict.fromkeys(c for by in served.values() for c in by)
    lost = len(problem.cost) - len(rows) + len(problem.text_edges) - len(text)
    dropped = problem.cost.shape[1] - len(columns)
    return replace(
        problem,
        cost=problem.cost[np.ix_(rows, columns)],
        text_edges=tuple(e._replace(source=row[e.source], target=row[e.target]) for e in text),
        cell_edges=tuple(
            c._replace(source=column[c.source], target=column[c.target]) for c in cell
        ),
        base=problem.base + lost + dropped * problem.node_insertion,
    )


def bound_distance(problem: Problem) -> tuple[float, float]:
    """Compute an upper and a lower bound of the distance.

    The upper bound is greedy: text nodes with the fewest matches choose first, and then again as long as
    the cost falls. The lower bound matches every node with its best and ignores edges.
    """
    cost = problem.cost
    m, n = cost.shape
    choice = np.full(m, DELETED)
    edges = _Edges(problem)
    order = np.argsort(np.isfinite(cost).sum(1), kind="stable")
    for _ in range(4):
        before = choice.copy()
        for a in order:
            choice[a] = DELETED
            taken = set(choice[choice != DELETED].tolist())
            costs = {DELETED: 1.0 + problem.node_insertion + edges.around(a, DELETED, choice)}
            for u in np.flatnonzero(np.isfinite(cost[a])).tolist():
                if u not in taken:
                    costs[u] = cost[a, u] + edges.around(a, u, choice)
            choice[a] = min(costs, key=costs.__getitem__)
        if (choice == before).all():
            break
    lowest = np.minimum(cost.min(1, initial=1.0), 1.0).sum() if n else float(m)
    insertions = max(0, n - m) * problem.node_insertion
    return compute_cost(problem, choice.tolist()), float(lowest) + insertions


def compute_cost(problem: Problem, choice: Sequence[int]) -> float:
    """Compute the cost of an assignment: the cell node of every text node, or `DELETED`."""
    used = [u for u in choice if u != DELETED]
    nodes = sum(1.0 if u == DELETED else problem.cost[a, u] for a, u in enumerate(choice))
    nodes += (problem.cost.shape[1] - len(used)) * problem.node_insertion
    return float(nodes) + _Edges(problem).total(choice)


class _Edges:
    """Costs of the edges of a problem under assignments of its nodes."""

    def __init__(self, problem: Problem) -> None:
        self.insertion = problem.edge_insertion
        self.text: dict[tuple[int, int], list[frozenset[str]]] = defaultdict(list)
        self.cell: dict[tuple[int, int], list[frozenset[str]]] = defaultdict(list)
        self.at: dict[int, set[int]] = defaultdict(set)
        for e in problem.text_edges:
            self.text[e.source, e.target].append(e.relations)
            self.at[e.source].add(e.target)
            self.at[e.target].add(e.source)
        for c in problem.cell_edges:
            self.cell[c.source, c.target].append(c.relations)

    def around(self, a: int, u: int, choice: NDArray[np.int64]) -> float:
        """Compute the cost of edges between text node a, matched with cell node u, and other matches."""
        cost = 0.0
        others = (
            self.at[a] if self.insertion == 0.0 else set(np.flatnonzero(choice != DELETED).tolist())
        )
        for b in others | self.at[a]:
            v = int(choice[b])
            if b == a:
                continue
            for pair, image in (((a, b), (u, v)), ((b, a), (v, u))):
                there = self.cell.get(image, ()) if DELETED not in image else ()
                # edges that both sides have to insert anyway are counted as savings
                cost += self.pair(self.text.get(pair, ()), there) - len(there) * self.insertion
        return cost

    def pair(self, text: Sequence[frozenset[str]], cell: Sequence[frozenset[str]]) -> float:
        """Compute the cost of changing the edges of one pair of nodes into those of another."""
        free = list(cell)
        wrong = 0
        for relations in sorted(text, key=len):
            match = next((c for c in free if c & relations), None)
            if match is None:
                wrong += 1
            else:
                free.remove(match)
        changed = min(wrong, len(free)) if self.insertion else 0  # cheaper than inserted anew
        return wrong + (len(free) - changed) * self.insertion

    def total(self, choice: Sequence[int]) -> float:
        """Compute the cost of all edges."""
        cost, met = 0.0, 0
        for (a, b), relations in self.text.items():
            image = (choice[a], choice[b])
            there = self.cell.get(image, ()) if DELETED not in image else ()
            met += len(there)
            cost += self.pair(relations, there)
        return cost + (sum(map(len, self.cell.values())) - met) * self.insertion


TIMEOUT = 0.1
"""Time for one pair [s]: the paper's 11 pairs a second."""
PER_ENTRY = 1e-7
"""Time of NetworkX for an entry of its cost matrices [s], before its own clock starts."""
DEEPEST = 400
"""Largest number of nodes that are searched: NetworkX recurses once a node."""


@dataclass(frozen=True, slots=True)
class Costs:
    """Costs of edits; deleting a node or an edge of the first graph costs 1.

    A description mentions few of the objects of a cell, so nodes and edges that only the second graph
    has are free by default, and nodes match only where labels fit.
    """

    node_insertion: float = 0.0
    edge_insertion: float = 0.0
    mismatch: float = math.inf
    """Cost of matching nodes of different labels."""


PLAIN = Costs(1.0, 1.0, 1.0)
"""Textbook distance, as in the paper: every edit costs 1. It mostly counts the objects of a cell."""


class Distance(NamedTuple):
    """Edit distance of two graphs."""

    cost: float
    exact: bool
    """Whether the search ended in time; otherwise the cost is an upper bound."""


class GraphRanking(NamedTuple):
    """Graphs in the order of their distances; ties stay in the order given."""

    rows: NDArray[np.int64]
    """(K,) rows of the graphs."""
    costs: Floats
    """(K,) their distances."""
    exact: NDArray[np.bool_]
    """(K,)"""


def rank(
    description: Description,
    graphs: Sequence[SceneGraph],
    *,
    centers: ArrayLike | None = None,
    timeout: float = TIMEOUT,
    plain: bool = False,
) -> GraphRanking:
    """Rank cells by the edit distance of their scene graphs to a text's graph (question Q3).

    Parameters
    ----------
    centres
        East and north (K, 2) [m] of the centres of the cells, where the speaker becomes a node.
        Without them, statements about the speaker are ignored, as in the paper.
    timeout
        Time limit of one distance [s]; checked between steps of the search.
    plain
        Count every edit as 1, as the paper does, and ignore the speaker.

    Raises
    ------
    DescriptionError
        The text mentions no objects.
    MissingExtraError
        NetworkX or SciPy is not installed.
    OptionError
        The time limit is not above 0, or there is not one centre a graph.
    """
    if centers is not None and np.shape(centers) != (len(graphs), 2):
        raise OptionError(
            f"centers have shape {np.shape(centers)} for {len(graphs)} graphs; give east "
            "and north for each cell."
        )
    middles = [None] * len(graphs) if centers is None or plain else list(np.asarray(centers))
    text = LabelledGraph.of_description(
        description, speaker=bool(middles and middles[0] is not None)
    )
    kinds = {r for e in text.edges for r in e.relations} | (set(BEARINGS) if plain else set())
    found = []
    for graph, middle in zip(graphs, middles, strict=True):
        cell = LabelledGraph.of_scene_graph(graph, middle)
        cell = replace(cell, edges=tuple(e for e in cell.edges if e.relations & kinds))
        found.append(distance(text, cell, costs=PLAIN if plain else Costs(), timeout=timeout))
    costs = np.array([d.cost for d in found])
    order = np.argsort(costs, kind="stable")
    return GraphRanking(order, costs[order], np.array([d.exact for d in found], np.bool_)[order])


def distance(
    first: LabelledGraph,
    second: LabelledGraph,
    *,
    costs: Costs | None = None,
    timeout: float = TIMEOUT,
) -> Distance:
    """Compute the cost of the cheapest edits that turn the first graph into the second, or a bound on it.

    Raises `MissingExtraError` without NetworkX or SciPy, `OptionError` for a bad time limit.
    """
    costs = costs or Costs()
    if not (isinstance(timeout, int | float) and timeout > 0.0):
        raise OptionError(f"timeout is {timeout!r} s; give a time greater than 0.")
    nx = _networkx()
    start = time.perf_counter()
    problem = _make_problem(first, second, costs)
    if costs.edge_insertion == 0.0 and math.isinf(costs.mismatch):
        problem = reduce_problem(problem)
    best, lowest = bound_distance(problem)
    if best <= lowest + 1e-9:
        return Distance(problem.base + best, exact=True)
    entries = (len(problem.text_edges) + len(problem.cell_edges)) ** 2
    rest = timeout - (time.perf_counter() - start) - PER_ENTRY * entries
    if rest <= 0.0 or sum(problem.cost.shape) > DEEPEST:
        return Distance(problem.base + best, exact=False)
    return _search(problem, best, rest, nx)


def _search(problem: Problem, best: float, timeout: float, nx: Any) -> Distance:  # noqa: ANN401
    """Improve a bound by NetworkX."""
    start = time.perf_counter()
    deleted = float(len(problem.cost) + len(problem.text_edges))
    inserted = problem.cost.shape[1] * problem.node_insertion
    inserted += len(problem.cell_edges) * problem.edge_insertion
    cost = np.minimum(problem.cost, 1.0 + 2.0 * (deleted + inserted))
    text, cell = nx.MultiDiGraph(), nx.MultiDiGraph()
    for graph, count, edges in (
        (text, cost.shape[0], problem.text_edges),
        (cell, cost.shape[1], problem.cell_edges),
    ):
        graph.add_nodes_from((i, {"row": i}) for i in range(count))
        graph.add_edges_from((s, t, {"relations": r}) for s, t, r in edges)
    paths = nx.optimize_edit_paths(
        text,
        cell,
        node_subst_cost=lambda a, b: cost[a["row"], b["row"]],
        node_del_cost=lambda _: 1.0,
        node_ins_cost=lambda _: problem.node_insertion,
        edge_subst_cost=lambda a, b: float(not a["relations"] & b["relations"]),
        edge_del_cost=lambda _: 1.0,
        edge_ins_cost=lambda _: problem.edge_insertion,
        upper_bound=best + 1e-9,
        timeout=timeout,
    )
    for _, _, found in paths:
        best = min(best, found)
    return Distance(problem.base + best, exact=time.perf_counter() - start < timeout)


def _make_problem(first: LabelledGraph, second: LabelledGraph, costs: Costs) -> Problem:
    fits = [[compute_fit(a, b) for b in second.nodes] for a in first.nodes]
    fit = np.array(fits, np.float64).reshape(len(first.nodes), len(second.nodes))
    if math.isinf(costs.mismatch):
        cost = np.where(fit > 0.0, 1.0 - fit, np.inf)
    else:
        cost = np.where(fit >= 1.0, 0.0, costs.mismatch)
    edges = first.edges, second.edges
    return Problem(cost, *edges, costs.node_insertion, costs.edge_insertion)


def _networkx() -> Any:  # noqa: ANN401  # a module that may be missing
    try:
        import networkx as nx
        import scipy.optimize  # noqa: F401  # solves its assignments; it would import it while timed
    except ImportError as error:
        raise MissingExtraError(
            "Edit distances need NetworkX and SciPy: pip install 'placegraph[networkx]'."
        ) from error
    return nx
