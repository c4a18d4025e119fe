"""Request of a search: a parsed description, a prior of the place, and how to match.

`make_request` checks all options, and compiles the description against the city.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import isfinite, nan, pi
from typing import Any, Literal, NamedTuple, Protocol, Self, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, angle_between, bearing
from placegraph.errors import OptionError
from placegraph.outdoor.language import describe
from placegraph.outdoor.language.description import (
    LISTENER,
    Description,
    Relation,
    Statement,
    ends,
    find_speaker_nodes,
)
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.likelihood.query import Query, TokenWeights, compile_query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.index import REACH, STRIDE, ViewIndex
from placegraph.outdoor.map.names import NameIndex
from placegraph.outdoor.network.network import EncodedCity, EncodedText
from placegraph.outdoor.options import By, Matcher, RankingOptions, Score
from placegraph.outdoor.search.ask import Answer
from placegraph.vectors import Origin, Region, VectorStore
from placegraph.vectors.stores import refuse_other

WALKING_SIGMA = 900.0
"""Standard deviation, along each axis, of places around a listener whom somebody tells of them [m]."""
Preset = Literal["default", "paper", "published"]
_RANKING_VIEWPOINTS = ("fused", "relational")


class Route(NamedTuple):
    """Direction, and perhaps distance, from the listener to the speaker."""

    bearing: float
    """[rad]"""
    sigma: float
    """[rad]"""
    certainty: float
    distance: float | None = None
    """[m], where the text states one."""

    def likelihood_ratio(self, delta: Floats) -> Floats:
        """Return the likelihood ratio (W,) of positions (W, 2) [m] from the listener, against anywhere."""
        sigma = 0.9 * self.sigma
        off = np.exp(-0.5 * (angle_between(bearing(delta), self.bearing) / sigma) ** 2)
        if self.distance is None:
            return np.asarray(off * np.sqrt(2.0 * np.pi) / sigma)
        # on the ring at that distance, against all around within a walk
        far, width = np.hypot(*delta.T), 0.25 * self.distance + 60.0
        ring = off * np.exp(-0.5 * ((far - self.distance) / width) ** 2)
        area = 2.0 * np.pi * sigma * width * np.maximum(far, width)
        return np.asarray(ring / area * 1e6 / np.maximum(_walk_density(far), 1e-6))


def _walk_density(distance: Floats) -> Floats:
    """Density [1/km^2] of meeting places around a listener: mostly within a kilometre or so."""
    return np.asarray(
        np.exp(-0.5 * (distance / WALKING_SIGMA) ** 2) * 1e6 / (2.0 * np.pi * WALKING_SIGMA**2)
    )


@dataclass(frozen=True, eq=False)
class LocationPrior:
    """Prior of the speaker's place; every part is optional."""

    near: Floats | None = None
    """(2,) east, north [m] the speaker is near."""
    radius: float = 1000.0
    """Radius around `near` that holds half of the probability [m]."""
    listener: Floats | None = None
    """(2,) east, north [m] of "you"."""
    routes: tuple[Route, ...] = ()
    """Ways from the listener to the speaker."""
    inside: Callable[[Floats], NDArray[np.bool_]] | None = None
    """Whether the speaker may be at positions (K, 2) [m]; anywhere if not given."""

    @classmethod
    def around(cls, city: City, near: Sequence[float] | None, radius: float) -> Self:
        """Make a prior near a longitude and latitude [deg]; a third number is the radius [m].

        Raises
        ------
        OptionError
            `near` is not in degrees, or the radius is out of range.

        """
        if near is not None and np.size(near) == 3:
            near, radius = near[:2], near[2]
        if not 1.0 <= to_number(radius) <= 1e7:
            raise OptionError(f"radius is {radius!r} m; choose between 1 and 10,000,000 m.")
        center = None if near is None else to_position(city, near, "near")
        return cls(center, to_number(radius))

    @property
    def is_informative(self) -> bool:
        """Whether anything is known."""
        return not (self.near is None and self.listener is None and self.inside is None)

    def is_off_map(self, city: City) -> bool:
        """Whether the map does not reach the surroundings of `near`."""
        return self.near is not None and not len(
            city.views.near(self.near, 4.0 * self.radius + REACH)
        )

    def evaluate(self, positions: Floats) -> Floats:
        """Return the log prior probability (W,) of all viewpoints of a map at positions (W, 2) [m].

        Without any knowledge the prior is uniform; it is -inf where the speaker cannot be. `near` shifts
        probability within the map, and off the map only where the map ends before the radius.
        """
        allowed = (
            np.ones(len(positions), np.bool_) if self.inside is None else self.inside(positions)
        )
        n = int(allowed.sum())
        prior = np.where(allowed, -np.log(max(1, n)), -np.inf)
        if not n:
            return prior
        if self.near is not None:
            # of a round Gaussian, half lies within 1.1774 sigma; viewpoints stand in for their square
            sigma = np.hypot(self.radius / 1.1774, STRIDE / 2)
            off = -0.5 * (((positions - self.near) / sigma) ** 2).sum(axis=1)
            off = np.where(allowed, off, -np.inf)
            prior = off - np.logaddexp.reduce(off) + off.max()
        if self.listener is not None:
            delta = positions - self.listener
            area = n * STRIDE**2 / 1e6
            prior += np.log(_walk_density(np.hypot(*delta.T)) * area + 1e-3)
            for route in self.routes:
                ratio = route.likelihood_ratio(delta)
                prior += np.log(route.certainty * ratio + (1.0 - route.certainty) + 0.05)
        return prior

    def evaluate_views(self, views: ViewIndex) -> Floats:
        """Return the log prior (W,) of all viewpoints, summing to at most 1; empty if nothing is known."""
        if not self.is_informative:
            return np.zeros(0)
        log_prior = self.evaluate(views.positions.astype(np.float64))
        # a route cannot lie off the map altogether
        mass = float(np.logaddexp.reduce(log_prior))
        return log_prior - (mass if self.listener is not None else max(0.0, mass))


