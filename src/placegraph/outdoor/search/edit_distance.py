"""Graph edit distance between text graphs (Eq. 3-4) and scene graphs of cells (Eq. 7-8)."""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.graph import SceneGraph
from placegraph.errors import DescriptionError, MissingExtraError, OptionError
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Mention,
    Relation,
    Statement,
)
from placegraph.outdoor.map.directions_kernels import name_direction

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
    """Graph with labels: a text graph (Eq. 4) or a scene graph (Eq. 7)."""

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
    """Return how well node b is what node a is called, 0 to 1."""
    if a.name and a.name == b.name:
        return 1.0
    fits = max((w * _called(b, label) for label, w in a.labels.items()), default=0.0)
    if a.name:  # another thing of its kind has another name; one without may be it
        fits *= 0.0 if b.name else UNNAMED
    return fits


def _called(node: Node, label: str) -> float:
    """Return how well a label, or ``key=*``, fits a node."""
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
            edges.append(Edge(i, here, frozenset((name_direction(delta),))))
            edges.append(Edge(here, i, frozenset((name_direction(-delta),))))
    return edges


def check_center(center: ArrayLike) -> NDArray[np.float64]:
    """East and north (2,) [m]; raises `OptionError` where it is something else."""
    at = np.asarray(center, np.float64)
    if at.shape != (2,) or not np.isfinite(at).all():
        raise OptionError(f"center is {center!r}; give east and north in metres.")
    return at


DELETED = -1


@dataclass(frozen=True)
class Problem:
    """An assignment of text nodes (rows) to cell nodes (columns), each to at most one."""

    cost: NDArray[np.float64]
    """(M, N) cost of a cell node that stands for a text node; infinite where it cannot."""
    text_edges: tuple[Edge, ...]
    cell_edges: tuple[Edge, ...]
    node_insertion: float
    edge_insertion: float
    base: float = 0.0
    """Cost of what was already decided."""

    @property
    def all_deleted(self) -> float:
        """Cost of deleting the text graph."""
        return float(len(self.cost) + len(self.text_edges))

    @property
    def all_inserted(self) -> float:
        """Cost of inserting the cell graph."""
        nodes, edges = self.cost.shape[1], len(self.cell_edges)
        return nodes * self.node_insertion + edges * self.edge_insertion


def reduced(problem: Problem) -> Problem:
    """Drop what does not change the distance where cell edges are inserted for nothing.

    A cell node that no text node fits is inserted, a text node that fits none is deleted with its
    edges; a cell edge counts only where it serves a text edge between nodes it may stand for.
    Serving one wrongly costs as much as deleting it. So the distance is the same.
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


def bound(problem: Problem) -> tuple[float, float]:
    """Upper and lower bound of the distance.

    Text nodes take, the choosiest first, whatever then costs least; then each may choose anew as
    long as that helps. The lower bound lets every node take what it likes and counts no edges.
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
    return total(problem, choice.tolist()), float(lowest) + insertions


def total(problem: Problem, choice: Sequence[int]) -> float:
    """Cost of an assignment: the cell node of every text node, or `DELETED`."""
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
        """Cost of the edges between text node a, put on cell node u, and those already put."""
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
        """Cost of turning the edges of one pair of nodes into those of another."""
        free = list(cell)
        wrong = 0
        for relations in sorted(text, key=len):
            match = next((c for c in free if c & relations), None)
            if match is None:
                wrong += 1
            else:
                free.remove(match)
        served = min(wrong, len(free)) if self.insertion else 0  # wrongly, but cheaper than anew
        return wrong + (len(free) - served) * self.insertion

    def total(self, choice: Sequence[int]) -> float:
        """Cost of all edges."""
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
"""Time that NetworkX needs to fill an entry of its cost matrices [s]; its own clock starts after."""
DEEPEST = 400
"""More nodes than this are not searched: NetworkX descends one call a node."""


@dataclass(frozen=True, slots=True)
class Costs:
    """Costs of edits; to delete a node or an edge of the first graph costs 1.

    A description mentions a few of the many things of a cell: what it leaves out is no
    contradiction. Things and relations that only the second graph has are therefore free. And
    "the bakery" is no bench: a node that fits no sense of a mention never stands for it.
    """

    node_insertion: float = 0.0
    edge_insertion: float = 0.0
    mismatch: float = math.inf
    """Of a node that stands for another of a different label; infinite where it never may."""

    @property
    def one_sided(self) -> bool:
        """Whether only the first graph's nodes and edges have to be accounted for."""
        return self.edge_insertion == 0.0 and math.isinf(self.mismatch)


PLAIN = Costs(1.0, 1.0, 1.0)
"""The textbook's distance, which the paper takes: every edit costs 1. It is a metric between scene
graphs, and mostly says how many things a cell holds."""


