"""Modes fitted to the whole sequence at once: better poses from fewer particles.

Over a few metres odometry hardly bends, so the sequence is a rig with one unknown pose of four
degrees of freedom. Samples are drawn around each mode again and again: they are weighed by all
frames together, and the next are drawn from their mean and spread (the cross-entropy method). Modes
that fall hopelessly behind are left where they are, as rivals that the best must be told from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.pose.particles import APART, TURNED, distinct, log_sum, moments

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from placegraph.indoor.likelihood.score import View
    from placegraph.indoor.likelihood.scorer import Scorer

SPREAD = np.array([0.12, 0.12, 0.08, 0.05])
"""First standard deviations: x, y, z [m], yaw [rad]; about a cell of the table."""
NARROWEST = np.array([0.004, 0.004, 0.004, 0.0015])
_SAMPLES = 56


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose of the reference frame, fitted to all frames."""

    pose: NDArray[np.float64]
    """(4,)"""
    log_likelihood: float
    """Of the whole sequence [nat]."""
    spread: NDArray[np.float64]
    """(4,) standard deviations from which the next samples would be drawn."""
    samples: NDArray[np.float64]
    """(N, 4) poses of the last rounds."""
    values: NDArray[np.float64]
    """(N,) their log-likelihoods."""


@dataclass(frozen=True, slots=True)
class Round:
    """One level of the polish."""

    views: Sequence[View]
    steps: NDArray[np.float64]
    """(T, 4) from the reference frame to each view."""
    rounds: int
    """Samples are drawn so often."""
    most: int
    """Modes that take part."""
    gap: float
    """Modes further behind the best [nat] are dropped before."""


def polish(
    scorer: Scorer, starts: NDArray[np.float64], levels: Sequence[Round], rng: Generator
) -> list[Fit]:
    """Fits at the modes `starts` (M, 4) of the reference frame, best first, coarse to fine.

    A mode that falls behind is not polished further but stays in the list, as far behind the best
    as it was when it was left: it is what the best has to be told from.
    """
    level = levels[0]
    values = scorer.together(starts, level.views, level.steps)
    fits = [
        Fit(pose, value, SPREAD, pose[None], np.array([value]))
        for pose, value in zip(starts, values, strict=True)
    ]
    left: list[tuple[Fit, float]] = []  # and how far behind
    for number, level in enumerate(levels):
        # starts within reach of one peak would climb it together: let others have a turn
        near = _NEAR if number or len(levels) == 1 else {"apart": APART, "turned": TURNED}
        fits, fallen = _survivors(fits, level, near)
        top = fits[0].log_likelihood
        left += [(fit, top - fit.log_likelihood) for fit in fallen]
        fits = [_fit(scorer, fit, level, rng) for fit in fits]
    fits.sort(key=lambda fit: -fit.log_likelihood)
    best = fits[0].log_likelihood
    fits += [replace(fit, log_likelihood=best - behind) for fit, behind in left]
    poses = np.array([f.pose for f in fits])
    kept = distinct(poses, np.array([f.log_likelihood for f in fits]), len(fits), **_NEAR)
    return [fits[i] for i in kept]


_NEAR = {"apart": 0.3, "turned": 0.2}
"""Fits nearer than this are one."""


def _survivors(
    fits: list[Fit], level: Round, near: Mapping[str, float]
) -> tuple[list[Fit], list[Fit]]:
    """Distinct fits within the gap, best first, and the other distinct ones."""
    poses = np.array([f.pose for f in fits])
    values = np.array([f.log_likelihood for f in fits])
    kept = [fits[i] for i in distinct(poses, values, len(fits), **near)]
    able = [f for f in kept[: level.most] if f.log_likelihood > values.max() - level.gap]
    return able, kept[len(able) :]


def refine(
    scorer: Scorer,
    pose: NDArray[np.float64],
    spread: NDArray[np.float64],
    level: Round,
    rng: Generator,
) -> Fit:
    """Fit of one pose (4,), known to about `spread` (4,), to all frames."""
    return _fit(scorer, Fit(pose, 0.0, spread, pose[None], np.zeros(1)), level, rng)


def _fit(scorer: Scorer, fit: Fit, level: Round, rng: Generator) -> Fit:
    """Draw, weigh and draw again around one fit."""
    mean, spread = fit.pose, fit.spread
    samples, values = [], []
    for _ in range(level.rounds):
        drawn = mean + rng.normal(size=(_SAMPLES, 4)) * spread
        drawn[0] = mean
        scores = scorer.together(drawn, level.views, level.steps)
        samples.append(drawn)
        values.append(scores)
        # tempered so that about a sixth of the samples count, however sharp the likelihood
        heat = max(1.0, float(scores.max() - np.partition(scores, -_SAMPLES // 6)[-_SAMPLES // 6]))
        weights = np.exp((scores - scores.max()) * (1.5 / heat))
        mean, covariance = moments(drawn, weights)
        spread = np.maximum(1.3 * np.sqrt(np.diag(covariance)), NARROWEST)
    at_mean = scorer.together(mean[None], level.views, level.steps)
    drawn, scores = np.concatenate([*samples, mean[None]]), np.concatenate([*values, at_mean])
    best = int(scores.argmax())
    # the mean of many good samples is smoother than the luckiest of them
    pose = mean if scores[best] - at_mean[0] < 1.0 else drawn[best]
    return Fit(pose, float(scores[best]), spread, drawn, scores)


def probabilities(values: NDArray[np.float64], temperature: float) -> NDArray[np.float64]:
    """Probabilities (M,) of modes by log-likelihoods (M,): witnesses are not independent."""
    logs = values / temperature
    return np.asarray(np.exp(logs - log_sum(logs)))


_SOFT = 6.0  # nats that count as one among the samples of a fit


TILT = 0.006
"""Standard deviation of the tilt that gravity gives [rad]: a third of a degree, as of a phone."""


def covariance_of(fit: Fit) -> NDArray[np.float64]:
    """Covariance (6, 6) of a fit from its samples: x, y, z, and a turn about the map's axes."""
    logs = (fit.values - fit.values.max()) / _SOFT
    _, covariance = moments(fit.samples, np.exp(logs))
    whole = np.diag([0.0, 0.0, 0.0, TILT**2, TILT**2, 0.0])
    whole[np.ix_(_FITTED, _FITTED)] = covariance + np.diag(NARROWEST**2)
    return whole


_FITTED = [0, 1, 2, 5]
