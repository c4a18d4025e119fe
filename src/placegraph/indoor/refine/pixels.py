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
    things: NDArray[np.int64]
    """(M,) what may move as one: same number, same object and same cubic metre."""

    @classmethod
    def of(
        cls,
        points: NDArray[np.float64],
        pixels: NDArray[np.float64],
        camera: Camera,
        sigma: float,
        objects: NDArray[np.int32],
    ) -> Sights:
        """Sights of a camera, all of one standard deviation [px]; `objects`: (M,) rows of the map's."""
        rays = camera.directions(pixels)[:, :2] if len(pixels) else np.zeros((0, 2))
        focal = 0.5 * (camera.fx + camera.fy)
        things = _things(points, objects)
        return cls(points, pixels, rays, np.full(len(points), float(sigma)), focal, things)

    @classmethod
    def none(cls) -> Sights:
        """No point."""
        nothing = np.zeros(0)
        two = np.zeros((0, 2))
        return cls(np.zeros((0, 3)), two, two, nothing, 1.0, nothing.astype(np.int64))

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Sights:
        """Some of them."""
        columns = (self.points, self.pixels, self.rays, self.sigma)
        return Sights(*(c[rows] for c in columns), focal=self.focal, things=self.things[rows])

    def errors(self, map_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """Reprojection errors (M,) [px] at a pose (4, 4); infinite behind the camera."""
        at = (self.points - map_from_camera[:3, 3]) @ map_from_camera[:3, :3]
        ahead = at[:, 2] > 1e-3
        xy = at[:, :2] / np.where(ahead, at[:, 2], 1.0)[:, None]
        off = self.focal * np.linalg.norm(xy - self.rays, axis=1)
        return np.where(ahead, off, np.inf)


def _things(points: NDArray[np.float64], objects: NDArray[np.int32]) -> NDArray[np.int64]:
    """One number (M,) for each object and cubic metre: a wall does not move as one."""
    x, y, z = (np.floor(points).astype(np.int64) & 0x3FF).T
    return (objects.astype(np.int64) << 30) | (x << 20) | (y << 10) | z
