"""What is unknown of the camera beside the poses: focal lengths, gravity, and scale, time and place of depth.

Gauss-Newton as in `solve`, whose normal equations of all poses are bordered by what the frames have in
common. Depth tells its scale (it grows along the rays) from its focal length (it grows across them);
matches of images tell theirs; and both together tell where, and when, depth was read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.core.geometry import Floats, cross_matrix, rotation_from_vector
from placegraph.core.threads import product
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.refine.fit import (
    POINTS,
    READINGS,
    Problem,
    add_beliefs,
    leaning,
    twists,
    usual_lag,
)

if TYPE_CHECKING:
    from placegraph.indoor.refine.correspondences import Readings, Sights

SCALE, FOCAL, IMAGE, TIME = range(4)
"""Unknowns: logarithms of the factors on depth readings, on the depth camera's focal length and on
that of the images; what depth lags by (`lag`), which is always free."""
PLACE = (4, 5, 6, 7, 8, 9)
"""Shift [m] and turn [rad] of the depth camera, in the axes of the camera."""
TILT = (10, 11, 12)
"""Turn [rad] of gravity, in the axes of the camera: an accelerometer that is mounted aslant."""
COUNT = 13
BEFORE = np.array([0.15, 0.15, 0.15, np.nan, *(0.1,) * 9])
"""Standard deviations of the unknowns before anything is seen; of lags `lag.usual_lag`."""
WIDTHS = (10.0, 10.0, 6.0, 6.0, 4.0, 4.0, 3.0, 3.0)
"""Of the robust kernel in each step [standard deviations]: what is off has to have a say at first."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibrated:
    """Poses and unknowns that fit best together."""

    poses: Floats
    """(T, 4, 4) map_from_camera"""
    values: Floats
    """(COUNT,)"""
    errors: Floats
    """(COUNT,) standard deviations; 0: it was not asked for."""
    cost: float
    """Mean robust cost of readings and matches, 0 to 1."""


class Rows(NamedTuple):
    """Linearised residuals of one frame."""

    derivatives: Floats
    """(R, 6 + COUNT) by a shift [m] and a turn [rad] of the camera in map axes, and the unknowns."""
    residuals: Floats
    """(R,)"""
    weights: Floats
    """(R,)"""
    cost: float
    """Mean robust cost."""


def calibrate(
    scene: Scene,
    problem: Problem,
    start: Floats,
    free: Sequence[int],
    widths: Sequence[float] = WIDTHS,
) -> Calibrated:
    """Poses (T, 4, 4) from a start, and the unknowns in `free` from 0: one step for each width.

    Where no step can be told, as of numbers that are not finite, nothing is found: the start, zeros,
    and an infinite cost.
    """
    poses, values, size = start.copy(), np.zeros(COUNT), 6 * len(start)
    chosen = np.array([*free, TIME], int)
    ways, before = twists(problem.odometry, problem.stamps), BEFORE.copy()
    before[TIME] = usual_lag(problem.stamps)
    covariance, cost = np.eye(size + len(chosen)), np.nan
    for width in widths:
        h, g, costs = np.zeros((size + COUNT,) * 2), np.zeros(size + COUNT), []
        for t, pose in enumerate(poses):
            at = np.r_[6 * t : 6 * t + 6, size : size + COUNT]
            for rows in _seen(scene, problem, t, pose, ways[t], values, width):
                weighted = rows.derivatives.T * rows.weights
                h[np.ix_(at, at)] += product(weighted, rows.derivatives)
                g[at] += weighted @ rows.residuals
                costs.append(rows.cost)
        upright = replace(problem, gravity=turned_gravity(problem.gravity, values))
        add_beliefs(upright, poses, start, h[:size, :size], g[:size])
        _add_tilt(upright, poses, values, h, g)
        h[size:, size:] += np.diag(1.0 / before**2)
        g[size:] += values / before**2
        kept = np.r_[0:size, size + chosen]
        system = h[np.ix_(kept, kept)]
        covariance = _inverse(system)
        step = -covariance @ g[kept]
        if not np.isfinite(step).all():
            return Calibrated(start.copy(), np.zeros(COUNT), np.zeros(COUNT), np.inf)
        moves = step[:size].reshape(-1, 6)
        poses[:, :3, 3] += moves[:, :3]
        poses[:, :3, :3] = rotation_from_vector(moves[:, 3:]) @ poses[:, :3, :3]
        values[chosen] += step[size:]
        cost = float(np.mean(costs)) if costs else np.nan
    errors = np.zeros(COUNT)
    errors[chosen] = np.sqrt(np.diag(covariance)[size:])
    return Calibrated(poses, values, errors, cost)


def _inverse(system: Floats) -> Floats:
    """Inverse of normal equations; NaN of those that have none."""
    try:
        return np.asarray(np.linalg.inv(system))
    except np.linalg.LinAlgError:
        return np.full_like(system, np.nan)