def share_views(city: City, near: Sequence[float], radius: float) -> Floats:
    """Return the prior probability (W,) of all viewpoints near a place, summing to at most 1.

    Raises `OptionError` where the place lies on the map only if its numbers are swapped.
    """
    prior = LocationPrior.around(city, near, radius)
    if prior.is_off_map(city) and (hint := hint_swapped(city, near)):
        raise OptionError(f"near is {near!r}, which is off the map.{hint}")
    shares = np.exp(prior.evaluate(city.views.positions.astype(np.float64)))
    return np.asarray(shares / max(1.0, float(shares.sum())))


def to_number(value: object) -> float:
    """Convert a value to a number, or to NaN where it is none, such as a text or `True`."""
    try:
        return nan if isinstance(value, str | bytes | bool) else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return nan


def check_finite(value: object, name: str, what: str) -> float:
    """Convert a value to a finite number; raises `OptionError` otherwise."""
    if not isfinite(found := to_number(value)):
        raise OptionError(f"{name} is {value!r}; give {what} as a finite number.")
    return found


def check_heading(value: object) -> float:
    """Convert a heading to a number [rad]; raises `OptionError` where it is none, or in degrees."""
    found = check_finite(value, "heading", "an angle")
    if abs(found) > 2.0 * pi + 1e-6:
        raise OptionError(
            f"heading is {value!r}, but headings are in radians, clockwise from north; if these are "
            f"degrees, give numpy.deg2rad({value!r})."
        )
    return found


def check_nonnegative(value: object, name: str) -> float:
    """Convert a value to a finite number of at least 0; raises `OptionError` otherwise."""
    if (found := check_finite(value, name, "an amount")) < 0.0:
        raise OptionError(f"{name} is {value!r}; give 0 or more.")
    return found


def is_count(value: object) -> bool:
    """Whether a value is an integer of at least 1."""
    return isinstance(value, int | np.integer) and value is not True and bool(value >= 1)


