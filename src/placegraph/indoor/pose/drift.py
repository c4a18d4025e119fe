"""Drift correction: frames and odometry, which may err, as one chain of poses."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, between, compose, wrap_angle
from placegraph.indoor.likelihood.observe import FINE, View
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.pose.local_fit import (
    FINEST,
    GAP,
    NARROWEST,
    SOFT,
    SPREAD,
    WIDENED,
    Fit,
    FitLevel,
    fit_level,
)
from placegraph.indoor.pose.window import Chain, Window, timed

USUAL = 0.25
"""Errors of odometry, in units of the noise that is allowed for, that are expected beforehand ..."""
_WITNESSES = 10.0  # ... as if so many steps had shown them
FIRST = 2.0
"""Errors that a fit starts with: it is easier to stiffen a chain than to loosen it."""
_SCALES = (0.1, 12.0)
_LOOSE = np.array([1.0, 1.0, 1.0, 0.5])  # m, rad: what nothing holds stays where it is


@dataclass(frozen=True, slots=True, eq=False)
class QuadraticFactors:
    """What frames say of their own poses: log-likelihoods, quadratic about some pose."""

    at: Floats
    """(T, 4)"""
    gradient: Floats
    """(T, 4) of the log-likelihood [nat/m, nat/rad]."""
    information: Floats
    """(T, 4, 4) minus its second derivative; 0: the frame has said nothing yet."""

    @classmethod
    def nothing(cls, poses: Floats) -> QuadraticFactors:
        """Before any frame has been asked."""
        return cls(poses, np.zeros_like(poses), np.zeros((*poses.shape, 4)))

    def gain(self, poses: Floats) -> float:
        """What poses (T, 4) gain by it."""
        off = poses - self.at
        off[:, 3] = wrap_angle(off[:, 3])
        pulled = self.gradient - 0.5 * np.einsum("tij,tj->ti", self.information, off)
        return float(np.sum(off * pulled))

    def learned(self, rows: NDArray[np.int64], other: QuadraticFactors) -> QuadraticFactors:
        """With what some frames (rows) say now instead of what they said before."""
        at, gradient, information = self.at.copy(), self.gradient.copy(), self.information.copy()
        at[rows], gradient[rows], information[rows] = other.at, other.gradient, other.information
        return QuadraticFactors(at, gradient, information)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of the frames of a window, and how far odometry was wrong."""

    poses: Floats
    """(T, 4)"""
    covariances: Floats
    """(T, 4, 4)"""
    scales: Floats
    """(4,) errors of odometry in units of the chain's deviations, the first three alike."""

    @classmethod
    def start(cls, chain: Chain, pose: Floats, spread: Floats) -> Trajectory:
        """A rigid course through a pose (4,) of the last frame that is known to `spread` (4,)."""
        poses = chain.rigid(pose)
        variances = np.zeros_like(poses)
        variances[:-1] = np.cumsum((FIRST * chain.deviations[::-1]) ** 2, axis=0)[::-1]
        far = between(poses[-1:], poses)[:, :2]
        variances[:, :2] += (np.linalg.norm(far, axis=1) ** 2 * variances[:, 3])[:, None] / 4.0
        variances += spread**2
        return cls(poses, variances[:, :, None] * np.eye(4), np.full(4, FIRST))

    def cost(self, chain: Chain) -> float:
        """What its departure from odometry costs [nat]."""
        if len(self.poses) < 2:
            return 0.0
        errors = _errors(chain, self.poses)[0] / (self.scales * chain.deviations)
        return float(0.5 * np.sum(errors**2))


