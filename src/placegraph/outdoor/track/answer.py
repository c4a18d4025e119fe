"""What a tracker answers: the belief at a stop as an estimate, with what was said here and before."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from placegraph.core.estimate import CityEstimate, Evidence, Place, Status
from placegraph.core.geometry import Floats
from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.search.answer import CONTRADICTS, MOST_SUPPORT, contradicted, place, support
from placegraph.outdoor.search.confidence import (
    IN_SIGHT,
    believed,
    doubt_of,
    status_of,
)
from placegraph.outdoor.search.evidence import evidence_at
from placegraph.outdoor.search.posterior import modes
from placegraph.outdoor.search.viewpoints import SPACING
from placegraph.outdoor.track.grid import TrackGrid
from placegraph.outdoor.track.stop import Memory, Stop


@dataclass(frozen=True)
class Waypoint:
    """One call of a tracker, and what it came to."""

    said: str
    """The text, or the motion in words."""
    status: Status
    best: Place | None
    """The best mode after it."""


def estimate(
    city: City, stop: Stop, memory: tuple[Memory, ...], grid: TrackGrid, top: int, why: str
) -> CityEstimate:
    """Where the speaker is by what is believed at a stop; `why` the last text added nothing to it."""
    query, understood = stop.query, stop.query.description if stop.query else None
    doubt = doubt_of(query, city) if query else None
    found = stop.posterior(grid, MOST_SUPPORT)
    peaks = modes(found, top, SPACING)
    # a way is followed to what is in sight, whatever its texts alone would claim
    status, reason = status_of(found, peaks, IN_SIGHT, doubt)
    found, peaks = believed(found, peaks, IN_SIGHT, doubt)
    places = tuple(
        place(mode, city, partial(explained, mode.position, city, query, memory)) for mode in peaks
    )
    if query and understood and understood.conflicts and places and contradicted(places[0], query):
        status, reason = Status.LOST, CONTRADICTS.format(understood.conflicts[0])
    reason = f"{reason} {why}".strip()
    return CityEstimate(status, places, reason, understood, support(found, city), map=city)


def explained(
    position: Floats, city: City, query: Query | None, memory: tuple[Memory, ...]
) -> tuple[Evidence, ...]:
    """Evidence of what was said here, then of what was said before, the latest first."""
    here = evidence_at(position, city, query) if query is not None else ()
    return (*here, *(e for m in reversed(memory) for e in m.evidence(position, city)))


def why_nothing(query: Query) -> str:
    """Why a text changed nothing."""
    reasons = sorted({reason for _, reason in query.unused})
    if reasons:
        return "Nothing that was said last can be looked for: " + "; ".join(reasons) + "."
    return "Nothing of what was said last could be understood."
