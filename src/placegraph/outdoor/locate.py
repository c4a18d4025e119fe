"""Where was this said? Text in, estimate out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from placegraph.errors import OptionError
from placegraph.estimate import CityEstimate, Place, Status
from placegraph.geometry import angle_between
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Relation,
    Statement,
)
from placegraph.outdoor.likelihood.query import Query, compile_query, ends, standing_at
from placegraph.outdoor.map.index import REACH
from placegraph.outdoor.search.cells import (
    MATCHERS,
    WAYS,
    By,
    Matcher,
    check_sources,
    is_count,
    rank_cells,
    views_of_candidates,
)
from placegraph.outdoor.search.cells import within as lies_in
from placegraph.outdoor.search.evidence import evidence_at
from placegraph.outdoor.search.posterior import Mode, Posterior, modes, posterior, status_of
from placegraph.outdoor.search.viewpoints import Prior, search

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.outdoor.map.city import City
    from placegraph.outdoor.network.encoded import EncodedCity
    from placegraph.outdoor.search.ask import Answer
    from placegraph.vectors import Region, VectorStore

MOST_SUPPORT = 4000
"""At most this many points of the posterior are kept in an estimate."""
SPACING = 6.67
"""Positions are scored this finely [m]."""
DENSE_REACH = 0.4
"""Probability that the place is near one of 50 cells that embeddings propose, in a large city (60 texts
each: Vancouver .40, Ankara .45, Liechtenstein .48): an estimate by these alone cannot be surer."""
RANKS_ONLY = "The {} matcher ranks places; how sure it is of the best it does not know."
SHARPNESS = {"transformer": 1.0, "edit-distance": 1.0, "embedding": 20.0}
"""What a matcher's score is multiplied by to be a log-likelihood."""


def locate(
    city: City,
    text: str | Description,
    *,
    top: int = 5,
    near: Sequence[float] | None = None,
    radius: float = 1000.0,
    heading: float | None = None,
    listener: Sequence[float] | None = None,
    answers: Sequence[Answer] = (),
    matching: Matching | None = None,
) -> CityEstimate:
    """Locate a description in a city; see `CityMap.locate`."""
    matching = matching or Matching()
    if not is_count(top):
        raise OptionError(f"top is {top!r}; ask for at least one mode.")
    if near is not None and np.size(near) == 3:
        near, radius = near[:2], near[2]
    if not 1.0 <= (within := _number(radius)) <= 1e7:
        raise OptionError(f"radius is {radius!r} m; choose between 1 and 10,000,000 m.")
    if heading is not None and not np.isfinite(heading := _number(heading)):
        raise OptionError(f"heading is {heading!r}; give an angle in radians.")
    near_at, listener_at = _position(city, near, "near"), _position(city, listener, "listener")
    description = read(city, text, heading=heading)
    for answer in answers:
        if not hasattr(answer, "added_to"):
            raise OptionError(
                f"answers holds {answer!r}; answer questions by `question.answer(option)`."
            )
        description = answer.added_to(description)
    way, rest = _split(description, known=listener_at is not None)
    to_somebody = any(LISTENER in ends(s) for s in description.statements)
    query = compile_query(replace(description, statements=rest), city, on_a_way=to_somebody)
    check_sources(city, store=matching.store, region=matching.region, encoded=matching.encoded)
    inside = None if matching.region is None else partial(lies_in, city, region=matching.region)
    prior = Prior(near_at, within, listener_at, way, inside)
    positive = any(not s.negated for s in query.used)
    if not positive and not way:
        return CityEstimate(Status.LOST, (), _why_nothing(description, query), description)
    if reason := _off_the_map(city, prior, near, matching.region):
        return CityEstimate(Status.LOST, (), reason, description)
    found, spacing = _found(query, city, prior, matching)
    peaks = modes(found, top, spacing)
    status, reason = _status(found, peaks, matching)
    places = tuple(_place(mode, city, query) for mode in peaks)
    if places and description.conflicts and not _resolved(places[0], query):
        status, reason = (
            Status.LOST,
            "The description contradicts itself: " + description.conflicts[0],
        )
    return CityEstimate(status, places, reason, description, _support(found, city))


@dataclass(frozen=True)
class Matching:
    """How places are found and compared; see `CityMap.locate`."""

    matcher: Matcher = "relational"
    by: By | Literal["auto"] = "auto"
    candidates: int = 50
    store: VectorStore | None = None
    region: Region | None = None
    encoded: EncodedCity | None = None

    def __post_init__(self) -> None:
        if self.matcher not in MATCHERS or self.by not in ("auto", *WAYS):
            raise OptionError(
                f"matcher {self.matcher!r}, candidates by {self.by!r}: choose among "
                f"{', '.join(MATCHERS)} and auto, {', '.join(WAYS)}."
            )
        if not is_count(self.candidates):
            raise OptionError(f"candidates is {self.candidates!r}; choose at least 1.")


def _status(found: Posterior, peaks: list[Mode], matching: Matching) -> tuple[Status, str]:
    """Status of the posterior; a matcher whose scores are no probabilities is never sure."""
    status, reason = status_of(found, peaks)
    if status is Status.OK and matching.matcher not in ("fused", "relational"):
        return Status.AMBIGUOUS, RANKS_ONLY.format(matching.matcher)
    return status, reason


