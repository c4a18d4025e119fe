"""Where was this said? Text in, estimate out, stage by stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from placegraph.core.estimate import CityEstimate
from placegraph.errors import OptionError
from placegraph.outdoor.language.description import LISTENER, Description, Relation, Statement
from placegraph.outdoor.likelihood.query import compile_query, read, standing_at
from placegraph.outdoor.likelihood.statements import ends
from placegraph.outdoor.map.city import City
from placegraph.outdoor.search.answer import answer, answer_nothing
from placegraph.outdoor.search.ask import Answer
from placegraph.outdoor.search.cells import search_cells
from placegraph.outdoor.search.request import Matching, Request, is_count, within
from placegraph.outdoor.search.status import find_obstacle
from placegraph.outdoor.search.viewpoints import search
from placegraph.outdoor.search.whereabouts import Way, Whereabouts, number, position, swapped


@dataclass(frozen=True, eq=False)
class Hints:
    """What a user knows beside the words; see `CityMap.locate`."""

    near: Sequence[float] | None = None
    radius: float = 1000.0
    heading: float | None = None
    listener: Sequence[float] | None = None
    answers: Sequence[Answer] | None = ()
    language: str | None = None


def locate(
    city: City,
    text: str | Description,
    *,
    top: int = 5,
    hints: Hints | None = None,
    matching: Matching | None = None,
) -> CityEstimate:
    """Locate a description in a city; see `CityMap.locate`."""
    if not is_count(top):
        raise OptionError(f"top is {top!r}; ask for at least one mode.")
    hints = hints or Hints()
    description, asked = understand(city, text, hints, matching or Matching())
    told = bool(asked.known.ways)
    obstacle = find_obstacle(asked.query, description, way_told=told) or _off_the_map(asked, hints)
    if obstacle:
        return answer_nothing(obstacle, description)
    found = search_cells(asked) if asked.matching.of_cells else search(asked)
    return answer(asked, found, top, description)


def understand(
    city: City, text: str | Description, hints: Hints, matching: Matching
) -> tuple[Description, Request]:
    """What was said, answers to questions included, and what it asks of the city."""
    known = Whereabouts.around(city, hints.near, hints.radius)
    if hints.heading is not None and not np.isfinite(number(hints.heading)):
        raise OptionError(f"heading is {hints.heading!r}; give a finite angle.")
    heading = None if hints.heading is None else number(hints.heading)
    listener = None if hints.listener is None else position(city, hints.listener, "listener")
    description = read(city, text, heading=heading, language=hints.language)
    for given in hints.answers or ():
        if not hasattr(given, "added_to"):
            raise OptionError(
                f"answers holds {given!r}; answer questions by `question.answer(option)`."
            )
        description = given.added_to(description)
    way, rest = _split(description, known=listener is not None)
    to_somebody = any(LISTENER in ends(s) for s in description.statements)
    query = compile_query(replace(description, statements=rest), city, on_a_way=to_somebody)
    matching.check(city)
    inside = None if matching.region is None else partial(within, city, region=matching.region)
    known = replace(known, listener=listener, ways=way, inside=inside)
    return description, Request(city, query, known, matching)


def _split(
    description: Description, *, known: bool
) -> tuple[tuple[Way, ...], tuple[Statement, ...]]:
    """Split off what is said of the way from the listener.

    Whatever the speaker stands at lies where the speaker does.
    """
    here = standing_at(description.statements)
    way, rest = [], []
    for s in description.statements:
        if known and s.relation is Relation.DIRECTION and s.bearing is not None and not s.negated:
            if s.source in here and s.target == LISTENER:
                way.append(Way(s.bearing, s.bearing_sigma, s.certainty, s.distance))
                continue
            if s.target in here and s.source == LISTENER:
                way.append(Way(s.bearing + np.pi, s.bearing_sigma, s.certainty, s.distance))
                continue
        rest.append(s)
    return tuple(way), tuple(rest)


def _off_the_map(asked: Request, hints: Hints) -> str:
    """Why the speaker cannot be anywhere on the map; an empty string where they can."""
    known, views = asked.known, asked.city.views
    if hints.near is not None and known.off(asked.city):
        near = tuple(hints.near[:2])
        return f"The map does not reach the surroundings of {near}.{swapped(asked.city, near)}"
    if known.inside is not None and not known.inside(views.positions.astype(np.float64)).any():
        return f"The map has nothing to see in {tuple(asked.matching.region or ())}."
    return ""
