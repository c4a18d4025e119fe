"""Weighted particles and how many are drawn: KLD-sampling and stratified resampling."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.indoor.likelihood.score import log_sum
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.pose.search import near

BIN = np.array([0.2, 0.2, 0.2, np.deg2rad(10.0)])
"""Bins of the state histogram of KLD-sampling: x, y, z [m], yaw [rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """N particles with normalised log weights."""

    poses: NDArray[np.float64]
    """(N, 4) float64, x, y, z [m], yaw [rad]."""
    log_weights: NDArray[np.float64]
    """(N,) float64; their exponentials add up to 1."""

    @classmethod
    def even(cls, poses: NDArray[np.float64]) -> Particles:
        """Particles that all weigh the same."""
        return cls(poses, np.full(len(poses), -np.log(max(1, len(poses)))))

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def weights(self) -> NDArray[np.float64]:
        """(N,) adding up to 1."""
        return np.asarray(np.exp(self.log_weights))

    def reweighted(self, log_likelihoods: NDArray[np.float64]) -> tuple[Particles, float]:
        """Particles after an observation, and the log of its mean likelihood."""
        raw = self.log_weights + log_likelihoods
        total = log_sum(raw)
        return Particles(self.poses, raw - total), total

    def effective(self) -> float:
        """Effective sample size, 1 to N."""
        return float(np.exp(-log_sum(2.0 * self.log_weights)))


def kld_count(particles: Particles, options: FilterOptions) -> int:
    """Particles that KLD-sampling asks for (Fox 2001): n of Sec. 3.5, k counted by weight.

    k is the number of bins of the histogram of what resampling would draw: bins that hold less
    than the weight of half a particle do not count.
    """
    bins = np.floor(particles.poses / BIN).astype(np.int64)
    bins[:, 3] %= round(2.0 * np.pi / BIN[3])  # yaws that have gone round are the same
    _, inverse = np.unique(bins, axis=0, return_inverse=True)
    mass = np.bincount(inverse.ravel(), weights=particles.weights)
    k = int((mass > 0.5 / len(particles)).sum())
    return kld_bound(k, options.kld_error, options.kld_confidence)


def kld_bound(bins: int, error: float, confidence: float) -> int:
    """Samples after which the histogram's divergence stays below `error` with this confidence."""
    if bins < 2:
        return 1
    from statistics import NormalDist

    z = NormalDist().inv_cdf(confidence)
    a = 2.0 / (9.0 * (bins - 1))
    return int(np.ceil((bins - 1) / (2.0 * error) * (1.0 - a + np.sqrt(a) * z) ** 3))


def resample(particles: Particles, count: int, rng: Generator) -> Particles:
    """`count` particles drawn by stratified resampling: one from each `1 / count` of the weight."""
    edges = np.cumsum(particles.weights)
    points = (np.arange(count) + rng.random(count)) / count * edges[-1]
    rows = np.minimum(np.searchsorted(edges, points, side="right"), len(particles) - 1)
    return Particles.even(particles.poses[rows])


def masses(particles: Particles, modes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weight (K,) of the particles that belong to each of modes (K, 4), or to none before it."""
    left, out = particles.weights, np.zeros(len(modes))
    for k, mode in enumerate(modes):
        own = near(particles.poses, mode)
        out[k] = left[own].sum()
        left = np.where(own, 0.0, left)
    return out
