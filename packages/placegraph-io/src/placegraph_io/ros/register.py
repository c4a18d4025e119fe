"""Depth as the colour camera sees it, where another camera measured it."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera

_WIDER = 1.1  # of the image's farthest corner: beyond it a lens model says nothing true


class Registration:
    """From a depth camera to the colour camera's place, in images that keep the depth's density."""

    def __init__(self, colour: Camera, depth: Camera) -> None:
        self.colour, self.depth = colour, depth
        part = min(1.0, depth.fx / colour.fx, depth.fy / colour.fy)
        size = (max(1, round(colour.width * part)), max(1, round(colour.height * part)))
        self.camera = colour.resized(*size)
        """Of the registered images: the colour camera in their size."""

    def __reduce__(self) -> tuple[type[Registration], tuple[Camera, Camera]]:
        return Registration, (self.colour, self.depth)

    @cached_property
    def _rays(self) -> NDArray[np.float64]:
        """(h, w, 3) of the depth camera's pixels, z = 1."""
        v, u = np.mgrid[: self.depth.height, : self.depth.width]
        return self.depth.directions(np.stack([u + 0.5, v + 0.5], axis=-1))

    @cached_property
    def _reach(self) -> float:
        """How far from the axis, where z is 1, the colour camera sees."""
        w, h = self.camera.width, self.camera.height
        edge = np.array([(x, y) for x in (0.0, w / 2, w) for y in (0.0, h / 2, h)])
        rays = self.camera.directions(edge)[:, :2]
        return _WIDER * float(np.nanmax(np.linalg.norm(rays, axis=1)))

    def __call__(
        self, depth: NDArray[np.float32], colour_from_depth: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Depth (H, W) [m] of `camera` from depth (h, w) [m]; where two meet, the nearer hides the other."""
        read = np.isfinite(depth)
        points = self._rays[read] * depth[read, None]
        points = points @ colour_from_depth[:3, :3].T + colour_from_depth[:3, 3]
        z = points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = (z > 0) & (np.hypot(points[:, 0], points[:, 1]) < self._reach * z)
        places = self.camera.project(points[seen])
        z = z[seen].astype(np.float32)
        out = np.full((self.camera.height, self.camera.width), np.inf, np.float32)
        with np.errstate(invalid="ignore"):
            cells = np.floor(places)
            inside = (cells >= 0) & (cells < (self.camera.width, self.camera.height))
            kept = inside.all(axis=1)
        columns, rows = cells[kept].astype(np.intp).T
        np.minimum.at(out, (rows, columns), z[kept])
        out[np.isinf(out)] = np.nan
        return out