def solve_trajectory(chain: Chain, course: Trajectory, told: QuadraticFactors) -> Trajectory:
    """The course that frames and odometry agree on best: one step of Gauss-Newton, and of EM."""
    count = len(course.poses)
    off = course.poses - told.at
    off[:, 3] = wrap_angle(off[:, 3])
    g = np.einsum("tij,tj->ti", told.information, off) - told.gradient
    h = np.zeros((count, 4, count, 4))
    t = np.arange(count)
    h[t, :, t, :] = told.information + np.diag(1.0 / _LOOSE**2)
    before, after = t[:-1], t[1:]
    errors, swung = _errors(chain, course.poses)
    weights = 1.0 / (course.scales * chain.deviations) ** 2
    pulled = np.swapaxes(swung, 1, 2) * weights[:, None]
    h[before, :, before, :] += pulled @ swung
    h[after, :, after, :] += weights[:, :, None] * np.eye(4)
    h[before, :, after, :] += pulled
    h[after, :, before, :] += np.swapaxes(pulled, 1, 2)
    g[:-1] += np.einsum("tij,tj->ti", pulled, errors)
    g[1:] += weights * errors
    whole = np.linalg.inv(h.reshape(4 * count, 4 * count)).reshape(count, 4, count, 4)
    moved = -np.tensordot(whole, g, axes=2)
    poses = course.poses + moved
    poses[:, 3] = wrap_angle(poses[:, 3])
    scales = course.scales
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
        course, poses=poses, covariances=np.asarray(whole[t, :, t, :], np.float64), scales=scales
    )


def _errors(chain: Chain, poses: Floats) -> tuple[Floats, Floats]:
    """Errors (T - 1, 4) of the steps in map axes, and their derivatives by the pose before."""
    led = compose(poses[:-1], chain.steps)
    errors = poses[1:] - led
    errors[:, 3] = wrap_angle(errors[:, 3])
    swung = np.tile(-np.eye(4), (len(errors), 1, 1))
    # a turn of frame t swings the step from it
    swung[:, 0, 3] = led[:, 1] - poses[:-1, 1]
    swung[:, 1, 3] = poses[:-1, 0] - led[:, 0]
    return errors, swung


def _scales(squares: Floats) -> Floats:
    """Scales (4,) of errors by their expected squares (T - 1, 4)."""
    sums = np.array([*[squares[:, :3].mean(axis=1).sum()] * 3, squares[:, 3].sum()])
    variance = (_WITNESSES * USUAL**2 + sums) / (_WITNESSES + len(squares))
    return np.clip(np.sqrt(variance), *_SCALES)


GAIN = 10.0
"""Log-likelihood that bending must gain for each frame looked at [nat]."""
_ROUNDS = 5
_SHRINK = 0.6
_WIDEST = 2.5
_HOPE = 3.0  # times what paraboloids foresee, which fall too steeply, may be gained


def correct_drift(window: Window, fits: list[Fit], rng: Generator) -> list[Fit]:
    """Fits whose courses follow the drift of odometry, where there is any; best first."""
    if len(window) < 2:
        return fits
    with timed(window.seconds, "correct_drift"):
        level = fit_level(window, FINE, rounds=_ROUNDS)
        top = fits[0].log_likelihood
        near = sum(fit.log_likelihood > top - GAP for fit in fits)
        # fits that fell behind early look nearer than they are
        values = [_log_likelihood(window.scorer, fit, level) for fit in fits[:near]]
        followed = [
            _fit_trajectory(window.scorer, fit, level, rng)
            if value > max(values) - GAP
            else replace(fit, log_likelihood=value)
            for fit, value in zip(fits, values, strict=False)
        ]
        gains = np.array(
            [f.log_likelihood - g.log_likelihood for f, g in zip(followed, fits, strict=False)]
        )
        clear = GAIN * len(level.rows)
        if gains.max() < clear:
            return fits
        # places that gain about alike stay as far from each other, and so do those not asked
        gains[gains > gains.max() - clear] = gains.max()
        gains = np.append(gains, np.full(len(fits) - near, gains.max()))
        courses = [*followed, *fits[near:]]
        out = [
            replace(course, log_likelihood=fit.log_likelihood + gain)
            for course, fit, gain in zip(courses, fits, gains.tolist(), strict=True)
        ]
        return sorted(out, key=lambda fit: -fit.log_likelihood)


