"""Robust Gauss-Newton fit of all poses of a sequence.

The poses of all frames are unknown, six degrees of freedom each. Depth readings and matched points
tie each frame to the map, odometry ties it to its neighbours, gravity to the vertical. Weights are
set anew at each step, from a wide robust kernel to a narrow one.

Depth and images may lag behind the odometry's clock, each by one more unknown of the sequence: a camera
that turns by a radian a second is two degrees elsewhere after 35 ms, the lag of a Kinect's depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import (
    Floats,
    cross_matrix,
    rotation_from_vector,
    vector_from_rotation,
)
from placegraph.errors import InputError
from placegraph.indoor.options import RefineOptions
from placegraph.indoor.pose.covariance import UPRIGHT, common_covariance
from placegraph.indoor.refine.correspondences import Kernel, PointMatches, Readings, Surfaces
from placegraph.indoor.refine.refine_kernels import depth_system, pixel_system

USUAL = (0.03, 0.3)
"""Standard deviation of a lag: in the unit of the stamps [s], or this share of the time between two
frames where that is more (of frames that are numbered, not timed)."""
MOST = 4.0
"""No lag is found that is more of these deviations."""
CLEAR = 4.0
"""A lag is told that is so many of its standard deviations ..."""
TOLD = 0.2
"""... and no less than this share of `lag_deviation`."""


DEPTH, IMAGES = range(2)
"""Rows of what lags."""


@dataclass(frozen=True, slots=True, eq=False)
class Lags:
    """Lags of depth and images behind their stamps."""

    values: Floats
    """(2,) in the stamps' unit"""
    deviations: Floats
    """(2,)"""
    twist: Floats
    """(T, 6) as of `twists`"""
    deviation: float
    """Standard deviation, see `lag_deviation`."""

    def depth_poses(self, poses: Floats) -> Floats:
        """Return the poses (T, 4, 4) of the depth images, from poses at the stamps."""
        return shift_in_time(poses, self.twist, float(self.values[DEPTH]))

    def image_poses(self, poses: Floats) -> Floats:
        """Return the poses (T, 4, 4) of the colour images, from poses at the stamps."""
        return shift_in_time(poses, self.twist, float(self.values[IMAGES]))

    def find_clear(self) -> dict[str, float]:
        """Return lags that the data leave no doubt of: `depth`, `images`, in the stamps' unit."""
        rows = np.flatnonzero(find_clear_lags(self))
        return {("depth", "images")[row]: float(self.values[row]) for row in rows}


def find_clear_lags(lags: Lags | None) -> NDArray[np.bool_]:
    """Return which of depth and images (2,) clearly lag."""
    if lags is None:
        return np.zeros(2, bool)
    least = np.maximum(CLEAR * lags.deviations, TOLD * lags.deviation)
    return np.asarray(np.abs(lags.values) > least)


def lag_deviation(stamps: Floats) -> float:
    """Return standard deviation of lags of frames with these stamps (T,), in their unit."""
    between = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.0
    return max(USUAL[0], USUAL[1] * between)


def twists(odometry: Floats, stamps: Floats) -> Floats:
    """Return way and turn (T, 6) of a camera a unit of its stamps (T,), in its own axes, at each frame.

    Between the frames before and after; `odometry`: (T, 4, 4). Zero of a single frame.
    """
    count = len(odometry)
    if count < 2:
        return np.zeros((count, 6))
    before, after = np.maximum(np.arange(count) - 1, 0), np.minimum(np.arange(count) + 1, count - 1)
    rotation = np.swapaxes(odometry[:, :3, :3], 1, 2)
    way = np.einsum("tij,tj->ti", rotation, odometry[after, :3, 3] - odometry[before, :3, 3])
    turned = np.swapaxes(odometry[before, :3, :3], 1, 2) @ odometry[after, :3, :3]
    both = np.concatenate([way, vector_from_rotation(turned)], axis=1)
    return np.asarray(both / (stamps[after] - stamps[before])[:, None])


def shift_in_time(poses: Floats, twist: Floats, lag: float) -> Floats:
    """Return poses (T, 4, 4) a `lag` later on ways (T, 6) as of `twists`."""
    out = poses.copy()
    out[:, :3, 3] += lag * np.einsum("tij,tj->ti", poses[:, :3, :3], twist[:, :3])
    out[:, :3, :3] = poses[:, :3, :3] @ rotation_from_vector(lag * twist[:, 3:])
    return out


