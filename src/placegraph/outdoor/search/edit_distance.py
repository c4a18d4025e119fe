"""Rule-based matching (question Q3 of the paper): edit distance of a text graph and a scene graph.

Exact graph edit distance is NP-hard. NetworkX searches depth first and improves a bound until its
time is up; what it is given is first made as small as is possible without changing the answer,
and a greedy assignment is the bound it starts from. So there is an answer at any time limit.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.graph import SceneGraph
from placegraph.errors import MissingExtraError, OptionError
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.search.edit_bound import Problem, bound, reduced
from placegraph.outdoor.search.edit_graphs import BEARINGS, LabelledGraph, Node, fit

TIMEOUT = 0.1
"""Time for one pair [s]: the paper's 11 pairs a second."""
PER_ENTRY = 1e-7
"""Time that NetworkX needs to fill an entry of its cost matrices [s]; its own clock starts after."""
DEEPEST = 400
"""More nodes than this are not searched: NetworkX descends one call a node."""


@dataclass(frozen=True, slots=True)
class Costs:
    """What edits cost; deleting a node or an edge of the first graph costs 1.

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
    centers
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
