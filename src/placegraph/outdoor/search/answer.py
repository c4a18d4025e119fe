"""From a posterior to an estimate: modes as places with their evidence, status, support."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import CityEstimate, Evidence, Place, Status
from placegraph.core.geometry import angle_between
from placegraph.outdoor.language.description import LISTENER, SPEAKER, Description, Statement
from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.likelihood.statements import ends
from placegraph.outdoor.map.city import City
from placegraph.outdoor.search.confidence import believed, claim_of, doubt_of, status_of
from placegraph.outdoor.search.evidence import evidence_at
from placegraph.outdoor.search.posterior import Mode, Posterior, modes, ranked
from placegraph.outdoor.search.request import Request
from placegraph.outdoor.search.viewpoints import SPACING

MOST_SUPPORT = 4000
"""At most this many points of the posterior are kept in an estimate."""
RANKS_ONLY = "The {} matcher ranks places; how sure it is of the best it does not know."
CONTRADICTS = "The description contradicts itself: {}"


def estimate(asked: Request, found: Posterior, top: int, understood: Description) -> CityEstimate:
    """Modes of a posterior; a matcher whose scores are no probabilities is never sure of them."""
    city, query, matching = asked.city, asked.query, asked.matching
    spacing = city.cells.size if matching.of_cells else SPACING
    peaks = (ranked if matching.ranks else modes)(found, top, spacing)
    claim, doubt = claim_of(understood), doubt_of(query, city)
    status, reason = status_of(found, peaks, claim, doubt)
    if peaks and (matching.ranks or (matching.of_cells and status is Status.OK)):
        status, reason = Status.AMBIGUOUS, RANKS_ONLY.format(matching.matcher)
    if not matching.of_cells:
        found, peaks = believed(found, peaks, claim, doubt)
    places = tuple(
        place(mode, city, partial(evidence_at, mode.position, city, query)) for mode in peaks
    )
    if places and understood.conflicts and contradicted(places[0], query):
        status, reason = Status.LOST, CONTRADICTS.format(understood.conflicts[0])
    return CityEstimate(
        status, places, reason, understood, support(found, city), ranked=matching.ranks, map=city
    )


def place(mode: Mode, city: City, explain: Callable[[], tuple[Evidence, ...]]) -> Place:
    """A mode in degrees."""
    longitude, latitude = (float(x) for x in city.plane.to_lonlat(mode.position))
    cell = city.cells.nearest(mode.position)
    return Place(longitude, latitude, mode.probability, cell, mode.covariance, explain=explain)


def support(found: Posterior, city: City) -> NDArray[np.float64]:
    """Heaviest points (N, 3): longitude, latitude [deg], probability."""
    heaviest = np.argsort(-found.probabilities, kind="stable")[:MOST_SUPPORT]
    lonlat = city.plane.to_lonlat(found.positions[heaviest])
    return np.column_stack([lonlat, found.probabilities[heaviest]])


def contradicted(place: Place, query: Query) -> bool:
    """Whether most of what was said contradicts itself at a place, where no other thing serves it."""
    said = place.evidence[: len(query.used)]
    torn: set[int] = set()
    for i, a in enumerate(query.used):
        for j, b in enumerate(query.used[:i]):
            if _opposed(a, b) and (
                "against" in (said[i].verdict, said[j].verdict)
                or len({o.id for o in (*said[i].objects, *said[j].objects)}) <= _things(a)
            ):
                torn |= {i, j}
    return 2 * len(torn) > len(query.used)


def _things(statement: Statement) -> int:
    """Number of things a statement is about; two opposed ones need more than that."""
    return sum(node not in (SPEAKER, LISTENER) for node in ends(statement))


def _opposed(a: Statement, b: Statement) -> bool:
    """Whether two directions between the same mentions exclude each other."""
    if a.bearing is None or b.bearing is None or set(ends(a)) != set(ends(b)):
        return False
    other = b.bearing if ends(a) == ends(b) else b.bearing + np.pi
    return float(angle_between(a.bearing, other)) > 2.0