def in_map_axes(poses: Floats, twist: Floats) -> NDArray[np.float64]:
    """Return ways and turns (T, 6) of poses (T, 4, 4) in map axes."""
    rotation = poses[:, :3, :3]
    parts = [np.einsum("tij,tj->ti", rotation, part) for part in (twist[:, :3], twist[:, 3:])]
    return np.concatenate(parts, axis=1)


READINGS = 200.0
"""Independent readings that the depth of one frame is worth: neighbours err together."""
POINTS = 40.0
"""Independent points that the matches of one frame are worth at most."""
ASTRAY = (0.006, 0.004)
"""Usual deviations [m], [rad] that all measurements of one frame share, by errors of map or stamp."""
WITNESSES = 4
"""Number of errors that `ASTRAY` counts as, beside those of the capture."""


class NormalEquations(NamedTuple):
    """Normal equations of one sense at T poses, frame by frame."""

    information: Floats
    """(T, 6, 6)"""
    gradient: Floats
    """(T, 6)"""

    def marginalize(self, frame_errors: Floats) -> NormalEquations:
        """Return the equations if each frame as a whole may be off by deviations (2,) [m], [rad]."""
        sure = np.repeat(1.0 / np.square(frame_errors), 3)
        kept = sure[:, None] * np.linalg.inv(self.information + np.diag(sure))
        return NormalEquations(
            kept @ self.information, np.einsum("tij,tj->ti", kept, self.gradient)
        )

    def frame_errors(self, before: Floats, step: Floats) -> Floats:
        """Return deviations (2,) by which frames seem astray once their poses have gone a step (T, 6)."""
        told = self.information.any(axis=(1, 2))
        left = self.gradient + np.einsum("tij,tj->ti", self.information, step)
        sure = np.diag(np.repeat(1.0 / np.square(before), 3))
        off = np.linalg.solve(self.information + sure, left[..., None])[told, :, 0]
        return root_mean_squares(off, ASTRAY, WITNESSES)


def root_mean_squares(errors: Floats, before: tuple[float, float], prior_count: int) -> Floats:
    """Return root mean squares (2,) of shifts and turns (N, 6), with what was believed before."""
    squares = np.square(errors).reshape(-1, 2, 3).sum(axis=(0, 2))
    count = prior_count + 3 * len(errors)
    return np.asarray(np.sqrt((prior_count * np.square(before) + squares) / count))


def depth_equations(
    problem: Problem, poses: Floats, shares: Floats, width: float
) -> tuple[NormalEquations, Floats, float]:
    """Return the normal equations of depth at poses (T, 4, 4); see `match_equations` and `Solution`.

    With it: sums of weights and numbers of readings of objects (N, 2), and the mean robust cost.
    """
    noise = problem.options.noise
    kernel = Kernel(noise.floor, noise.slope, noise.surface, noise.facing, width)
    told, total = np.zeros((problem.objects, 2)), np.zeros(3)
    h, g = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6))
    for t, seen in enumerate(problem.readings):
        if seen is None:
            continue
        block, slope, of_objects, sums = depth_system(
            problem.surfaces,
            shares,
            np.ascontiguousarray(poses[t, :3, :3]),
            np.ascontiguousarray(poses[t, :3, 3]),
            seen.directions,
            seen.depth,
            seen.normals,
            kernel,
        )
        # few readings are not worth more than they are
        scale = READINGS / max(float(sums[0]), 0.25 * len(seen.depth), 1.0)
        h[t], g[t] = scale * block, scale * slope
        told += of_objects
        total += sums
    return NormalEquations(h, g), told, float(total[1] / total[0]) if total[0] else np.nan


def match_equations(problem: Problem, poses: Floats, width: float) -> NormalEquations:
    """Return the normal equations of matches at poses (T, 4, 4), by a kernel's width in deviations."""
    h, g = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6))
    for t, seen in enumerate(problem.matches):
        if not len(seen):
            continue
        block, slope, total = pixel_system(
            np.ascontiguousarray(poses[t, :3, :3]),
            np.ascontiguousarray(poses[t, :3, 3]),
            seen.points,
            seen.rays,
            seen.sigma,
            seen.focal,
            width,
        )
        scale = min(1.0, POINTS / max(total, 1.0))
        h[t], g[t] = scale * block, scale * slope
    return NormalEquations(h, g)


