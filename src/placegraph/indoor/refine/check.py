"""What held-back samples say of trajectories: readings and windows that took no part in the fit.

Each sense gives every trajectory a log-likelihood [nat] by its own noise, which is estimated from what
it shows: depth that misses the map by centimetres everywhere, or images that look little like it, say
little. So both senses add up, and neither has a veto.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, Floats
from placegraph.indoor.rays.layout import LANES
from placegraph.indoor.refine.correspondences import Readings, Surfaces, distances, smaller
from placegraph.indoor.refine.matching.guided import lightness, resized
from placegraph.indoor.refine.refine_kernels import correlations
from placegraph.indoor.render import Renderer
from placegraph.indoor.render.render_kernels import TILE
from placegraph.io.capture.frame import Frame

NEAR = 0.1
"""Readings farther from the map's surface [m] are of something that it does not show."""
FINEST = 0.005
"""No reading and no map is truer than this [m]."""
WORST = 10.0
"""Error, in units of the usual one, beyond which a sample is no worse."""
BLOCKS = 9
"""Blocks in the width of an image; one of four is held back."""
SMALL = 160
"""Longer side at which images are compared [px]."""
COUNTED = 24
"""Least number of blocks of samples, over all frames."""
_HALF = 3
_FEW = 4  # blocks whose spread is none
_ALIKE = 1e-9
_SAME = 0.99  # no window is more alike
_STEP = 2 * TILE  # a window lies in four packets of rays


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """What the held-back samples of one sense say of C trajectories."""

    blocks: Floats
    """(C, B) log-likelihoods, summed up in blocks [nat]"""
    scores: Floats
    """(C, N) log-likelihoods of the samples that tell anything [nat]"""

    @property
    def samples(self) -> int:
        """How many tell anything."""
        return self.scores.shape[1]

    @classmethod
    def of(cls, scores: Sequence[Sequence[Floats]]) -> Evidence:
        """Scores [nat] of C trajectories, each of T frames, of samples (N,); NaN: it tells nothing.

        Neighbours err together: blocks vary more than sums of as many independent samples would, and
        by that factor (Kish's design effect) samples are worth less.
        """
        frames = [np.stack(of_frame) for of_frame in zip(*scores, strict=True)]
        bands = max(1, -(-COUNTED // max(1, len(frames))))
        parts = [part for f in frames for part in np.array_split(f, bands, axis=1)]
        parts = [part[:, np.isfinite(part).all(axis=0)] for part in parts]
        blocks = np.array([part.sum(axis=1) for part in parts]).reshape(len(parts), len(scores)).T
        samples = np.concatenate([np.zeros((len(scores), 0)), *parts], axis=1)
        count, told = samples.shape[1], np.array([part.shape[1] > 0 for part in parts], bool)
        effect = 1.0
        if count and len(scores) > 1:
            single = np.var(samples[1:] - samples[0], axis=1).sum() * count / told.sum()
            together = np.var(blocks[1:, told] - blocks[0, told], axis=1).sum()
            effect = max(1.0, float(together / max(single, _ALIKE)))
        return cls(blocks / effect, samples)

    def gain(self, row: int) -> Floats:
        """(B,) by how much a trajectory is more likely than the first [nat]."""
        return np.asarray(self.blocks[row] - self.blocks[0])


def surely(gains: Floats) -> float:
    """Mean of gains (B,) over its standard error; blocks that tell nothing, 0, do not count."""
    told = gains[np.abs(gains) > _ALIKE]
    if len(told) < _FEW:
        return 0.0
    return float(told.mean() / (told.std() / np.sqrt(len(told)) + _ALIKE))


def likely(ratio: Floats) -> Floats:
    """Log-likelihoods of errors, in units of the usual one, that are spread as Cauchy's density is."""
    return np.asarray(-np.log1p(np.square(np.minimum(ratio, WORST))))


def depth_evidence(
    surfaces: Surfaces, held: Sequence[Readings | None], trajectories: Sequence[Floats]
) -> Evidence:
    """Evidence of held-back readings of T frames on trajectories (T, 4, 4); tiles are the samples.

    Distances are spread as Cauchy's density is, as wide as those of the trajectory that fits best.
    """
    found = [
        [np.abs(d).reshape(-1, LANES) for d in distances(surfaces, held, poses)]
        for poses in trajectories
    ]
    usual = [_usual(np.concatenate(of_one)) for of_one in found]
    width = max(FINEST, min(usual, default=NEAR))
    return Evidence.of([[_of_tiles(d / width) for d in of_one] for of_one in found])


def _usual(distance: Floats) -> float:
    """Median of distances [m] from the surface, of readings that it explains at all."""
    near = distance[distance < NEAR]
    return float(np.median(near)) if len(near) else NEAR


def _of_tiles(ratio: Floats) -> Floats:
    """Mean log-likelihood (N,) of the readings of each tile (N, 16); NaN without a reading."""
    read = ~np.isnan(ratio)
    score = likely(np.where(read, ratio, 0.0))
    count = read.sum(axis=1)
    return np.where(count > 0, score.sum(axis=1) / np.maximum(count, 1), np.nan)


def held_back(pixels: Floats, camera: Camera) -> NDArray[np.bool_]:
    """Which image points (N, 2) [px] of a camera lie in blocks that are kept for the check."""
    block = np.floor(pixels / (max(camera.width, camera.height) / BLOCKS)).astype(np.int64)
    return np.asarray((block % 2 == 1).all(axis=1))


def image_evidence(
    renderer: Renderer,
    frames: Sequence[Frame],
    queries: Sequence[NDArray[np.uint8] | None],
    trajectories: Sequence[Floats],
) -> Evidence:
    """Evidence of held-back windows of T images, where there are any, on trajectories (T, 4, 4).

    By the correlation rho of a window with the rendering at the same place, -log(1 - rho^2) / 2: the
    pixels of a window count as one, as the map's colours err together. Only windows in which the
    query shows something are samples; where the rendering shows nothing, they correlate with nothing.
    """
    scores: list[list[Floats]] = [[] for _ in trajectories]
    for t, (frame, query) in enumerate(zip(frames, queries, strict=True)):
        if query is None:
            for out in scores:
                out.append(np.zeros(0))
            continue
        small = smaller(frame.camera, SMALL)
        seen = lightness(resized(query, small.width, small.height))
        at = _windows(small)
        wanted = np.zeros((-(-small.height // TILE), -(-small.width // TILE)), bool)
        for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
            wanted[at[:, 0] // TILE + row, at[:, 1] // TILE + column] = True
        for out, poses in zip(scores, trajectories, strict=True):
            drawn = renderer.render(poses[t], small, samples=1, wanted=wanted)
            alike = correlations(seen, lightness(drawn.colour), drawn.mask, at, _HALF)
            out.append(-0.5 * np.log1p(-np.square(np.minimum(alike, _SAME))))
    return Evidence.of(scores)


def _windows(camera: Camera) -> NDArray[np.int64]:
    """Centres (N, 2) row, column of the held-back windows of a camera's images."""
    rows = np.arange(_HALF, camera.height - _STEP + _HALF + 1, _STEP)
    columns = np.arange(_HALF, camera.width - _STEP + _HALF + 1, _STEP)
    at = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    return at[held_back(at[:, ::-1].astype(np.float64) + 0.5, camera)]
