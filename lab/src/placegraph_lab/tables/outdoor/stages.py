"""The paper's pipeline stage by stage, each with its time: read, embed, search, match (Eq. 9-16)."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.city import CityMap
from placegraph.outdoor.likelihood.query import compile_query, read
from placegraph.outdoor.network.encoded import EncodedCity, EncodedText
from placegraph.outdoor.network.network import Matches
from placegraph_lab.tables.outdoor.queries import Query

STAGES = ("read", "embed", "search", "match")
AT_ONCE = 2000
"""Pairs matched in one call where all cells are: memory stays small."""


class Run(NamedTuple):
    """One query through the pipeline."""

    seconds: dict[str, float]
    """By stage."""
    rows: NDArray[np.int64]
    """Rows of `city.cells.points`, best first."""

    @property
    def total(self) -> float:
        """Seconds of all stages."""
        return sum(self.seconds.values())


def run(encoded: EncodedCity, text: str, candidates: int | None = 10) -> Run:
    """Rank the cells nearest by embedding, by the cosine; all cells where `candidates` is None."""
    city = encoded.city
    clock = [time.perf_counter()]
    query = compile_query(read(city, text), city)
    clock.append(time.perf_counter())
    said = encoded.text(query)
    embedding = encoded.network.embed_texts(said.graphs)
    clock.append(time.perf_counter())
    if candidates is None:
        rows = np.arange(len(city.cells))
    else:
        points = encoded.store.search(embedding, candidates).ids[0]
        rows = np.searchsorted(city.cells.points, points[points >= 0])
    clock.append(time.perf_counter())
    found = matched(encoded, said, rows)
    ranked = rows[np.argsort(-found.cosine, kind="stable")]
    clock.append(time.perf_counter())
    return Run(dict(zip(STAGES, np.diff(clock).tolist(), strict=True)), ranked)


def matched(encoded: EncodedCity, said: EncodedText, rows: NDArray[np.int64]) -> Matches:
    """Match a text with cells `rows` (K,) (Eq. 14-17), some thousands at once."""
    found = [
        encoded.match(said, encoded.cells, rows[i : i + AT_ONCE])
        for i in range(0, len(rows), AT_ONCE)
    ]
    return Matches(*(np.concatenate(column) for column in zip(*found, strict=True)))


def medians(runs: Sequence[Run]) -> dict[str, float]:
    """Median seconds by stage and in total."""
    found = {s: float(np.median([r.seconds[s] for r in runs])) for s in STAGES}
    return found | {"total": float(np.median([r.total for r in runs]))}


def found_within(
    city: CityMap, queries: Sequence[Query], best: Sequence[NDArray[np.float64]], radius: float
) -> float:
    """Share of queries whose best place (2,) east, north [m] lies within `radius` [m] of the truth."""
    truth = city.plane.to_plane([(q.longitude, q.latitude) for q in queries])
    return float((np.hypot(*(np.reshape(best, (-1, 2)) - truth).T) <= radius).mean())


def slope(cells: Sequence[int], seconds: Sequence[float]) -> float:
    """Seconds more for each cell more, by least squares."""
    return float(np.polyfit(np.asarray(cells, np.float64), np.asarray(seconds, np.float64), 1)[0])
