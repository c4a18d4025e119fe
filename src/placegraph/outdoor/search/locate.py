"""Stages from a sentence to an estimate (GOTLoc, Eq. 3-17), and the evidence of each place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import hypot

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import CityEstimate, Evidence, ObjectRef, Place
from placegraph.core.geometry import Floats, angle_between, bearing
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Relation,
    Statement,
    ends,
)
from placegraph.outdoor.language.languages import translate
from placegraph.outdoor.likelihood.match_kernels import score_distant, score_exact
from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts
from placegraph.outdoor.map.index import REACH
from placegraph.outdoor.search.cells import search_cells
from placegraph.outdoor.search.posterior import (
    SPACING,
    Mode,
    Posterior,
    compute_posterior,
    find_candidates,
    find_modes,
    make_prior_posterior,
    rank_modes,
    rerank,
    score_candidates,
)
from placegraph.outdoor.search.request import (
    Hints,
    Matching,
    Request,
    find_off_map,
    make_request,
)
from placegraph.outdoor.search.status import (
    Diagnostics,
    decide,
    diagnose,
    find_contradiction,
    find_obstacle,
    find_uncertainty,
    infer_claim,
    shrink,
)


def locate(
    city: City, text: str | Description, *, top: int, hints: Hints, matching: Matching
) -> CityEstimate:
    """Locate a description in a city; see `CityMap.locate`."""
    request = make_request(city, text, hints, matching)
    query, understood = request.query, request.understood
    obstacle = find_obstacle(query, understood, tells_way=bool(request.prior.routes))
    if obstacle := obstacle or find_off_map(request, hints):
        return make_lost_estimate(obstacle, understood)
    posterior = search_cells(request) if matching.ranks_cells else search_views(request)
    return make_estimate(request, posterior, top)


def search_views(request: Request) -> Posterior:
    """Search the viewpoints of a city: candidates, scores, re-ranking, Bayes' rule."""
    if not request.query.used:
        return make_prior_posterior(request)
    scored = score_candidates(request, find_candidates(request))
    if request.matching.matcher == "fused":
        scored = rerank(request, scored)
    return compute_posterior(request, scored)


Explain = Callable[[Floats], tuple[Evidence, ...]]
"""Computes the evidence at a position (2,) [m]."""
MIN_MODES = 5
"""Smallest number of modes that the reason of an estimate counts, however few are listed."""
MAX_SUPPORT = 4000
"""Largest number of points of the posterior in an estimate."""


def make_estimate(request: Request, posterior: Posterior, top: int) -> CityEstimate:
    """Make the estimate of a posterior: at most `top` modes, their evidence, status and support."""
    city, query, matching = request.city, request.query, request.matching
    spacing = city.cells.size if matching.ranks_cells else SPACING
    find = rank_modes if matching.is_ranking_only else find_modes
    modes = find(posterior, max(top, MIN_MODES), spacing)
    diagnostics = diagnose(posterior, modes, infer_claim(request.understood), query, city)
    if matching.ranks_cells:
        diagnostics = replace(
            diagnostics, cell_matcher=matching.matcher, is_ranking_only=matching.is_ranking_only
        )
    explain = partial(find_evidence, city=city, query=query)
    estimate = decide_estimate(posterior, modes[:top], diagnostics, query, city, explain)
    return replace(estimate, understood=request.understood, ranked=matching.is_ranking_only)


