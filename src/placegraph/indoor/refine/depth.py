"""Depth readings of a frame, to be aligned with the map: projective point-to-plane.

Every reading casts its own ray, so that its partner is what the camera would see there, hidden
surfaces have no part, and no cloud, tree or normal estimation is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.rays.packets_kernels import Tracer
from placegraph.indoor.refine.fit_kernels import plane_distances, read
from placegraph.indoor.render import camera_rays
from placegraph.io.capture.frame import Frame

_TILE = 4
_REACH = 3  # pixels from a reading to the points that its normal is made of


@dataclass(frozen=True, slots=True, eq=False)
class Readings:
    """Depth of one frame at R = 16 * tiles pixels, in tiles of 4 x 4."""

    directions: NDArray[np.float32]
    """(R, 3) rays in the camera through the pixels' centres, z = 1."""
    depth: NDArray[np.float32]
    """(R,) [m], 0: no reading."""
    normals: NDArray[np.float32]
    """(R, 3) of what was seen, towards the camera; zero where unknown."""


def readings(frame: Frame, depth: NDArray[np.float32], count: int, phase: int = 0) -> Readings:
    """About `count` readings of a depth image (h, w) [m], spread evenly.

    Two phases never share a pixel. Readings on edges of depth are left out: what lies between two
    surfaces belongs to none.
    """
    h, w = depth.shape
    camera = frame.depth_camera or frame.camera
    stride = max(2, round((h * w / count) ** 0.5))
    v, u = _tiled(_lattice(h, stride, phase), _lattice(w, stride, phase))
    found = Readings(*read(depth, camera_rays(camera), v, u, _REACH))
    if camera.model == "fisheye":
        seen = np.isfinite(camera.directions(np.stack([u, v], axis=-1) + 0.5)).all(axis=-1)
        found.depth[~seen] = 0.0
    return found


def _lattice(size: int, stride: int, phase: int) -> NDArray[np.int64]:
    start = (stride // 2 + phase * (stride // 2)) % stride
    return np.arange(start, size, stride)


def _tiled(
    rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (R,) of a lattice in tiles of 4 x 4, filled up with -1."""
    pad = [(0, -len(rows) % _TILE), (0, -len(columns) % _TILE)]
    v = np.pad(rows, pad[0], constant_values=-1)
    u = np.pad(columns, pad[1], constant_values=-1)
    grid = np.stack(np.meshgrid(v, u, indexing="ij"))
    tiles = grid.reshape(2, len(v) // _TILE, _TILE, len(u) // _TILE, _TILE)
    flat = tiles.transpose(0, 1, 3, 2, 4).reshape(2, -1)
    return flat[0], flat[1]


class Surfaces(NamedTuple):
    """What compiled code needs of the map to align depth with it."""

    tracer: Tracer
    normals: NDArray[np.float32]
    """(T, 3) unit normals."""
    object_of: NDArray[np.int32]
    """(T,)"""

    @classmethod
    def of(cls, scene: Scene) -> Surfaces:
        """Surfaces of a map."""
        return cls(scene.caster.tracer, scene.normals, scene.mesh.object_of)


class Kernel(NamedTuple):
    """How residuals [m] become weights; see `options.DepthNoise`."""

    floor: float
    slope: float
    surface: float
    facing: tuple[float, float]
    width: float
    """Residual, in standard deviations, at which a reading has a quarter of its say left."""


def distances(surfaces: Surfaces, seen: Sequence[Readings | None], poses: Floats) -> list[Floats]:
    """Distances (R,) [m] of the readings of each frame from the map's surface at poses (T, 4, 4).

    NaN where there is no reading, infinite where the map shows nothing.
    """
    return [
        np.zeros(0)
        if one is None
        else plane_distances(
            surfaces,
            np.ascontiguousarray(pose[:3, :3]),
            np.ascontiguousarray(pose[:3, 3]),
            one.directions,
            one.depth,
        )
        for one, pose in zip(seen, poses, strict=True)
    ]
