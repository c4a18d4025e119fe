"""Evidence of what lies outdoors: towns as a whole, their streets, and the buildings that scenes stand in."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geojson import contains_points
from placegraph.core.geometry import Floats
from placegraph.outdoor.language.description import SPEAKER, WITHIN, Description, Relation
from placegraph.outdoor.language.words import tokens
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts
from placegraph.outdoor.map.index import REACH
from placegraph.outdoor.map.objects import AREA, LINE, POINT
from placegraph.outdoor.search.locate import (
    DECISIVE,
    find_evidence,
    make_estimate,
    score_positions,
    search_views,
)
from placegraph.outdoor.search.posterior import PRIOR_ELSEWHERE, Posterior
from placegraph.outdoor.search.request import (
    Hints,
    LocationPrior,
    Matching,
    Request,
    TextContext,
    hint_swapped,
    make_request,
)
from placegraph.outdoor.search.status import find_obstacle, infer_claim

if TYPE_CHECKING:
    from placegraph.core.estimate import CityEstimate, Evidence
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.likelihood.query import Query
    from placegraph.outdoor.search.ask import Question
    from placegraph.world.estimate import WorldQuery

SHARE_NEAREST, SHARE_NEXT, FALLOFF, SHARE_ANY = 0.8, 0.4, 12.0, 0.003
"""Share of houses whose address is of the nearest street with a name; of one that is hardly farther,
and by how much farther [m] this falls to a third; and of any street. Of 28,000 pairs of house and
street in Vancouver, Manhattan, Toronto, Ankara, Monaco and Liechtenstein."""
SHARE_ANY_NEAR = 0.1
"""Share of houses whose address is of any one street within 150 m."""
SHARE_ADDRESS, SHARE_CORNER = 0.97, 0.3
"""Share of people who name the street of the address on the map; of a corner house, the other street."""
MAX_STREET_DISTANCE = 150.0
"""No building stands on a street that is farther off [m]."""
SURROUNDINGS = (12.0, 24.0)
"""Distances from a building's walls of what is seen from its doors and windows [m]."""
MAX_CITY_DISTANCE = 100.0
"""A scene so far off a city's map is in another town [m]."""
SAME_BUILDING = 30.0
"""A building is the one that the speaker is in where its point is this near its middle [m]."""
MISSING_NAME = -5.0
"""Log-likelihood ratio of a town for each name of the text that another town has and this one lacks."""
MAX_RATIO_OUTSIDE = -2.0
"""Largest log-likelihood ratio of a building that the speaker is not in, by the text."""


class TownWords(TextContext, Protocol):
    """Meanings of words in a town."""

    @property
    def label_index(self) -> Mapping[str, Sequence[int]]:
        """Tokens by label and by ``key=*``."""


class Town(Protocol):
    """A map of the outdoors: a city, or a world in shards."""

    @property
    def words(self) -> TownWords:
        """Meanings of words in it."""

    def is_street(self, name: str) -> bool:
        """Whether a name means streets, and nothing else."""

    def match(self, description: Description, query: WorldQuery) -> TownMatch | str:
        """Search for a description; return what was found, or why nothing can be searched for."""

    def explain_prior(self, near: Sequence[float], radius: float) -> str | None:
        """Return None where the location prior is on the map; else a hint, which may be empty."""

    def ask(self, part: str, estimate: CityEstimate) -> Question | None:
        """Choose the question that tells the places of a part (`TownMatch.parts`) apart."""


class BuildingScore(NamedTuple):
    """Likelihood of one building, by a description of the outdoors."""

    ratio: float
    """Log-likelihood ratio of being there, against anywhere."""
    is_meant: bool
    """Whether the speaker says to be in this building."""
    weights: tuple[float, ...]
    """Log-likelihood ratio of each statement."""