LOOSE = (1.0, 0.5)
"""Standard deviations [m], [rad] about the start that no data need to overcome: what nothing holds
stays where it is."""
STEADY = 10
"""Odometry is believed to err as `RefineOptions.motion` says as if so many errors had shown it; and how
far frames lean from gravity has Student's distribution of so many degrees of freedom."""
_LEAST = 1e-4  # no odometry is truer [m, rad]
_STILL = 2e-4  # a step so small [m, rad] is the last
_TELLING = 20  # readings of an object from which on it may be found to have moved
_MOVED = 0.05  # share that a moved object keeps


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Measurements of the poses of T frames."""

    surfaces: Surfaces
    readings: Sequence[Readings | None]
    """(T,)"""
    matches: Sequence[PointMatches]
    """(T,)"""
    odometry: Floats
    """(T, 4, 4) odometry_from_camera"""
    gravity: Floats
    """(T, 3) unit direction in camera axes"""
    stamps: Floats
    """(T,) [s], or numbers of frames"""
    objects: int
    """Number of the map's objects."""
    options: RefineOptions
    drift: tuple[float, float] = (1.0, 1.0)
    """Errors of odometry's ways and of its turns, in units of `RefineOptions.motion`."""
    prior: tuple[Floats, Floats] | None = None
    """Poses (T, 4, 4) that were known before, and their standard deviations (6,) [m], [rad] in map
    axes, common to all frames; None: `LOOSE` about the start."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Poses that fit best, and the information of the fit."""

    poses: Floats
    """(T, 4, 4) map_from_camera"""
    information: Floats
    """(6 T, 6 T) of shifts [m] and turns [rad] in map axes, frame by frame."""
    shares: Floats
    """(N,) weight of each object: low where its readings lie elsewhere, as of moved furniture."""
    cost: float
    """Mean robust cost of the depth readings, 0 to 1; NaN without depth."""
    steps: int
    """Gauss-Newton steps taken."""
    lags: Lags | None = None
    """By what depth and images are late; None: not asked."""

    def covariance(self, frame: int = -1) -> Floats:
        """Return (6, 6) of one frame, the others being unknown too."""
        count = len(self.poses)
        rows = np.arange(6) + 6 * (frame % count)
        unit = np.zeros((6 * count, 6))
        unit[rows, np.arange(6)] = 1.0
        return np.asarray(np.linalg.solve(self.information, unit)[rows])


