"""Positions of many shards in one plane, so that what lies beside a border lies side by side."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from placegraph.geometry import LocalPlane

if TYPE_CHECKING:
    from numpy.typing import NDArray

WIDE = 1.35
"""Shards whose planes begin so near to each other share one [deg of a great circle]: 150 km."""
APART = 1e8
"""Planes lie so far from each other that nothing of one is near anything of another [m]."""


@dataclass(eq=False)
class Frames:
    """Planes, each `APART` north of the one before; the heaviest shards come first."""

    planes: list[LocalPlane] = field(default_factory=list)

    def placed(
        self, origin: tuple[float, float], positions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Positions (K, 2) [m] of a shard whose plane begins at `origin` [deg]."""
        own = LocalPlane(*origin)
        at = next((i for i, p in enumerate(self.planes) if _angle(p, own) < WIDE), len(self.planes))
        if at == len(self.planes):
            self.planes.append(own)
        if self.planes[at] != own:
            positions = self.planes[at].to_plane(own.to_lonlat(positions))
        return np.add(positions, (0.0, APART * at))

    def lonlat(self, position: NDArray[np.float64]) -> tuple[float, float]:
        """Longitude and latitude [deg] of a position (2,)."""
        at = round(float(position[1]) / APART)
        longitude, latitude = (
            self.planes[at].to_lonlat(np.subtract(position, (0.0, APART * at))).tolist()
        )
        return longitude, latitude


def _angle(one: LocalPlane, other: LocalPlane) -> float:
    """About how far apart two planes begin [deg of a great circle]."""
    aside = abs((one.longitude - other.longitude + 180.0) % 360.0 - 180.0)
    lower = min(abs(one.latitude), abs(other.latitude))
    return float(np.hypot(aside * np.cos(np.radians(lower)), one.latitude - other.latitude))
