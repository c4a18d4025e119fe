"""Frames as a chain: what each says of its own pose, and odometry, which may err, of the steps between.

Drift is not assumed away, and not assumed to be there. How much the odometry of a window errs is a
variance component: expectation and maximisation by turns find the poses, given how far steps may be
wrong, and how wrong the steps were, given the poses. Where odometry is good the chain is all but a
rigid rig; where it drifts, frames that see enough go their own way and take the others along.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, between, compose, wrap
from placegraph.indoor.options import MotionNoise
from placegraph.indoor.pose.motion import deviations

USUAL = 0.25
"""Errors of odometry, in units of the noise that is allowed for, that are expected beforehand ..."""
_WITNESSES = 10.0  # ... as if so many steps had shown them
FIRST = 2.0
"""Errors that a fit starts with: it is easier to stiffen a chain than to loosen it."""
_SCALES = (0.1, 12.0)
_LOOSE = np.array([1.0, 1.0, 1.0, 0.5])  # m, rad: what nothing holds stays where it is


@dataclass(frozen=True, eq=False)
class Chain:
    """Odometry of the T frames of a window."""

    poses: Floats
    """(T, 4) level poses in odometry's own frame."""
    deviations: Floats
    """(T - 1, 4) standard deviations of the steps between, in units of which errors are measured."""

    @classmethod
    def of(cls, poses: Floats, noise: MotionNoise) -> Chain:
        """Chain of level odometry (T, 4)."""
        return cls(poses, deviations(between(poses[:-1], poses[1:]), noise))

    @cached_property
    def steps(self) -> Floats:
        """(T - 1, 4) from each frame to the next."""
        return between(self.poses[:-1], self.poses[1:])

    def rigid(self, pose: Floats) -> Floats:
        """Poses (T, 4) of all frames if odometry were right, from that of the last (4,)."""
        return compose(pose, between(self.poses[-1], self.poses))


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What frames say of their own poses: log-likelihoods, quadratic about some pose."""

    at: Floats
    """(T, 4)"""
    gradient: Floats
    """(T, 4) of the log-likelihood [nat/m, nat/rad]."""
    information: Floats
    """(T, 4, 4) minus its second derivative; 0: the frame has said nothing yet."""

    @classmethod
    def nothing(cls, poses: Floats) -> Told:
        """Before any frame has been asked."""
        return cls(poses, np.zeros_like(poses), np.zeros((*poses.shape, 4)))

    def gain(self, poses: Floats) -> float:
        """What poses (T, 4) gain by it."""
        off = poses - self.at
        off[:, 3] = wrap(off[:, 3])
        pulled = self.gradient - 0.5 * np.einsum("tij,tj->ti", self.information, off)
        return float(np.sum(off * pulled))

    def learned(self, rows: NDArray[np.int64], other: Told) -> Told:
        """With what some frames (rows) say now instead of what they said before."""
        at, gradient, information = self.at.copy(), self.gradient.copy(), self.information.copy()
        at[rows], gradient[rows], information[rows] = other.at, other.gradient, other.information
        return Told(at, gradient, information)


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """Poses of the frames of a window, and how far odometry was wrong."""

    poses: Floats
    """(T, 4)"""
    covariances: Floats
    """(T, 4, 4)"""
    scales: Floats
    """(4,) errors of odometry in units of the chain's deviations, the first three alike."""

    @classmethod
    def start(cls, chain: Chain, pose: Floats, spread: Floats) -> Course:
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


def bent(chain: Chain, course: Course, told: Told) -> Course:
    """The course that frames and odometry agree on best: one step of Gauss-Newton, and of EM."""
    count = len(course.poses)
    off = course.poses - told.at
    off[:, 3] = wrap(off[:, 3])
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
    poses[:, 3] = wrap(poses[:, 3])
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
    errors[:, 3] = wrap(errors[:, 3])
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
