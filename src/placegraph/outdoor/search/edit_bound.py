"""Edit distance before any search: what cannot matter is dropped, and a greedy bound is found."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from placegraph.outdoor.search.edit_graphs import Edge

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