def decide_estimate(
    posterior: Posterior,
    modes: list[Mode],
    diagnostics: Diagnostics,
    query: Query | None,
    city: City,
    explain: Explain,
) -> CityEstimate:
    """Make the estimate of modes: shrunk probabilities, places in degrees, status, support.

    `explain` computes the evidence at a position when a user asks for it.
    """
    if not diagnostics.cell_matcher:
        posterior, modes = shrink(posterior, modes, diagnostics)
    places = []
    for mode in modes:
        longitude, latitude = city.plane.to_lonlat(mode.position).tolist()
        cell, evidence = city.cells.nearest(mode.position), partial(explain, mode.position)
        places.append(
            Place(longitude, latitude, mode.probability, cell, mode.covariance, explain=evidence)
        )
    best = places[0] if places else None
    contradiction = find_contradiction(best, query)
    probable = diagnostics.is_probable
    uncertainty = find_uncertainty(best, query, city, diagnostics) if probable else ""
    status, reason = decide(
        replace(diagnostics, contradiction=contradiction, uncertainty=uncertainty)
    )
    understood = None if query is None else query.description
    heaviest = np.argsort(-posterior.probabilities, kind="stable")[:MAX_SUPPORT]
    lonlat = city.plane.to_lonlat(posterior.positions[heaviest])
    support = np.column_stack([lonlat, posterior.probabilities[heaviest]])
    reason = translate(reason, understood.language if understood else "en")
    return CityEstimate(
        status,
        tuple(places),
        reason,
        understood,
        support,
        radius=diagnostics.claim.radius,
        map=city,
    )


def make_lost_estimate(obstacle: str, understood: Description | None = None) -> CityEstimate:
    """Make the estimate without a place of a search that an obstacle forbids."""
    status, reason = decide(Diagnostics(obstacle=obstacle))
    reason = translate(reason, understood.language if understood else "en")
    return CityEstimate(status, (), reason, understood)


PRIOR_ASSIGNED = 0.9
"""Prior that a mention means one object throughout, of an explanation: that is one assignment."""
DECISIVE = 0.25
"""Smallest log-likelihood ratio of a statement that speaks for, or against, a place."""
PHRASES = {
    Relation.DIRECTION: "is in a direction of",
    Relation.NEAR: "is near",
    Relation.INSIDE: "is in",
    Relation.ALONG: "is on",
    Relation.ACROSS: "is across from",
    Relation.BETWEEN: "is between",
    Relation.VISIBLE: "is in sight of",
    Relation.SAME: "is at",
}
WINDS = ("north", "northeast", "east", "southeast", "south", "southwest", "west", "northwest")


def name_bearing(angle: float) -> str:
    """Name a bearing [rad] by one of eight compass directions."""
    return WINDS[round(angle / (np.pi / 4)) % 8]


def find_evidence(position: Floats, city: City, query: Query) -> tuple[Evidence, ...]:
    """Find the evidence of every statement at a position (2,) [m]; unused statements come last."""
    unused = tuple(
        Evidence(quote_statement(s, query), "silent", 0.0, (), reason) for s, reason in query.unused
    )
    if not query.used:
        return unused
    ratios, served = score_positions(position[None], city, query)
    found = [
        _make_evidence(s, float(r), [int(o) for o in rows if o >= 0], position, city, query)
        for s, r, rows in zip(query.used, ratios[0], served[0], strict=True)
    ]
    return (*found, *unused)