@dataclass(frozen=True, eq=False)
class BuildingMatch:
    """Score of one building, with its evidence."""

    score: BuildingScore
    explain: Callable[[], tuple[Evidence, ...]]
    """Evidence of the statements at the middle of the building."""

    def add_ratio(self, ratio: float) -> BuildingMatch:
        """Return the match with a log-likelihood ratio added to its score."""
        return replace(self, score=self.score._replace(ratio=self.score.ratio + ratio))

    @property
    def evidence(self) -> tuple[Evidence, ...]:
        """Evidence of each statement for the building."""
        found = self.explain()
        own = [
            e if abs(e.weight - w) < DECISIVE else replace(
                e, weight=w, verdict="for" if w > DECISIVE else "against" if w < -DECISIVE else "silent",
                note="" if w > DECISIVE else e.note,
            )
            for e, w in zip(found, self.score.weights, strict=False)
        ]  # fmt: skip
        return (*own, *found[len(own) :])


@dataclass(frozen=True, eq=False)
class TownMatch:
    """Result of a search for a description in a town."""

    query: Query
    posterior: Posterior
    estimate: CityEstimate
    parts: dict[str, CityEstimate]
    """The estimate, or the parts of it that questions can be asked of, by name of the map."""
    gap: str
    """Which part of the town was not searched, and why; empty where all that matters was."""
    missing: int = field(default=0, kw_only=True)
    """Number of names of the text that another town has and this one lacks."""

    @cached_property
    def gain(self) -> float:
        """Log-likelihood ratio of this town, wherever in it, against anywhere else."""
        here, off = float(self.posterior.probabilities.sum()), self.posterior.elsewhere
        ratio = (here + 1e-9) / (off + 1e-9) * PRIOR_ELSEWHERE / (1.0 - PRIOR_ELSEWHERE)
        slope = infer_claim(self.query.description).of_radius.slope
        return slope * float(np.log(ratio)) + MISSING_NAME * self.missing

    @property
    def cost(self) -> str:
        """Sentence that says how much was searched."""
        return ""

    @property
    def notes(self) -> tuple[str, ...]:
        """Maps that did not answer."""
        return ()

    def match_buildings(self, corners: Sequence[Floats]) -> list[BuildingMatch | None]:
        """Score buildings by their corners (4, 2) [deg]; None for those in other towns."""
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class CityMatch(TownMatch):
    """Result of a search in one city."""

    city: CityMap
    request: Request

    def match_buildings(self, corners: Sequence[Floats]) -> list[BuildingMatch | None]:
        """Score buildings by their corners (4, 2) [deg]; None for those in other towns."""
        scorer = BuildingScorer(self.city, self.request)
        out: list[BuildingMatch | None] = []
        for each in corners:
            score = scorer.score(each)
            middle = self.city.plane.to_plane(each).mean(axis=0)
            explain = partial(find_evidence, middle, self.city, self.query)
            out.append(None if score is None else BuildingMatch(score, explain))
        return out


@dataclass(frozen=True, eq=False)
class CityTown:
    """A `Town` of one city map."""

    name: str
    words: CityMap

    def is_street(self, name: str) -> bool:
        """Whether a name means streets, and nothing else."""
        return len(find_roads(self.words, name)) > 0

    def match(self, description: Description, query: WorldQuery) -> TownMatch | str:
        """Search for a description; return what was found, or why nothing can be searched for."""
        city = self.words
        hints = Hints(query.near, query.radius, query.heading, answers=query.answers)
        request = make_request(city, description, hints, Matching())
        if not request.is_positive:
            return find_obstacle(request.query, request.understood)
        near = request.prior.near
        if near is not None and not len(city.views.near(near, 4.0 * request.prior.radius)):
            return ""
        found = search_views(request)
        made = make_estimate(request, found, query.top)
        return CityMatch(request.query, found, made, {self.name: made}, "", city, request)

    def explain_prior(self, near: Sequence[float], radius: float) -> str | None:
        """Return None where the location prior is on the map; else a hint, which may be empty."""
        is_off = LocationPrior.around(self.words, near, radius).is_off_map(self.words)
        return hint_swapped(self.words, near) if is_off else None

    def ask(self, part: str, estimate: CityEstimate) -> Question | None:
        """Choose the question that tells the places of an estimate apart."""
        del part
        return self.words.ask(estimate)


