"""From a posterior to an estimate: modes as places with their evidence, status, support."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import CityEstimate, Place
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.map.city import City
from placegraph.outdoor.search.evidence import Explain, evidence_at
from placegraph.outdoor.search.posterior import Mode, Posterior, modes, ranked
from placegraph.outdoor.search.request import Request
from placegraph.outdoor.search.status import (
    Diagnostics,
    decide,
    diagnose,
    find_contradiction,
    infer_claim,
    shrink,
)
from placegraph.outdoor.search.viewpoints import SPACING

MOST_SUPPORT = 4000
"""At most this many points of the posterior are kept in an estimate."""


def answer(asked: Request, found: Posterior, top: int, understood: Description) -> CityEstimate:
    """Return the estimate of a posterior: at most `top` modes, their evidence, status and support."""
    city, query, matching = asked.city, asked.query, asked.matching
    spacing = city.cells.size if matching.of_cells else SPACING
    peaks = (ranked if matching.ranks else modes)(found, top, spacing)
    diagnostics = diagnose(found, peaks, infer_claim(understood), query, city)
    if matching.of_cells:
        diagnostics = replace(diagnostics, cell_matcher=matching.matcher, ranks_only=matching.ranks)
    else:
        found, peaks = shrink(found, peaks, diagnostics)
    places = make_places(peaks, city, partial(evidence_at, city=city, query=query))
    contradiction = find_contradiction(places[0] if places else None, query)
    status, reason = decide(replace(diagnostics, contradiction=contradiction))
    return CityEstimate(
        status, places, reason, understood, find_support(found, city),
        ranked=matching.ranks, map=city,
    )  # fmt: skip


def answer_nothing(obstacle: str, understood: Description | None = None) -> CityEstimate:
    """Return the estimate without a place, where an obstacle forbids a search."""
    status, reason = decide(Diagnostics(obstacle=obstacle))
    return CityEstimate(status, (), reason, understood)


def make_places(peaks: list[Mode], city: City, explain: Explain) -> tuple[Place, ...]:
    """Return modes in degrees; `explain` makes the evidence at a position (2,) [m] when it is needed."""

    def place(mode: Mode) -> Place:
        longitude, latitude = city.plane.to_lonlat(mode.position).tolist()
        cell, evidence = city.cells.nearest(mode.position), partial(explain, mode.position)
        return Place(longitude, latitude, mode.probability, cell, mode.covariance, explain=evidence)

    return tuple(map(place, peaks))


def find_support(found: Posterior, city: City) -> NDArray[np.float64]:
    """Return the heaviest points (N, 3) of a posterior: longitude, latitude [deg], probability."""
    heaviest = np.argsort(-found.probabilities, kind="stable")[:MOST_SUPPORT]
    lonlat = city.plane.to_lonlat(found.positions[heaviest])
    return np.column_stack([lonlat, found.probabilities[heaviest]])
