"""Tracker of a speaker: a Bayes filter over all viewpoints of a map, without random samples.

Motion propagates the belief, and texts update it. Sentences between two motions are parsed as one text:
"the bakery" may mean one mentioned before, and a repeated statement adds no certainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import atan2, hypot, pi

import numpy as np

from placegraph.core.estimate import CityEstimate, Evidence, Place, Status
from placegraph.core.geometry import Floats, bearing
from placegraph.errors import OptionError
from placegraph.language.text import check_text
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.likelihood.query import Query, compile_query
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.index import STRIDE
from placegraph.outdoor.search.ask import Answer
from placegraph.outdoor.search.locate import (
    MAX_SUPPORT,
    decide_estimate,
    find_evidence,
    make_lost_estimate,
)
from placegraph.outdoor.search.posterior import SPACING, find_modes
from placegraph.outdoor.search.request import (
    check_finite,
    check_heading,
    check_nonnegative,
    is_count,
    parse,
    share_views,
)
from placegraph.outdoor.search.status import IN_SIGHT, diagnose, explain_no_change
from placegraph.outdoor.track.belief import (
    COMPASS_SIGMA,
    MAX_DISTANCE,
    MIN_EVIDENCE,
    Belief,
    Measurement,
    MotionKernel,
    PastMeasurement,
    TrackGrid,
    add_mass,
    inject_uniform,
    make_displacement_kernel,
    make_walk_kernel,
    odometry_sigma,
    propagate,
)
from placegraph.outdoor.track.motion import TURN_SIGMA, Leg, split_legs
from placegraph.outdoor.track.route import Route
from placegraph.outdoor.track.route_answer import estimate_end, read_instructions
from placegraph.outdoor.track.route_text import Step


@dataclass(frozen=True)
class TrackStep:
    """One call of a tracker, and its result."""

    text: str
    """The text, or the motion in words."""
    status: Status
    best: Place | None
    """The best mode after the call."""


def find_track_evidence(
    position: Floats, city: City, query: Query | None, memory: tuple[PastMeasurement, ...]
) -> tuple[Evidence, ...]:
    """Find the evidence of the texts at this place, then of those at earlier places, the latest first."""
    here = find_evidence(position, city, query) if query is not None else ()
    return (*here, *(e for m in reversed(memory) for e in m.find_evidence(position, city)))


MAX_STARTS = 1000
"""Largest number of places where a told way may begin."""
MAX_MEMORIES = 6
"""Largest number of earlier places in the evidence."""


class CityTracker:
    """Tracker of a speaker by texts about places and about motion.

    Made by `CityMap.track`. Every call returns the new estimate; the map is not changed, and the same
    calls give the same answers.

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
            raise OptionError(f"top is {top!r}; give at least 1.")
        self.city = city
        self._top = int(top)
        self._grid = TrackGrid.of_views(city.views)
        self._first_heading = None if heading is None else check_heading(heading)
        self._shares = None if near is None else share_views(city, near, radius)
        self.reset()

    def reset(self) -> CityEstimate:
        """Forget all texts and motions."""
        self._measurement = Measurement(Belief.start(self._grid, self._shares))
        self._memory: tuple[PastMeasurement, ...] = ()
        self._heading: tuple[float, float] | None = (
            None if self._first_heading is None else (self._first_heading, 0.1)
        )
        self._understood = False
        self._history: tuple[TrackStep, ...] = ()
        self._estimate = make_lost_estimate(
            "There is no text yet; describe the objects around you."
        )
        return self._estimate

    @property
    def estimate(self) -> CityEstimate:
        """The latest estimate."""
        return self._estimate

    @property
    def history(self) -> tuple[TrackStep, ...]:
        """All calls, with the best modes after them: the path."""
        return self._history

    @property
    def heading(self) -> float | None:
        """Heading of the speaker [rad, clockwise from north]; None where their way does not tell."""
        return None if self._heading is None else self._heading[0] % (2.0 * pi)

    @property
    def elsewhere(self) -> float:
        """Probability that the speaker is not on the map."""
        return self._measurement.current.elsewhere

    def tell(self, text: str | Description) -> CityEstimate:
        """Update by a description or a text, such as "I walked 200 m east. I am at a bakery".

        Raises `DescriptionError` where the text is empty, too long, or no text.
        """
        why = ""
        if isinstance(text, Description):
            why = self._update(text)
            return self._record(text.text or "a description", why)
        check_text(text)
        if steps := read_instructions(text, self.city):
            return self._follow(text.strip(), steps)
        for part in split_legs(text):
            if isinstance(part, Leg):
                self._apply_leg(part)
            else:
                why = self._update(part)
        return self._record(text.strip(), why)

    def _follow(self, text: str, steps: list[Step]) -> CityEstimate:
        """Follow a way along the streets from where the speaker is."""
        here = self._measurement
        start = here.to_posterior(self._grid, MAX_STARTS)
        sharp = self._heading is not None and self._heading[1] < 1.0
        route = Route(self.city, start, self.heading if sharp else None, STRIDE)
        ends = route.follow(steps)
        estimate = estimate_end(route, ends, text, self._top)
        if estimate.best is not None:
            mass = np.zeros_like(here.current.mass)
            add_mass(mass, self._grid, ends.positions, ends.probabilities)
            self._measurement = Measurement(Belief(mass, 1.0 - float(mass.sum(dtype=np.float64))))
            self._memory, self._understood = (), True
            last = self.city.plane.to_plane(estimate.way[-2:])
            self._heading = float(bearing(last[-1] - last[0])), TURN_SIGMA
        self._estimate = estimate
        self._history += (TrackStep(text, estimate.status, estimate.best),)
        return estimate

    def answer(self, answer: Answer) -> CityEstimate:
        """Update by the answer to a question about the last estimate, with the texts at this place."""
        measurement = self._measurement
        more = answer.added_to(
            measurement.query.description if measurement.query else Description("")
        )
        query = compile_query(more, self.city)
        if query.used:
            self._measurement = measurement.update(
                (*measurement.texts, more), query, self.city, self._grid
            )
            self._understood = True
        return self._record(f"{answer.question.text} {answer.option}", "")

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
        east = check_finite(east, "east", "metres")
        north = check_finite(north, "north", "metres")
        length = hypot(east, north)
        loose = odometry_sigma(length) if sigma is None else check_nonnegative(sigma, "sigma")
        if length > 0.0:
            self._heading = atan2(east, north), min(pi, loose / length)
        if max(length, loose) > MAX_DISTANCE:
            self._forget_place()
        else:
            self._propagate(make_displacement_kernel(east, north, loose))
        return self._record(f"moved {east:.1f} m east, {north:.1f} m north", "")

    def walk(
        self,
        distance: float,
        bearing: float | None = None,
        *,
        distance_sigma: float | None = None,
        bearing_sigma: float = COMPASS_SIGMA,
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
        distance = check_nonnegative(distance, "distance")
        loose = odometry_sigma(distance)
        if distance_sigma is not None:
            loose = check_nonnegative(distance_sigma, "distance_sigma")
        turn = check_nonnegative(bearing_sigma, "bearing_sigma")
        bearing = None if bearing is None else check_finite(bearing, "bearing", "an angle")
        self._walk(distance, loose, bearing, turn)
        where = "" if bearing is None else f" at {np.rad2deg(bearing) % 360.0:.0f} degrees"
        return self._record(f"walked {distance:.1f} m{where}", "")

    def _apply_leg(self, leg: Leg) -> None:
        """Apply a leg of a text."""
        bearing, sigma = leg.bearing, leg.sigma
        if bearing is None and leg.turn is not None and self._heading is not None:
            before, loose = self._heading
            bearing, sigma = before + leg.turn, hypot(sigma, loose)
        if leg.distance > 0.0:
            self._walk(leg.distance, leg.spread, bearing, sigma)
        elif leg.sigma > 0.0:  # a turn: "on my left" has another meaning now
            self._measurement = self._start_measurement()
            self._heading = None if bearing is None else (bearing, min(sigma, pi))

    def _walk(self, distance: float, loose: float, bearing: float | None, sigma: float) -> None:
        if bearing is not None and sigma > 1.2:
            bearing = None  # nearly uniform after many turns
        if distance > 0.0:
            self._heading = None if bearing is None else (bearing, min(sigma, pi))
        if distance + loose > MAX_DISTANCE:
            self._forget_place()
        else:
            self._propagate(make_walk_kernel(distance, loose, bearing, sigma))

    def _propagate(self, kernel: MotionKernel) -> None:
        belief = propagate(self._measurement.to_refined_belief(self._grid), kernel)
        self._memory = tuple(
            m.propagate(kernel.mean, kernel.covariance) for m in self._list_memories()
        )
        self._measurement = Measurement(inject_uniform(belief, self._grid))

    def _list_memories(self) -> tuple[PastMeasurement, ...]:
        """Return the earlier measurements, this one included."""
        memory = self._measurement.to_past(self._grid)
        return self._memory if memory is None else (*self._memory, memory)[-MAX_MEMORIES:]

    def _start_measurement(self) -> Measurement:
        """Return a new measurement at the same place; the texts so far are remembered."""
        self._memory = self._list_memories()
        return Measurement(self._measurement.current, fine=self._measurement.fine)

    def _forget_place(self) -> None:
        """Reset the belief, after a way so long that nothing is left of it."""
        self._measurement = Measurement(Belief.start(self._grid))
        self._memory = ()

    def _update(self, text: str | Description) -> str:
        """Update the belief by a text; return why that was not possible, or an empty string."""
        measurement = self._measurement
        if measurement.texts and not measurement.accepts(text):
            measurement = self._start_measurement()
        texts = (*measurement.texts, text)
        joint = text if isinstance(text, Description) else " ".join(map(str, texts))
        query = self._compile(joint)
        repeated = measurement.query is not None and len(query.used) == len(measurement.query.used)
        if repeated or not query.used:
            alone = self._compile(text)
            return "" if alone.used else explain_no_change(alone)
        after = measurement.update(texts, query, self.city, self._grid)
        gain = after.log_evidence - measurement.log_evidence
        if (
            measurement.texts
            and gain < np.log(MIN_EVIDENCE)
            and (alone := self._compile(text)).used
        ):
            anew = measurement.with_injection(self._grid).update(
                (text,), alone, self.city, self._grid
            )
            if anew.log_evidence > gain + np.log(2.0):
                self._memory = self._list_memories()
                after = anew
        self._measurement = after
        self._understood = True
        return ""

    def _compile(self, text: str | Description) -> Query:
        return compile_query(parse(self.city, text, heading=self.heading), self.city)

    def _record(self, text: str, why: str) -> CityEstimate:
        """Make the estimate of the current belief, and add the call to the history."""
        measurement, query = self._measurement, self._measurement.query
        if self._understood or self._shares is not None:
            found = measurement.to_posterior(self._grid, MAX_SUPPORT)
            modes = find_modes(found, self._top, SPACING)
            # objects in sight count, whatever the texts alone would claim
            diagnostics = diagnose(found, modes, IN_SIGHT, query, self.city)
            explain = partial(find_track_evidence, city=self.city, query=query, memory=self._memory)
            self._estimate = decide_estimate(
                found, modes, replace(diagnostics, remark=why), query, self.city, explain
            )
        else:
            understood = query.description if query else None
            reason = why or "No text was about a place yet; describe the objects around you."
            self._estimate = make_lost_estimate(reason, understood)
        self._history += (TrackStep(text, self._estimate.status, self._estimate.best),)
        return self._estimate

    def __repr__(self) -> str:
        return f"CityTracker({self.city.source!r}, {len(self._history)} steps)"
