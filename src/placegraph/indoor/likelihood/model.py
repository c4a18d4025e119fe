"""What a likelihood is, and which one the options choose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.likelihood.calibrated import Calibrated
from placegraph.indoor.likelihood.paper import Paper
from placegraph.indoor.likelihood.view import Background, Noise, View
from placegraph.indoor.options import Likelihood


class Model(Protocol):
    """How what a frame shows becomes a log-likelihood."""

    noise: Noise
    """Its numbers, for compiled loops."""

    def named(self, cosines: NDArray[np.float32], temperature: float, usual: Floats) -> Floats:
        """What patches say if they see each of N objects or, last column, none: (M, N + 1).

        `cosines`: (M, N) of each kind of patch with each object; `temperature`: of their softmax;
        `usual`: (N,) how much of a map each object fills.
        """

    def shares(self, counts: Floats) -> Floats:
        """Weight (N,) of one patch of each object, which is seen in so many (N,)."""

    def usual_depth(
        self, depth: NDArray[np.float32], directions: Floats, background: Background
    ) -> NDArray[np.float32]:
        """What each reading (R,) [m] along directions (R, 3) scores if nothing is known of the pose."""

    def combined(self, scores: NDArray[np.float32], terms: NDArray[np.bool_]) -> Floats:
        """Log-likelihoods (N,) of scores (N, 4) of `score_poses`; `terms` (3,) are asked for."""

    def heat(self, views: Sequence[View]) -> float:
        """Nats that count as one among modes where these views are summed."""


def model_of(options: Likelihood) -> Model:
    """The likelihood that the options name: the paper's Eq. 2, or the calibrated one."""
    return Paper(options) if options.kind == "gaussian" else Calibrated(options)
