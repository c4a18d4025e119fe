"""A truncated signed distance volume of voxel blocks where surfaces are, and nowhere else.

Curless and Levoy, "A volumetric method for building complex models from range images", 1996; blocks
in a hash after Niessner et al., "Real-time 3D reconstruction at scale using voxel hashing", 2013.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.threads import share
from placegraph.indoor.mapping.fuse import volume_kernels as kernels
from placegraph.indoor.mapping.fuse.depth_kernels import farthest, visible
from placegraph.indoor.mapping.fuse.views import Shot
from placegraph.indoor.mapping.fuse.volume_kernels import SIDE, SIZE

FIRST = 4096
"""Blocks that there is room for at first."""
BLOCK = 24 * SIZE
"""Bytes of a block, less a few for its place."""
TILE = 8
"""Edge of the squares of pixels of which the farthest reading is kept [px]."""
STEP = 2
"""Every such line and column of the depth calls for blocks."""
BRIGHTNESS_STEP = 4
"""Likewise, for comparing brightness."""
ENOUGH = 200
"""Places that brightness must be compared at."""
DARKEST, BRIGHTEST = 0.5, 2.0
"""What an image is multiplied by, at most."""
BAND = 2.0
"""Colour is taken this near to the surface [voxels]."""


class FullError(Exception):
    """The volume would outgrow its memory; caught within fusion."""


class Volume:
    """Signed distances in blocks; `take` adds views, in place."""

    def __init__(self, voxel: float, truncation: float, memory: float) -> None:
        """Empty volume of voxels of this edge [m], that may take `memory` bytes."""
        self.voxel, self.truncation = voxel, truncation
        self.most = max(int(memory / BLOCK), 1)
        self.count = 0
        room = min(FIRST, self.most)
        self.places = np.zeros((room, 3), np.int32)
        """(B, 3) whole coordinates of blocks; the first `count` are used, here and below."""
        self.distance = np.zeros((room, SIZE), np.float32)
        """[m], positive in front of surfaces, cut at the truncation"""
        self.weight = np.zeros((room, SIZE), np.float32)
        """sum of cos(incidence) / depth^4 of the views [1 / m^4]"""
        self.colour = np.zeros((room, SIZE, 3), np.float32)
        """mean sRGB near surfaces, 0 to 255"""
        self.paint = np.zeros((room, SIZE), np.float32)
        """weight of the colour"""
        self.hash()

    def hash(self) -> None:
        """Make a hash with room for all blocks."""
        size = 1 << int(np.ceil(np.log2(4 * len(self.places))))
        self.keys = np.full(size, -1, np.int64)
        self.rows = np.zeros(size, np.int32)
        kernels.rehash(self.keys, self.rows, self.places, self.count)

    def grow(self) -> None:
        """Make room for more blocks; `FullError` where memory ends."""
        room = len(self.places)
        if room >= self.most:
            raise FullError
        more = min(room + room // 2, self.most)
        for name in ("places", "distance", "weight", "colour", "paint"):
            held: NDArray[np.float32] = getattr(self, name)
            wider = np.zeros((more, *held.shape[1:]), held.dtype)
            wider[:room] = held
            setattr(self, name, wider)
        self.hash()

    @property
    def bytes(self) -> int:
        """Memory of the blocks that are used."""
        return self.count * BLOCK

    def take(self, view: Shot, facets: NDArray[np.float32], *, gains: bool) -> float:
        """Take in a view, in place; what its image was multiplied by to fit those before.

        `facets`: (h, w, 6) of `depth_kernels.facets_of`. Raises `FullError` where memory ends.
        """
        pose, depth_eye = view.map_from_camera, view.eyes[0]
        edge = SIDE * self.voxel
        while True:
            count = kernels.touch(
                self.keys, self.rows, self.places, self.count, len(self.places), facets, depth_eye,
                pose, edge, self.truncation, STEP,
            )  # fmt: skip
            self.count = count if count >= 0 else -1 - count
            if count >= 0:
                break
            self.grow()
        gain = self.gain(view, facets) if gains else 1.0
        back = np.linalg.inv(pose)
        far = farthest(facets, TILE)
        chosen = visible(
            self.places,
            self.count,
            edge,
            far,
            TILE,
            depth_eye,
            facets.shape[:2],
            back,
            self.truncation,
        )
        share(
            kernels.integrate, len(chosen), self.distance, self.weight, self.colour, self.paint,
            self.places, chosen, self.voxel, self.truncation, facets, view.image, gain, view.eyes,
            back, BAND * self.voxel,
        )  # fmt: skip
        return gain

    def gain(self, view: Shot, facets: NDArray[np.float32]) -> float:
        """What brings a view's image to the brightness of the model; 1 where they hardly overlap."""
        ratios = kernels.brightness_ratios(
            self.keys, self.rows, self.colour, self.paint, self.voxel, facets, view.image, view.eyes,
            view.map_from_camera, BRIGHTNESS_STEP, 0.0,
        )  # fmt: skip
        return (
            float(np.clip(np.median(ratios), DARKEST, BRIGHTEST)) if len(ratios) >= ENOUGH else 1.0
        )

    def gaps(self, points: Floats) -> NDArray[np.float32]:
        """Distances (N,) [m] of points (N, 3) [m, map] from the surface, cut at the truncation."""
        return kernels.gaps_at(
            self.keys, self.rows, self.distance, self.weight, self.voxel, self.truncation, points
        )