@dataclass(frozen=True, eq=False)
class BuildingScorer:
    """Scores the buildings of a city by a description."""

    home: CityMap
    request: Request
    """Its city may hold more objects than `home`, which people mention from afar."""

    @cached_property
    def streets(self) -> dict[int, NDArray[np.int64]]:
        """Rows of the street of each statement that names the street of the speaker."""
        query = self.request.query
        named = {
            i: find_roads(self.home, query.description.mentions[s.target].name)
            for i, s in enumerate(query.used)
            if s.relation is Relation.ALONG and s.source == SPEAKER
        }
        return {i: rows for i, rows in named.items() if len(rows)}

    def score(self, corners: Floats) -> BuildingScore | None:
        """Score a building by its corners (4, 2) [deg]; None where it is off the map.

        What the speaker is *in* is compared with the building itself, the street that the speaker is on
        with its address, all else with its surroundings as well.
        """
        footprint = self.home.plane.to_plane(corners)
        middle = footprint.mean(axis=0)
        if not len(self.home.views.near(middle, MAX_CITY_DISTANCE)):
            return None
        query = self.request.query
        inner = np.concatenate([middle[None], (footprint + middle) / 2.0])
        rays = (
            np.concatenate([footprint, (footprint + np.roll(footprint, 1, axis=0)) / 2.0]) - middle
        )
        far = np.linalg.norm(rays, axis=1, keepdims=True)
        outer = np.concatenate(
            [middle + rays * (1.0 + d / np.maximum(far, 1.0)) for d in SURROUNDINGS]
        )
        ratios, served = score_positions(np.concatenate([inner, outer]), self.request.city, query)
        weights, is_meant = [], False
        for i, s in enumerate(query.used):
            is_within = s.relation in WITHIN and s.source == SPEAKER
            ratio = float((ratios[: len(inner)] if is_within else ratios)[:, i].max())
            if i in self.streets:
                ratio = self._score_street(i, footprint)
            if is_within and not s.negated:
                holds, is_building = self._contains(served[: len(inner), i], footprint)
                is_meant |= is_building
                ratio = ratio if holds else min(ratio, MAX_RATIO_OUTSIDE)
            weights.append(ratio)
        slope = infer_claim(query.description).of_radius.slope
        return BuildingScore(slope * sum(weights), is_meant, tuple(weights))

    def _score_street(self, i: int, footprint: Floats) -> float:
        """Log-likelihood ratio of statement i, which names the street of the speaker.

        Against the other streets around; so far as the building is on that street, as for somebody there.
        """
        query = self.request.query
        noise, is_negated = query.statements.noise[i], query.used[i].negated
        on = compare_address(self.home, self.streets[i], footprint)
        p = on.probability if on is not None else 0.0
        odds = 1.0 - p if is_negated else p / SHARE_ANY_NEAR
        gain = float(np.log((1.0 - noise) * odds + noise))
        if on is None or is_negated:
            return gain
        there, _ = score_positions(on.position[None], self.request.city, query)
        return gain + p * max(0.0, float(there[0, i]) - gain)

    def _contains(self, rows: NDArray[np.int32], footprint: Floats) -> tuple[bool, bool]:
        """Return whether one of some objects holds a building (4, 2) [m], and whether it is a building.

        A shop is where its point is; a square or a park may hold a building, and is none; a promenade
        holds nothing.
        """
        o, middle = self.request.city.objects, footprint.mean(axis=0)
        ring = np.concatenate([footprint, footprint[:1]])
        holds = is_meant = False
        for r in np.unique(rows[rows >= 0]).tolist():
            part = o.part_starts, o.point_starts, o.points, o.kind[r], r
            away = float(np.hypot(*nearest_on_parts(*part, *middle)[:2]))
            if o.kind[r] == AREA:
                labels = o.label_values[o.label_starts[r] : o.label_starts[r + 1]].tolist()
                is_central = bool(contains_points(o.center[r][None], [ring])[0])
                this = away == 0.0 or is_central
                is_building = is_central or any(o.labels[k].startswith("building") for k in labels)
            else:
                this = is_building = o.kind[r] == POINT and away < SAME_BUILDING
            holds, is_meant = holds or this, is_meant or (this and is_building)
        return holds, is_meant