def to_position(city: City, lonlat: Sequence[float], name: str) -> Floats:
    """Convert a longitude and latitude [deg] to east and north (2,) [m]; raises `OptionError`."""
    numbers = [to_number(x) for x in lonlat] if np.iterable(lonlat) else []
    if len(numbers) != 2 or not (abs(numbers[0]) <= 180.0 and abs(numbers[1]) <= 90.0):
        raise OptionError(
            f"{name} is {lonlat!r}; give longitude and latitude in degrees, in this order."
            f"{hint_swapped(city, numbers)}"
        )
    return city.plane.to_plane(numbers)


def hint_swapped(city: City, lonlat: Sequence[float]) -> str:
    """Return a sentence where a position (2,) [deg] lies on the map once its numbers are swapped, or ""."""
    if len(lonlat) < 2 or not abs(lonlat[0]) <= 90.0:
        return ""
    longitude, latitude = lonlat[1], lonlat[0]
    points = city.objects.points
    there = city.plane.to_plane((longitude, latitude))
    if not ((points.min(axis=0) <= there) & (there <= points.max(axis=0))).all():
        return ""
    return f" Swapped, it lies on the map: longitude comes first, {longitude},{latitude}."


def find_in_region(city: City, positions: Floats, region: Region) -> NDArray[np.bool_]:
    """Find which positions (K, 2) [m] lie in a region."""
    region.validate()
    longitude, latitude = city.plane.to_lonlat(positions).T
    east, west = longitude <= region.east, longitude >= region.west
    across = east | west if region.crosses_date_line else east & west
    return across & (latitude >= region.south) & (latitude <= region.north)


class MatchingOptions(TypedDict, total=False):
    """`preset`, the `language` of the text, and fields of `Matching`, as `CityMap.locate` takes them."""

    preset: Preset
    language: str | None
    matcher: Matcher
    score: Score | None
    by: By | Literal["auto"]
    candidates: int
    store: VectorStore | None
    region: Region | None
    printed: bool
    encoded: EncodedCity | None


PRESETS: dict[Preset, MatchingOptions] = {
    "default": {},
    "paper": {
        "matcher": "transformer", "score": "cosine", "by": "dense", "candidates": 10, "printed": True,
    },
    "published": {"matcher": "embedding", "by": "dense", "candidates": 10, "printed": True},
}  # fmt: skip
"""The paper's pipeline (Eq. 3-16), and what its published code does: cross attention there leaves
every graph as it is, so that what ranks is a cosine of embeddings made without the partner."""


