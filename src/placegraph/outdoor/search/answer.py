"""From a posterior to an estimate: modes as places, the evidence of each, status and support."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import CityEstimate, Evidence, ObjectRef, Place
from placegraph.core.geometry import angle_between, bearing
from placegraph.outdoor.language.description import (
    LISTENER,
    SPEAKER,
    Description,
    Relation,
    Statement,
)
from placegraph.outdoor.likelihood.match_kernels import distant, look_again
from placegraph.outdoor.likelihood.query import Query, ends
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.geometry_kernels import nearest_on_parts
from placegraph.outdoor.map.index import REACH
from placegraph.outdoor.search.posterior import SPACING, Mode, Posterior, find_modes, rank_modes
from placegraph.outdoor.search.request import Request
from placegraph.outdoor.search.status import (
    Diagnostics,
    decide,
    diagnose,
    find_contradiction,
    infer_claim,
    shrink,
)

CERTAIN = 0.9
"""Prior that a mention means one thing: an explanation is one assignment."""
TELLING = 0.25
"""A statement speaks for or against a place from this log-likelihood ratio on [nat]."""
PHRASES = {
    Relation.DIRECTION: "is in a direction of",
    Relation.NEAR: "is near",
    Relation.INSIDE: "is in",
    Relation.ALONG: "is along",
    Relation.ACROSS: "is across from",
    Relation.BETWEEN: "is between",
    Relation.VISIBLE: "is in sight of",
    Relation.SAME: "is at",
}
Explain = Callable[[NDArray[np.float64]], tuple[Evidence, ...]]
"""Makes the evidence at a position (2,) [m]."""
WINDS = ("north", "northeast", "east", "southeast", "south", "southwest", "west", "northwest")


def wind(angle: float) -> str:
    """Name of a bearing [rad] among the eight winds."""
    return WINDS[round(angle / (np.pi / 4)) % 8]


def find_evidence(position: NDArray[np.float64], city: City, query: Query) -> tuple[Evidence, ...]:
    """Evidence of every statement at a position (2,) [m]; unused statements come last."""
    unused = tuple(
        Evidence(quote_statement(s, query), "silent", 0.0, (), reason) for s, reason in query.unused
    )
    if not query.used:
        return unused
    ratios, served = score_positions(position[None], city, query)
    found = [
        _evidence(s, float(r), [int(o) for o in rows if o >= 0], position, city, query)
        for s, r, rows in zip(query.used, ratios[0], served[0], strict=True)
    ]
    return (*found, *unused)


def score_positions(
    positions: NDArray[np.float64], city: City, query: Query
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Log-likelihood ratio (N, S) of each statement used at positions (N, 2) [m], and what serves it.

    Of the latter rows of objects (N, S, 2), -1 for none.
    """
    views = city.views
    around = np.unique(np.concatenate([views.near(p, REACH) for p in positions]))
    nearby = np.unique(city.in_sight(around).objects)
    far = np.zeros((len(positions), len(query.used)), np.float32)
    if query.far is not None:
        far = distant(query.statements, city.columns, query.far, positions)
    _, ratios, served = look_again(
        query.statements, city.columns, query.words(len(views.share)), positions[None],
        (np.array([0, len(nearby)]), nearby), far[None], CERTAIN, True,
    )  # fmt: skip
    return ratios[0], served[0]


def _evidence(
    statement: Statement,
    ratio: float,
    rows: list[int],
    position: NDArray[np.float64],
    city: City,
    query: Query,
) -> Evidence:
    verdict = "for" if ratio > TELLING else "against" if ratio < -TELLING else "silent"
    delta, off = _find_delta(statement, rows, position, city)
    if rows and not statement.negated and off > np.pi / 2:
        verdict = "against"  # it is rare enough to speak for the place, but it lies the other way
    if verdict == "for" and not rows and not statement.negated:
        rows = _from_afar(statement, position, city, query)
    note = ""
    if verdict == "against":
        note = _explain_against(statement, rows, delta, off)
        rows = rows if statement.negated or note.startswith("there it") else []
    elif not rows and not statement.negated:
        note = "nothing in sight serves it"
    elif unknown := query.by_kind.intersection(ends(statement)):
        names = " and ".join(query.description.mentions[n].name for n in sorted(unknown))
        note = f"the map knows no {names}; one of its kind serves"
    return Evidence(
        quote_statement(statement, query),
        verdict,
        ratio,
        tuple(describe_object(o, city) for o in rows),
        note,
    )


