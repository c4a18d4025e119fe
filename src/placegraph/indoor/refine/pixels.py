"""Points of the map that a frame was matched with."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.geometry import Camera


@dataclass(frozen=True, slots=True, eq=False)
class Sights:
    """M points of the map that one frame was matched with."""

    points: NDArray[np.float64]
    """(M, 3) [m, map]"""
    pixels: NDArray[np.float64]
    """(M, 2) where the frame's colour image shows them [px]."""
    rays: NDArray[np.float64]
    """(M, 2) the same without the camera: x and y where z is 1."""
    sigma: NDArray[np.float64]
    """(M,) standard deviation of the pixels [px]."""
    focal: float
    """[px]"""

    @classmethod
    def of(
        cls,
        points: NDArray[np.float64],
        pixels: NDArray[np.float64],
        camera: Camera,
        sigma: float,
    ) -> Sights:
        """Sights of a camera, all of one standard deviation [px]."""
        rays = camera.directions(pixels)[:, :2] if len(pixels) else np.zeros((0, 2))
        focal = 0.5 * (camera.fx + camera.fy)
        return cls(points, pixels, rays, np.full(len(points), float(sigma)), focal)

    @classmethod
    def none(cls) -> Sights:
        """No point."""
        return cls(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), 1.0)

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Sights:
        """Some of them."""
        columns = (self.points, self.pixels, self.rays, self.sigma)
        return Sights(*(c[rows] for c in columns), focal=self.focal)

    def errors(self, map_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reprojection errors (M,) [px] at a pose (4, 4); infinite behind the camera."""
        at = (self.points - map_from_camera[:3, 3]) @ map_from_camera[:3, :3]
        ahead = at[:, 2] > 1e-3
        xy = at[:, :2] / np.where(ahead, at[:, 2], 1.0)[:, None]
        off = self.focal * np.linalg.norm(xy - self.rays, axis=1)
        return np.where(ahead, off, np.inf)
