"""What the network reads of a picture: logarithms of light, and where up is.

Neither exposure nor white balance is known, so colours are told relative to the picture's mean,
which in logarithms takes out what multiplies a channel; the mean itself is told beside them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.map.textures import linear_from_srgb

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.geometry import Camera

    Floats = NDArray[np.float32]

CELLS = 144
"""Patches of a picture, about; they are as square as they can be."""
PIXELS = 10
"""Of a patch's side, once the picture is made small."""
STEM = 5
"""Pixels of a side of what the network reads at once: a quarter of a patch."""
FAINT = 0.02
"""Light that counts little; 1 is white."""
FACTS = 11
"""Numbers told with the colours of each quarter of a patch."""
INPUTS = 3 * STEM * STEM + FACTS


def log_light(linear: NDArray[np.floating]) -> NDArray[np.float32]:
    """Logarithm of linear light; black is -3.9, white 0."""
    out: NDArray[np.float32] = np.log(linear + np.float32(FAINT)).astype(np.float32)
    return out


@lru_cache(maxsize=1)
def log_of_bytes() -> NDArray[np.float32]:
    """`log_light` (256,) of sRGB bytes."""
    table = log_light(linear_from_srgb(np.arange(256) / 255.0))
    table.flags.writeable = False
    return table


def grid_of(camera: Camera) -> tuple[int, int]:
    """Rows and columns of patches: about `CELLS`, nearly square, of a camera's images."""
    side = (camera.width / camera.height) ** 0.5
    base = CELLS**0.5
    rows = min(max(round(base / side), 2), 72)
    return rows, min(max(round(base * side), 2), 72)


def small(rgb: NDArray[np.uint8], grid: tuple[int, int]) -> NDArray[np.uint8]:
    """Picture (PIXELS * rows, PIXELS * columns, 3) of means over what a pixel covers."""
    from PIL import Image

    size = PIXELS * grid[1], PIXELS * grid[0]
    return np.asarray(Image.fromarray(rgb).resize(size, Image.Resampling.BOX))


def rises(camera: Camera, gravity: NDArray[np.floating], grid: tuple[int, int]) -> Floats:
    """Sine of the elevation (2 rows, 2 columns) of the rays through quarters of patches."""
    rays = _rays(camera, grid)
    up = -np.asarray(gravity, np.float32)
    out: NDArray[np.float32] = rays @ up
    return out


@lru_cache(maxsize=8)
def _rays(camera: Camera, grid: tuple[int, int]) -> Floats:
    """Unit rays (2 rows, 2 columns, 3) through the middles of quarters of patches."""
    rows, columns = 2 * grid[0], 2 * grid[1]
    y, x = np.mgrid[:rows, :columns] + 0.5
    uv = np.stack([x * camera.width / columns, y * camera.height / rows], axis=-1)
    rays = camera.directions(uv)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    out = np.where(np.isfinite(rays), rays, 0.0).astype(np.float32)
    out.flags.writeable = False
    return out


def span(camera: Camera, grid: tuple[int, int]) -> float:
    """Logarithm of the angle that a patch is wide and high, about 5 degrees."""
    across = camera.width / grid[1] / camera.fx * camera.height / grid[0] / camera.fy
    return float(np.log(across) / 2.0 - np.log(0.09))


def inputs(log: NDArray[np.float32], rise: NDArray[np.float32], wide: float) -> Floats:
    """What the network reads (2 rows, 2 columns, INPUTS) of a picture's logarithms of light.

    `log`: (PIXELS rows, PIXELS columns, 3); `rise`: `rises`; `wide`: `span`.
    """
    rows, columns = rise.shape
    flat = log.reshape(-1, 3)
    mean = flat.mean(axis=0)
    level = float(mean.mean())
    shade = flat.mean(axis=1)
    out = np.empty((rows, columns, INPUTS), np.float32)
    cells = (log - mean).reshape(rows, STEM, columns, STEM, 3).swapaxes(1, 2)
    out[..., :-FACTS] = cells.reshape(rows, columns, -1)
    facts = out[..., -FACTS:]
    facts[..., 0] = rise
    facts[..., 1] = np.abs(rise)
    facts[..., 2] = 4.0 * rise * rise
    facts[..., 3] = wide
    facts[..., 4:7] = mean - level
    facts[..., 7] = level + 1.5
    facts[..., 8] = shade.std() - 0.7
    facts[..., 9] = (flat[:, 0] - flat[:, 2]).std()
    facts[..., 10] = (2.0 * flat[:, 1] - flat[:, 0] - flat[:, 2]).std()
    return out