@dataclass(frozen=True, eq=False)
class StreetMatch:
    """Probability that somebody in a building says to be on a street."""

    probability: float
    position: Floats
    """(2,) of the street, nearest to the building [m]."""


def find_roads(city: CityMap, name: str) -> NDArray[np.int64]:
    """Find the rows of the streets that a name means; none where it means other objects, too."""
    starts, objects = city.token_objects
    found = [t + len(city.objects.labels) for t in city.name_index.find_rows(name)]
    rows = np.concatenate([objects[starts[t] : starts[t + 1]] for t in found] or [objects[:0]])
    return np.unique(rows) if all(_is_road(city, int(row)) for row in rows) else rows[:0]


def compare_address(city: CityMap, roads: NDArray[np.int64], corners: Floats) -> StreetMatch | None:
    """Compare the address of the building around corners (4, 2) [m] with a street, by its rows.

    By the address on the map, else by the streets near the building; None where the street is far off.
    """
    o = city.objects
    around = np.unique(city.in_sight(city.views.near(corners.mean(axis=0), REACH)).objects)
    buildings = [
        int(row)
        for row in around
        if o.kind[row] == AREA
        and o.label(row).startswith("building")
        and _distance(city, row, corners.mean(axis=0)[None])[0] == 0.0
    ]
    walls = np.concatenate([corners, *(p for row in buildings for p in o.parts(row))])
    there, position = min((_distance(city, row, walls) for row in roads), key=lambda x: x[0])
    if there > MAX_STREET_DISTANCE:
        return None
    named = [row for row in around if _is_road(city, row) and o.name(row)]
    farther = there - min([there, *(_distance(city, row, walls)[0] for row in named)])
    near = (
        SHARE_NEAREST
        if farther < 0.1
        else max(SHARE_ANY, SHARE_NEXT * float(np.exp(-farther / FALLOFF)))
    )
    written = set()
    for row in buildings:  # "7 Lange Straße" is on Lange Straße
        names = (o.names[i] for i in o.name_values[o.name_starts[row] : o.name_starts[row + 1]])
        streets = (name.partition(" ")[2] for name in names if name[:1].isdigit())
        written |= {" ".join(tokens(street)) for street in streets if street}
    if not written:
        return StreetMatch(near, position)
    called = {" ".join(tokens(o.name(int(row)))) for row in roads}
    return StreetMatch(
        SHARE_ADDRESS if written & called else max(SHARE_ANY, SHARE_CORNER * near), position
    )


def _distance(city: CityMap, row: int, points: Floats) -> tuple[float, Floats]:
    """Distance of an object from the nearest of points (N, 2) [m], and its nearest place (2,)."""
    o = city.objects
    best = (np.inf, points[0])
    for x, y in points.tolist():
        east, north, square = nearest_on_parts(
            o.part_starts, o.point_starts, o.points, o.kind[row], row, x, y
        )
        if square < best[0] ** 2:
            best = (float(np.sqrt(square)), np.array([x + east, y + north]))
    return best


def _is_road(city: CityMap, row: int) -> bool:
    return bool(city.objects.kind[row] == LINE) and city.objects.label(row).startswith("highway")