@dataclass(frozen=True, eq=False)
class Matching(RankingOptions):
    """Options of the search, with the store, region and network that it uses; raises `OptionError`."""

    store: VectorStore | None = None
    """Vector store that is searched for embeddings, such as a Milvus server; the map's own if not given."""
    region: Region | None = None
    """The place is known to lie in it."""
    printed: bool = False
    """Whether to use the shipped network that the paper prints, on its graphs of cells, instead of ours."""
    encoded: EncodedCity | None = None
    """The map, encoded by a network; by the shipped one if not given."""

    @classmethod
    def preset(cls, name: Preset, **options: Unpack[MatchingOptions]) -> Matching:
        """Make the options of a preset (`PRESETS`), with those given in their stead.

        Raises
        ------
        OptionError
            An option is out of range, or `candidates` are given where no cells are counted.

        """
        if name not in PRESETS:
            raise OptionError(f"preset is {name!r}; choose one of {', '.join(PRESETS)}.")
        chosen: dict[str, Any] = {**PRESETS[name], **options}
        matcher = chosen.get("matcher")
        # options of a preset fall where another matcher has no use for them
        unused = {"score"} if matcher != "transformer" else set()
        unused |= {"by", "candidates", "printed"} if matcher in _RANKING_VIEWPOINTS else set()
        found = cls(**{k: v for k, v in chosen.items() if k in options or k not in unused})
        if "candidates" in options and not found.counts_cells:
            raise OptionError(
                f"candidates is {found.candidates}, but {found.matcher} search with "
                f"{found.source} does not propose cells; use dense or both, or remove it."
            )
        return found

    @property
    def source(self) -> By:
        """Source of candidates: `by`, with ``auto`` resolved."""
        if self.by != "auto":
            return self.by
        return "sparse" if self.store is None else "both"

    @property
    def counts_cells(self) -> bool:
        """Whether `candidates` limits the number of cells that are matched."""
        return self.source in ("dense", "both") or (self.source == "sparse" and self.ranks_cells)

    @property
    def ranks_cells(self) -> bool:
        """Whether the matcher ranks cells, as in the paper, and not viewpoints."""
        return self.matcher not in _RANKING_VIEWPOINTS

    @property
    def is_ranking_only(self) -> bool:
        """Whether scores of the matcher are cosines or edits, and not the log odds of Eq. 17."""
        return self.ranks_cells and (self.matcher != "transformer" or self.score == "cosine")

    @property
    def uses_network(self) -> bool:
        """Whether a network takes part."""
        return self.matcher not in ("relational", "edit-distance", "edit-distance-plain") or (
            self.source in ("dense", "both") or self.store is not None
        )

    def encode(self, city: City) -> EncodedCity:
        """Encode a city by the chosen network."""
        return self.encoded or EncodedCity.of_city(city, printed=self.printed)

    def check(self, city: City) -> None:
        """Raise `OptionError` or `StoreError` for a region, store or network that does not fit the map."""
        if self.region is not None:
            if not isinstance(self.region, Region):
                raise OptionError(
                    f"region is {self.region!r}; give a `Region` of west, south, east and north in "
                    "degrees."
                )
            self.region.validate()
        encoded = self.encoded
        if encoded is not None and not (
            isinstance(encoded, EncodedCity)
            and (encoded.city is city or encoded.origin.map == city.digest)
        ):
            raise OptionError(
                f"encoded is not an encoding of {city!r}; give an `EncodedCity` of this map."
            )
        printed = self.printed if encoded is None else encoded.printed
        if printed and self.matcher == "fused":
            raise OptionError(
                "The network as printed ranks cells, but fused matching ranks viewpoints; choose the "
                "matcher transformer or embedding, or other weights."
            )
        if self.store is None:
            return
        found = getattr(self.store, "origin", None)
        if not isinstance(found, Origin):
            raise OptionError(
                f"store is {self.store!r}, which is not a vector store; open one with `open_store`."
            )
        wanted = self.encode(city).origin
        # empty is not known
        refuse_other(
            "The store", Origin(found.map or wanted.map, found.model or wanted.model), wanted
        )


@dataclass(frozen=True, eq=False)
class Hints:
    """Knowledge of a user beside the text; see `CityMap.locate`."""

    near: Sequence[float] | None = None
    radius: float = 1000.0
    heading: float | None = None
    listener: Sequence[float] | None = None
    answers: Sequence[Answer] | None = ()
    language: str | None = None


@dataclass(frozen=True, eq=False)
class Request:
    """A description compiled against a city, the prior of the place, and how to match."""

    city: City
    query: Query
    prior: LocationPrior = field(default_factory=LocationPrior)
    matching: Matching = field(default_factory=Matching)
    understood: Description = field(default_factory=lambda: Description(""))
    """The whole description; `query` lacks what became part of the prior."""

    @property
    def is_positive(self) -> bool:
        """Whether the text says that anything is there."""
        return any(not s.negated for s in self.query.used)

    @cached_property
    def token_weights(self) -> TokenWeights:
        """Weights of every token of the map for every mention."""
        return self.query.token_weights(len(self.city.views.share))

    @cached_property
    def log_prior(self) -> Floats:
        """Log prior (W,) of all viewpoints, or nothing where nothing is known."""
        return self.prior.evaluate_views(self.city.views)

    @cached_property
    def highest(self) -> float:
        """Largest log prior of a viewpoint."""
        views = len(self.city.views)
        return float(self.log_prior.max()) if len(self.log_prior) else -float(np.log(views))

    def relative(self, rows: NDArray[np.int32]) -> Floats:
        """Return the log prior (K,) of viewpoints, against the largest."""
        known = len(self.log_prior) > 0
        return self.log_prior[rows] - self.highest if known else np.zeros(len(rows))

    @cached_property
    def encoded(self) -> EncodedCity:
        """City encoded by the chosen network."""
        return self.matching.encode(self.city)

    @cached_property
    def text(self) -> EncodedText:
        """Query encoded by the chosen network."""
        return self.encoded.text(self.query)

    @cached_property
    def embedding(self) -> NDArray[np.float32]:
        """Embedding (1, D) of the text graph (Eq. 9)."""
        return self.encoded.network.embed_texts(self.text.graphs)

    def inside(self, positions: Floats) -> NDArray[np.bool_]:
        """Find which positions (K, 2) [m] lie in the region of `matching`."""
        region = self.matching.region
        if region is None:
            return np.ones(len(positions), np.bool_)
        return find_in_region(self.city, positions, region)


