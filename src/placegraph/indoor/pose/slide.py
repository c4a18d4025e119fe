"""Directions that nothing holds: a pose is slid along the one least known, and rivals lie there.

A fit tells of the next hand's breadth. Where few surfaces and colours hold it, as height before a bare
wall, what fits as well a metre further on would be missed, and a narrow covariance believed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats, between
from placegraph.indoor.likelihood.observe import COARSE, FINE
from placegraph.indoor.pose.chain import Chain
from placegraph.indoor.pose.covariance import least_certain
from placegraph.indoor.pose.polish import (
    MERGED,
    SPREAD,
    Fit,
    probabilities,
    refine,
    round_of,
    told_apart,
)
from placegraph.indoor.pose.window import Window, timed

FIRM = 0.03
"""A pose known to this [m] in all directions is not slid."""
_SLIDES = np.linspace(-1.2, 1.2, 49)
"""How far the best pose is moved [m]."""
_AROUND, _DRAWS = np.array([0.02, 0.02, 0.02, 0.01]), 12
"""Deviations [m, rad] about each step, and draws there: the best pose was the luckiest of many, too."""
_RIVAL = 0.003
"""Share from which on a place along the way is fitted."""


def slid(window: Window, fit: Fit, rng: Generator) -> tuple[Fit, Floats | None]:
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


def freed(window: Window, fits: list[Fit], rng: Generator) -> list[Fit]:
    """Fits, best first, with what fits next to the best along the direction in which it is least known."""
    if window.options.answer == "mle":
        return fits
    with timed(window.seconds, "polish"):
        fits = told_apart(fits)  # bending may have brought some together
        best, other = slid(window, fits[0], rng)
        fits = [best, *fits[1:]]
        if other is None:
            return fits
        chain = Chain.of(best.poses, window.options.motion)
        level = replace(round_of(window, FINE, rounds=4), chain=chain)
        along = between(best.pose, best.poses[level.rows])
        value = float(window.scorer.together(best.pose[None], level.views, along)[0])
        rival = refine(window.scorer, other, SPREAD, level, rng)
        gain = rival.log_likelihood - value
        rival = replace(rival, log_likelihood=best.log_likelihood + gain)
        if gain > 0.0:
            rival, _ = slid(window, rival, rng)
        return told_apart([*fits, rival])
