"""Geometry of the ground floor: the local east-north plane and directions in it.

Bearings are radians clockwise from north, as on a compass: north 0, east pi/2.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

WGS84_A = 6_378_137.0
"""Semi-major axis of the WGS84 ellipsoid [m]."""
WGS84_E2 = 6.694_379_990_14e-3
"""First eccentricity of the WGS84 ellipsoid, squared."""


@dataclass(frozen=True, slots=True)
class LocalPlane:
    """East-north metric plane that touches WGS84 at an origin.

    Metres per degree come from the ellipsoid's radii of curvature at the origin. The scale is
    exact at the origin's latitude; 15 km north or south of it, lengths from west to east are off
    by 0.24 % times the tangent of the latitude (0.24 % at 45 degrees, 0.42 % at 60).
    """

    longitude: float
    """Origin [deg]."""
    latitude: float
    """Origin [deg]."""

    @property
    def metres_per_degree(self) -> tuple[float, float]:
        """Metres per degree of longitude and of latitude at the origin."""
        phi = radians(self.latitude)
        w2 = 1.0 - WGS84_E2 * (1.0 - cos(phi) ** 2)
        prime_vertical = WGS84_A / sqrt(w2)
        meridian = WGS84_A * (1.0 - WGS84_E2) / w2**1.5
        return radians(prime_vertical * cos(phi)), radians(meridian)

    def to_plane(self, lonlat: ArrayLike) -> Floats:
        """Longitude and latitude (..., 2) [deg] to east and north (..., 2) [m]."""
        delta = np.asarray(lonlat, np.float64) - (self.longitude, self.latitude)
        delta[..., 0] = (delta[..., 0] + 180.0) % 360.0 - 180.0  # across the date line
        return delta * self.metres_per_degree

    def to_lonlat(self, east_north: ArrayLike) -> Floats:
        """East and north (..., 2) [m] to longitude and latitude (..., 2) [deg]."""
        degrees = np.asarray(east_north, np.float64) / self.metres_per_degree
        degrees += (self.longitude, self.latitude)
        degrees[..., 0] = (degrees[..., 0] + 180.0) % 360.0 - 180.0
        return degrees


def bearing(delta: ArrayLike) -> Floats:
    """Bearing (...) [rad, 0 to 2 pi, clockwise from north] of vectors (..., 2) east, north."""
    delta = np.asarray(delta, np.float64)
    turn: Floats = np.arctan2(delta[..., 0], delta[..., 1]) % (2.0 * np.pi)
    turn *= turn < 2.0 * np.pi  # a hair west of north rounds to a full turn
    return turn


def angle_between(a: ArrayLike, b: ArrayLike) -> Floats:
    """Smallest angle (...) [rad, 0 to pi] between two bearings."""
    difference = np.abs(np.asarray(a, np.float64) - np.asarray(b, np.float64)) % (2.0 * np.pi)
    return np.minimum(difference, 2.0 * np.pi - difference)