def _add_tilt(problem: Problem, poses: Floats, values: Floats, h: Floats, g: Floats) -> None:
    """Add how gravity (`solve._add_gravity`) depends on its own turn, which is none about gravity itself."""
    up, variance = leaning(problem, poses)
    turns = poses[:, :3, :3] @ cross_matrix(problem.gravity)
    own = 6 * len(poses) + np.array(TILT)
    for t, (j, by_pose) in enumerate(zip(turns[:, :2], -cross_matrix(up)[:, :2], strict=True)):
        rows = np.arange(6 * t + 3, 6 * t + 6)
        across = by_pose.T @ j / variance
        h[np.ix_(rows, own)] += across
        h[np.ix_(own, rows)] += across.T
        h[np.ix_(own, own)] += j.T @ j / variance
        g[own] += j.T @ up[t, :2] / variance
    down = problem.gravity.mean(axis=0) / problem.options.tilt
    h[np.ix_(own, own)] += np.outer(down, down)
    g[own] += down * (down @ values[list(TILT)])


def turned_gravity(gravity: Floats, values: Floats) -> Floats:
    """Directions of gravity (..., 3) in camera axes, mended."""
    return np.asarray(gravity @ rotation_from_vector(values[list(TILT)]).T)


def depth_from_camera(values: Floats, way: Floats | None = None) -> Floats:
    """Pose (4, 4) of the depth camera in the camera, which goes a `way` (6,) while depth is late."""
    move = values[list(PLACE)] + (0.0 if way is None else values[TIME] * way)
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = rotation_from_vector(move[3:]), move[:3]
    return mount


def _seen(
    scene: Scene,
    problem: Problem,
    t: int,
    pose: Floats,
    way: Floats,
    values: Floats,
    width: float,
) -> list[Rows]:
    """What depth and matches of frame `t` say at a pose (4, 4)."""
    out, read, sights = [], problem.readings[t], problem.sights[t]
    if read is not None and (read.depth > 0).any():
        out.append(_depth_rows(scene, problem, read, pose, way, values, width))
    if len(sights):
        out.append(_image_rows(sights, pose, float(values[IMAGE]), width))
    return out


def _depth_rows(
    scene: Scene,
    problem: Problem,
    seen: Readings,
    pose: Floats,
    way: Floats,
    values: Floats,
    width: float,
) -> Rows:
    """Distances to the planes that readings hit; residuals and weights as of `depth_system`."""
    noise, read = problem.options.noise, seen.depth > 0
    mount = pose @ depth_from_camera(values, way)
    rotation = mount[:3, :3]
    inside = seen.directions[read] * np.exp([-values[FOCAL], -values[FOCAL], 0.0])
    hits = scene.caster.cast(mount[:3, 3], inside @ rotation.T)
    hit = hits.triangle >= 0
    inside, z = inside[hit], seen.depth[read][hit].astype(np.float64) * np.exp(values[SCALE])
    aims = inside @ rotation.T
    normals = problem.surfaces.normals[hits.triangle[hit]].astype(np.float64)
    slant = np.sum(normals * aims, axis=1)
    e = slant * (z - hits.distance[hit])
    facing = np.abs(np.sum((normals @ rotation) * seen.normals[read][hit], axis=1))
    low, high = noise.facing
    share = np.clip((facing - low) / (high - low), 0.0, 1.0)
    variance = ((noise.floor + noise.slope * z**2) * slant) ** 2 + noise.surface**2
    ratio = e**2 / (variance * width**2)
    count = max(1, int(read.sum()))
    worth = READINGS / max(count, 0.25 * len(seen.depth))
    j = np.zeros((len(e), 6 + COUNT))
    j[:, :3], j[:, 3:6] = normals, np.cross(aims * z[:, None], normals)
    own = np.concatenate([j[:, :3] @ pose[:3, :3], j[:, 3:6] @ pose[:3, :3]], axis=1)
    wider = (inside * (1.0, 1.0, 0.0) * z[:, None]) @ rotation.T
    j[:, 6 + SCALE], j[:, 6 + FOCAL] = slant * z, -np.sum(normals * wider, axis=1)
    j[:, 6 + TIME], j[:, 6 + np.array(PLACE)] = own @ way, own
    missed = 1.0 - float(np.sum(share / (1.0 + ratio))) / count
    return Rows(j, e, worth * share / (1.0 + ratio) ** 2 / variance, missed)


def _image_rows(seen: Sights, pose: Floats, focal: float, width: float) -> Rows:
    """Reprojection errors; residuals and weights as of `pixel_system`, `focal` the logarithm."""
    away = seen.points - pose[:3, 3]
    at = away @ pose[:3, :3]
    ahead = at[:, 2] > 0.05
    away, at, sigma = away[ahead], at[ahead], seen.sigma[ahead]
    rays = seen.rays[ahead] * np.exp(-focal)
    xy = at[:, :2] / at[:, 2:]
    e = seen.focal * (xy - rays)
    ratio = np.sum(e**2, axis=1) / (sigma * width) ** 2
    w = 1.0 / (1.0 + ratio) ** 2
    w *= min(1.0, POINTS / max(float(w.sum()), 1.0)) / sigma**2
    # d(pixel)/d(shift) = -f/z (r_row - xy r_3), with r the columns of the rotation
    shift = pose[:3, :2].T - xy[..., None] * pose[:3, 2]
    shift *= -(seen.focal / at[:, 2])[:, None, None]
    j = np.zeros((len(at), 2, 6 + COUNT))
    j[..., :3], j[..., 3:6] = shift, np.cross(away[:, None], shift)
    j[..., 6 + IMAGE] = seen.focal * rays
    missed = float(np.mean(ratio / (1.0 + ratio))) if len(at) else 1.0
    return Rows(j.reshape(-1, 6 + COUNT), e.ravel(), np.repeat(w, 2), missed)
