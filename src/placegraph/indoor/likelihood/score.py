"""Scores poses on the device asked for, and keeps count of what it cost."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, compose
from placegraph.errors import OptionError
from placegraph.indoor.likelihood.model import model_of
from placegraph.indoor.likelihood.score_kernels import score_poses
from placegraph.indoor.likelihood.view import View
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import Likelihood


class Scorer:
    """Log-likelihoods of poses in one map, under one likelihood.

    `device`: ``cpu``, ``cuda`` (or ``cuda:1``; extra ``gpu``), or ``auto``: the CPU, which for the
    few hundred particles the visibility table leaves is as quick as a transfer.
    """

    def __init__(self, scene: Scene, likelihood: Likelihood, device: str = "auto") -> None:
        self.scene = scene
        self.model = model_of(likelihood)
        self.rays = 0
        self.poses = 0
        self.seconds = 0.0
        self.device = "cpu" if device == "auto" else device
        self._warp = None
        if self.device != "cpu":
            if not self.device.startswith("cuda"):
                raise OptionError(f"device is {device!r}; it is 'auto', 'cpu' or 'cuda'.")
            from placegraph.indoor.likelihood.warp import WarpScorer

            self._warp = WarpScorer(scene, self.device)

    def terms(self, poses: Floats, view: View) -> NDArray[np.float32]:
        """Scores (N, 4) of poses (N, 4), a column a term; see `score_poses`."""
        start = perf_counter()
        poses = np.ascontiguousarray(poses, np.float64)
        if self._warp is not None:
            scores = self._warp.score(poses, view, self.model.noise)
        else:
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
            "device": self.device,
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
