"""Covariance of a fitted pose, widened along directions that nothing observes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats, between
from placegraph.indoor.likelihood.observe import COARSE, FINE
from placegraph.indoor.pose.local_fit import (
    MERGED,
    SPREAD,
    WIDENED,
    Fit,
    fit_level,
    fit_pose,
    merge_fits,
    probabilities,
)
from placegraph.indoor.pose.window import Chain, Window, timed

TILT = 0.006
"""Standard deviation of the tilt that gravity gives [rad]: a third of a degree, as of a phone."""
FITTED = [0, 1, 2, 5]
"""What is fitted of x, y, z, and a turn about the map's axes."""


def pose_covariance(fitted: Floats) -> Floats:
    """Return the covariance (6, 6) of x, y, z and a turn about the map's axes from that of a fit (4, 4)."""
    whole = np.diag([0.0, 0.0, 0.0, WIDENED * TILT**2, WIDENED * TILT**2, 0.0])
    whole[np.ix_(FITTED, FITTED)] = fitted
    return whole


def least_certain(covariance: Floats) -> tuple[float, Floats]:
    """Return the largest standard deviation [m] of a position and its direction, a unit vector (3,)."""
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    return float(np.sqrt(variances[-1])), axes[:, -1]


FIRM = 0.03
"""A pose known to this [m] in all directions is not probed."""
_SLIDES = np.linspace(-1.2, 1.2, 49)
"""How far the best pose is moved [m]."""
_AROUND, _DRAWS = np.array([0.02, 0.02, 0.02, 0.01]), 12
"""Deviations [m, rad] about each step, and draws there: the best pose was the luckiest of many, too."""
_RIVAL = 0.003
"""Share from which on a place along the way is fitted."""


def _probe_direction(window: Window, fit: Fit, rng: Generator) -> tuple[Fit, Floats | None]:
    """The fit, as uncertain as sliding it shows, and where else (4,) it is likeliest to stand."""
    sd, axis = least_certain(fit.covariance)
    if sd < FIRM:
        return fit, None
    poses, shares = _along(window, fit, axis, rng)
    more = max(0.0, float(shares @ _SLIDES**2) - sd**2)
    covariance = fit.covariance.copy()
    covariance[:3, :3] += more * np.outer(axis, axis)
    away = np.where(np.abs(_SLIDES) > MERGED["apart"], shares, 0.0)
    rival = poses[away.argmax()] if away.max() > _RIVAL else None
    return replace(fit, covariance=covariance), rival


def _along(window: Window, fit: Fit, axis: Floats, rng: Generator) -> tuple[Floats, Floats]:
    """Best poses (S, 4) about each step along an axis (3,), and the share (S,) of each."""
    judging, looked = window.judging, window.newest
    views, steps = [judging.views(COARSE)[i] for i in looked], between(fit.pose, fit.poses[looked])
    drawn = rng.normal(size=(len(_SLIDES), _DRAWS, 4)) * _AROUND
    drawn[:, 0] = 0.0
    drawn += (fit.pose + _SLIDES[:, None] * np.append(axis, 0.0))[:, None]
    logs = judging.scorer.together(drawn.reshape(-1, 4), views, steps).reshape(drawn.shape[:2])
    best = np.arange(len(_SLIDES)), logs.argmax(axis=1)
    heat = judging.scorer.model.heat(views)
    return drawn[best], probabilities(logs[best], heat)


def explore_unobservable(window: Window, fits: list[Fit], rng: Generator) -> list[Fit]:
    """Fits, best first, with what fits next to the best along the direction in which it is least known."""
    with timed(window.seconds, "polish"):
        fits = merge_fits(fits)  # bending may have brought some together
        best, other = _probe_direction(window, fits[0], rng)
        fits = [best, *fits[1:]]
        if other is None:
            return fits
        chain = Chain.of(best.poses, window.options.motion)
        level = replace(fit_level(window, FINE, rounds=4), chain=chain)
        along = between(best.pose, best.poses[level.rows])
        value = float(window.scorer.together(best.pose[None], level.views, along)[0])
        rival = fit_pose(window.scorer, other, SPREAD, level, rng)
        gain = rival.log_likelihood - value
        rival = replace(rival, log_likelihood=best.log_likelihood + gain)
        if gain > 0.0:
            rival, _ = _probe_direction(window, rival, rng)
        return merge_fits([*fits, rival])
