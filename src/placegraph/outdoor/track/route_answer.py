"""Estimate of where a told way ends, with the way and its steps as evidence."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from placegraph.core.estimate import CityEstimate, Evidence
from placegraph.core.geometry import Floats
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.map.city import City
from placegraph.outdoor.search.locate import (
    DECISIVE,
    decide_estimate,
    describe_object,
    make_lost_estimate,
)
from placegraph.outdoor.search.posterior import Posterior, find_modes
from placegraph.outdoor.search.request import Hints, Matching, find_off_map, make_request
from placegraph.outdoor.search.status import Calibration, Claim, diagnose
from placegraph.outdoor.track.route import Route, RouteEnds
from placegraph.outdoor.track.route_text import TURN, Move, Step, read_route

AT_AN_END = Claim(100.0, Calibration(0.0, 1.0), Calibration(0.0, 1.0))
"""Claim for a text that tells a way along streets: people stop a shop or two away."""
SPACING = 5.0
"""Distance of the ends that are weighed [m]."""
OTHERS = re.compile(
    r"\b(?:I|[Mm]e|[Mm]y|[Ww]e|[Uu]s|(?:[Nn]orth|[Ss]outh)(?:[ -]?(?:east|west))?|[Ee]ast|[Ww]est)\b"
    r"(?!\s+[A-Z\d])"
)
"""Words of texts about the speaker, or by the compass: these are read as statements."""
OPENING = re.compile(
    r"""\W*(?:(?:then|next|first|now|once|you|will|just)\s+)*(?:go|head|walk|start|begin|turn|continue|take
    |make|bear|carry|pass|follow|proceed|move|cross|keep|exit|travel|drive|from|after|at|as|when|with)\b""",
    re.VERBOSE | re.IGNORECASE,
)
"""First words of instructions."""


def read_instructions(text: str | Description, city: City) -> list[Step]:
    """Read the steps of a text that tells a way by turns and junctions; empty for other texts."""
    if not isinstance(text, str) or not TURN.search(text) or not OPENING.match(text):
        return []
    steps = [] if OTHERS.search(text) else read_route(text, city)
    return steps if {Move.TURN} < {step.move for step in steps} else []


def locate_route(
    city: City, text: str, steps: list[Step], *, hints: Hints, matching: Matching, top: int
) -> CityEstimate:
    """Estimate where a way ends that begins at the listener, or anywhere."""
    request = make_request(city, text, hints, matching)
    prior = request.prior
    if obstacle := find_off_map(request, hints):
        return make_lost_estimate(obstacle, request.understood)
    start = None if prior.listener is None else Posterior(prior.listener[None], np.ones(1), 0.0)
    route = Route(city, start, hints.heading)
    ends = route.follow(steps)
    if prior.near is not None or prior.inside is not None:
        log = replace(prior, listener=None).evaluate(ends.positions)
        weights = ends.probabilities * np.exp(log - log.max(initial=-1e300))
        weights *= (1.0 - ends.elsewhere) / max(weights.sum(), 1e-300)
        ends = replace(ends, probabilities=weights)
    return estimate_end(route, ends, text, top)


def estimate_end(route: Route, ends: RouteEnds, text: str, top: int) -> CityEstimate:
    """Make the estimate of the end of a way."""
    city = route.city
    if not ends.probabilities.any():
        return make_lost_estimate(
            "No street of this map leads where the text goes.", Description(text)
        )

    def explain(position: Floats) -> tuple[Evidence, ...]:
        return tuple(
            Evidence(
                text[step.start : step.end],
                "for" if ratio > DECISIVE else "against" if ratio < -DECISIVE else "silent",
                ratio,
                tuple(describe_object(int(row), city) for row in rows),
            )
            for step, ratio, rows in route.trace(ends, find_end(position))[1]
        )

    def find_end(position: Floats) -> int:
        near = np.hypot(*(ends.positions - position).T) <= 4.0 * SPACING
        return int(np.argmax(ends.probabilities * near))

    posterior = Posterior(ends.positions, ends.probabilities, ends.elsewhere)
    modes = find_modes(posterior, top, SPACING)
    diagnostics = diagnose(posterior, modes, AT_AN_END, None)
    estimate = decide_estimate(posterior, modes, diagnostics, None, city, explain)
    way = city.plane.to_lonlat(route.trace(ends, find_end(modes[0].position))[0])
    return replace(estimate, understood=Description(text), way=way)
