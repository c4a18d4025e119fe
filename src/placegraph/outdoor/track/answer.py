"""What a tracker answers: the belief at a stop as an estimate, with what was said here and before."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from placegraph.core.estimate import CityEstimate, Evidence, Place, Status
from placegraph.core.geometry import Floats
from placegraph.outdoor.likelihood.query import Query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.search.answer import MOST_SUPPORT, find_support, make_places
from placegraph.outdoor.search.evidence import evidence_at
from placegraph.outdoor.search.posterior import modes
from placegraph.outdoor.search.status import IN_SIGHT, decide, diagnose, find_contradiction, shrink
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
    """Return where the speaker is by the belief at a stop; `why` the last text did not change it."""
    query = stop.query
    found = stop.posterior(grid, MOST_SUPPORT)
    peaks = modes(found, top, SPACING)
    # a way is followed to what is in sight, whatever its texts alone would claim
    diagnostics = diagnose(found, peaks, IN_SIGHT, query, city)
    found, peaks = shrink(found, peaks, diagnostics)
    places = make_places(peaks, city, partial(explain, city=city, query=query, memory=memory))
    contradiction = find_contradiction(places[0] if places else None, query)
    status, reason = decide(replace(diagnostics, contradiction=contradiction, remark=why))
    understood = query.description if query else None
    return CityEstimate(status, places, reason, understood, find_support(found, city), map=city)


def explain(
    position: Floats, city: City, query: Query | None, memory: tuple[Memory, ...]
) -> tuple[Evidence, ...]:
    """Evidence of what was said here, then of what was said before, the latest first."""
    here = evidence_at(position, city, query) if query is not None else ()
    return (*here, *(e for m in reversed(memory) for e in m.evidence(position, city)))