def _from_afar(
    statement: Statement, position: NDArray[np.float64], city: City, query: Query
) -> list[int]:
    """The nearest rare thing out of sight that the statement may speak of."""
    far = query.far
    if far is None:
        return []
    ends = [n - 2 for n in (statement.source, statement.target) if n > 1]
    lists = [far.objects[far.starts[m] : far.starts[m + 1]] for m in ends]
    known = [rows for rows in lists if len(rows)]
    if not known:
        return []
    rows = min(known, key=len)
    distance = np.hypot(*(city.objects.center[rows] - position).T)
    return [int(rows[np.argmin(distance)])]


def _explain_against(
    statement: Statement, rows: list[int], delta: NDArray[np.float64], off: float
) -> str:
    """Return what speaks against a statement, as people would say it."""
    if statement.negated:
        return "but it is there"
    if statement.relation is not Relation.DIRECTION or not rows:
        return "nothing in sight serves it"
    if off < np.pi / 4:
        return "it fits, but no better than elsewhere"
    return f"there it lies to the {wind(float(bearing(delta)))}"


def _find_delta(
    statement: Statement, rows: list[int], position: NDArray[np.float64], city: City
) -> tuple[NDArray[np.float64], float]:
    """Return the vector (2,) [m] from what served as target to what served as source, and its error.

    The error is the angle [rad] by which a stated direction is wrong, 0 without one.
    """
    o, (east, north) = city.objects, position.tolist()
    stands = [
        np.array(nearest_on_parts(
            o.part_starts, o.point_starts, o.points, o.kind[row], row, east, north
        )[:2])
        for row in rows
    ]  # fmt: skip
    if not rows:
        return np.zeros(2), 0.0
    if len(rows) == 1:
        delta = stands[0] if statement.target == SPEAKER else -stands[0]
    else:
        delta = stands[0] - stands[1]
    if statement.bearing is None or np.hypot(*delta) < 1.0:
        return delta, 0.0
    return delta, float(angle_between(bearing(delta), statement.bearing))


def describe_object(row: int, city: City) -> ObjectRef:
    """Describe a map object in an estimate."""
    o = city.objects
    longitude, latitude = (float(x) for x in city.plane.to_lonlat(o.center[row]))
    return ObjectRef(o.osm(row), o.label(row), o.name(row), longitude, latitude)


def quote_statement(statement: Statement, query: Query) -> str:
    """A statement in the text's own words; put into words where one sentence makes several."""
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
        how = f"is {wind(statement.bearing)} of"
    if statement.negated:
        how = how.replace("is ", "is not ", 1)
    told = f"{words(statement.source)} {how} {words(statement.target)}"
    if statement.relation is Relation.BETWEEN:
        told += f" and {words(statement.target2)}"
    return told.replace("me is", "I am").replace("you is", "you are")


MOST_SUPPORT = 4000
"""At most this many points of the posterior are kept in an estimate."""


def answer(asked: Request, found: Posterior, top: int) -> CityEstimate:
    """Return the estimate of a posterior: at most `top` modes, their evidence, status and support."""
    city, query, matching = asked.city, asked.query, asked.matching
    spacing = city.cells.size if matching.of_cells else SPACING
    peaks = (rank_modes if matching.ranks else find_modes)(found, top, spacing)
    diagnostics = diagnose(found, peaks, infer_claim(asked.understood), query, city)
    if matching.of_cells:
        diagnostics = replace(diagnostics, cell_matcher=matching.matcher, ranks_only=matching.ranks)
    else:
        found, peaks = shrink(found, peaks, diagnostics)
    places = make_places(peaks, city, partial(find_evidence, city=city, query=query))
    contradiction = find_contradiction(places[0] if places else None, query)
    status, reason = decide(replace(diagnostics, contradiction=contradiction))
    return CityEstimate(
        status, places, reason, asked.understood, find_support(found, city),
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
