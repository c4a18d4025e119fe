"""From a posterior to an estimate: modes as places with their evidence, status, support."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from placegraph.estimate import CityEstimate, Place, Status
from placegraph.outdoor.search.confidence import believed, claim_of, doubt_of, status_of
from placegraph.outdoor.search.evidence import evidence_at
from placegraph.outdoor.search.posterior import modes, ranked
from placegraph.outdoor.search.viewpoints import SPACING

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from placegraph.estimate import Evidence
    from placegraph.outdoor.language.description import Description
    from placegraph.outdoor.likelihood.query import Query
    from placegraph.outdoor.map.city import City
    from placegraph.outdoor.search.posterior import Mode, Posterior
    from placegraph.outdoor.search.request import Request

MOST_SUPPORT = 4000
"""At most this many points of the posterior are kept in an estimate."""
RANKS_ONLY = "The {} matcher ranks places; how sure it is of the best it does not know."
CONTRADICTS = "The description contradicts itself: {}"
CONTRADICTORY = 0.3
"""A text that contradicts itself is LOST where this share of it speaks against the best place."""


def estimate(asked: Request, found: Posterior, top: int, understood: Description) -> CityEstimate:
    """Modes of a posterior; a matcher whose scores are no probabilities is never sure of them."""
    city, query, matching = asked.city, asked.query, asked.matching
    spacing = city.cells.size if matching.of_cells else SPACING
    peaks = (ranked if matching.ranks else modes)(found, top, spacing)
    claim, doubt = claim_of(understood), doubt_of(query, city)
    status, reason = status_of(found, peaks, claim, doubt)
    if peaks and (matching.ranks or (matching.of_cells and status is Status.OK)):
        status, reason = Status.AMBIGUOUS, RANKS_ONLY.format(matching.matcher)
    trust = 1.0 if matching.of_cells else believed(peaks, claim, doubt)
    places = tuple(
        place(
            replace(mode, probability=trust * mode.probability),
            city,
            partial(evidence_at, mode.position, city, query),
        )
        for mode in peaks
    )
    if places and understood.conflicts and contradicted(places[0], query):
        status, reason = Status.LOST, CONTRADICTS.format(understood.conflicts[0])
    return CityEstimate(
        status, places, reason, understood, support(found, city), ranked=matching.ranks
    )


def place(mode: Mode, city: City, explain: Callable[[], tuple[Evidence, ...]]) -> Place:
    """A mode in degrees."""
    longitude, latitude = (float(x) for x in city.plane.to_lonlat(mode.position))
    cell = city.cells.nearest(mode.position)
    return Place(longitude, latitude, mode.probability, cell, mode.covariance, explain)


def support(found: Posterior, city: City) -> NDArray[np.float64]:
    """Heaviest points (N, 3): longitude, latitude [deg], probability."""
    heaviest = np.argsort(-found.probabilities, kind="stable")[:MOST_SUPPORT]
    lonlat = city.plane.to_lonlat(found.positions[heaviest])
    return np.column_stack([lonlat, found.probabilities[heaviest]])


def contradicted(place: Place, query: Query) -> bool:
    """Whether much of what was said speaks against a place; other things of a kind may serve it."""
    against = sum(e.verdict == "against" for e in place.evidence[: len(query.used)])
    return against > 0 and against >= CONTRADICTORY * len(query.used)