def _log_likelihood(scorer: Scorer, fit: Fit, level: FitLevel) -> float:
    """Log-likelihood of a fit as it is [nat]."""
    steps = between(fit.pose, fit.poses[level.rows])
    return float(scorer.together(fit.pose[None], level.views, steps)[0])


def _fit_trajectory(scorer: Scorer, fit: Fit, level: FitLevel, rng: Generator) -> Fit:
    """Return the fit with drift corrected.

    Each frame is sampled around its pose, the trajectory is solved, and again, closer; no longer than a
    clear gain is in sight.
    """
    chain, rows = level.chain, level.rows
    course, spread = Trajectory.start(chain, fit.pose, fit.spread), fit.spread
    told = QuadraticFactors.nothing(course.poses)
    best = course, -np.inf
    for _ in range(level.rounds):
        sd = np.sqrt(np.einsum("tii->ti", course.covariances[rows]))
        wide = np.clip(sd, spread, _WIDEST * SPREAD)
        said, value = _expand_likelihoods(scorer, course.poses[rows], wide, level.views, rng)
        value -= course.cost(chain)
        if value > best[1]:
            best = course, value
        told = told.learned(rows, said)
        course = solve_trajectory(chain, course, told)
        hoped = best[1] + _HOPE * SOFT * told.gain(course.poses)
        if hoped - fit.log_likelihood < 0.5 * GAIN * len(rows):
            return replace(fit, log_likelihood=best[1])
        spread = np.maximum(_SHRINK * spread, NARROWEST)
    told_apart = zip(course.poses[rows], level.views, strict=True)
    value = sum(float(scorer(pose[None], view)[0]) for pose, view in told_apart)
    value -= course.cost(chain)
    if value < best[1]:
        course, value = best
    covariance = WIDENED * (course.covariances[-1] + FINEST)
    return replace(fit, poses=course.poses, log_likelihood=value, covariance=covariance)


def _cell() -> Floats:
    """(24, 4) corners of the 24-cell at distance 1, opposite ones 12 rows apart."""
    corners = [
        np.array(signs) @ np.eye(4)[list(axes)]
        for axes in itertools.combinations(range(4), 2)
        for signs in ((1, 1), (1, -1))
    ]
    return np.concatenate([corners, np.negative(corners)]) / np.sqrt(2.0)


_CELL = _cell()
"""A design that weighs all directions alike, to the fifth order."""
_RADII = np.tile(np.repeat([1.2, 2.2], 6), 2)
_SQUARES = np.array([(i, j) for i in range(4) for j in range(i, 4)]).T
_RIDGE = 1e-3


def _expand_likelihoods(
    scorer: Scorer, poses: Floats, wide: Floats, views: Sequence[View], rng: Generator
) -> tuple[QuadraticFactors, float]:
    """What frames at poses (L, 4) say within about `wide` (L, 4) of them, and of the poses [nat]."""
    turns, _ = np.linalg.qr(rng.normal(size=(len(poses), 4, 4)))
    shells = rng.permuted(np.tile(_RADII[:12], (len(poses), 1)), axis=1)
    shells = np.concatenate([shells, shells], axis=1)[:, :, None]
    u = np.concatenate([np.zeros((len(poses), 1, 4)), (_CELL @ turns) * shells], axis=1)
    drawn = poses[:, None] + u * wide[:, None]
    values = np.stack([scorer(p, v) for p, v in zip(drawn, views, strict=True)])
    gradient, information = _paraboloids(u, values / SOFT)
    told = QuadraticFactors(
        poses, gradient / wide, information / (wide[:, :, None] * wide[:, None])
    )
    return told, float(values[:, 0].sum())


def _paraboloids(u: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Slopes (L, 4) and falls (L, 4, 4) at 0 of values (L, S) at points (L, S, 4), high ones first.

    No fall is negative, and none so small that the top would lie beyond the samples.
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
