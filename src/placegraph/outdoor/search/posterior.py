"""From scored viewpoints to modes: probabilities over the whole city."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.search.posterior_kernels import peaks

TEMPER = 1.0
"""Exponent of the likelihood: statements about one place are not independent."""
ELSEWHERE = 0.03
"""Prior probability that the place is not on the map."""
WITHIN = 50.0
"""A mode's probability is that of the true place lying within this distance [m]."""
APART = 40.0
"""Modes are at least this far apart [m]."""
LOOKED_AT = 8
"""Peaks that are compared at least: the first one found is not always the heaviest."""
HEAVIEST = 32
"""So many points are looked at for peaks."""


@dataclass(frozen=True)
class Posterior:
    """Probability of viewpoints; what is missing to 1 lies elsewhere, or was not scored."""

    positions: NDArray[np.float64]
    """(K, 2) east, north [m]."""
    probabilities: NDArray[np.float64]
    """(K,)"""
    elsewhere: float
    """Probability that the place is not on this map, or that the text is not about one."""

    def within(self, position: NDArray[np.float64], radius: float) -> float:
        """Probability of the place lying within `radius` [m] of a position (2,)."""
        return float(self.probabilities[_within(self.positions, position, radius)].sum())


def posterior(
    positions: NDArray[np.float64],
    scores: NDArray[np.float64],
    log_prior: NDArray[np.float64],
    unscored: float,
) -> Posterior:
    """Bayes over viewpoints.

    `scores` (K,) are log-likelihood ratios against anywhere, `log_prior` (K,) log shares of the
    viewpoints, `unscored` the log of what all viewpoints together weigh that were not scored.
    """
    here = TEMPER * scores + log_prior
    log_total = np.logaddexp.reduce(
        np.concatenate((here, [TEMPER * unscored])) + np.log1p(-ELSEWHERE)
    )
    log_total = np.logaddexp(log_total, np.log(ELSEWHERE))
    probabilities = np.exp(here + np.log1p(-ELSEWHERE) - log_total)
    return Posterior(positions, probabilities, float(np.exp(np.log(ELSEWHERE) - log_total)))


@dataclass(frozen=True)
class Mode:
    """A peak of the posterior."""

    position: NDArray[np.float64]
    """(2,) east, north [m]."""
    covariance: NDArray[np.float64]
    """(2, 2) [m^2]."""
    probability: float


def modes(found: Posterior, top: int, spacing: float) -> list[Mode]:
    """Peaks of the posterior, heaviest first; positions lie on a grid of `spacing` [m]."""
    heavy = np.argsort(-found.probabilities, kind="stable")[:HEAVIEST]
    own = (spacing**2 / 12.0 + 1.0) * np.eye(2)
    places, covariances, masses = peaks(
        found.positions, found.probabilities, heavy, max(top, LOOKED_AT), APART, WITHIN
    )
    return [
        Mode(places[i], covariances[i] + own, min(1.0, float(masses[i])))
        for i in np.argsort(-masses, kind="stable")[:top].tolist()
    ]


def ranked(found: Posterior, top: int, spacing: float) -> list[Mode]:
    """Peaks of positions that stand best first, whatever they weigh; arguments as of `modes`."""
    # each outweighs all below it together
    weights = 0.5 ** np.arange(1.0, 1.0 + len(found.positions))
    best = modes(replace(found, probabilities=weights), top, spacing)
    return [replace(mode, probability=found.within(mode.position, WITHIN)) for mode in best]


def _within(
    positions: NDArray[np.float64], center: NDArray[np.float64], radius: float
) -> NDArray[np.bool_]:
    """Which positions (..., K) lie within a radius [m] of a center (..., 2)."""
    east, north = positions[:, 0] - center[..., 0], positions[:, 1] - center[..., 1]
    return east * east + north * north <= radius * radius
