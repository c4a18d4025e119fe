# ruff: noqa: ARG002  # what `Model` asks of it
"""The paper's likelihood, taken at its word (SG2Loc Sec. 3.3, 3.4, Eq. 2)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.likelihood.observe import Background, Noise, View
from placegraph.indoor.likelihood.score_kernels import TONE
from placegraph.indoor.options import Likelihood


class Paper:
    """Scores of semantics, depth and colour up to 2, and a Gaussian of the missing rest.

    Eq. 2 centres the sum of s, lambda_1 s_d and lambda_2 s_i at 6, although Sec. 3.4 prints s_d and
    s_i up to 1. 6 is the sum of three maxima of 2 with both lambdas 1, as printed: so s_d and s_i are
    doubled, and the target is 2 (1 + lambda_1 + lambda_2), of those terms that there are.
    """

    def __init__(self, options: Likelihood) -> None:
        self.options = options
        self.noise = Noise.of(options, gaussian=True)

    def score_patches(
        self, cosines: NDArray[np.float32], temperature: float, object_shares: Floats
    ) -> Floats:
        """Score patches by cosine + 1 where patch and object agree (Sec. 3.3), (M, N + 1)."""
        best = cosines >= cosines.max(axis=1, keepdims=True) - 1e-6
        table = np.where(best, cosines + 1.0, 0.0)
        return np.concatenate([table, np.zeros((len(table), 1))], axis=1)

    def shares(self, counts: Floats) -> Floats:
        """Weight every patch in full."""
        return np.ones(len(counts))

    def background_depth(
        self, depth: NDArray[np.float32], directions: Floats, background: Background
    ) -> NDArray[np.float32]:
        """Return zeros: scores of Eq. 2 are no ratios."""
        return np.zeros(len(depth), np.float32)

    def combine_terms(self, scores: NDArray[np.float32], terms: NDArray[np.bool_]) -> Floats:
        """Combine by Eq. 2: -(2 (1 + l1 + l2) - (s + l1 d + l2 c))^2 / (2 sigma^2), of present terms."""
        o = self.options
        factors = np.array([1.0, o.depth_lambda, o.colour_lambda]) * terms
        missing = 2.0 * factors.sum() - scores[:, :TONE].astype(np.float64) @ factors
        return np.asarray(-(missing**2) / (2.0 * o.sigma**2))

    def compute_temperature(self, views: Sequence[View]) -> float:
        """Return 1: Eq. 2 is a log-likelihood already."""
        return 1.0
