"""Modes fitted to the whole window at once: better poses from fewer particles.

Over a few metres odometry hardly bends (where it does, `bend` follows), so the window is a rig with one
unknown pose of four degrees of freedom. Samples are drawn around each mode again and again: they are
weighed by all frames together, and the next are drawn from their mean and spread (the cross-entropy
method). Modes that fall hopelessly behind are left where they are, as rivals that the best must be told
from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, between, compose, wrap_angle
from placegraph.indoor.likelihood.observe import COARSE, FINE, View, recent
from placegraph.indoor.likelihood.score import Scorer, log_sum
from placegraph.indoor.likelihood.score_kernels import DEPTH
from placegraph.indoor.pose.search import APART, SCREENED, TURNED, distinct, thinned
from placegraph.indoor.pose.window import Chain, Window, timed
from placegraph.indoor.rays.trace_kernels import LANES

SPREAD = np.array([0.12, 0.12, 0.08, 0.05])
"""First standard deviations: x, y, z [m], yaw [rad]; about a cell of the table."""
NARROWEST = np.array([0.004, 0.004, 0.004, 0.0015])
WIDENED = 3.0
"""Factor on the covariance of samples that brings normalised errors to what they should be (benchmark)."""
GAP = 400.0
"""Modes further behind the best [nat] are not fitted to the last level."""
SOFT = 6.0  # nats that count as one: neighbouring samples of an image err together
_SAMPLES = 56
_COUNTED = 10
_RICH = 12  # tiles of a view half of which do
FINEST = np.diag(NARROWEST**2)
KNOWN = WIDENED * FINEST
"""Covariance of a fit before the first round."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose of the last frame, fitted to all frames, and those of all others."""

    poses: Floats
    """(T, 4) of all frames of the window."""
    log_likelihood: float
    """Of the whole window [nat]; of a mode of particles the log of their weight."""
    sampling: Floats
    """(4, 4) covariance of the next samples, were there any: before one image a step aside and a turn
    look nearly alike, so samples lie along such ridges."""
    covariance: Floats
    """(4, 4) of the last pose."""

    @property
    def pose(self) -> Floats:
        """(4,) of the last frame."""
        return self.poses[-1]

    @property
    def spread(self) -> Floats:
        """(4,) standard deviations of the next samples."""
        return np.asarray(np.sqrt(np.diag(self.sampling)))

    @classmethod
    def at(cls, chain: Chain, pose: Floats, value: float = 0.0, spread: Floats = SPREAD) -> Fit:
        """A rigid one through a pose (4,) of the last frame."""
        return cls(chain.rigid(pose), value, np.diag(spread**2), KNOWN)


@dataclass(frozen=True, slots=True)
class FitLevel:
    """One level of the coarse-to-fine fit."""

    chain: Chain
    """Of all frames of the window."""
    rows: NDArray[np.int64]
    """(L,) frames that are looked at."""
    views: Sequence[View]
    """(L,) of them."""
    rounds: int
    """Samples are drawn so often."""
    most: int
    """Modes that take part."""
    gap: float
    """Modes further behind the best [nat] are dropped before."""
    samples: int = _SAMPLES
    """Drawn at once."""


def fit_modes(
    scorer: Scorer, starts: Floats, levels: Sequence[FitLevel], rng: Generator
) -> list[Fit]:
    """Fits at the modes `starts` (M, 4) of the last frame, best first, coarse to fine.

    A mode that falls behind is not fitted further but stays in the list, as far behind the best
    as it was when it was left: it is what the best has to be told from.
    """
    chain, level = levels[0].chain, levels[0]
    along = between(chain.poses[-1], chain.poses[level.rows])
    values = scorer.together(starts, level.views, along)
    fits = [Fit.at(chain, pose, value) for pose, value in zip(starts, values, strict=True)]
    left: list[tuple[Fit, float]] = []  # and how far behind
    for number, level in enumerate(levels):
        # starts within reach of one peak would climb it together: let others have a turn
        reach = MERGED if number or len(levels) == 1 else {"apart": APART, "turned": TURNED}
        fits, fallen = _survivors(fits, level, reach)
        top = fits[0].log_likelihood
        left += [(fit, top - fit.log_likelihood) for fit in fallen]
        fits = [_fit_by_cross_entropy(scorer, fit, level, rng) for fit in fits]
    best = max(fit.log_likelihood for fit in fits)
    # a rival must not lose by chance what more samples would find
    fits = [
        max(fit, _fit_by_cross_entropy(scorer, fit, level, rng), key=lambda f: f.log_likelihood)
        if 0.0 < best - fit.log_likelihood < level.gap
        else fit
        for fit in fits
    ]
    best = max(fit.log_likelihood for fit in fits)
    fits += [replace(fit, log_likelihood=best - behind) for fit, behind in left]
    return merge_fits(fits)


def merge_fits(fits: list[Fit]) -> list[Fit]:
    """Of fits near each other the best; best first."""
    poses = np.array([f.pose for f in fits])
    kept = distinct(poses, np.array([f.log_likelihood for f in fits]), len(fits), **MERGED)
    return [fits[i] for i in kept]


