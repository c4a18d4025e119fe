"""Covariance of a pose that was fitted to a window, and exploration of its least certain direction.

The covariance after refinement is `placegraph.indoor.refine.fit.covariance`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Camera, Floats, between
from placegraph.indoor.likelihood.observe import COARSE, FINE
from placegraph.indoor.map.free_space import find_nearest_scene
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.pose.local_fit import (
    MERGED,
    SPREAD,
    Fit,
    fit_level,
    fit_pose,
    merge_fits,
    probabilities,
)
from placegraph.indoor.pose.window import Chain, Window, time_stage

TILT = 0.006
"""Standard deviation of the tilt that gravity gives [rad]: a third of a degree, as of a phone."""
FITTED = [0, 1, 2, 5]
"""Rows of a pose's covariance that are fitted: x, y, z, and the turn about the vertical."""
LEAST = 0.003
"""No map is truer than this [m]."""
DRIFT = 0.018
"""Error of a map where no camera made it: a random walk from the nearest one [m per root of a metre]."""
UPRIGHT = 0.5
"""Share of the error that goes into height: floors and table tops agree better than walls."""
_LEVER = 2.0  # distance over which the map's error turns a pose [m]


def map_error(scene: Scene, position: Floats) -> float:
    """Return the standard deviation [m] of a map as seen from a position (3,), common to all frames.

    The poses by which a map was made drift, so that it is truest near its own cameras. Meshes do not say
    where these were: `LEAST`.
    """
    of, _ = find_nearest_scene(scene, scene.viewpoints[:, :2])
    own = scene.viewpoints[of == scene.scene_at(position[:2])]
    away = np.linalg.norm(own - position, axis=1).min(initial=np.inf)
    return float(np.hypot(LEAST, DRIFT * np.sqrt(away))) if np.isfinite(away) else LEAST


def common_covariance(shift: float, turn: float, tilt: float = 0.0) -> Floats:
    """Return the covariance (6, 6) of an error of all frames: deviations [m], [rad], [rad]."""
    return np.diag(np.square([shift, shift, UPRIGHT * shift, tilt, tilt, turn]))


def pose_covariance(fit_covariance: Floats, error: float = LEAST) -> Floats:
    """Return the covariance (6, 6) of x, y, z and a turn about the map's axes.

    `fit_covariance`: (4, 4) of the fit; `error`: of the map, as of `map_error`.
    """
    whole = common_covariance(error, error / _LEVER, TILT)
    whole[np.ix_(FITTED, FITTED)] += fit_covariance
    return whole


def least_certain(covariance: Floats) -> tuple[float, Floats]:
    """Return the largest standard deviation [m] of a position and its direction, a unit vector (3,)."""
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    return float(np.sqrt(variances[-1])), axes[:, -1]


def bound_covariance(covariance: Floats, coarse: Floats, shift: Floats) -> Floats:
    """Return a covariance (6, 6) that is in no direction looser than that of the coarse pose.

    `shift`: way (3,) from the coarse pose [m]. Labels may hold a coarse pose where depth leaves it free.
    """
    known = coarse.copy()
    known[:3, :3] += np.outer(shift, shift)
    root = np.linalg.cholesky(known)
    white = np.linalg.solve(root, np.linalg.solve(root, covariance).T)
    ratios, axes = np.linalg.eigh(white)
    axes = root @ axes
    return np.asarray((axes * np.minimum(ratios, 1.0)) @ axes.T)


_PROBES = np.stack(np.meshgrid([0.1, 0.3, 0.5, 0.7, 0.9], [0.1, 0.3, 0.5, 0.7, 0.9]), axis=-1)
"""Image points whose distance is measured [width, height]."""


def lens_covariance(scene: Scene, camera: Camera, matrix: Floats) -> Floats:
    """Return the covariance (3, 3) [m^2] of the position of a map_from_camera by its `focal_error`.

    A camera whose focal length is off by a share seems to stand off by that share of the distance of what
    it sees, along its optical axis.
    """
    if not camera.focal_error:
        return np.zeros((3, 3))
    rays = camera.directions(_PROBES.reshape(-1, 2) * (camera.width, camera.height))
    rays = rays[np.isfinite(rays).all(axis=1)] @ matrix[:3, :3].T
    distance = scene.caster.cast(np.broadcast_to(matrix[:3, 3], rays.shape), rays).distance
    seen = distance[np.isfinite(distance)]
    off = camera.focal_error * (float(np.median(seen)) if len(seen) else 0.0) * matrix[:3, 2]
    return np.outer(off, off)


FIRM = 0.03
"""Deviation [m] below which a pose is not probed."""
_SLIDES = np.linspace(-1.2, 1.2, 49)
"""Offsets of the best pose along its least certain direction [m]."""
_AROUND, _DRAWS = np.array([0.02, 0.02, 0.02, 0.01]), 12
"""Deviations [m, rad] of the draws about each offset, and their number: the best pose was drawn, too."""
_RIVAL = 0.003
"""Least share of an offset that is fitted as a rival."""


def _probe_direction(window: Window, fit: Fit, rng: Generator) -> tuple[Fit, Floats | None]:
    """Widen the covariance of a fit along its least certain direction, and return a rival pose (4,) there."""
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
    """Return the best poses (S, 4) about each offset along an axis (3,), and their shares (S,)."""
    judging, looked = window.judging, window.newest
    views, steps = [judging.views(COARSE)[i] for i in looked], between(fit.pose, fit.poses[looked])
    drawn = rng.normal(size=(len(_SLIDES), _DRAWS, 4)) * _AROUND
    drawn[:, 0] = 0.0
    drawn += (fit.pose + _SLIDES[:, None] * np.append(axis, 0.0))[:, None]
    logs = judging.scorer.together(drawn.reshape(-1, 4), views, steps).reshape(drawn.shape[:2])
    best = np.arange(len(_SLIDES)), logs.argmax(axis=1)
    temperature = judging.scorer.model.compute_temperature(views)
    return drawn[best], probabilities(logs[best], temperature)


def explore_unobservable(window: Window, candidates: list[Fit], rng: Generator) -> list[Fit]:
    """Probe the best fit along its least certain direction, and add the best rival there; best first."""
    with time_stage(window.seconds, "polish"):
        candidates = merge_fits(candidates)  # bending may have brought some together
        best, other = _probe_direction(window, candidates[0], rng)
        candidates = [best, *candidates[1:]]
        if other is None:
            return candidates
        chain = Chain.of(best.poses, window.options.motion)
        level = replace(fit_level(window, FINE, rounds=4), chain=chain)
        along = between(best.pose, best.poses[level.rows])
        value = float(window.scorer.together(best.pose[None], level.views, along)[0])
        rival = fit_pose(window.scorer, other, SPREAD, level, rng)
        gain = rival.log_likelihood - value
        rival = replace(rival, log_likelihood=best.log_likelihood + gain)
        if gain > 0.0:
            rival, _ = _probe_direction(window, rival, rng)
        return merge_fits([*candidates, rival])
