"""Where the speaker may be before a word is heard: near a point, within a region, told of the way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import nan
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import angle_between, bearing
from placegraph.errors import OptionError
from placegraph.outdoor.map.city import City
from placegraph.outdoor.map.index import REACH, STRIDE, ViewIndex

WALK = 900.0
"""Spread to either side of the places that a listener is told of [m]; half lie within 1.2 times it."""


class Way(NamedTuple):
    """What was said of the way from the listener to the speaker."""

    bearing: float
    """[rad]"""
    sigma: float
    """[rad]"""
    certainty: float
    distance: float | None = None
    """[m], where said."""

    def fits(self, delta: NDArray[np.float64]) -> NDArray[np.float64]:
        """How much likelier it makes positions (W, 2) [m] from the listener than they were."""
        sigma = 0.9 * self.sigma
        off = np.exp(-0.5 * (angle_between(bearing(delta), self.bearing) / sigma) ** 2)
        if self.distance is None:
            return np.asarray(off * np.sqrt(2.0 * np.pi) / sigma)
        # on the ring at that distance, against all around within a walk
        far, width = np.hypot(*delta.T), 0.25 * self.distance + 60.0
        ring = off * np.exp(-0.5 * ((far - self.distance) / width) ** 2)
        area = 2.0 * np.pi * sigma * width * np.maximum(far, width)
        return np.asarray(ring / area * 1e6 / np.maximum(_walk(far), 1e-6))


@dataclass(frozen=True, eq=False)
class Whereabouts:
    """What is known of the place before a word is heard; all of it is optional."""

    near: NDArray[np.float64] | None = None
    """(2,) east, north [m] the speaker is near ..."""
    radius: float = 1000.0
    """... and the radius that holds half of the probability [m]."""
    listener: NDArray[np.float64] | None = None
    """(2,) east, north [m] of "you" ..."""
    ways: tuple[Way, ...] = ()
    """... and what was said of the way from there."""
    inside: Callable[[NDArray[np.float64]], NDArray[np.bool_]] | None = None
    """Whether the speaker may be at positions (K, 2) [m]; anywhere if not given."""

    @classmethod
    def around(cls, city: City, near: Sequence[float] | None, radius: float) -> Self:
        """Near a longitude and latitude [deg], a third number of which is the radius [m].

        Raises
        ------
        OptionError
            These are no degrees, or the radius is out of range.

        """
        if near is not None and np.size(near) == 3:
            near, radius = near[:2], near[2]
        if not 1.0 <= (within := number(radius)) <= 1e7:
            raise OptionError(f"radius is {radius!r} m; choose between 1 and 10,000,000 m.")
        return cls(None if near is None else position(city, near, "near"), within)

    @property
    def informative(self) -> bool:
        """Whether anything is known."""
        return not (self.near is None and self.listener is None and self.inside is None)

    def off(self, city: City) -> bool:
        """Whether the map does not reach the surroundings of `near`."""
        return self.near is not None and not len(
            city.views.near(self.near, 4.0 * self.radius + REACH)
        )

    def log(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Log prior probability (W,) of all viewpoints of a map; uniform where nothing is known.

        It is -inf where the speaker cannot be. `near` shifts probability within the map; it puts
        none off the map but where the map ends before it.
        """
        allowed = (
            np.ones(len(positions), np.bool_) if self.inside is None else self.inside(positions)
        )
        n = int(allowed.sum())
        prior = np.where(allowed, -np.log(max(1, n)), -np.inf)
        if not n:
            return prior
        if self.near is not None:
            # of a round Gaussian, half lies within 1.1774 sigma; viewpoints stand in for their square
            sigma = np.hypot(self.radius / 1.1774, STRIDE / 2)
            off = -0.5 * (((positions - self.near) / sigma) ** 2).sum(axis=1)
            off = np.where(allowed, off, -np.inf)
            prior = off - np.logaddexp.reduce(off) + off.max()
        if self.listener is not None:
            delta = positions - self.listener
            area = n * STRIDE**2 / 1e6
            prior += np.log(_walk(np.hypot(*delta.T)) * area + 1e-3)
            for way in self.ways:
                fits = way.fits(delta)
                prior += np.log(way.certainty * fits + (1.0 - way.certainty) + 0.05)
        return prior

    def log_of_views(self, views: ViewIndex) -> NDArray[np.float64]:
        """Log prior (W,) of all viewpoints, together at most 1; nothing where nothing is known."""
        if not self.informative:
            return np.zeros(0)
        log_prior = self.log(views.positions.astype(np.float64))
        # what is known of the way cannot lie off the map altogether
        mass = float(np.logaddexp.reduce(log_prior))
        return log_prior - (mass if self.listener is not None else max(0.0, mass))

    def shares(self, views: ViewIndex) -> NDArray[np.float64]:
        """Prior probability (W,) of all viewpoints, together at most 1."""
        shares = np.exp(self.log(views.positions.astype(np.float64)))
        return np.asarray(shares / max(1.0, float(shares.sum())))


def shares_around(city: City, near: Sequence[float], radius: float) -> NDArray[np.float64]:
    """`Whereabouts.shares` near a place; `OptionError` where that lies on the map only if swapped."""
    known = Whereabouts.around(city, near, radius)
    if known.off(city) and (hint := swapped(city, near)):
        raise OptionError(f"near is {near!r}, which is off the map.{hint}")
    return known.shares(city.views)


def _walk(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Density [1/km^2] of meeting places around a listener: mostly within a kilometre or so."""
    return np.asarray(np.exp(-0.5 * (distance / WALK) ** 2) * 1e6 / (2.0 * np.pi * WALK**2))


def number(value: object) -> float:
    """A number, or NaN where it is none, as a text or `True` is not."""
    try:
        return nan if isinstance(value, str | bytes | bool) else float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return nan


def position(city: City, lonlat: Sequence[float], name: str) -> NDArray[np.float64]:
    """East and north (2,) [m] of a longitude and latitude [deg]; `OptionError` where it is none."""
    numbers = [number(x) for x in lonlat] if np.iterable(lonlat) else []
    if len(numbers) != 2 or not (abs(numbers[0]) <= 180.0 and abs(numbers[1]) <= 90.0):
        raise OptionError(
            f"{name} is {lonlat!r}; give longitude and latitude in degrees, in this order."
            f"{swapped(city, numbers)}"
        )
    return city.plane.to_plane(numbers)


def swapped(city: City, lonlat: Sequence[float]) -> str:
    """That a position (2,) [deg] lies on the map if its numbers are swapped; empty where it does not."""
    if len(lonlat) < 2 or not abs(lonlat[0]) <= 90.0:
        return ""
    longitude, latitude = lonlat[1], lonlat[0]
    points = city.objects.points
    there = city.plane.to_plane((longitude, latitude))
    if not ((points.min(axis=0) <= there) & (there <= points.max(axis=0))).all():
        return ""
    return f" Swapped, it lies on the map: longitude comes first, {longitude},{latitude}."


def finite(value: object, name: str, what: str) -> float:
    """Return a finite number; raises `OptionError` otherwise."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        number = float("nan")
    if isinstance(value, bool | str | bytes) or not np.isfinite(number):
        raise OptionError(f"{name} is {value!r}; give {what} as a finite number.")
    return number


def positive(value: object, name: str) -> float:
    """Return a finite number from 0 on; raises `OptionError` otherwise."""
    number = finite(value, name, "an amount")
    if number < 0.0:
        raise OptionError(f"{name} is {value!r}; give 0 or more.")
    return number