class Distance(NamedTuple):
    """Edit distance of two graphs."""

    cost: float
    exact: bool
    """False where time was up: the cost is an upper bound."""


class Ranked(NamedTuple):
    """Graphs in the order of their distance, nearest first; equals stay in the order given."""

    rows: NDArray[np.int64]
    """(K,) which of the graphs."""
    costs: NDArray[np.float64]
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
) -> Ranked:
    """Rank cells by the edit distance of their scene graphs to a text's graph (question Q3).

    Parameters
    ----------
    centres
        East and north (K, 2) [m] of the cells' middles. Statements about the speaker then take part:
        the speaker is a node that stands there. Without them they do not, as in the paper.
    timeout
        When to stop improving one distance [s]; looked at between steps of the search.
    plain
        Count every edit as 1, as the paper does, instead of by `Costs`; never about the speaker.

    Raises
    ------
    DescriptionError
        The text names no things.
    MissingExtraError
        NetworkX or SciPy is not installed.
    OptionError
        The time limit is not above 0, or a centre is not two numbers.
    """
    if centers is not None and np.shape(centers) != (len(graphs), 2):
        raise OptionError(f"centers: shape {np.shape(centers)} for {len(graphs)} graphs.")
    middles = [None] * len(graphs) if centers is None or plain else list(np.asarray(centers))
    text = LabelledGraph.of_description(
        description, speaker=bool(middles and middles[0] is not None)
    )
    kinds = {r for e in text.edges for r in e.relations} | (set(BEARINGS) if plain else set())
    found = [
        distance(
            text,
            LabelledGraph.of_scene_graph(graph, middle).of_relations(kinds),
            costs=PLAIN if plain else Costs(),
            timeout=timeout,
        )
        for graph, middle in zip(graphs, middles, strict=True)
    ]
    costs = np.array([d.cost for d in found])
    order = np.argsort(costs, kind="stable")
    return Ranked(order, costs[order], np.array([d.exact for d in found], np.bool_)[order])


def distance(
    first: LabelledGraph,
    second: LabelledGraph,
    *,
    costs: Costs | None = None,
    timeout: float = TIMEOUT,
) -> Distance:
    """Cost of the cheapest edits that turn the first graph into the second, or a bound on it.

    Raises
    ------
    MissingExtraError
        NetworkX or SciPy is not installed.
    OptionError
        The time limit is not above 0.
    """
    costs = costs or Costs()
    if not (isinstance(timeout, int | float) and timeout > 0.0):
        raise OptionError(f"timeout is {timeout!r} s; give the search some time.")
    nx = _networkx()
    start = time.perf_counter()
    problem = _problem(first, second, costs)
    if costs.one_sided:
        problem = reduced(problem)
    best, lowest = bound(problem)
    if best <= lowest + 1e-9:
        return Distance(problem.base + best, exact=True)
    entries = (len(problem.text_edges) + len(problem.cell_edges)) ** 2
    rest = timeout - (time.perf_counter() - start) - PER_ENTRY * entries
    if rest <= 0.0 or sum(problem.cost.shape) > DEEPEST:
        return Distance(problem.base + best, exact=False)
    return _searched(problem, best, rest, nx)


def _searched(problem: Problem, best: float, timeout: float, nx: Any) -> Distance:  # noqa: ANN401
    """Let NetworkX improve a bound."""
    start = time.perf_counter()
    forbidden = 1.0 + 2.0 * (problem.all_deleted + problem.all_inserted)
    cost = np.minimum(problem.cost, forbidden)
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


def _problem(first: LabelledGraph, second: LabelledGraph, costs: Costs) -> Problem:
    cost = [[_node_cost(a, b, costs) for b in second.nodes] for a in first.nodes]
    return Problem(
        np.array(cost, np.float64).reshape(len(first.nodes), len(second.nodes)),
        first.edges,
        second.edges,
        costs.node_insertion,
        costs.edge_insertion,
    )


def _node_cost(a: Node, b: Node, costs: Costs) -> float:
    """Cost of node b standing for node a."""
    fits = fit(a, b)
    if math.isinf(costs.mismatch):
        return 1.0 - fits if fits > 0.0 else math.inf
    return 0.0 if fits >= 1.0 else costs.mismatch


def _networkx() -> Any:  # noqa: ANN401  # the module itself, which may not be there
    try:
        import networkx as nx
        import scipy.optimize  # noqa: F401  # solves its assignments; it would import it while timed
    except ImportError as error:
        raise MissingExtraError(
            "Edit distances need NetworkX and SciPy; `pip install 'placegraph[networkx]'` "
            "brings them."
        ) from error
    return nx
