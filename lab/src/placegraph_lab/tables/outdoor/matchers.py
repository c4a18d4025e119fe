"""Matchers by one protocol: a query goes in, the best cells of a map come out (Table II).

All rank the cells of the same map. Bags are handed the query's triples; all others read its text.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.likelihood.query import read
from placegraph.outdoor.search.cells import retrieve
from placegraph.outdoor.search.edit_distance import TIMEOUT
from placegraph.outdoor.search.request import Matching, MatchingOptions
from placegraph_lab.tables.outdoor.baselines import Bag
from placegraph_lab.tables.outdoor.metrics import RANKS, Answer, distances, positions
from placegraph_lab.tables.outdoor.nearby import Bins
from placegraph_lab.tables.outdoor.queries import Query, Setting
from placegraph_lab.tables.outdoor.report import BAGS

RELATIONAL, FUSED = "relational (default)", "fused"
DENSE = "dense candidates alone"
PAPER_EDITS, PAPER_TRANSFORMER = "paper's pipeline, rule-based", "paper's pipeline, our network"
EDIT_PLAIN, EDIT = "edit distance, plain, sparse candidates", "edit distance, sparse candidates"
LOGIT_DENSE = "transformer by logit, dense candidates"
COSINE, LOGIT = (
    "transformer by cosine, sparse candidates",
    "transformer by logit, sparse candidates",
)
_SPARSE: MatchingOptions = {"by": "sparse", "candidates": 10}
PIPELINES: dict[str, MatchingOptions] = {
    PAPER_EDITS: {"preset": "paper", "matcher": "edit-distance-plain"},
    PAPER_TRANSFORMER: {"preset": "paper"},
    DENSE: {"preset": "published"},
    LOGIT_DENSE: {"preset": "paper", "score": "logit"},
    EDIT_PLAIN: {"matcher": "edit-distance-plain", **_SPARSE},
    EDIT: {"matcher": "edit-distance", **_SPARSE},
    COSINE: {"matcher": "transformer", "score": "cosine", **_SPARSE},
    LOGIT: {"matcher": "transformer", **_SPARSE},
}
"""What ranks ten cells: found by their embeddings, as in the paper, or by the inverted index."""
MATCHERS = (*BAGS, *PIPELINES, RELATIONAL, FUSED)
"""All, in the order of the table."""
SLOW = (PAPER_EDITS, EDIT_PLAIN)
"""Those that only get some of the queries, of some of the cities."""


class Places(NamedTuple):
    """Ranked places, best first."""

    positions: Floats
    """(k, 2) longitude, latitude [deg]."""
    cells: tuple[str, ...]
    """(k,) cells of the map."""


class Matcher(Protocol):
    """Ranks the cells of a map by how well they fit a query."""

    def rank(self, query: Query, top: int) -> Places:
        """At most `top` places, best first."""


def places_of(city: CityMap, cells: Iterable[str]) -> Places:
    """Places in the middle of cells."""
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
        """Cells with the rarest of the query's words."""
        at = self.city.plane.to_plane(self.bag.locate(query, top))
        return places_of(self.city, (self.city.cells.nearest(p) for p in at))


@dataclass(frozen=True)
class LocateMatcher:
    """What a user calls: `CityMap.locate`, with its positions finer than cells."""

    city: CityMap
    options: Mapping[str, Any] = field(default_factory=dict)

    def rank(self, query: Query, top: int) -> Places:
        """Modes of the estimate."""
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
        matching = replace(matching, shipped=lambda: self.city.encoded)
        text = read(self.city, query.text)
        found = retrieve(self.city, text, matching, top=top, timeout=self.timeout)
        return places_of(self.city, found.cells)


def cell_centers(city: CityMap) -> Floats:
    """Centres (C, 2) of the cells, in the order of `city.cells.points`; east, north [m]."""
    return city.cells.centers(np.arange(len(city.cells)))


def matcher(
    name: str, city: CityMap, bins: Bins, setting: Setting = "none", *, seed: int = 0
) -> Matcher:
    """Matcher by its name in `MATCHERS`, ready for the queries of a setting."""
    if name in BAGS:
        return BagMatcher.of(city, bins, name, setting, seed)
    if name in PIPELINES:
        return RetrieveMatcher(city, PIPELINES[name])
    return LocateMatcher(city, {"matcher": "fused"} if name == FUSED else {})


def ask(
    asked: Matcher, city: CityMap, queries: Sequence[Query], *, top: int = max(RANKS)
) -> list[Answer]:
    """Give queries to a matcher; a place is exact where its cell is the one that covers the truth.

    A viewpoint that no cell of the map covers is never found exactly.
    """
    answers = []
    for query in queries:
        start = time.perf_counter()
        places = asked.rank(query, top)
        seconds = time.perf_counter() - start
        truth = city.cells.at(query.longitude, query.latitude)
        off = distances(places.positions, query.longitude, query.latitude)
        exact = tuple(truth is not None and cell == truth for cell in places.cells)
        answers.append(Answer(off, exact, seconds))
    return answers