def _found(query: Query, city: City, prior: Prior, matching: Matching) -> tuple[Posterior, float]:
    """Posterior of a query, and how finely its positions lie [m]."""
    by = matching.by
    if by == "auto":
        by = "sparse" if matching.store is None else "both"
    if matching.matcher not in ("fused", "relational"):
        return _by_cells(query, city, prior, matching, by), city.cells.size
    fused = matching.matcher == "fused"
    encoded = (matching.encoded or city.encoded) if fused or by in ("dense", "both") else None
    rows = None
    if query.used and by != "sparse":
        rows = views_of_candidates(
            city, query, matching.candidates, by, encoded,
            store=matching.store, region=matching.region,
        )  # fmt: skip
    reach = DENSE_REACH if by == "dense" else 1.0
    network = encoded if fused else None
    return search(query, city, prior, rows=rows, reach=reach, encoded=network), SPACING


def _by_cells(query: Query, city: City, prior: Prior, matching: Matching, by: By) -> Posterior:
    """Posterior over the centres of cells that one of the paper's matchers has ranked."""
    encoded = matching.encoded or city.encoded
    rows, scores = rank_cells(
        city, query, matching.matcher, matching.candidates, by, encoded,
        store=matching.store, region=matching.region,
    )  # fmt: skip
    if not len(rows):
        return Posterior(np.zeros((0, 2)), np.zeros(0), 1.0)
    centers = city.cells.centers(rows)
    log_prior = prior.log(centers) if prior.informative else np.full(len(rows), -np.log(len(rows)))
    log_odds = SHARPNESS[matching.matcher] * (scores - scores.max())
    return posterior(centers, log_odds + np.log(len(rows)), log_prior, -np.inf)


def read(city: City, text: str | Description, *, heading: float | None = None) -> Description:
    """Understand a text in the words of a city: its names count, whatever the vocabulary says."""
    if isinstance(text, Description):
        return text
    from placegraph.outdoor.language import describe
    from placegraph.outdoor.language.vocabulary import Vocabulary

    return describe(text, vocabulary=Vocabulary.default(), names=city.name_index, heading=heading)


def _off_the_map(
    city: City, prior: Prior, near: Sequence[float] | None, region: Region | None
) -> str:
    """Say why the speaker cannot be anywhere on the map; an empty string where they can."""
    if prior.near is not None and not len(city.views.near(prior.near, 4.0 * prior.radius + REACH)):
        return f"The map does not reach the surroundings of {near}."
    if prior.inside is not None and not prior.inside(city.views.positions.astype(np.float64)).any():
        return f"The map has nothing to see in {tuple(region or ())}."
    return ""


def _number(value: object) -> float:
    """A number, or NaN where it is none."""
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return float("nan")


def _position(city: City, lonlat: Sequence[float] | None, name: str) -> NDArray[np.float64] | None:
    if lonlat is None:
        return None
    numbers = [_number(x) for x in lonlat] if np.iterable(lonlat) else []
    if len(numbers) != 2 or not (abs(numbers[0]) <= 180.0 and abs(numbers[1]) <= 90.0):
        raise OptionError(
            f"{name} is {lonlat!r}; give longitude and latitude in degrees, in this order."
        )
    return city.plane.to_plane(numbers)


def _split(
    description: Description, *, known: bool
) -> tuple[tuple[tuple[float, float, float], ...], tuple[Statement, ...]]:
    """Split off what is said of the way from the listener: bearing, sigma, certainty.

    Whatever the speaker stands at lies where the speaker does.
    """
    here = standing_at(description.statements)
    way, rest = [], []
    for s in description.statements:
        if known and s.relation is Relation.DIRECTION and s.bearing is not None and not s.negated:
            if s.source in here and s.target == LISTENER:
                way.append((s.bearing, s.bearing_sigma, s.certainty))
                continue
            if s.target in here and s.source == LISTENER:
                way.append((s.bearing + np.pi, s.bearing_sigma, s.certainty))
                continue
        rest.append(s)
    return tuple(way), tuple(rest)


def _why_nothing(description: Description, query: Query) -> str:
    if query.used:
        return "Only what is absent was said; say what is there as well."
    reasons = {reason for _, reason in query.unused}
    if reasons:
        return "Nothing that was said can be looked for: " + "; ".join(sorted(reasons)) + "."
    if description.ignored:
        return "Nothing in the text could be understood; say what stands around you, and in which direction."
    return (
        "The text says nothing about a place; say what stands around you, and in which direction."
    )


def _place(mode: Mode, city: City, query: Query) -> Place:
    longitude, latitude = (float(x) for x in city.plane.to_lonlat(mode.position))
    return Place(
        longitude,
        latitude,
        mode.probability,
        city.cells.nearest(mode.position),
        mode.covariance,
        partial(evidence_at, mode.position, city, query),
    )


def _resolved(place: Place, query: Query) -> bool:
    """Whether different things serve the statements that oppose each other (two bakeries, say)."""
    said = place.evidence[: len(query.used)]
    for i, a in enumerate(query.used):
        for j, b in enumerate(query.used[:i]):
            if _opposed(a, b) and (
                "against" in (said[i].verdict, said[j].verdict)
                or len({o.id for o in (*said[i].objects, *said[j].objects)}) <= _things(a)
            ):
                return False
    return True


def _things(statement: Statement) -> int:
    """Number of things a statement is about; two opposed ones need more than that."""
    return sum(node not in (SPEAKER, LISTENER) for node in ends(statement))


def _opposed(a: Statement, b: Statement) -> bool:
    """Whether two directions between the same mentions exclude each other."""
    if a.bearing is None or b.bearing is None or set(ends(a)) != set(ends(b)):
        return False
    other = b.bearing if ends(a) == ends(b) else b.bearing + np.pi
    return float(angle_between(a.bearing, other)) > 2.0


def _support(found: Posterior, city: City) -> NDArray[np.float64]:
    heaviest = np.argsort(-found.probabilities, kind="stable")[:MOST_SUPPORT]
    lonlat = city.plane.to_lonlat(found.positions[heaviest])
    return np.column_stack([lonlat, found.probabilities[heaviest]])
