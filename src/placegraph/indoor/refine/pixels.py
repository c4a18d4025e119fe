"""Points of the map that a frame was matched with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.likelihood.observe import REFERENCE

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
    unit: float
    """Pixels of this camera in one of an image `REFERENCE` wide: what tolerances are given in."""

    @classmethod
    def of(
        cls,
        points: NDArray[np.float64],
        pixels: NDArray[np.float64],
        camera: Camera,
        sigma: float,
    ) -> Sights:
        """Sights of a camera; `sigma`: deviation of all [px of an image `REFERENCE` wide]."""
        rays = camera.directions(pixels)[:, :2] if len(pixels) else np.zeros((0, 2))
        unit = max(camera.width, camera.height) / REFERENCE
        sigmas = np.full(len(points), sigma * unit)
        return cls(points, pixels, rays, sigmas, 0.5 * (camera.fx + camera.fy), unit)

    @classmethod
    def none(cls) -> Sights:
        """No point."""
        return cls(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), 1.0, 1.0)

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Sights:
        """Some of them."""
        return replace(
            self,
            points=self.points[rows],
            pixels=self.pixels[rows],
            rays=self.rays[rows],
            sigma=self.sigma[rows],
        )

    def errors(self, map_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reprojection errors (M,) [px] at a pose (4, 4); infinite behind the camera."""
        at = (self.points - map_from_camera[:3, 3]) @ map_from_camera[:3, :3]
        ahead = at[:, 2] > 1e-3
        xy = at[:, :2] / np.where(ahead, at[:, 2], 1.0)[:, None]
        off = self.focal * np.linalg.norm(xy - self.rays, axis=1)
        return np.where(ahead, off, np.inf)
