"""The paper's pipeline stage by stage, each with its time: read, embed, search, match (Eq. 9-16)."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.network.network import EncodedCity
from placegraph.outdoor.search.cells import retrieve
from placegraph.outdoor.search.edit_distance import TIMEOUT
from placegraph.outdoor.search.request import Matching, MatchingOptions, parse
from placegraph_lab.tables.outdoor.baselines import Bag
from placegraph_lab.tables.outdoor.metrics import BAGS, RANKS, Answer, distances, positions
from placegraph_lab.tables.outdoor.nearby import Bins
from placegraph_lab.tables.outdoor.queries import Query, Setting

STAGES = ("read", "embed", "search", "match")


class Run(NamedTuple):
    """One query through the pipeline."""

    seconds: dict[str, float]  # by stage
    rows: NDArray[np.int64]  # rows of `city.cells.points`, best first

    @property
    def total(self) -> float:
        return sum(self.seconds.values())


def run(encoded: EncodedCity, text: str, candidates: int | None = 10) -> Run:
    """Rank the cells nearest by embedding, by the cosine; all cells where `candidates` is None."""
    city = encoded.city
    clock = [time.perf_counter()]
    query = compile_query(parse(city, text), city)
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
    found = encoded.match(said, encoded.cells, rows)
    ranked = rows[np.argsort(-found.cosine, kind="stable")]
    clock.append(time.perf_counter())
    return Run(dict(zip(STAGES, np.diff(clock).tolist(), strict=True)), ranked)


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
    return float(np.polyfit(np.asarray(cells, np.float64), np.asarray(seconds, np.float64), 1)[0])


RELATIONAL, FUSED = "relational (default)", "fused"
PRINTED, PRINTED_ALONE = "GOTLoc as printed", "GOTLoc as printed, embeddings alone"
PRINTED_EDITS = "GOTLoc as printed, rule-based"
DENSE = "our network, dense candidates alone"
COSINE_DENSE, LOGIT_DENSE = (
    "our network by cosine, dense candidates",
    "our network by logit, dense candidates",
)
EDIT_PLAIN, EDIT = "edit distance, plain, sparse candidates", "edit distance, sparse candidates"
COSINE, LOGIT = (
    "our network by cosine, sparse candidates",
    "our network by logit, sparse candidates",
)
_SPARSE: MatchingOptions = {"by": "sparse", "candidates": 10}
_DENSE: MatchingOptions = {"by": "dense", "candidates": 10}
PIPELINES: dict[str, MatchingOptions] = {
    PRINTED_EDITS: {"preset": "paper", "matcher": "edit-distance-plain"},
    PRINTED: {"preset": "paper"},
    PRINTED_ALONE: {"preset": "published"},
    COSINE_DENSE: {"matcher": "transformer", "score": "cosine", **_DENSE},
    DENSE: {"matcher": "embedding", **_DENSE},
    LOGIT_DENSE: {"matcher": "transformer", **_DENSE},
    EDIT_PLAIN: {"matcher": "edit-distance-plain", **_SPARSE},
    EDIT: {"matcher": "edit-distance", **_SPARSE},
    COSINE: {"matcher": "transformer", "score": "cosine", **_SPARSE},
    LOGIT: {"matcher": "transformer", **_SPARSE},
}
"""Matchers that rank ten cells from the paper's embeddings, from ours, or from the inverted index."""
MATCHERS = (*BAGS, *PIPELINES, RELATIONAL, FUSED)  # all, in the order of the table
SLOW = (PRINTED_EDITS, EDIT_PLAIN)  # those that only get some of the queries, of some of the cities


class Places(NamedTuple):
    """Ranked places, best first."""

    positions: Floats  # (k, 2) longitude, latitude [deg]
    cells: tuple[str, ...]  # (k,) cells of the map


class Matcher(Protocol):
    """Ranks the cells of a map by how well they fit a query."""

    def rank(self, query: Query, top: int) -> Places:
        """At most `top` places, best first."""


def places_of(city: CityMap, cells: Iterable[str]) -> Places:
    named = tuple(cells)
    at = [city.cells.center(cell) for cell in named]
    return Places(city.plane.to_lonlat(np.reshape(at, (-1, 2))), named)


@dataclass(frozen=True)
class BagMatcher:
    """A bag of words over the map's own cells."""

    city: CityMap
    bag: Bag

    @classmethod
    def of(
        cls, city: CityMap, bins: Bins, name: str, setting: Setting, seed: int = 0
    ) -> BagMatcher:
        """One of `BAGS`, as a setting wants it."""
        reach, longest = BAGS[name]
        pairs = "speaker" if setting == "speaker" else "triples"
        bag = Bag.of(
            bins,
            "labels" if name == "label bag" else pairs,  # type: ignore[arg-type]
            reach=reach,
            longest=longest,
            names=setting == "names",
            seed=seed,
            centers=bins.city.plane.to_plane(city.plane.to_lonlat(cell_centers(city))),
        )
        return cls(city, bag)

    def rank(self, query: Query, top: int) -> Places:
        at = self.city.plane.to_plane(self.bag.locate(query, top))
        return places_of(self.city, (self.city.cells.nearest(p) for p in at))


@dataclass(frozen=True)
class LocateMatcher:
    city: CityMap
    options: Mapping[str, Any] = field(default_factory=dict)

    def rank(self, query: Query, top: int) -> Places:
        estimate = self.city.locate(query.text, top=top, **self.options)
        return Places(positions(estimate), tuple(mode.cell for mode in estimate.modes))


@dataclass(frozen=True)
class RetrieveMatcher:
    """The paper's pipeline on cells (Eq. 9-16): candidates, then a matcher for each pair."""

    city: CityMap
    options: MatchingOptions
    timeout: float = TIMEOUT

    def rank(self, query: Query, top: int) -> Places:
        """Candidates, ranked."""
        options = self.options.copy()
        matching = Matching.preset(options.pop("preset", "default"), **options)
        if matching.uses_network and matching.encoded is None:
            encoded = self.city.encoded_as_printed if matching.printed else self.city.encoded
            matching = replace(matching, encoded=encoded)
        text = parse(self.city, query.text)
        found = retrieve(self.city, text, matching, top=top, timeout=self.timeout)
        return places_of(self.city, found.cells)


def cell_centers(city: CityMap) -> Floats:
    """Centres (C, 2) of the cells, in the order of `city.cells.points`; east, north [m]."""
    return city.cells.centers(np.arange(len(city.cells)))


def matcher(
    name: str, city: CityMap, bins: Bins, setting: Setting = "none", *, seed: int = 0
) -> Matcher:
    if name in BAGS:
        return BagMatcher.of(city, bins, name, setting, seed)
    if name in PIPELINES:
        return RetrieveMatcher(city, PIPELINES[name])
    return LocateMatcher(city, {"matcher": "fused"} if name == FUSED else {})


def ask(
    matcher: Matcher, city: CityMap, queries: Sequence[Query], *, top: int = max(RANKS)
) -> list[Answer]:
    """Give queries to a matcher; a place is exact where its cell is the one that covers the truth.

    A viewpoint that no cell of the map covers is never found exactly.
    """
    answers = []
    for query in queries:
        start = time.perf_counter()
        places = matcher.rank(query, top)
        seconds = time.perf_counter() - start
        truth = city.cells.at(query.longitude, query.latitude)
        off = distances(places.positions, query.longitude, query.latitude)
        exact = tuple(truth is not None and cell == truth for cell in places.cells)
        answers.append(Answer(off, exact, seconds))
    return answers