def solve(
    problem: Problem, start: Floats, widths: Sequence[tuple[float, float]], steps: int = 4
) -> Solution:
    """Return poses (T, 4, 4) from a start (T, 4, 4), through kernels from wide to narrow.

    `widths`: of the depth and of the pixel kernel, in standard deviations, one pair a round of at
    most `steps` Gauss-Newton steps.
    """
    poses, count = start.copy(), len(start)
    shares, cost, taken = np.ones(problem.objects), np.nan, 0
    twist, deviation = twists(problem.odometry, problem.stamps), lag_deviation(problem.stamps)
    lags, held, late = np.zeros(2), slice(0, 6 * count), None
    frame_errors = [np.array(ASTRAY)] * 2
    for left, (depth_width, pixel_width) in zip(reversed(range(len(widths))), widths, strict=True):
        # in the last round stamps are believed of which no doubt was found
        free = np.ones(2, bool) if left else find_clear_lags(late)
        lags = np.where(free, lags, 0.0)
        for number in range(steps):
            h, g = np.zeros((6 * count + 2, 6 * count + 2)), np.zeros(6 * count + 2)
            seen = [shift_in_time(poses, twist, lag) for lag in lags]
            by_depth, told, cost = depth_equations(problem, seen[0], shares, depth_width)
            equations = [by_depth, match_equations(problem, seen[1], pixel_width)]
            ways = [in_map_axes(at, twist) for at in seen]
            for k, one in enumerate(equations):
                _add(one.marginalize(frame_errors[k]), ways[k], 6 * count + k, h, g)
            prior = np.where(free, deviation, _LEAST * deviation) ** -2.0
            h[-2:, -2:] += np.diag(prior)
            g[-2:] += lags * prior
            add_priors(problem, poses, start, h[held, held], g[held])
            whole = -np.linalg.solve(h, g)
            step = whole[held].reshape(count, 6)
            if not np.isfinite(whole).all():  # a ray that is no number would never come back
                raise InputError(
                    "The poses of the frames cannot be fitted: their odometry, gravity, depth or "
                    "matches contain numbers that are not finite or far too large."
                )
            moves = [step + late * way for late, way in zip(whole[-2:], ways, strict=True)]
            frame_errors = [
                one.frame_errors(*at)
                for one, *at in zip(equations, frame_errors, moves, strict=True)
            ]
            poses[:, :3, 3] += step[:, :3]
            poses[:, :3, :3] = rotation_from_vector(step[:, 3:]) @ poses[:, :3, :3]
            lags = np.clip(lags + whole[-2:], -MOST * deviation, MOST * deviation)
            taken += 1
            if number:  # not before the poses have had one step to come near
                # weight (N,) of each object: what less than half fits is likely to have moved
                fits = told[:, 0] / np.maximum(told[:, 1], 1.0)
                shares = np.where(told[:, 1] > _TELLING, np.clip(2.0 * fits, _MOVED, 1.0), 1.0)
            if np.abs(step).max() < _STILL:
                break
        late = Lags(lags, np.sqrt(np.diag(np.linalg.inv(h))[-2:]), twist, deviation)
    across = h[held, -2:]
    information = h[held, held] - across @ np.linalg.solve(h[-2:, -2:], across.T)
    return Solution(poses, information, shares, cost, taken, late)


def _add(equations: NormalEquations, way: Floats, row: int, h: Floats, g: Floats) -> None:
    """Add what one sense tells of T poses and of its lag.

    `way`: (T, 6) that the poses go in a unit of the lag, whose place in h and g is `row`.
    """
    moved = np.einsum("tij,tj->ti", equations.information, way)
    for t, block in enumerate(equations.information):
        h[6 * t : 6 * t + 6, 6 * t : 6 * t + 6] += block
    held = slice(0, moved.size)
    h[held, row] += moved.ravel()
    h[row, held] += moved.ravel()
    h[row, row] += np.sum(way * moved)
    g[held] += equations.gradient.ravel()
    g[row] += np.sum(way * equations.gradient)


def odometry_errors(problem: Problem, poses: Floats) -> tuple[Floats, Floats]:
    """Return errors (T - 1, 6) of the steps between frames, in map axes, and their deviations (T - 1, 6)."""
    steps = np.linalg.inv(problem.odometry[:-1]) @ problem.odometry[1:]
    led = poses[:-1] @ steps
    shift = poses[1:, :3, 3] - led[:, :3, 3]
    turn = vector_from_rotation(poses[1:, :3, :3] @ np.swapaxes(led[:, :3, :3], 1, 2))
    noise = problem.options.motion
    way = np.linalg.norm(steps[:, :3, 3], axis=1)
    angle = np.linalg.norm(vector_from_rotation(steps[:, :3, :3]), axis=1)
    deviations = np.stack(
        [
            noise.translation + noise.translation_per_metre * way,
            noise.rotation + noise.rotation_per_radian * angle,
        ],
        axis=1,
    )
    deviations = np.maximum(deviations, _LEAST) * problem.drift
    return np.concatenate([shift, turn], axis=1), np.repeat(deviations, 3, axis=1)


def drift_of(problem: Problem, poses: Floats) -> tuple[float, float]:
    """Return the errors of odometry along poses (T, 4, 4), as `Problem.drift`."""
    errors, deviations = odometry_errors(problem, poses)
    way, turn = root_mean_squares(errors / deviations, (1.0, 1.0), STEADY).tolist()
    return way, turn