class TextContext(Protocol):
    """Vocabulary and names by which a text is read: a `City`, or a world of many."""

    @property
    def vocabulary(self) -> Vocabulary:
        """Meanings of words."""

    @property
    def name_index(self) -> NameIndex:
        """Proper names."""

    def block_length(self, bearing: float | None) -> float:
        """Length of a block [m] in a direction [rad], or in any."""


def parse(
    context: TextContext,
    text: str | Description,
    *,
    heading: float | None = None,
    language: str | None = None,
    answers: Sequence[Answer] = (),
) -> Description:
    """Parse a text with the names and tag values of a map (Eq. 3), and append answers to questions."""
    if not isinstance(text, Description):
        text = describe(
            text, vocabulary=context.vocabulary, names=context.name_index, heading=heading,
            language=language, block_length=context.block_length,
        )  # fmt: skip
    for given in answers:
        if not isinstance(given, Answer):
            raise OptionError(
                f"answers contains {given!r}; create answers with `question.answer(option)`."
            )
        text = given.added_to(text)
    return text


def make_request(city: City, text: str | Description, hints: Hints, matching: Matching) -> Request:
    """Check all options, read the text, and compile it; raises `OptionError`, `DescriptionError`."""
    prior = LocationPrior.around(city, hints.near, hints.radius)
    heading = None if hints.heading is None else check_heading(hints.heading)
    listener = None if hints.listener is None else to_position(city, hints.listener, "listener")
    understood = parse(
        city, text, heading=heading, language=hints.language, answers=hints.answers or ()
    )
    routes, others = ((), understood.statements) if listener is None else split_routes(understood)
    to_somebody = any(LISTENER in ends(s) for s in understood.statements)
    query = compile_query(replace(understood, statements=others), city, tells_way=to_somebody)
    matching.check(city)
    region = matching.region
    inside = None if region is None else partial(find_in_region, city, region=region)
    prior = replace(prior, listener=listener, routes=routes, inside=inside)
    return Request(city, query, prior, matching, understood)


def split_routes(description: Description) -> tuple[tuple[Route, ...], tuple[Statement, ...]]:
    """Split off directions between the listener and the speaker, or what the speaker stands at."""
    here = find_speaker_nodes(description.statements)
    routes, others = [], []
    for s in description.statements:
        turn = 0.0 if s.source in here and s.target == LISTENER else np.pi
        between = turn == 0.0 or (s.target in here and s.source == LISTENER)
        if between and s.relation is Relation.DIRECTION and s.bearing is not None and not s.negated:
            routes.append(Route(s.bearing + turn, s.bearing_sigma, s.certainty, s.distance))
        else:
            others.append(s)
    return tuple(routes), tuple(others)


def find_off_map(request: Request, hints: Hints) -> str:
    """Return why the speaker cannot be anywhere on the map; empty where they can."""
    city, prior = request.city, request.prior
    if hints.near is not None and prior.is_off_map(city):
        near = tuple(hints.near[:2])
        return f"The map does not cover the surroundings of {near}.{hint_swapped(city, near)}"
    if prior.inside is not None and not prior.inside(city.views.positions.astype(np.float64)).any():
        return f"The map has no objects in {tuple(request.matching.region or ())}."
    return ""
