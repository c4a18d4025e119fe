"""Sensors of a rendered walk: what a camera and a depth camera make of what there is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.textures import srgb_from_linear

if TYPE_CHECKING:
    from placegraph_lab.worlds.flat.render import Shot

FARTHEST = 9.5
"""Beyond this the depth camera reads nothing [m]."""


def develop(
    radiance: NDArray[np.float32], exposure: float, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Colour image (h, w, 3) uint8 sRGB of linear radiance (h, w, 3).

    Automatic exposure, off by the factor `exposure`; darker corners; a soft shoulder; shot and
    read noise.
    """
    h, w = radiance.shape[:2]
    y, x = np.mgrid[:h, :w]
    corner = np.hypot((x + 0.5) / w - 0.5, (y + 0.5) / h - 0.5) / np.hypot(0.5, 0.5)
    level = float(np.exp(np.log(radiance.mean(axis=2) + 1e-3).mean()))
    gain = 0.3 * exposure / max(level, 1e-3)
    light = 1.0 - np.exp(-gain * radiance * (1.0 - 0.25 * corner**2)[..., None])
    noise = np.sqrt(0.00025 * light + 0.00001)
    light = light + noise * rng.standard_normal(light.shape)
    encoded = srgb_from_linear(np.clip(light, 0.0, 1.0))
    return np.rint(encoded * 255.0).astype(np.uint8)


def measured(shot: Shot, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Depth image (h, w) uint16 [mm], 0 = no reading.

    The error grows with the square of the distance and is partly common to neighbours; holes are
    at grazing angles, at edges, in blobs, beyond `FARTHEST`, and 2 % of the rest.
    """
    z = np.nan_to_num(shot.depth.astype(np.float64), nan=np.inf)
    near = np.minimum(z, FARTHEST + 1.0)
    sigma = 0.0012 + 0.0019 * (near - 0.4) ** 2
    common = _smooth(rng.standard_normal((z.shape[0] // 4 + 2, z.shape[1] // 4 + 2)), z.shape)
    noisy = near + sigma * (0.7 * rng.standard_normal(z.shape) + 0.7 * common)
    edge = np.zeros(z.shape, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(near, axis=axis)) > 0.05 * np.minimum(
            np.take(near, range(1, z.shape[axis]), axis),
            np.take(near, range(z.shape[axis] - 1), axis),
        )
        before, after = [(0, 0), (0, 0)], [(0, 0), (0, 0)]
        before[axis], after[axis] = (1, 0), (0, 1)
        edge |= np.pad(jump, before) | np.pad(jump, after)
    knots = rng.standard_normal((z.shape[0] // 12 + 2, z.shape[1] // 12 + 2))
    lost = (z > FARTHEST) | (shot.facing < 0.12) | (_smooth(knots, z.shape) > 1.6)
    lost |= edge & (rng.random(z.shape) < 0.6)
    lost |= rng.random(z.shape) < 0.02
    return np.where(lost, 0, np.rint(noisy * 1000.0)).astype(np.uint16)


def _smooth(knots: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Image of a shape, linear between knots, which are one row and column more than cells."""
    for axis in (0, 1):
        cells = knots.shape[axis] - 1
        at = (np.arange(shape[axis]) + 0.5) * cells / shape[axis]
        low = np.floor(at).astype(int)
        part = np.expand_dims(at - low, 1 - axis)
        knots = np.take(knots, low, axis) * (1 - part) + np.take(knots, low + 1, axis) * part
    return knots
