"""Scores of poses by the calibrated likelihood, or by Eq. 2 of SG2Loc (`paper`)."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, compose
from placegraph.core.threads import multiply_matrices
from placegraph.indoor.likelihood.observe import Background, Model, Noise, View
from placegraph.indoor.likelihood.paper import Paper
from placegraph.indoor.likelihood.score_kernels import COLOUR, DEPTH, score_poses, show_view
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import Likelihood

TEMPERATURE = 2.7
"""Temperature of the log-likelihood of one frame; of T frames sqrt(T) times that, as they overlap."""
TEMPERATURE_DEPTH = 4.0
"""Temperature with depth, whose errors are the map's, and correlated ..."""
TEMPERATURE_TONES = 6.0
"""... and with tones beside depth, as an image counts twice."""


class CalibratedLikelihood:
    """Calibrated likelihood, in which every patch, reading and sample may err (docs/indoor.md).

    Each adds its log-likelihood ratio at a pose against anywhere in the map [nat].
    """

    def __init__(self, options: Likelihood) -> None:
        self.options = options
        self.noise = Noise.of(options, gaussian=False)

    def score_patches(
        self, cosines: NDArray[np.float32], temperature: float, object_shares: Floats
    ) -> Floats:
        """Return likelihood ratios (M, N + 1) of patches for each object.

        Softmax of the cosines, mixed with the share of patches that are labelled wrongly.
        """
        logits = cosines / (self.options.sharpness or temperature)
        share = np.exp(logits - logits.max(axis=1, keepdims=True))
        share /= share.sum(axis=1, keepdims=True)
        wrong = self.options.wrong
        table = (1.0 - wrong) * share * cosines.shape[1] + wrong
        table /= (table @ object_shares)[:, None]
        return np.concatenate([table, np.ones((len(table), 1))], axis=1)

    def shares(self, counts: Floats) -> Floats:
        """Return the weight (N,) of a patch of each object: of many the square root of the surplus counts."""
        return np.sqrt(np.minimum(1.0, self.options.object_patches / np.maximum(counts, 1.0)))

    def background_depth(
        self, depth: NDArray[np.float32], directions: Floats, background: Background
    ) -> NDArray[np.float32]:
        """Return the log of the mean likelihood ratio (R,) of each reading over all places of the map."""
        out = np.zeros(len(depth), np.float32)
        rows = np.flatnonzero(depth > 0)
        if not rows.size:
            return out
        reach = np.linalg.norm(directions[rows], axis=1)
        measured = (depth[rows] * reach).astype(np.float32)[:, None]
        elevation = np.arcsin(directions[rows, 2] / reach)
        bands = len(background.ranges)
        band = ((elevation / background.highest + 1.0) / 2.0 * bands).astype(int)
        # the floor of the deviation is a bin of the table: finer is not known of the usual
        sd = self.noise.depth_floor + 0.1 + self.noise.depth_slope * measured
        error = background.distances[None, :].astype(np.float32) - measured
        ratio = np.exp(reading_ratio(error, sd, self.noise))
        means = multiply_matrices(ratio, background.ranges.T.astype(np.float32))
        mean = means[np.arange(len(rows)), np.clip(band, 0, bands - 1)]
        out[rows] = np.log(np.maximum(mean, 1e-3))
        return out

    def combine_terms(self, scores: NDArray[np.float32], terms: NDArray[np.bool_]) -> Floats:
        """Sum the terms that are there to log-likelihoods (N,); tones count beside depth."""
        asked = np.append(terms, terms[COLOUR] and terms[DEPTH])
        return np.asarray(scores.astype(np.float64)[:, asked].sum(axis=1))

    def compute_temperature(self, views: Sequence[View]) -> float:
        """Return the temperature by which the summed log-likelihood of views is divided."""
        depth, colour = np.any([v.terms for v in views], axis=0)[[DEPTH, COLOUR]]
        beside = TEMPERATURE_TONES if colour else TEMPERATURE_DEPTH
        return float((beside if depth else TEMPERATURE) * np.sqrt(len(views)))


def reading_ratio(
    error: NDArray[np.floating], sd: NDArray[np.floating], noise: Noise
) -> NDArray[np.floating]:
    """Return the log-likelihood of readings whose map lies `error` [m] beyond them, with Cauchy's tails."""
    with np.errstate(invalid="ignore"):
        good = 1.0 / (1.0 + (error / sd) ** 2)
    cost = np.where(error > 0, *np.array([noise.near_cost, noise.far_cost], error.dtype))
    return np.asarray(good * noise.depth_gain - (1.0 - good) * cost)


def model_of(options: Likelihood) -> Model:
    """Make the likelihood model of the options: the paper's Eq. 2, or the calibrated one."""
    return Paper(options) if options.kind == "gaussian" else CalibratedLikelihood(options)


class Scorer:
    """Log-likelihoods of poses in one map, under one likelihood."""

    def __init__(self, scene: Scene, likelihood: Likelihood) -> None:
        self.scene = scene
        self.model = model_of(likelihood)
        self.rays = 0
        self.poses = 0
        self.seconds = 0.0

    def terms(self, poses: Floats, view: View) -> NDArray[np.float32]:
        """Score poses (N, 4) by each term, (N, 4); see `score_poses`."""
        start = perf_counter()
        poses = np.ascontiguousarray(poses, np.float64)
        scene = self.scene
        scores = score_poses(scene.caster.tracer, scene.surface, poses, view, self.model.noise)
        self.rays += len(poses) * len(view.directions)
        self.poses += len(poses)
        self.seconds += perf_counter() - start
        return np.asarray(scores)

    def show(self, pose: Floats, view: View) -> tuple[NDArray[Any], ...]:
        """Return the scores (4,) of a pose (4,), and what the map shows there; see `show_view`."""
        tracer = self.scene.caster.tracer
        return show_view(tracer, self.scene.surface, pose, view, self.model.noise)

    def stats(self) -> dict[str, Any]:
        """Return the cost so far: poses, rays and seconds."""
        return {
            "poses_scored": self.poses,
            "rays": self.rays,
            "seconds_scoring": round(self.seconds, 4),
        }

    def __call__(self, poses: Floats, view: View) -> Floats:
        """Return log-likelihoods (N,) of poses (N, 4) for one view."""
        return self.model.combine_terms(self.terms(poses, view), view.terms)

    def together(self, poses: Floats, views: Sequence[View], steps: Floats) -> Floats:
        """Return log-likelihoods (N,) of poses (N, 4) of a reference frame for all views of a window.

        `steps`: (T, 4) from the reference frame to that of each view, by odometry.
        """
        total = np.zeros(len(poses))
        for view, step in zip(views, steps, strict=True):
            total += self(compose(poses, step), view)
        return total


def log_sum(values: NDArray[np.float64]) -> float:
    """Return log(sum(exp(values))) without overflow."""
    top = float(values.max())
    return top + float(np.log(np.exp(values - top).sum()))
