"""Fits of poses to a window: cross-entropy method, drift correction.

Over a few metres odometry hardly drifts, so the window is a rig with one unknown pose of four degrees of
freedom. Samples are drawn around each mode, weighted by all frames together, and the next samples are
drawn from their mean and covariance (the cross-entropy method). Modes that fall far behind stay in the
list as rivals. Then frames and odometry, which may drift, are fitted as one chain of poses.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, between, compose, wrap_angle
from placegraph.indoor.likelihood.observe import COARSE, FINE, View, recent
from placegraph.indoor.likelihood.score import Scorer, log_sum
from placegraph.indoor.likelihood.score_kernels import DEPTH
from placegraph.indoor.pose.search import APART, SCREENED, TURNED, select_distinct, thin_view
from placegraph.indoor.pose.window import Chain, Window, time_stage
from placegraph.indoor.rays.trace_kernels import LANES

SPREAD = np.array([0.12, 0.12, 0.08, 0.05])
"""First standard deviations: x, y, z [m], yaw [rad]; about a cell of the table."""
NARROWEST = np.array([0.004, 0.004, 0.004, 0.0015])
WIDENED = 3.0
"""Factor on the covariance of samples that calibrates normalized errors (benchmark)."""
GAP = 400.0
"""Modes further behind the best [nat] are not fitted to the last level."""
_GAP_OF_ONE = 150.0  # the same of one frame; it grows with the root of their number
_FEW = 2  # frames all of whose rays the fine level needs
SOFT = 6.0  # nats that count as one: neighbouring samples of an image err together
_SAMPLES = 56
_COUNTED = 10
_RICH = 12  # tiles of a view half of which do
FINEST = np.diag(NARROWEST**2)
KNOWN = WIDENED * FINEST
"""Covariance (4, 4) of a fit before the first round."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Fit of a pose of the last frame to all frames of a window."""

    poses: Floats
    """(T, 4) of all frames of the window."""
    log_likelihood: float
    """Log-likelihood of the whole window [nat]; for a mode of particles, the log of their weight."""
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
        """Make a rigid fit through a pose (4,) of the last frame."""
        return cls(chain.rigid(pose), value, np.diag(spread**2), KNOWN)


@dataclass(frozen=True, slots=True)
class FitLevel:
    """One level of the coarse-to-fine fit."""

    chain: Chain
    """Odometry of all frames of the window."""
    rows: NDArray[np.int64]
    """(L,) frames that are looked at."""
    views: Sequence[View]
    """(L,) of them."""
    rounds: int
    """Number of times that samples are drawn."""
    most: int
    """Largest number of modes that take part."""
    gap: float
    """Modes further behind the best [nat] are dropped before."""
    samples: int = _SAMPLES
    """Drawn at once."""


def fit_modes(
    scorer: Scorer, starts: Floats, levels: Sequence[FitLevel], rng: Generator
) -> list[Fit]:
    """Fit the modes `starts` (M, 4) of the last frame coarse to fine; best first.

    A mode that falls behind is not fitted further but stays in the list as a rival, as far behind the best
    as it was then.
    """
    chain, level = levels[0].chain, levels[0]
    along = between(chain.poses[-1], chain.poses[level.rows])
    values = scorer.together(starts, level.views, along)
    candidates = [Fit.at(chain, pose, value) for pose, value in zip(starts, values, strict=True)]
    left: list[tuple[Fit, float]] = []  # and how far behind
    for number, level in enumerate(levels):
        # starts within reach of one peak would climb it together: let others have a turn
        reach = MERGED if number or len(levels) == 1 else {"apart": APART, "turned": TURNED}
        candidates, fallen = _survivors(candidates, level, reach)
        top = candidates[0].log_likelihood
        left += [(fit, top - fit.log_likelihood) for fit in fallen]
        candidates = [_fit_by_cross_entropy(scorer, fit, level, rng) for fit in candidates]
    best = max(fit.log_likelihood for fit in candidates)
    # a rival must not lose by chance what more samples would find
    candidates = [
        max(fit, _fit_by_cross_entropy(scorer, fit, level, rng), key=lambda f: f.log_likelihood)
        if 0.0 < best - fit.log_likelihood < level.gap
        else fit
        for fit in candidates
    ]
    best = max(fit.log_likelihood for fit in candidates)
    candidates += [replace(fit, log_likelihood=best - behind) for fit, behind in left]
    return merge_fits(candidates)


