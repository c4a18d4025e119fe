"""Where the scenes of a world stand on Earth, as far as their anchors tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import Anchor, EarthPose
from placegraph.core.geometry import LocalPlane

if TYPE_CHECKING:
    from placegraph.indoor.map.scene import Scene

UNANCHORED = 0.1
"""How well a scene that stands nowhere fits a fix, against one that stands right there."""
WRONG_FIX = 1e-3
"""Share of fixes that are far off."""


@dataclass(frozen=True, eq=False)
class Standing:
    """One candidate of the place of a scene, or of a part of one that was merged."""

    anchor: Anchor
    corners: NDArray[np.float64]
    """(4, 2) longitude, latitude [deg] of the part's bounds."""
    there: EarthPose
    """Of somebody anywhere in it, with its probability among all of the scene."""
    part: str
    """Which of the merged scenes it is of."""

    @classmethod
    def of(cls, scene: Scene) -> tuple[Standing, ...]:
        """Candidates of a scene, best first; none where it is not anchored."""
        found, share = [], 1.0 / len(scene.scenes)
        for part, box in zip(scene.scenes, scene.scene_bounds, strict=True):
            (x0, y0, z), (x1, y1, _) = box.tolist()
            corners = [(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]
            found += [
                cls(a, a.to_earth(corners)[:, :2], a.somewhere(box, probability=share), part)
                for a in scene.anchors_of(part)
            ]
        return tuple(sorted(found, key=lambda s: -s.there.probability))

    @property
    def lonlat(self) -> tuple[float, float]:
        """Longitude, latitude [deg] of the middle of the map."""
        return self.there.longitude, self.there.latitude

    @property
    def covariance(self) -> NDArray[np.float64]:
        """(2, 2) east-north [m^2] of somebody anywhere in the map."""
        return self.there.covariance[:2, :2]

    def near(self, lonlat: Sequence[float], radius: float) -> float:
        """How well, `WRONG_FIX` to 1, the place fits a fix of which half lies within a radius [m]."""
        (east, both), (_, north) = self.covariance.tolist()
        covariances = np.array([[east, both, north]])
        return float(fit(np.array([self.lonlat]), covariances, lonlat, radius)[0])


def fit(
    lonlats: NDArray[np.float64],
    covariances: NDArray[np.float64],
    lonlat: Sequence[float],
    radius: float,
) -> NDArray[np.float64]:
    """How well (K,), `WRONG_FIX` to 1, places (K, 2) fit a fix of which half lies within a radius [m].

    `covariances`: (K, 3) of each place: east, both, north [m^2].
    """
    there = (float(lonlat[0]), float(lonlat[1]))
    spread = (radius / 1.1774) ** 2
    wide = np.sqrt(spread + covariances[:, 0] + covariances[:, 2])
    # of a hundred thousand, planes are laid through those alone that are not too far to matter
    middle = np.cos(np.radians((lonlats[:, 1] + there[1]) / 2.0))
    aside = (lonlats[:, 0] - there[0] + 180.0) % 360.0 - 180.0
    away = 111_000.0 * np.hypot(aside * middle, lonlats[:, 1] - there[1])
    rows = np.flatnonzero(away < 15.0 * wide + 1000.0)
    out = np.full(len(lonlats), WRONG_FIX)
    off = [LocalPlane(*own).to_plane(there) for own in lonlats[rows].tolist()]
    x, y = np.reshape(off, (-1, 2)).T
    east, both, north = covariances[rows].T
    east, north = east + spread, north + spread
    squares = (north * x * x - 2.0 * both * x * y + east * y * y) / (east * north - both * both)
    out[rows] += (1.0 - WRONG_FIX) * np.exp(-0.5 * squares)
    return out


def nowhere() -> NDArray[np.float64]:
    """Covariance (2, 2) of what has no place on Earth."""
    return np.full((2, 2), np.nan)
