"""What a trained network is worth by itself: where candidates are given, and in the paper's pipeline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.city import CityMap
from placegraph.outdoor.likelihood.query import compile_query, read
from placegraph.outdoor.network.encoded import EncodedCity
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.outdoor.search.candidates import dense_cells
from placegraph.outdoor.search.request import Matching, Request
from placegraph_lab.tables.outdoor.matchers import BagMatcher
from placegraph_lab.tables.outdoor.metrics import RANKS
from placegraph_lab.tables.outdoor.nearby import Bins
from placegraph_lab.tables.outdoor.queries import Query
from placegraph_lab.tables.outdoor.stages import matched

Hits = dict[str, NDArray[np.bool_]]
"""By what was done (Q, 3): whether the true cell is the best, one of three, one of five."""


GIVEN = (5, 10, 20, 50)
"""Numbers of cells, the true one among them, that every network ranks."""
CANDIDATES = 10
"""The paper's n of Eq. 12."""


@dataclass(frozen=True)
class Task:
    """Queries of one city, and the cells that are given to every network beside the true one."""

    city: CityMap
    queries: tuple[Query, ...]
    truth: NDArray[np.int64]
    """(Q,) rows of `city.cells.points`: the cell that covers the viewpoint."""
    others: tuple[NDArray[np.int64], ...]
    """For each query (K,) rows of wrong cells, best of the bag first."""

    @classmethod
    def of(cls, city: CityMap, bins: Bins, queries: Sequence[Query]) -> Task:
        """Let the tuned triple bag choose wrong cells; a viewpoint that no cell covers is left out."""
        bag = BagMatcher.of(city, bins, "triple bag, tuned", "none")
        row = {cell: i for i, cell in enumerate(city.cells)}
        kept, truth, others = [], [], []
        for query in queries:
            true = city.cells.at(query.longitude, query.latitude)
            if true is None:
                continue
            found = dict.fromkeys(row[c] for c in bag.rank(query, 2 * max(GIVEN)).cells)
            kept.append(query)
            truth.append(row[true])
            others.append(np.array([r for r in found if r != row[true]], np.int64))
        return cls(city, tuple(kept), np.array(truth, np.int64), tuple(others))


def evaluate(task: Task, network: GraphTransformer) -> Hits:
    """What a network finds, query by query, by how cells are proposed and ranked.

    ``N given``: the true cell and the bag's N - 1 best others, by the matching logit (Eq. 17), and
    ``N given, cosine`` by Eq. 15. ``dense``: all cells by their embeddings (Eq. 11-12), ``among
    10`` whether the true one is among the best ten; ``10 candidates`` these ten by the logit, and
    ``10 candidates, cosine`` the paper's pipeline (Eq. 9-16).
    """
    encoded = EncodedCity(task.city, network)
    found: dict[str, list[list[bool]]] = {}
    for query, truth, others in zip(task.queries, task.truth, task.others, strict=True):
        for name, hits in _hits(encoded, query.text, int(truth), others).items():
            found.setdefault(name, []).append(hits)
    return {name: np.array(hits) for name, hits in found.items()}


def _hits(
    encoded: EncodedCity, text: str, truth: int, others: NDArray[np.int64]
) -> dict[str, list[bool]]:
    query = compile_query(read(encoded.city, text), encoded.city)
    asked = Request(encoded.city, query, matching=Matching(encoded=encoded))
    dense = dense_cells(asked, CANDIDATES)
    given = np.append(others[: max(GIVEN) - 1], truth)  # last: where all are equal, it is not found
    match, own = (matched(encoded, asked.text, rows) for rows in (given, dense))
    logit, cosine = match.logit, match.cosine
    table = {}
    for n in GIVEN:
        some = np.append(np.arange(min(n, len(given)) - 1), len(given) - 1)
        table[f"{n} given"] = given[some][_best(logit[some])]
        table[f"{n} given, cosine"] = given[some][_best(cosine[some])]
    table["dense"] = dense
    table[f"{CANDIDATES} candidates"] = dense[_best(own.logit)]
    table[f"{CANDIDATES} candidates, cosine"] = dense[_best(own.cosine)]
    hits = {name: [bool((rows[:k] == truth).any()) for k in RANKS] for name, rows in table.items()}
    return hits | {f"among {CANDIDATES}": [bool((dense == truth).any())] * len(RANKS)}


def _best(scores: NDArray[np.float32]) -> NDArray[np.int64]:
    return np.argsort(-scores, kind="stable")


def literal_alone(network: GraphTransformer) -> GraphTransformer:
    """The same encoders, with a logit that is what the statements say literally: nothing learned."""
    silent = {"judge.2.weight": np.zeros_like(network.arrays["judge.2.weight"])}
    shape = replace(network.shape, crossings=0)
    return replace(network, shape=shape, arrays=network.arrays | silent)


def recall(tables: Sequence[Hits]) -> dict[str, list[float]]:
    """Recall@1/3/5, mean of the cities."""
    return {
        name: np.mean([table[name].mean(axis=0) for table in tables], axis=0).tolist()
        for name in tables[0]
    }