def _add_odometry(problem: Problem, poses: Floats, h: Floats, g: Floats) -> None:
    if len(poses) < 2:
        return
    errors, deviations = odometry_errors(problem, poses)
    # a turn of frame t swings the step from it: led = p_t + R_t step
    swings = cross_matrix(poses[1:, :3, 3] - errors[:, :3] - poses[:-1, :3, 3])
    for t in range(len(errors)):
        j = np.zeros((6, 12))
        j[:, :6], j[:, 6:] = -np.eye(6), np.eye(6)
        j[:3, 3:6] = swings[t]
        weighted = j.T / deviations[t] ** 2
        rows = slice(6 * t, 6 * t + 12)
        h[rows, rows] += weighted @ j
        g[rows] += weighted @ errors[t]


def add_priors(problem: Problem, poses: Floats, start: Floats, h: Floats, g: Floats) -> None:
    """Add what is believed of poses (T, 4, 4) without looking to normal equations (6 T)."""
    _add_odometry(problem, poses, h, g)
    # the known tilt is a prior, not a cage: it gives way where frames are seen to lean far
    up, variance = measure_lean(problem, poses)
    for t, j in enumerate(-cross_matrix(up)[:, :2]):
        rows = slice(6 * t + 3, 6 * t + 6)
        h[rows, rows] += j.T @ j / variance
        g[rows] += j.T @ up[t, :2] / variance
    _add_known(problem, poses, start, h, g)


def measure_lean(problem: Problem, poses: Floats) -> tuple[Floats, float]:
    """Return up (T, 3) in map axes as gravity has it at poses (T, 4, 4), and the variance of its x and y."""
    up = -np.einsum("tij,tj->ti", poses[:, :3, :3], problem.gravity)
    return up, problem.options.tilt**2 + float(np.mean(up[:, :2] ** 2)) / STEADY


def _add_known(problem: Problem, poses: Floats, start: Floats, h: Floats, g: Floats) -> None:
    prior, deviations = start, np.repeat(LOOSE, 3)
    if problem.prior is not None:
        # one and the same knowledge, not one of each frame
        prior, deviations = problem.prior[0], problem.prior[1] * np.sqrt(len(poses))
    shift = poses[:, :3, 3] - prior[:, :3, 3]
    turn = vector_from_rotation(poses[:, :3, :3] @ np.swapaxes(prior[:, :3, :3], 1, 2))
    weights = 1.0 / np.square(deviations)
    g += (np.concatenate([shift, turn], axis=1) * weights).ravel()
    h[np.diag_indices(len(h))] += np.tile(weights, len(poses))


MISS = 0.65
"""Error common to all frames, in units of what matches miss by (benchmark)."""
_MEDIAN = 1.4826  # standard deviations in a median absolute deviation


def covariance(problem: Problem, solution: Solution, error: float) -> Floats:
    """Return (6, 6) of the last frame of a solution: the fit's own, and what is common to all frames.

    `error`: of the map, as of `map_error` [m].
    """
    shift, away = common_error(problem, solution, error)
    turn = shift / away
    tilt = min(UPRIGHT * turn, problem.options.tilt)
    return solution.covariance() + common_covariance(shift, turn, tilt)


def common_error(problem: Problem, solution: Solution, error: float) -> tuple[float, float]:
    """Return the standard deviation of a trajectory's common error [m], and the mean viewing distance [m].

    It is the map's, or what matches miss by if that is more. The distance makes turns of shifts.
    """
    found, away = [error], []
    depths = [r.depth[r.depth > 0] for r in problem.readings if r is not None]
    if any(map(len, depths)):
        away.append(float(np.median(np.concatenate(depths))))
    if any(map(len, problem.matches)):
        missed, far = _missed(problem.matches, solution.poses)
        found.append(MISS * missed)
        away.append(far)
    return max(found), float(np.mean(away)) if away else 1.0


def _missed(matches: Sequence[PointMatches], poses: Floats) -> tuple[float, float]:
    """By how much matches miss, at their distance [m], and that distance [m]."""
    angles, far = [], []
    for seen, pose in zip(matches, poses, strict=True):
        if len(seen):
            angles.append(seen.errors(pose) / seen.focal)
            far.append(np.linalg.norm(seen.points - pose[:3, 3], axis=1))
    distance = float(np.median(np.concatenate(far)))
    return _MEDIAN / np.sqrt(2.0) * float(np.median(np.concatenate(angles))) * distance, distance
