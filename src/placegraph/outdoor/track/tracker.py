"""Tracker of a speaker: motion moves a posterior over places, and each sentence sharpens it.

The Bayesian step of a filter (predict by motion, correct by statements) over all viewpoints of a map
at once, so that nothing is drawn by chance. Sentences between two motions are read as one text: "the
bakery" may mean the one spoken of before, and a repeated statement adds no certainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import atan2, hypot, pi

import numpy as np

from placegraph.core.estimate import CityEstimate, Evidence, Place, Status
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.language.text import check_text
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.likelihood.query import Query, compile_query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.search.answer import (
    MOST_SUPPORT,
    answer_nothing,
    find_evidence,
    find_support,
    make_places,
)
from placegraph.outdoor.search.ask import Answer
from placegraph.outdoor.search.posterior import SPACING, find_modes
from placegraph.outdoor.search.request import finite, is_count, parse, positive, share_views
from placegraph.outdoor.search.status import (
    IN_SIGHT,
    decide,
    diagnose,
    explain_no_change,
    find_contradiction,
    shrink,
)
from placegraph.outdoor.track.belief import (
    COMPASS,
    FARTHEST,
    SURPRISED,
    Belief,
    Kernel,
    Memory,
    Stop,
    TrackGrid,
    inject_uniform,
    make_displacement,
    make_walk,
    odometry_sigma,
    propagate,
)
from placegraph.outdoor.track.motion import Leg, split_legs


@dataclass(frozen=True)
class Waypoint:
    """One call of a tracker, and what it came to."""

    said: str
    """The text, or the motion in words."""
    status: Status
    best: Place | None
    """The best mode after it."""


def answer_belief(
    city: City, stop: Stop, memory: tuple[Memory, ...], grid: TrackGrid, top: int, why: str
) -> CityEstimate:
    """Return where the speaker is by the belief at a stop; `why` the last text did not change it."""
    query = stop.query
    found = stop.posterior(grid, MOST_SUPPORT)
    peaks = find_modes(found, top, SPACING)
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
    here = find_evidence(position, city, query) if query is not None else ()
    return (*here, *(e for m in reversed(memory) for e in m.evidence(position, city)))


REMEMBERED = 6
"""Of so many places before, the evidence is told again."""


class CityTracker:
    """Follows a speaker through a city by what they say of places and of their way.

    Made by `CityMap.track`. Every call returns the estimate that it leads to; the map is not changed,
    and the same calls give the same answers.

    Parameters
    ----------
    near
        Longitude and latitude [deg] the speaker is known to start near; a third number is the radius
        [m].
    radius
        Radius of `near` [m]: half of the prior lies within.
    heading
        Where the speaker looks at first [rad, clockwise from north]; later it is the way they went.
    top
        How many modes at most.

    Raises
    ------
    OptionError
        An option is out of range.

    """

    def __init__(
        self,
        city: City,
        *,
        near: Sequence[float] | None = None,
        radius: float = 1000.0,
        heading: float | None = None,
        top: int = 5,
    ) -> None:
        if not is_count(top):
            raise OptionError(f"top is {top!r}; ask for at least one mode.")
        self.city = city
        self._top = int(top)
        self._grid = TrackGrid.of(city.views)
        self._first_heading = None if heading is None else finite(heading, "heading", "an angle")
        self._shares = None if near is None else share_views(city, near, radius)
        self.reset()

    def reset(self) -> CityEstimate:
        """Forget all that was said and gone."""
        self._stop = Stop(Belief.start(self._grid, self._shares))
        self._memory: tuple[Memory, ...] = ()
        self._heading: tuple[float, float] | None = (
            None if self._first_heading is None else (self._first_heading, 0.1)
        )
        self._understood = False
        self._history: tuple[Waypoint, ...] = ()
        self._estimate = answer_nothing("Nothing has been said yet; say what stands around you.")
        return self._estimate

    @property
    def estimate(self) -> CityEstimate:
        """The latest estimate."""
        return self._estimate

    @property
    def history(self) -> tuple[Waypoint, ...]:
        """All calls and the best modes after them: the path."""
        return self._history

    @property
    def heading(self) -> float | None:
        """Bearing in which the speaker looks [rad, clockwise from north], as far as their way tells."""
        return None if self._heading is None else self._heading[0] % (2.0 * pi)

    @property
    def elsewhere(self) -> float:
        """Probability that the speaker is on no place of the map."""
        return self._stop.now.elsewhere

    def tell(self, text: str | Description) -> CityEstimate:
        """Take what was said of places and of the way: "I walked 200 m east. I am at a bakery".

        Or a parsed description of what is in sight. `DescriptionError`: empty, too long, no text.
        """
        why = ""
        if isinstance(text, Description):
            why = self._hear(text)
            return self._noted(text.text or "a description", why)
        check_text(text)
        for part in split_legs(text):
            if isinstance(part, Leg):
                self._went(part)
            else:
                why = self._hear(part)
        return self._noted(text.strip(), why)

    def answer(self, answer: Answer) -> CityEstimate:
        """Take the answer to a question about the last estimate, read with what was said here before."""
        stop = self._stop
        more = answer.added_to(stop.query.description if stop.query else Description(""))
        query = compile_query(more, self.city)
        if query.used:
            self._stop = stop.update((*stop.texts, more), query, self.city, self._grid)
            self._understood = True
        return self._noted(f"{answer.question.text} {answer.option}", "")

    def move(self, east: float, north: float, *, sigma: float | None = None) -> CityEstimate:
        """Move by a measured displacement.

        Parameters
        ----------
        east, north
            Displacement [m].
        sigma
            Its standard deviation along each axis [m]; 3 % of its length and 1 m where not given.

        Raises
        ------
        OptionError
            A number is not finite, or `sigma` is negative.

        """
        east = finite(east, "east", "metres")
        north = finite(north, "north", "metres")
        length = hypot(east, north)
        loose = odometry_sigma(length) if sigma is None else positive(sigma, "sigma")
        if length > 0.0:
            self._heading = atan2(east, north), min(pi, loose / length)
        if max(length, loose) > FARTHEST:
            self._start_over()
        else:
            self._moved(make_displacement(east, north, loose))
        return self._noted(f"moved {east:.1f} m east, {north:.1f} m north", "")

    def walk(
        self,
        distance: float,
        bearing: float | None = None,
        *,
        distance_sigma: float | None = None,
        bearing_sigma: float = COMPASS,
    ) -> CityEstimate:
        """Move by a measured distance, in a measured direction if there is one.

        Parameters
        ----------
        distance
            Length of the way, straight [m].
        bearing
            Direction [rad, clockwise from north]; None: any.
        distance_sigma
            Standard deviation of the distance [m]; 3 % and 1 m where not given.
        bearing_sigma
            Standard deviation of the bearing [rad].

        Raises
        ------
        OptionError
            A number is not finite, or a distance or deviation is negative.

        """
        distance = positive(distance, "distance")
        given = distance_sigma
        loose = odometry_sigma(distance) if given is None else positive(given, "distance_sigma")
        turn = positive(bearing_sigma, "bearing_sigma")
        bearing = None if bearing is None else finite(bearing, "bearing", "an angle")
        self._go(distance, loose, bearing, turn)
        where = "" if bearing is None else f" at {np.rad2deg(bearing) % 360.0:.0f} degrees"
        return self._noted(f"walked {distance:.1f} m{where}", "")

    # --- motion ---

    def _went(self, leg: Leg) -> None:
        """Take a way that was told."""
        bearing, sigma = leg.bearing, leg.sigma
        if bearing is None and leg.turn is not None and self._heading is not None:
            before, loose = self._heading
            bearing, sigma = before + leg.turn, hypot(sigma, loose)
        if leg.distance > 0.0:
            self._go(leg.distance, leg.spread, bearing, sigma)
        elif leg.sigma > 0.0:  # a turn: what is left of one has changed
            self._stop = self._next()
            self._heading = None if bearing is None else (bearing, min(sigma, pi))

    def _go(self, distance: float, loose: float, bearing: float | None, sigma: float) -> None:
        if bearing is not None and sigma > 1.2:
            bearing = None  # after so many turns any direction is as likely
        if distance > 0.0:
            self._heading = None if bearing is None else (bearing, min(sigma, pi))
        if distance + loose > FARTHEST:
            self._start_over()
        else:
            self._moved(make_walk(distance, loose, bearing, sigma))

    def _moved(self, kernel: Kernel) -> None:
        belief = propagate(self._stop.placed(self._grid), kernel)
        self._memory = tuple(m.after(kernel.mean, kernel.covariance) for m in self._remembered())
        self._stop = Stop(inject_uniform(belief, self._grid))

    def _remembered(self) -> tuple[Memory, ...]:
        """Return the memories with that of this stop."""
        memory = self._stop.memory(self._grid)
        return self._memory if memory is None else (*self._memory, memory)[-REMEMBERED:]

    def _next(self) -> Stop:
        """Return a fresh stop at the same place; what was said at this one is remembered."""
        self._memory = self._remembered()
        return Stop(self._stop.now, fine=self._stop.fine)

    def _start_over(self) -> None:
        """Forget where the speaker was, after a way so long that nothing is left of it."""
        self._stop = Stop(Belief.start(self._grid))
        self._memory = ()

    # --- words ---

    def _hear(self, text: str | Description) -> str:
        """Sharpen the belief; returns why that was not possible, or an empty string."""
        stop = self._stop
        if stop.texts and not stop.goes_on(text):
            stop = self._next()
        texts = (*stop.texts, text)
        joint = text if isinstance(text, Description) else " ".join(map(str, texts))
        query = self._compile(joint)
        repeated = stop.query is not None and len(query.used) == len(stop.query.used)
        if repeated or not query.used:
            alone = self._compile(text)
            return "" if alone.used else explain_no_change(alone)
        after = stop.update(texts, query, self.city, self._grid)
        gain = after.log_evidence - stop.log_evidence
        if stop.texts and gain < np.log(SURPRISED) and (alone := self._compile(text)).used:
            anew = stop.unsure(self._grid).update((text,), alone, self.city, self._grid)
            if anew.log_evidence > gain + np.log(2.0):
                self._memory = self._remembered()
                after = anew
        self._stop = after
        self._understood = True
        return ""

    def _compile(self, text: str | Description) -> Query:
        return compile_query(parse(self.city, text, heading=self.heading), self.city)

    # --- answers ---

    def _noted(self, said: str, why: str) -> CityEstimate:
        """Make the estimate and keep it."""
        if self._understood or self._shares is not None:
            self._estimate = answer_belief(
                self.city, self._stop, self._memory, self._grid, self._top, why
            )
        else:
            understood = self._stop.query.description if self._stop.query else None
            reason = why or "Nothing was said of a place yet; say what stands around you."
            self._estimate = answer_nothing(reason, understood)
        self._history += (Waypoint(said, self._estimate.status, self._estimate.best),)
        return self._estimate

    def __repr__(self) -> str:
        return f"CityTracker({self.city.source!r}, {len(self._history)} steps)"
