"""The encoder of learned features: any dense backbone of timm, pooled over images of the map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.map.scene import Scene
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_learn.backbone import Backbone

MODEL = "vit_small_patch14_dinov2.lvd142m"
TEMPERATURE = 0.1
"""A guess: cosines of one network's features are spread wider than those of another's."""
_CELLS = 16  # along the longer side, if no size is asked for: 9 x 16 patches, Sec. 3.3
_RAYS = 4  # cast through a patch, across and down
_NEAR = 0.1  # a depth reading belongs to the surface that is this near [m] ...
_SLOPE = 0.05  # ... and this share of its depth


class FeaturesEncoder:
    """Patches by a backbone's features, objects by the mean feature of the patches that saw them.

    Parameters
    ----------
    model
        Name in timm: DINOv2, DINOv3, SigLIP and other ViTs, or a convolutional network.
    pretrained, weights, layer, device
        Of `Backbone`.
    size
        Longer side of the images that the network sees [px]; as much as gives 16 patches if not
        given. The shorter follows from the image; both are whole numbers of patches.
    temperature
        Cosine that counts one nat.

    Raises
    ------
    OptionError
        The size is less than a patch, or the temperature not positive.
    MissingExtraError, InputError, ServiceError
        As `Backbone` does.

    """

    name = "features"

    def __init__(
        self,
        model: str = MODEL,
        *,
        pretrained: bool = True,
        weights: str | Path | None = None,
        size: int | None = None,
        layer: int = -1,
        temperature: float = TEMPERATURE,
        device: str = "auto",
    ) -> None:
        if not temperature > 0:
            raise OptionError(f"temperature is {temperature}; it is a number above 0.")
        self.temperature = temperature
        self._backbone = Backbone(
            model, pretrained=pretrained, weights=weights, layer=layer, device=device
        )
        cell = self._backbone.cell
        if size is not None and size < cell:
            raise OptionError(f"size is {size}; {model} has patches of {cell} px.")
        self._cells = _CELLS if size is None else size // cell
        self._layer = layer

    @property
    def dimension(self) -> int:
        """Numbers of a vector, d."""
        return self._backbone.dimension

    @property
    def key(self) -> str:
        """Its name, the network's, a digest of its weights, the layer and the patches of an image."""
        backbone = self._backbone
        return f"features {backbone.name} {backbone.digest} {self._layer} {self._cells}"

    def patches(self, image: Frame) -> NDArray[np.float32]:
        """Unit vectors (rows, columns, d) of a frame's patches; raises `InputError` as `rgb` does."""
        from PIL import Image

        rgb = image.rgb()
        rows, columns = self._grid(rgb.shape[0], rgb.shape[1])
        cell = self._backbone.cell
        small = Image.fromarray(rgb).resize(
            (columns * cell, rows * cell), Image.Resampling.BICUBIC, reducing_gap=3.0
        )
        return _unit(self._backbone(np.asarray(small)))

    def camera(self, image: Frame) -> Camera:
        """Camera of the colour image."""
        return image.camera

    def objects(self, scene: Scene, captures: Sequence[Capture] = ()) -> NDArray[np.float32]:
        """Unit vectors (N, d) of a map's objects; zero of what no image shows.

        Patches count by the square of their share of the object: one that shows half of it and half
        of another says little. Rays whose depth reading lies elsewhere than the map's surface see
        something else, and do not count. Raises `OptionError` where there is no image.
        """
        if not any(len(capture) for capture in captures):
            raise OptionError(
                "captures: features of objects come from images of the map; give captures with poses."
            )
        sums = np.zeros((len(scene), self.dimension))
        for capture in captures:
            for frame in capture:
                vectors = self.patches(frame)
                patch, row, share = covered(scene, frame, vectors.shape[:2])
                seen = vectors.reshape(-1, self.dimension)[patch]
                np.add.at(sums, row, seen * share[:, None] ** 2)
        return _unit(sums.astype(np.float32))

    def _grid(self, height: int, width: int) -> tuple[int, int]:
        longer, shorter = max(height, width), min(height, width)
        other = max(1, round(self._cells * shorter / longer))
        return (self._cells, other) if height > width else (other, self._cells)


def covered(
    scene: Scene, frame: Frame, grid: tuple[int, int]
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float64]]:
    """What the patches of a frame, whose odometry is map_from_camera, show of a map's objects.

    Returns patches (K,), row by row, rows of objects (K,), and the share (K,) of the patch's rays
    that see the object.
    """
    rows, columns = grid
    y, x = np.mgrid[: rows * _RAYS, : columns * _RAYS]
    uv = np.stack(
        [
            (x.ravel() + 0.5) * frame.camera.width / (columns * _RAYS),
            (y.ravel() + 0.5) * frame.camera.height / (rows * _RAYS),
        ],
        axis=-1,
    )
    rays = frame.camera.directions(uv)
    pose = frame.odometry
    hits = scene.caster.cast(pose[:3, 3], rays @ pose[:3, :3].T)
    objects = np.where(hits.triangle >= 0, scene.mesh.object_of[np.maximum(hits.triangle, 0)], -1)
    objects[~_agreed(frame, rays, hits.distance)] = -1
    patch = (y // _RAYS * columns + x // _RAYS).ravel()
    keys, counts = np.unique((patch * len(scene) + objects)[objects >= 0], return_counts=True)
    return keys // len(scene), keys % len(scene), counts / _RAYS**2


def _agreed(
    frame: Frame, rays: NDArray[np.float64], depth: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Whether readings, where there are any, agree with the map's depth (R,) along rays (R, 3)."""
    readings = frame.depth()
    if readings is None:
        return np.ones(len(rays), np.bool_)
    camera = frame.depth_camera or frame.camera
    with np.errstate(invalid="ignore"):
        column, row = np.floor(camera.project(rays)).T
        inside = (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    at = np.where(inside, row, 0).astype(np.intp), np.where(inside, column, 0).astype(np.intp)
    reading = np.where(inside, readings[at], np.nan)
    with np.errstate(invalid="ignore"):
        off = np.abs(reading - depth) > _NEAR + _SLOPE * reading
    return ~off


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return (vectors / np.maximum(lengths, 1e-9)).astype(np.float32)
