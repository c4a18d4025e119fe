"""Directions that nothing holds: a pose is slid along the one least known, and rivals lie there.

A fit tells of the next hand's breadth. Where few surfaces and colours hold it, as height before a bare
wall, what fits as well a metre further on would be missed, and a narrow covariance believed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.geometry import between, compose
from placegraph.indoor.likelihood.observe import FINE
from placegraph.indoor.pose.chain import Chain
from placegraph.indoor.pose.polish import (
    MERGED,
    SPREAD,
    probabilities,
    refine,
    round_of,
    told_apart,
)
from placegraph.indoor.pose.window import timed

if TYPE_CHECKING:
    from numpy.random import Generator

    from placegraph.geometry import Floats
    from placegraph.indoor.pose.polish import Fit
    from placegraph.indoor.pose.window import Window

FIRM = 0.05
"""A pose known to this [m] in all directions is not slid."""
_SLIDES = np.linspace(-1.2, 1.2, 49)
"""How far the best pose is moved [m]."""
_RIVAL = 0.003
"""Share from which on a place along the way is fitted."""


def least_known(covariance: Floats) -> tuple[float, Floats]:
    """Standard deviation [m] and unit vector (3,) of the direction that holds a position least."""
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    return float(np.sqrt(variances[-1])), axes[:, -1]


def slid(window: Window, fit: Fit) -> tuple[Fit, list[Fit]]:
    """The fit, as uncertain as sliding it shows, and where else it could stand, likeliest first."""
    sd, axis = least_known(fit.covariance)
    if sd < FIRM:
        return fit, []
    judging, looked = window.judging, window.newest
    poses = fit.pose + _SLIDES[:, None] * np.append(axis, 0.0)
    views = [judging.views(FINE)[i] for i in looked]
    logs = judging.scorer.together(poses, views, between(fit.pose, fit.poses[looked]))
    depth = any(window.sightings[i].depth is not None for i in looked)
    shares = probabilities(logs, judging.scorer.model.heat(len(looked), depth=depth))
    more = max(0.0, float(shares @ _SLIDES**2) - sd**2)
    covariance = fit.covariance.copy()
    covariance[:3, :3] += more * np.outer(axis, axis)
    fit = replace(fit, covariance=covariance)
    around = np.pad(shares, 1)
    peaks = (shares >= np.maximum(around[:-2], around[2:])) & (shares > _RIVAL)
    away = np.flatnonzero(peaks & (np.abs(_SLIDES) > MERGED["apart"]))
    away = away[np.argsort(-shares[away], kind="stable")]
    steps = between(fit.pose, fit.poses)
    return fit, [replace(fit, poses=compose(pose, steps)) for pose in poses[away]]


def freed(window: Window, fits: list[Fit], rng: Generator) -> list[Fit]:
    """Fits, best first, with what fits next to the best along the direction in which it is least known."""
    if window.options.answer == "mle":
        return fits
    with timed(window.seconds, "polish"):
        fits = told_apart(fits)  # bending may have brought some together
        best, others = slid(window, fits[0])
        fits = [best, *fits[1:]]
        if not others:
            return fits
        chain = Chain.of(others[0].poses, window.options.motion)
        level = replace(round_of(window, FINE, rounds=4), chain=chain)
        along = between(best.pose, best.poses[level.rows])
        value = float(window.scorer.together(best.pose[None], level.views, along)[0])
        rival = refine(window.scorer, others[0].pose, SPREAD, level, rng)
        gain = rival.log_likelihood - value
        rival = replace(rival, log_likelihood=best.log_likelihood + gain)
        if gain > 0.0:
            rival, _ = slid(window, rival)
        return told_apart([*fits, rival])