def score_positions(
    positions: Floats, city: City, query: Query
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Score the statements used at positions (N, 2) [m].

    Returns log-likelihood ratios (N, S), and rows of the source and target objects that fit each
    best (N, S, 2), -1 for none.
    """
    views = city.views
    around = np.unique(np.concatenate([views.near(p, REACH) for p in positions]))
    nearby = np.unique(city.in_sight(around).objects)
    added = np.zeros((len(positions), len(query.used)), np.float32)
    if query.distant is not None:
        added = score_distant(
            query.statements, city.columns, query.distant, positions.astype(np.float32)
        )
    _, ratios, served = score_exact(
        query.statements, city.columns, query.token_weights(len(views.share)), positions[None],
        (np.array([0, len(nearby)]), nearby), added[None], PRIOR_ASSIGNED, True,
    )  # fmt: skip
    return ratios[0], served[0]


def _make_evidence(
    statement: Statement, ratio: float, rows: list[int], position: Floats, city: City, query: Query
) -> Evidence:
    verdict = "for" if ratio > DECISIVE else "against" if ratio < -DECISIVE else "silent"
    delta, error = _compute_offset(statement, rows, position, city)
    if rows and not statement.negated and error > np.pi / 2:
        verdict = "against"  # it is rare enough to speak for the place, but it lies the other way
    if verdict == "for" and not rows and not statement.negated:
        rows = _find_distant_object(statement, position, city, query)
    note = ""
    if verdict == "against" and statement.negated:
        note = "but it is present"
    elif verdict == "against" and rows and statement.relation is Relation.DIRECTION:
        if error < np.pi / 4:
            note, rows = "it fits, but no better than elsewhere", []
        else:
            note = f"from here it lies to the {name_bearing(float(bearing(delta)))}"
    elif verdict == "against" or not (rows or statement.negated or query.is_about_site(statement)):
        note, rows = "nothing in sight fits it", []
    elif unknown := query.by_kind.intersection(ends(statement)):
        names = " and ".join(query.description.mentions[n].name for n in sorted(unknown))
        note = f"{names} is not on the map; an object of its kind fits"
    objects = tuple(describe_object(row, city) for row in rows)
    return Evidence(quote_statement(statement, query), verdict, ratio, objects, note)


def _find_distant_object(
    statement: Statement, position: Floats, city: City, query: Query
) -> list[int]:
    """Find the nearest rare object out of sight that a statement may mention."""
    far = query.distant
    if far is None:
        return []
    mentions = [n - 2 for n in ends(statement) if n > 1]
    lists = [far.objects[far.starts[m] : far.starts[m + 1]] for m in mentions]
    rows = min((rows for rows in lists if len(rows)), key=len, default=None)
    if rows is None or rows[0] >= len(city.objects):  # a crossing or a house is no object
        return []
    distance = np.hypot(*(city.objects.center[rows] - position).T)
    return [int(rows[np.argmin(distance)])]


def _compute_offset(
    statement: Statement, rows: list[int], position: Floats, city: City
) -> tuple[Floats, float]:
    """Compute the vector (2,) [m] from the target object to the source object, and its error.

    The error is the angle [rad] by which a stated direction is wrong, 0 without one.
    """
    o, (east, north) = city.objects, position.tolist()
    if not rows:
        return np.zeros(2), 0.0
    points = np.array([
        nearest_on_parts(o.part_starts, o.point_starts, o.points, o.kind[row], row, east, north)[:2]
        for row in rows
    ])  # fmt: skip
    if len(rows) == 1:
        delta = points[0] if statement.target == SPEAKER else -points[0]
    else:
        delta = points[0] - points[1]
    if statement.bearing is None or hypot(*delta) < 1.0:
        return delta, 0.0
    return delta, float(angle_between(bearing(delta), statement.bearing))


def describe_object(row: int, city: City) -> ObjectRef:
    """Describe a map object in an estimate."""
    o = city.objects
    longitude, latitude = (float(x) for x in city.plane.to_lonlat(o.center[row]))
    return ObjectRef(o.osm(row), o.label(row), o.name(row), longitude, latitude)


def quote_statement(statement: Statement, query: Query) -> str:
    """Quote a statement from the text, or put it into words where one sentence makes several."""
    others = query.description.statements
    if statement.text and sum(s.text == statement.text for s in others) == 1:
        return statement.text
    mentions = query.description.mentions

    def words(node: int | None) -> str:
        if node in (None, SPEAKER, LISTENER):
            return "you" if node == LISTENER else "me"
        return mentions[node].name or mentions[node].words

    how = PHRASES[statement.relation]
    if statement.bearing is not None:
        how = f"is {name_bearing(statement.bearing)} of"
    if statement.negated:
        how = how.replace("is ", "is not ", 1)
    phrase = f"{words(statement.source)} {how} {words(statement.target)}"
    if statement.relation is Relation.BETWEEN:
        phrase += f" and {words(statement.target2)}"
    return phrase.replace("me is", "I am").replace("you is", "you are")