def merge_fits(candidates: list[Fit]) -> list[Fit]:
    """Keep the best of fits near each other; best first."""
    poses = np.array([f.pose for f in candidates])
    kept = select_distinct(
        poses, np.array([f.log_likelihood for f in candidates]), len(candidates), **MERGED
    )
    return [candidates[i] for i in kept]


MERGED = {"apart": 0.3, "turned": 0.2}
"""Fits nearer than this are merged."""


def _survivors(
    candidates: list[Fit], level: FitLevel, reach: Mapping[str, float]
) -> tuple[list[Fit], list[Fit]]:
    """Return distinct fits within the gap, best first, and the other distinct ones."""
    poses = np.array([f.pose for f in candidates])
    values = np.array([f.log_likelihood for f in candidates])
    kept = [candidates[i] for i in select_distinct(poses, values, len(candidates), **reach)]
    able = [f for f in kept[: level.most] if f.log_likelihood > values.max() - level.gap]
    return able, kept[len(able) :]


def fit_pose(scorer: Scorer, pose: Floats, spread: Floats, level: FitLevel, rng: Generator) -> Fit:
    """Fit one pose (4,), known to standard deviations `spread` (4,), to all frames."""
    return _fit_by_cross_entropy(scorer, Fit.at(level.chain, pose, spread=spread), level, rng)


