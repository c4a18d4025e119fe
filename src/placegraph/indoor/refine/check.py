"""Whether a refined trajectory explains held-back pixels better than the coarse one.

Readings and patches that took no part in the fit are scored under both trajectories, and compared
pair by pair: what is hard to explain is so for both, and drops out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.rays.layout import LANES
from placegraph.indoor.refine.depth import distances
from placegraph.indoor.refine.fit_kernels import correlations
from placegraph.indoor.refine.match import smaller
from placegraph.indoor.refine.matching.guided import lightness, resized

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from placegraph.formats.capture.frame import Frame
    from placegraph.geometry import Camera, Floats
    from placegraph.indoor.refine.depth import Readings, Surfaces
    from placegraph.indoor.render import Renderer

SCALE = 0.03
"""Distance of a reading from the map's surface at which it counts half [m]."""
BLOCKS = 9
"""Blocks in the width of an image; one of four is held back."""
SMALL = 160
"""Longer side at which images are compared [px]."""
_HALF = 3
_STEP = 5


@dataclass(frozen=True, slots=True)
class Gain:
    """How much better held-back samples are explained after than before."""

    before: float
    """Mean score, 0 to 1; NaN: no sample."""
    after: float
    z: float
    """Mean gain over its standard error; 0: no sample."""

    @classmethod
    def of(cls, before: Floats, after: Floats) -> Gain:
        """Of paired scores (N,)."""
        if not len(before):
            return cls(np.nan, np.nan, 0.0)
        gain = after - before
        error = gain.std() / np.sqrt(len(gain)) + 1e-9
        z = float(gain.mean() / error) if np.abs(gain).max() > 1e-9 else 0.0
        return cls(float(before.mean()), float(after.mean()), z)


def depth_gain(
    surfaces: Surfaces, held: Sequence[Readings | None], before: Floats, after: Floats
) -> Gain:
    """Gain of trajectories (T, 4, 4) on held-back readings of T frames; tiles are the samples."""
    first, second = (_tile_scores(surfaces, held, poses) for poses in (before, after))
    told = np.isfinite(first)
    return Gain.of(first[told], second[told])


def _tile_scores(surfaces: Surfaces, held: Sequence[Readings | None], poses: Floats) -> Floats:
    """Mean score of each tile: 1 on the map's surface, 0 far from it; NaN without a reading."""
    scores = [np.zeros((0, LANES))]
    for seen, distance in zip(held, distances(surfaces, held, poses), strict=True):
        if seen is not None:
            scores.append((1.0 / (1.0 + (distance / SCALE) ** 2)).reshape(-1, LANES))
    of_tiles = np.concatenate(scores)
    read = np.isfinite(of_tiles)
    counts = read.sum(axis=1)
    means = np.where(read, of_tiles, 0.0).sum(axis=1) / np.maximum(counts, 1)
    return np.where(counts > 0, means, np.nan)


def held_back(pixels: Floats, camera: Camera) -> NDArray[np.bool_]:
    """Which image points (N, 2) [px] of a camera lie in blocks that are kept for the check."""
    block = np.floor(pixels / (max(camera.width, camera.height) / BLOCKS)).astype(np.int64)
    return np.asarray((block % 2 == 1).all(axis=1))


def image_gain(
    renderer: Renderer,
    frames: Sequence[Frame],
    queries: Sequence[NDArray[np.uint8]],
    before: Floats,
    after: Floats,
) -> Gain:
    """Gain on held-back blocks of images: correlation of small windows at the same place.

    Only windows in which the query shows something are samples; where the rendering shows nothing,
    they correlate with nothing.
    """
    scores: list[list[Floats]] = [[], []]
    for t, (frame, query) in enumerate(zip(frames, queries, strict=True)):
        small = smaller(frame.camera, SMALL)
        seen = lightness(resized(query, small.width, small.height))
        at = _windows(small)
        for out, poses in zip(scores, (before, after), strict=True):
            drawn = renderer.render(poses[t], small, samples=1)
            out.append(correlations(seen, lightness(drawn.colour), drawn.mask, at, _HALF))
    first, second = (np.concatenate([np.zeros(0), *s]) for s in scores)
    told = np.isfinite(first) & np.isfinite(second)
    return Gain.of(first[told], second[told])


def _windows(camera: Camera) -> NDArray[np.int64]:
    """Centres (N, 2) row, column of the held-back windows of a camera's images."""
    rows = np.arange(_HALF, camera.height - _HALF, _STEP)
    columns = np.arange(_HALF, camera.width - _HALF, _STEP)
    at = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    return at[held_back(at[:, ::-1].astype(np.float64) + 0.5, camera)]
