"""What a trained network is worth by itself: on candidates of its own, and on given ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.outdoor.likelihood.query import compile_query, read
from placegraph.outdoor.network.encoded import EncodedCity
from placegraph.outdoor.search.candidates import dense_cells
from placegraph.outdoor.search.request import Matching, Request
from placegraph_lab.tables.outdoor.matchers import BagMatcher, cell_centers
from placegraph_lab.tables.outdoor.metrics import RANKS
from placegraph_lab.tables.outdoor.stages import matched

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.geometry import Floats
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.network.network import GraphTransformer
    from placegraph_lab.tables.outdoor.nearby import Bins
    from placegraph_lab.tables.outdoor.queries import Query

GIVEN = 20
"""Cells of the tuned triple bag that every network ranks: the same for all."""
CANDIDATES = (5, 10, 20, 50)
"""Numbers of the network's own candidates."""
HIT = 50.0
"""A cell whose centre lies within this distance of the truth is right [m]."""


@dataclass(frozen=True)
class Task:
    """Queries of one city, and the cells that are given to every network."""

    city: CityMap
    queries: tuple[Query, ...]
    given: tuple[NDArray[np.int64], ...]
    """For each query (K,) rows of `city.cells.points`, best of the bag first."""

    @classmethod
    def of(cls, city: CityMap, bins: Bins, queries: Sequence[Query]) -> Task:
        """Let the tuned triple bag choose cells."""
        bag = BagMatcher.of(city, bins, "triple bag, tuned", "none")
        row = {cell: i for i, cell in enumerate(city.cells)}
        given = [np.array([row[c] for c in bag.rank(q, GIVEN).cells]) for q in queries]
        return cls(city, tuple(queries), tuple(given))

    def right(self, ranked: Sequence[NDArray[np.int64]], off: Sequence[Floats]) -> list[float]:
        """Share of the queries with a right cell among the best 1, 3 and 5."""
        hits = [d[rows] <= HIT for rows, d in zip(ranked, off, strict=True)]
        return [float(np.mean([h[:k].any() for h in hits])) for k in RANKS]


def evaluate(task: Task, network: GraphTransformer) -> dict[str, list[float]]:
    """Recall@1/3/5 within 50 m of a network, by how its cells are found and ranked.

    ``given``: the bag's cells by the matching logit (Eq. 17), ``given, cosine`` by Eq. 15;
    ``dense``: all cells by embedding (Eq. 11-12), ``dense, of 10`` whether a right one is among
    the best ten; ``N candidates``: the best N by embedding, ranked by the logit.
    """
    encoded = EncodedCity(task.city, network)
    centers = cell_centers(task.city)
    off: list[Floats] = []
    found: dict[str, list[NDArray[np.int64]]] = {}
    for query, given in zip(task.queries, task.given, strict=True):
        truth = task.city.plane.to_plane((query.longitude, query.latitude))
        off.append(np.hypot(*(centers - truth).T))
        for name, rows in _ranked(encoded, query.text, given).items():
            found.setdefault(name, []).append(rows)
    table = {name: task.right(ranked, off) for name, ranked in found.items()}
    ten = [
        float(np.mean([(d[r[:10]] <= HIT).any() for r, d in zip(found["dense"], off, strict=True)]))
    ]
    return table | {"dense, of 10": ten}


def _ranked(
    encoded: EncodedCity, text: str, given: NDArray[np.int64]
) -> dict[str, NDArray[np.int64]]:
    """Rankings of cells for one text."""
    query = compile_query(read(encoded.city, text), encoded.city)
    asked = Request(encoded.city, query, matching=Matching(encoded=encoded))
    said = asked.text
    dense = dense_cells(asked, max(CANDIDATES))
    first, own = matched(encoded, said, given), matched(encoded, said, dense)
    table = {
        "given": given[np.argsort(-first.logit, kind="stable")],
        "given, cosine": given[np.argsort(-first.cosine, kind="stable")],
        "dense": dense,
    }
    for n in CANDIDATES:
        table[f"{n} candidates"] = dense[np.argsort(-own.logit[:n], kind="stable")]
    return table


def mean_of(tables: Sequence[dict[str, list[float]]]) -> dict[str, list[float]]:
    """Mean of the tables of several cities."""
    return {name: np.mean([table[name] for table in tables], axis=0).tolist() for name in tables[0]}
