"""What a likelihood is, and which one the options choose."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, compose
from placegraph.indoor.likelihood.calibrated import Calibrated
from placegraph.indoor.likelihood.observe import Model, View
from placegraph.indoor.likelihood.paper import Paper
from placegraph.indoor.likelihood.score_kernels import score_poses
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import Likelihood


def model_of(options: Likelihood) -> Model:
    """The likelihood that the options name: the paper's Eq. 2, or the calibrated one."""
    return Paper(options) if options.kind == "gaussian" else Calibrated(options)


class Scorer:
    """Log-likelihoods of poses in one map, under one likelihood."""

    def __init__(self, scene: Scene, likelihood: Likelihood) -> None:
        self.scene = scene
        self.model = model_of(likelihood)
        self.rays = 0
        self.poses = 0
        self.seconds = 0.0

    def terms(self, poses: Floats, view: View) -> NDArray[np.float32]:
        """Scores (N, 4) of poses (N, 4), a column a term; see `score_poses`."""
        start = perf_counter()
        poses = np.ascontiguousarray(poses, np.float64)
        scene = self.scene
        scores = score_poses(scene.caster.tracer, scene.surface, poses, view, self.model.noise)
        self.rays += len(poses) * len(view.directions)
        self.poses += len(poses)
        self.seconds += perf_counter() - start
        return np.asarray(scores)

    def stats(self) -> dict[str, Any]:
        """What it has cost so far."""
        return {
            "poses_scored": self.poses,
            "rays": self.rays,
            "seconds_scoring": round(self.seconds, 4),
        }

    def __call__(self, poses: Floats, view: View) -> Floats:
        """Log-likelihoods (N,) of poses (N, 4) against one view."""
        return self.model.combined(self.terms(poses, view), view.terms)

    def together(self, poses: Floats, views: Sequence[View], steps: Floats) -> Floats:
        """Log-likelihoods (N,) of poses (N, 4) of a reference frame against a whole window.

        `steps`: (T, 4) from the reference frame to that of each view, by odometry.
        """
        total = np.zeros(len(poses))
        for view, step in zip(views, steps, strict=True):
            total += self(compose(poses, step), view)
        return total
