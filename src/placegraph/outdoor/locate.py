"""Localization of a sentence: from text to estimate, stage by stage (GOTLoc, Eq. 3-17)."""

from __future__ import annotations

from placegraph.core.estimate import CityEstimate
from placegraph.errors import OptionError
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.map.city import City
from placegraph.outdoor.search.answer import answer, answer_nothing
from placegraph.outdoor.search.candidates import find_candidates
from placegraph.outdoor.search.cells import search_cells
from placegraph.outdoor.search.posterior import (
    Posterior,
    compute_posterior,
    rerank,
    score,
    spread_prior,
)
from placegraph.outdoor.search.request import (
    Hints,
    Matching,
    Request,
    find_off_map,
    is_count,
    make_request,
)
from placegraph.outdoor.search.status import find_obstacle


def locate(
    city: City, text: str | Description, *, top: int, hints: Hints, matching: Matching
) -> CityEstimate:
    """Locate a description in a city; see `CityMap.locate`."""
    if not is_count(top):
        raise OptionError(f"top is {top!r}; ask for at least one mode.")
    asked = make_request(city, text, hints, matching)
    obstacle = find_obstacle(asked.query, asked.understood, way_told=bool(asked.prior.routes))
    if obstacle := obstacle or find_off_map(asked, hints):
        return answer_nothing(obstacle, asked.understood)
    found = search_cells(asked) if matching.of_cells else search(asked)
    return answer(asked, found, top)


def search(asked: Request) -> Posterior:
    """Return the posterior over viewpoints: candidates, scores, a second opinion, Bayes' rule."""
    if not asked.query.used:
        return spread_prior(asked)
    candidates = find_candidates(asked)
    scored = score(asked, candidates)
    if asked.matching.matcher == "fused":
        scored = rerank(asked, scored)
    return compute_posterior(asked, scored)
