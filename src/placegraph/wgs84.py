"""The ellipsoid: geodetic, Earth-centred (ECEF) and east-north-up (ENU) coordinates of WGS84, exact.

Where a plane will do, `geometry.LocalPlane` is simpler; here nothing is flattened, and poles and the
date line need no care.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import ArrayLike

from placegraph.geometry import WGS84_A, WGS84_E2, Floats

_AXIS = WGS84_A * sqrt(1.0 - WGS84_E2)  # semi-minor axis [m]


def ecef_from_geodetic(lonlath: ArrayLike) -> Floats:
    """Earth-centred points (..., 3) [m] of longitude, latitude [deg] and height [m] (..., 3)."""
    lon, lat, height = np.moveaxis(np.asarray(lonlath, np.float64), -1, 0)
    lon, lat = np.radians(lon), np.radians(lat)
    prime_vertical = WGS84_A / np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    across = (prime_vertical + height) * np.cos(lat)
    up = (prime_vertical * (1.0 - WGS84_E2) + height) * np.sin(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), up], axis=-1)


def geodetic_from_ecef(points: ArrayLike) -> Floats:
    """Longitude, latitude [deg] and height [m] (..., 3) of Earth-centred points (..., 3) [m].

    Bowring's iteration: to 1e-9 m within 100 km of the ellipsoid. At a pole longitude is 0.
    """
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    across, squash = np.hypot(x, y), sqrt(1.0 - WGS84_E2)
    reduced = np.arctan2(z, across * squash)
    for _ in range(4):
        lat = np.arctan2(
            z + WGS84_E2 / (1.0 - WGS84_E2) * _AXIS * np.sin(reduced) ** 3,
            across - WGS84_E2 * WGS84_A * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2(squash * np.sin(lat), np.cos(lat))
    surface = WGS84_A * np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    height = across * np.cos(lat) + z * np.sin(lat) - surface
    return np.stack([np.degrees(np.arctan2(y, x)), np.degrees(lat), height], axis=-1)


def ecef_from_enu(longitude: float, latitude: float) -> Floats:
    """Rotation (3, 3): the axes east, north, up of a place [deg] in the Earth-centred frame."""
    lon, lat = np.radians(longitude), np.radians(latitude)
    sl, cl, sp, cp = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    return np.array([[-sl, -sp * cl, cp * cl], [cl, -sp * sl, cp * sl], [0.0, cp, sp]])
