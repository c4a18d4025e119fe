"""The course of a window bent to what its frames see: drift is estimated, not assumed away.

A polished fit believes odometry. Here each frame is sampled around its own pose, what it says becomes a
paraboloid, and the paraboloids and the odometry between them, which may drift, are one small linear
problem (`chain`). A course is bent only where that explains the frames clearly better: where odometry is
good nothing changes, and places that look alike stay alike.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats, between
from placegraph.indoor.likelihood.observe import FINE
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.likelihood.view import View
from placegraph.indoor.pose.chain import Course, Told, bent
from placegraph.indoor.pose.covariance import WIDENED
from placegraph.indoor.pose.polish import (
    FINEST,
    GAP,
    NARROWEST,
    SOFT,
    SPREAD,
    Fit,
    Round,
    round_of,
)
from placegraph.indoor.pose.window import Window, timed

GAIN = 10.0
"""Log-likelihood that bending must gain for each frame looked at [nat]."""
_ROUNDS = 5
_SHRINK = 0.6
_WIDEST = 2.5
_HOPE = 3.0  # times what paraboloids foresee, which fall too steeply, may be gained


def bend(window: Window, fits: list[Fit], rng: Generator) -> list[Fit]:
    """Fits whose courses follow the drift of odometry, where there is any; best first."""
    if len(window) < 2:
        return fits
    with timed(window.seconds, "bend"):
        level = round_of(window, FINE, rounds=_ROUNDS)
        top = fits[0].log_likelihood
        near = sum(fit.log_likelihood > top - GAP for fit in fits)
        # fits that fell behind early look nearer than they are
        values = [_value(window.scorer, fit, level) for fit in fits[:near]]
        followed = [
            _followed(window.scorer, fit, level, rng)
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


def _value(scorer: Scorer, fit: Fit, level: Round) -> float:
    """Log-likelihood of a fit as it is [nat]."""
    steps = between(fit.pose, fit.poses[level.rows])
    return float(scorer.together(fit.pose[None], level.views, steps)[0])


def _followed(scorer: Scorer, fit: Fit, level: Round, rng: Generator) -> Fit:
    """The fit bent.

    Each frame is asked around where it is thought to be, the course is bent, and again, closer; no
    longer than a clear gain is in sight.
    """
    chain, rows = level.chain, level.rows
    course, spread = Course.start(chain, fit.pose, fit.spread), fit.spread
    told = Told.nothing(course.poses)
    best = course, -np.inf
    for _ in range(level.rounds):
        sd = np.sqrt(np.einsum("tii->ti", course.covariances[rows]))
        wide = np.clip(sd, spread, _WIDEST * SPREAD)
        said, value = _asked(scorer, course.poses[rows], wide, level.views, rng)
        value -= course.cost(chain)
        if value > best[1]:
            best = course, value
        told = told.learned(rows, said)
        course = bent(chain, course, told)
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


def _asked(
    scorer: Scorer, poses: Floats, wide: Floats, views: Sequence[View], rng: Generator
) -> tuple[Told, float]:
    """What frames at poses (L, 4) say within about `wide` (L, 4) of them, and of the poses [nat]."""
    turns, _ = np.linalg.qr(rng.normal(size=(len(poses), 4, 4)))
    shells = rng.permuted(np.tile(_RADII[:12], (len(poses), 1)), axis=1)
    shells = np.concatenate([shells, shells], axis=1)[:, :, None]
    u = np.concatenate([np.zeros((len(poses), 1, 4)), (_CELL @ turns) * shells], axis=1)
    drawn = poses[:, None] + u * wide[:, None]
    values = np.stack([scorer(p, v) for p, v in zip(drawn, views, strict=True)])
    gradient, information = _paraboloids(u, values / SOFT)
    told = Told(poses, gradient / wide, information / (wide[:, :, None] * wide[:, None]))
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
