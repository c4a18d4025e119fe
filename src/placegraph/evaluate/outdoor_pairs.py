"""How many pairs of a text and a cell each matcher judges in a second (Table III)."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import OptionError
from placegraph.outdoor import scan
from placegraph.outdoor.edit_distance import rank
from placegraph.outdoor.locate import read
from placegraph.outdoor.query import compile_query
from placegraph.outdoor.search import TOGETHER

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.random import Generator

    from placegraph.evaluate.outdoor_queries import Query
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.description import Description

EVERYTHING = 1e9
"""Margin [nat] that leaves nothing out: every pair is scored in full."""


def rate(work: Callable[[], int], *, seconds: float, least: int = 3) -> float:
    """Pairs a second: the median of runs that together take `seconds`, after one that warms up.

    Parameters
    ----------
    work
        Judges some pairs and says how many they were.
    least
        Runs at the least.

    Raises
    ------
    OptionError
        Where there is no time, or no run.
    """
    if not (seconds > 0.0 and least > 0):
        raise OptionError(f"seconds is {seconds}, least is {least}; give both above 0.")
    work()
    rates: list[float] = []
    end = time.perf_counter() + seconds
    while len(rates) < least or time.perf_counter() < end:
        start = time.perf_counter()
        pairs = work()
        rates.append(pairs / (time.perf_counter() - start))
    return float(np.median(rates))


@dataclass(frozen=True)
class Pairs:
    """Texts, and cells drawn at random for each of them."""

    city: CityMap
    descriptions: tuple[Description, ...]
    rows: tuple[np.ndarray, ...]
    """For each text (K,) rows of `city.cells.points`."""

    @classmethod
    def of(cls, city: CityMap, queries: Sequence[Query], cells: int, rng: Generator) -> Pairs:
        """Every query with `cells` cells."""
        return cls(
            city,
            tuple(read(city, q.text) for q in queries),
            tuple(rng.choice(len(city.cells), cells, replace=False) for _ in queries),
        )

    def by_edits(self, *, plain: bool, texts: int, cells: int, timeout: float) -> Callable[[], int]:
        """Edit distance of some of the pairs; the graphs of the cells are made before."""
        names = tuple(self.city.cells)
        chosen = [
            (d, [names[i] for i in r[:cells]])
            for d, r in zip(self.descriptions[:texts], self.rows, strict=False)
        ]
        graphs = [[self.city.graph(cell) for cell in cells] for _, cells in chosen]
        centers = [[self.city.cells.center(cell) for cell in cells] for _, cells in chosen]

        def work() -> int:
            for (description, _), given, at in zip(chosen, graphs, centers, strict=True):
                rank(description, given, centers=at, timeout=timeout, plain=plain)
            return sum(map(len, graphs))

        return work

    @cached_property
    def views(self) -> tuple[np.ndarray, ...]:
        """For each text (K,) viewpoints drawn at random: what relational matching scores."""
        rng = np.random.default_rng(0)
        count = len(self.city.views.positions)
        return tuple(rng.choice(count, len(r)).astype(np.int32) for r in self.rows)

    def by_relations(self) -> Callable[[], int]:
        """Relational matching of all pairs in full, texts compiled anew."""
        city, columns, scene = self.city, self.city.views.columns, self.city.scene
        tokens = len(city.views.posting_starts) - 1

        def work() -> int:
            for description, chosen in zip(self.descriptions, self.views, strict=True):
                query = compile_query(description, city)
                statements = query.statements
                scan.score_views(
                    statements,
                    scene,
                    columns,
                    query.words(tokens),
                    chosen,
                    np.ones(len(chosen)),
                    np.zeros(len(chosen)),
                    np.zeros((len(chosen), len(statements.op)), np.float32),
                    TOGETHER,
                    EVERYTHING,
                )
            return sum(map(len, self.views))

        return work