def _fit_by_cross_entropy(scorer: Scorer, fit: Fit, level: FitLevel, rng: Generator) -> Fit:
    """Draw poses of the trajectory as a whole, weight them by all frames, and draw again around these."""
    mean, sampling, steps = fit.pose, fit.sampling, between(fit.pose, fit.poses)
    along = steps[level.rows]
    samples, values = [], []
    for _ in range(level.rounds):
        drawn = mean + rng.normal(size=(level.samples, 4)) @ np.linalg.cholesky(sampling).T
        drawn[0] = mean
        scores = scorer.together(drawn, level.views, along)
        samples.append(drawn)
        values.append(scores)
        # tempered so that several samples count, but not most of them, however sharp the likelihood
        counted = min(_COUNTED, 3 * level.samples // 8)
        temperature = max(1.0, float(scores.max() - np.partition(scores, -counted)[-counted]))
        weights = np.exp((scores - scores.max()) * (1.5 / temperature))
        mean, covariance = moments(drawn, weights)
        sampling = 1.69 * covariance + FINEST
    at_mean = scorer.together(mean[None], level.views, along)
    drawn, scores = np.concatenate([*samples, mean[None]]), np.concatenate([*values, at_mean])
    best = int(scores.argmax())
    # the mean of many good samples is smoother than the luckiest of them
    pose = mean if scores[best] - at_mean[0] < 1.0 else drawn[best]
    weights = np.exp((scores - scores.max()) / SOFT)
    weights /= weights.sum()
    # few samples have weight: the unbiased covariance of weighted samples
    covariance = moments(drawn, weights)[1] / max(1.0 - weights @ weights, 0.25)
    covariance = WIDENED * (covariance + FINEST)
    return Fit(compose(pose, steps), float(scores[best]), sampling, covariance)


def fit_window(
    window: Window, starts: Floats, rng: Generator, landmark_poses: Floats | None = None
) -> list[Fit]:
    """Fit the last frame's pose from `starts` (M, 4) to all frames of a window; best first.

    `landmark_poses`: (K, 4), which are fitted to the last level, whatever coarser ones say.
    """
    gap = min(GAP, _GAP_OF_ONE * len(window) ** 0.5)
    with time_stage(window.seconds, "fit_modes"):
        # two rounds for all before any is dropped: a start may lie a hand's breadth off its peak
        levels = [
            fit_level(window, COARSE, rounds=2, samples=32, most=10, frames=5),
            fit_level(window, COARSE, rounds=3, samples=32, most=4, gap=800.0),
            fit_level(window, FINE, rounds=4, samples=48, most=3, gap=gap),
        ]
        fits = fit_modes(window.scorer, starts, levels, rng)
        for pose in () if landmark_poses is None else landmark_poses:
            fits.append(fit_pose(window.scorer, pose, SPREAD, levels[-1], rng))
        return merge_fits(fits)


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
    """Make a level of the fit.

    Coarse levels use frames of the whole window, the newest above all; fine levels the newest alone. With
    depth in all frames fewer samples and half of the rays suffice; steps of colour need all of them, and
    so does the fine level of one frame or two.
    """
    fine = stride == FINE
    looked = window.newest if fine else recent(len(window), frames)
    views = [window.views(stride)[i] for i in looked]
    # small images have no rays to spare
    if not all(view.terms[DEPTH] and len(view.patch) >= _RICH * LANES for view in views):
        samples = _SAMPLES
    elif len(window) > _FEW or not fine:
        views = [thin_view(view, 2, i) for view, i in zip(views, looked, strict=True)]
    return FitLevel(window.chain, looked, views, rounds, most, gap, samples)


def moments(poses: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Return the mean (4,) and covariance (4, 4) of weighted poses (N, 4), yaw on the circle."""
    weights = weights / weights.sum()
    yaw = np.arctan2(weights @ np.sin(poses[:, 3]), weights @ np.cos(poses[:, 3]))
    mean = np.append(weights @ poses[:, :3], yaw)
    errors = poses - mean
    errors[:, 3] = wrap_angle(errors[:, 3])
    return mean, np.einsum("n,ni,nj->ij", weights, errors, errors)


def probabilities(values: Floats, temperature: float) -> Floats:
    """Return probabilities (M,) of modes by tempered log-likelihoods (M,), as evidence is correlated."""
    logs = values / temperature
    return np.asarray(np.exp(logs - log_sum(logs)))


USUAL = 0.25
"""Prior scale of odometry errors, in units of the motion noise ..."""
_WITNESSES = 10.0  # ... and its weight in steps
FIRST = 2.0
"""Scale that a fit starts with: a chain stiffens more easily than it loosens."""
_SCALES = (0.1, 12.0)
_LOOSE = np.array([1.0, 1.0, 1.0, 0.5])  # m, rad: what nothing holds stays where it is


@dataclass(frozen=True, slots=True, eq=False)
class QuadraticFactors:
    """Quadratic approximations of the log-likelihoods of frames about their poses."""

    at: Floats
    """(T, 4)"""
    gradient: Floats
    """(T, 4) of the log-likelihood [nat/m, nat/rad]."""
    information: Floats
    """(T, 4, 4) minus the second derivative; 0: the frame was not expanded yet."""

    @classmethod
    def zeros(cls, poses: Floats) -> QuadraticFactors:
        """Make factors without information."""
        return cls(poses, np.zeros_like(poses), np.zeros((*poses.shape, 4)))

    def gain(self, poses: Floats) -> float:
        """Return the gain of the log-likelihood at poses (T, 4)."""
        off = poses - self.at
        off[:, 3] = wrap_angle(off[:, 3])
        pulled = self.gradient - 0.5 * np.einsum("tij,tj->ti", self.information, off)
        return float(np.sum(off * pulled))

    def with_rows(self, rows: NDArray[np.int64], other: QuadraticFactors) -> QuadraticFactors:
        """Return the factors with those of some frames (rows) replaced."""
        at, gradient, information = self.at.copy(), self.gradient.copy(), self.information.copy()
        at[rows], gradient[rows], information[rows] = other.at, other.gradient, other.information
        return QuadraticFactors(at, gradient, information)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of the frames of a window, and the scale of odometry errors."""

    poses: Floats
    """(T, 4)"""
    covariances: Floats
    """(T, 4, 4)"""
    scales: Floats
    """(4,) errors of odometry in units of the chain's deviations, the first three alike."""

    @classmethod
    def start(cls, chain: Chain, pose: Floats, spread: Floats) -> Trajectory:
        """Make a rigid trajectory through a pose (4,) of the last frame with deviations `spread` (4,)."""
        poses = chain.rigid(pose)
        variances = np.zeros_like(poses)
        variances[:-1] = np.cumsum((FIRST * chain.deviations[::-1]) ** 2, axis=0)[::-1]
        far = between(poses[-1:], poses)[:, :2]
        variances[:, :2] += (np.linalg.norm(far, axis=1) ** 2 * variances[:, 3])[:, None] / 4.0
        variances += spread**2
        return cls(poses, variances[:, :, None] * np.eye(4), np.full(4, FIRST))

    def cost(self, chain: Chain) -> float:
        """Return the negative log-likelihood of odometry [nat]."""
        if len(self.poses) < 2:
            return 0.0
        errors = _errors(chain, self.poses)[0] / (self.scales * chain.deviations)
        return float(0.5 * np.sum(errors**2))


def solve_trajectory(chain: Chain, trajectory: Trajectory, factors: QuadraticFactors) -> Trajectory:
    """Fit a trajectory to frames and odometry by one step of Gauss-Newton, and of EM for the scales."""
    count = len(trajectory.poses)
    off = trajectory.poses - factors.at
    off[:, 3] = wrap_angle(off[:, 3])
    g = np.einsum("tij,tj->ti", factors.information, off) - factors.gradient
    h = np.zeros((count, 4, count, 4))
    t = np.arange(count)
    h[t, :, t, :] = factors.information + np.diag(1.0 / _LOOSE**2)
    before, after = t[:-1], t[1:]
    errors, swung = _errors(chain, trajectory.poses)
    weights = 1.0 / (trajectory.scales * chain.deviations) ** 2
    pulled = np.swapaxes(swung, 1, 2) * weights[:, None]
    h[before, :, before, :] += pulled @ swung
    h[after, :, after, :] += weights[:, :, None] * np.eye(4)
    h[before, :, after, :] += pulled
    h[after, :, before, :] += np.swapaxes(pulled, 1, 2)
    g[:-1] += np.einsum("tij,tj->ti", pulled, errors)
    g[1:] += weights * errors
    whole = np.linalg.inv(h.reshape(4 * count, 4 * count)).reshape(count, 4, count, 4)
    moved = -np.tensordot(whole, g, axes=2)
    poses = trajectory.poses + moved
    poses[:, 3] = wrap_angle(poses[:, 3])
    scales = trajectory.scales
    if count > 1:
        left = errors + np.einsum("tij,tj->ti", swung, moved[:-1]) + moved[1:]
        crossed = swung @ whole[before, :, after, :]
        unsure = (
            np.einsum("tij,tjk,tik->ti", swung, whole[before, :, before, :], swung)
            + np.einsum("tii->ti", whole[after, :, after, :])
            + 2.0 * np.einsum("tii->ti", crossed)
        )
        scales = _scales((left**2 + unsure) / chain.deviations**2)
    return replace(
        trajectory,
        poses=poses,
        covariances=np.asarray(whole[t, :, t, :], np.float64),
        scales=scales,
    )


def _errors(chain: Chain, poses: Floats) -> tuple[Floats, Floats]:
    """Return errors (T - 1, 4) of the steps in map axes, and their derivatives by the pose before."""
    led = compose(poses[:-1], chain.steps)
    errors = poses[1:] - led
    errors[:, 3] = wrap_angle(errors[:, 3])
    swung = np.tile(-np.eye(4), (len(errors), 1, 1))
    # a turn of frame t swings the step from it
    swung[:, 0, 3] = led[:, 1] - poses[:-1, 1]
    swung[:, 1, 3] = poses[:-1, 0] - led[:, 0]
    return errors, swung


def _scales(squares: Floats) -> Floats:
    """Return the scales (4,) of errors by their expected squares (T - 1, 4)."""
    sums = np.array([*[squares[:, :3].mean(axis=1).sum()] * 3, squares[:, 3].sum()])
    variance = (_WITNESSES * USUAL**2 + sums) / (_WITNESSES + len(squares))
    return np.clip(np.sqrt(variance), *_SCALES)


GAIN = 10.0
"""Least gain of the log-likelihood by drift correction, for each frame of the level [nat]."""
_ROUNDS = 5
_SHRINK = 0.6
_WIDEST = 2.5
_HOPE = 3.0  # times what paraboloids foresee, which fall too steeply, may be gained


def correct_drift(window: Window, candidates: list[Fit], rng: Generator) -> list[Fit]:
    """Correct the drift of odometry in fits, if that gains clearly; best first.

    Rows *drift* and *steady drift* of docs/benchmarks/indoor.md.
    """
    if len(window) < 2:
        return candidates
    with time_stage(window.seconds, "correct_drift"):
        level = fit_level(window, FINE, rounds=_ROUNDS)
        top = candidates[0].log_likelihood
        near = sum(fit.log_likelihood > top - GAP for fit in candidates)
        # fits that fell behind early look nearer than they are
        values = [
            float(
                window.scorer.together(
                    fit.pose[None], level.views, between(fit.pose, fit.poses[level.rows])
                )[0]
            )
            for fit in candidates[:near]
        ]
        corrected = [
            _fit_trajectory(window.scorer, fit, level, rng)
            if value > max(values) - GAP
            else replace(fit, log_likelihood=value)
            for fit, value in zip(candidates, values, strict=False)
        ]
        gains = np.array(
            [
                f.log_likelihood - g.log_likelihood
                for f, g in zip(corrected, candidates, strict=False)
            ]
        )
        clear = GAIN * len(level.rows)
        if gains.max() < clear:
            return candidates
        # places that gain about alike stay as far from each other, and so do those not asked
        gains[gains > gains.max() - clear] = gains.max()
        gains = np.append(gains, np.full(len(candidates) - near, gains.max()))
        trajectories = [*corrected, *candidates[near:]]
        out = [
            replace(trajectory, log_likelihood=fit.log_likelihood + gain)
            for trajectory, fit, gain in zip(trajectories, candidates, gains.tolist(), strict=True)
        ]
        return sorted(out, key=lambda fit: -fit.log_likelihood)


def _fit_trajectory(scorer: Scorer, fit: Fit, level: FitLevel, rng: Generator) -> Fit:
    """Correct the drift of one fit.

    Sample each frame around its pose, solve the trajectory, and repeat closer, as long as a clear gain is
    possible.
    """
    chain, rows = level.chain, level.rows
    trajectory, spread = Trajectory.start(chain, fit.pose, fit.spread), fit.spread
    factors = QuadraticFactors.zeros(trajectory.poses)
    best = trajectory, -np.inf
    for _ in range(level.rounds):
        sd = np.sqrt(np.einsum("tii->ti", trajectory.covariances[rows]))
        wide = np.clip(sd, spread, _WIDEST * SPREAD)
        said, value = _expand_likelihoods(scorer, trajectory.poses[rows], wide, level.views, rng)
        value -= trajectory.cost(chain)
        if value > best[1]:
            best = trajectory, value
        factors = factors.with_rows(rows, said)
        trajectory = solve_trajectory(chain, trajectory, factors)
        hoped = best[1] + _HOPE * SOFT * factors.gain(trajectory.poses)
        if hoped - fit.log_likelihood < 0.5 * GAIN * len(rows):
            return replace(fit, log_likelihood=best[1])
        spread = np.maximum(_SHRINK * spread, NARROWEST)
    told_apart = zip(trajectory.poses[rows], level.views, strict=True)
    value = sum(float(scorer(pose[None], view)[0]) for pose, view in told_apart)
    value -= trajectory.cost(chain)
    if value < best[1]:
        trajectory, value = best
    covariance = WIDENED * (trajectory.covariances[-1] + FINEST)
    return replace(fit, poses=trajectory.poses, log_likelihood=value, covariance=covariance)


def _cell() -> Floats:
    """Return the corners (24, 4) of the 24-cell at distance 1, opposite ones 12 rows apart."""
    corners = [
        np.array(signs) @ np.eye(4)[list(axes)]
        for axes in itertools.combinations(range(4), 2)
        for signs in ((1, 1), (1, -1))
    ]
    return np.concatenate([corners, np.negative(corners)]) / np.sqrt(2.0)


_CELL = _cell()
"""Spherical design of strength 5: all directions weigh alike."""
_RADII = np.tile(np.repeat([1.2, 2.2], 6), 2)
_SQUARES = np.array([(i, j) for i in range(4) for j in range(i, 4)]).T
_RIDGE = 1e-3


def _expand_likelihoods(
    scorer: Scorer, poses: Floats, wide: Floats, views: Sequence[View], rng: Generator
) -> tuple[QuadraticFactors, float]:
    """Expand the log-likelihoods of frames about poses (L, 4), within `wide` (L, 4); and their sum [nat]."""
    turns, _ = np.linalg.qr(rng.normal(size=(len(poses), 4, 4)))
    shells = rng.permuted(np.tile(_RADII[:12], (len(poses), 1)), axis=1)
    shells = np.concatenate([shells, shells], axis=1)[:, :, None]
    u = np.concatenate([np.zeros((len(poses), 1, 4)), (_CELL @ turns) * shells], axis=1)
    drawn = poses[:, None] + u * wide[:, None]
    values = np.stack([scorer(p, v) for p, v in zip(drawn, views, strict=True)])
    gradient, information = _paraboloids(u, values / SOFT)
    factors = QuadraticFactors(
        poses, gradient / wide, information / (wide[:, :, None] * wide[:, None])
    )
    return factors, float(values[:, 0].sum())


def _paraboloids(u: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Fit paraboloids to values (L, S) at points (L, S, 4): gradients (L, 4), information (L, 4, 4) at 0.

    High values weigh more. No curvature is negative, or so small that the top lies beyond the samples.
    """
    i, j = _SQUARES
    basis = np.concatenate([np.ones((*values.shape, 1)), u, u[..., i] * u[..., j]], axis=2)
    below = values.max(axis=1, keepdims=True) - values
    weights = np.exp(-below / np.maximum(np.median(below, axis=1, keepdims=True), 1e-9))
    pulled = np.swapaxes(basis * weights[..., None], 1, 2)
    normal = pulled @ basis + _RIDGE * np.eye(basis.shape[2])
    found = np.linalg.solve(normal, (pulled @ values[..., None]))[..., 0]
    slope, fall = found[:, 1:5], np.zeros((len(u), 4, 4))
    fall[:, i, j] -= found[:, 5:]
    fall += np.swapaxes(fall, 1, 2)
    falls, axes = np.linalg.eigh(fall)
    along = np.einsum("lij,li->lj", axes, slope)
    falls = np.maximum(falls, np.maximum(0.5 * np.abs(along), 0.0))
    return slope, np.einsum("lij,lj,lkj->lik", axes, falls, axes)