MERGED = {"apart": 0.3, "turned": 0.2}
"""Fits nearer than this are one."""


def _survivors(
    fits: list[Fit], level: FitLevel, reach: Mapping[str, float]
) -> tuple[list[Fit], list[Fit]]:
    """Distinct fits within the gap, best first, and the other distinct ones."""
    poses = np.array([f.pose for f in fits])
    values = np.array([f.log_likelihood for f in fits])
    kept = [fits[i] for i in distinct(poses, values, len(fits), **reach)]
    able = [f for f in kept[: level.most] if f.log_likelihood > values.max() - level.gap]
    return able, kept[len(able) :]


def fit_pose(scorer: Scorer, pose: Floats, spread: Floats, level: FitLevel, rng: Generator) -> Fit:
    """Fit of one pose (4,), known to about `spread` (4,), to all frames."""
    return _fit_by_cross_entropy(scorer, Fit.at(level.chain, pose, spread=spread), level, rng)


def _fit_by_cross_entropy(scorer: Scorer, fit: Fit, level: FitLevel, rng: Generator) -> Fit:
    """Draw poses of the course as a whole, weigh them by all frames, and draw again around these."""
    mean, sampling, steps = fit.pose, fit.sampling, between(fit.pose, fit.poses)
    along = steps[level.rows]
    samples, values = [], []
    for _ in range(level.rounds):
        drawn = mean + rng.normal(size=(level.samples, 4)) @ np.linalg.cholesky(sampling).T
        drawn[0] = mean
        scores = scorer.together(drawn, level.views, along)
        samples.append(drawn)
        values.append(scores)
        # tempered so that several samples count, however sharp the likelihood
        heat = max(1.0, float(scores.max() - np.partition(scores, -_COUNTED)[-_COUNTED]))
        weights = np.exp((scores - scores.max()) * (1.5 / heat))
        mean, covariance = moments(drawn, weights)
        sampling = 1.69 * covariance + FINEST
    at_mean = scorer.together(mean[None], level.views, along)
    drawn, scores = np.concatenate([*samples, mean[None]]), np.concatenate([*values, at_mean])
    best = int(scores.argmax())
    # the mean of many good samples is smoother than the luckiest of them
    pose = mean if scores[best] - at_mean[0] < 1.0 else drawn[best]
    _, covariance = moments(drawn, np.exp((scores - scores.max()) / SOFT))
    covariance = WIDENED * (covariance + FINEST)
    return Fit(compose(pose, steps), float(scores[best]), sampling, covariance)


def fit_window(window: Window, starts: Floats, rng: Generator) -> list[Fit]:
    """Fits of the last frame's pose, first at `starts` (M, 4), to all frames of a window, best first."""
    with timed(window.seconds, "fit_modes"):
        # two rounds for all before any is dropped: a start may lie a hand's breadth off its peak
        levels = [
            fit_level(window, COARSE, rounds=2, samples=32, most=10, frames=5),
            fit_level(window, COARSE, rounds=3, samples=32, most=4, gap=800.0),
            fit_level(window, FINE, rounds=4, samples=40, most=3, gap=GAP),
        ]
        return fit_modes(window.scorer, starts, levels, rng)


def fit_level(
    window: Window,
    stride: float,
    *,
    rounds: int,
    samples: int = _SAMPLES,
    most: int = 1,
    gap: float = np.inf,
    frames: int = SCREENED,
) -> FitLevel:
    """Return a level of the fit.

    Coarse levels look at frames of the whole window as a rig, the newest above all; fine ones at the
    newest alone, and bend the way to the others. With depth in all of them fewer samples and half of
    the rays do; steps of colour need them all.
    """
    fine = stride == FINE
    looked = window.newest if fine else recent(len(window), frames)
    views = [window.views(stride)[i] for i in looked]
    # small images have no rays to spare
    if all(view.terms[DEPTH] and len(view.patch) >= _RICH * LANES for view in views):
        views = [thinned(view, 2, i) for view, i in zip(views, looked, strict=True)]
    else:
        samples = _SAMPLES
    return FitLevel(window.chain, looked, views, rounds, most, gap, samples)


def moments(poses: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Mean (4,) and covariance (4, 4) of weighted poses (N, 4); yaw as on a circle."""
    weights = weights / weights.sum()
    yaw = np.arctan2(weights @ np.sin(poses[:, 3]), weights @ np.cos(poses[:, 3]))
    mean = np.append(weights @ poses[:, :3], yaw)
    errors = poses - mean
    errors[:, 3] = wrap_angle(errors[:, 3])
    return mean, np.einsum("n,ni,nj->ij", weights, errors, errors)


def probabilities(values: Floats, temperature: float) -> Floats:
    """Probabilities (M,) of modes by log-likelihoods (M,): witnesses are not independent."""
    logs = values / temperature
    return np.asarray(np.exp(logs - log_sum(logs)))
