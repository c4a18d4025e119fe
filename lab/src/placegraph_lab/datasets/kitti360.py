"""The world frame of KITTI-360 on the globe.

All drives share one frame, x east, y north [m]. It is a Mercator projection, scaled to the latitude
of one published origin, "a lake in Karlsruhe", which it begins at: `convertPoseToOxts.py` and
`utils.py` of KITTI-360's development kit, in `convertOxtsPose`. KITTI360Pose keeps that frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asinh, cos, radians, tan

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.geometry import Floats

RADIUS = 6_378_137.0  # of the sphere that is projected [m]


@dataclass(frozen=True, slots=True)
class Mercator:
    """Metric frame of a Mercator projection, true to scale at the latitude of its origin."""

    longitude: float  # origin [deg]
    latitude: float  # origin [deg]

    @property
    def _scale(self) -> float:
        return RADIUS * cos(radians(self.latitude))

    def to_plane(self, lonlat: ArrayLike) -> Floats:
        """Longitude and latitude (..., 2) [deg] to east and north (..., 2) [m]."""
        lon, lat = np.moveaxis(np.asarray(lonlat, np.float64), -1, 0)
        east = np.radians(lon - self.longitude)
        north = np.arcsinh(np.tan(np.radians(lat))) - asinh(tan(radians(self.latitude)))
        return self._scale * np.stack([east, north], axis=-1)

    def to_lonlat(self, east_north: ArrayLike) -> Floats:
        """East and north (..., 2) [m] to longitude and latitude (..., 2) [deg]."""
        east, north = np.moveaxis(np.asarray(east_north, np.float64) / self._scale, -1, 0)
        lat = np.arctan(np.sinh(north + asinh(tan(radians(self.latitude)))))
        return np.stack([self.longitude + np.degrees(east), np.degrees(lat)], axis=-1)


WORLD = Mercator(8.4295857, 48.9843445)
"""Frame of KITTI-360's poses, point clouds and annotations, and of KITTI360Pose."""
