"""Correction of a camera that is not as the capture says, by frames with depth.

Used for an answer that is not `OK`, whose refinement was refused, or if `measure_scale_error` suspects the
camera. Unknowns, with their rows in docs/benchmarks/indoor.md: focal lengths of images and of depth
(*focal length*), scale (*depth scale*), time (*depth late*) and place (*depth aside*) of depth, and a turn
of gravity (*tilt*). Gauss-Newton finds them together with the poses: the normal equations of all poses
(`fit`) are bordered by the unknowns that frames have in common. Depth tells its scale (which grows along
the rays) from its focal length (across them), matches tell the focal length of images, and both together
tell where and when depth was read. Frames are corrected round by round; an unknown that is not clearly off
stays as given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Calibration, PoseEstimate, Status
from placegraph.core.geometry import (
    Camera,
    Floats,
    between,
    compose,
    cross_matrix,
    pose_matrix,
    rotation_from_vector,
)
from placegraph.core.threads import multiply_matrices
from placegraph.indoor.likelihood.observe import spread
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.pose.window import PoseQuery, Window
from placegraph.indoor.refine.fit import (
    POINTS,
    READINGS,
    Problem,
    add_priors,
    lag_deviation,
    measure_lean,
    twists,
)
from placegraph.indoor.refine.refiner import FittedTrajectory, Refiner, matching_stages
from placegraph.indoor.status import choose_camera, diagnostics_of
from placegraph.io.capture.frame import Frame, Images, LazyImages

if TYPE_CHECKING:
    from placegraph.indoor.refine.correspondences import PointMatches, Readings
    from placegraph.indoor.refine.refinement import RefineSetup

SCALE, FOCAL, IMAGE, TIME = range(4)
"""Unknowns: logarithms of the factors on depth readings, on the depth camera's focal length and on
that of the images; what depth lags by (`lag`), which is always free."""
PLACE = (4, 5, 6, 7, 8, 9)
"""Shift [m] and turn [rad] of the depth camera, in the axes of the camera."""
TILT = (10, 11, 12)
"""Turn [rad] of gravity, in the axes of the camera: an accelerometer that is mounted aslant."""
COUNT = 13
BEFORE = np.array([0.15, 0.15, 0.15, np.nan, *(0.1,) * 9])
"""Prior standard deviations of the unknowns; of lags `fit.lag_deviation`."""
WIDTHS = (10.0, 10.0, 6.0, 6.0, 4.0, 4.0, 3.0, 3.0)
"""Widths of the robust kernel in each step [standard deviations], wide at first."""


@dataclass(frozen=True, slots=True, eq=False)
class CalibratedPoses:
    """Poses and unknowns that fit best together."""

    poses: Floats
    """(T, 4, 4) map_from_camera"""
    values: Floats
    """(COUNT,)"""
    errors: Floats
    """(COUNT,) standard deviations; 0: not free."""
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


def calibrate_camera(
    scene: Scene,
    problem: Problem,
    start: Floats,
    free: Sequence[int],
    widths: Sequence[float] = WIDTHS,
) -> CalibratedPoses:
    """Fit poses (T, 4, 4) from a start, and the unknowns in `free` from 0: one step for each width.

    If a step is not finite, return the start, zeros, and an infinite cost.
    """
    poses, values, size = start.copy(), np.zeros(COUNT), 6 * len(start)
    choose_answer = np.array([*free, TIME], int)
    ways, before = twists(problem.odometry, problem.stamps), BEFORE.copy()
    before[TIME] = lag_deviation(problem.stamps)
    covariance, cost = np.eye(size + len(choose_answer)), np.nan
    for width in widths:
        h, g, costs = np.zeros((size + COUNT,) * 2), np.zeros(size + COUNT), []
        for t, pose in enumerate(poses):
            at = np.r_[6 * t : 6 * t + 6, size : size + COUNT]
            for rows in _linearize_frame(scene, problem, t, pose, ways[t], values, width):
                weighted = rows.derivatives.T * rows.weights
                h[np.ix_(at, at)] += multiply_matrices(weighted, rows.derivatives)
                g[at] += weighted @ rows.residuals
                costs.append(rows.cost)
        upright = replace(problem, gravity=turn_gravity(problem.gravity, values))
        add_priors(upright, poses, start, h[:size, :size], g[:size])
        _add_tilt(upright, poses, values, h, g)
        h[size:, size:] += np.diag(1.0 / before**2)
        g[size:] += values / before**2
        unknowns = np.r_[0:size, size + choose_answer]
        system = h[np.ix_(unknowns, unknowns)]
        covariance = _inverse(system)
        step = -covariance @ g[unknowns]
        if not np.isfinite(step).all():
            return CalibratedPoses(start.copy(), np.zeros(COUNT), np.zeros(COUNT), np.inf)
        moves = step[:size].reshape(-1, 6)
        poses[:, :3, 3] += moves[:, :3]
        poses[:, :3, :3] = rotation_from_vector(moves[:, 3:]) @ poses[:, :3, :3]
        values[choose_answer] += step[size:]
        cost = float(np.mean(costs)) if costs else np.nan
    errors = np.zeros(COUNT)
    errors[choose_answer] = np.sqrt(np.diag(covariance)[size:])
    return CalibratedPoses(poses, values, errors, cost)


def _inverse(system: Floats) -> Floats:
    """Return the inverse of normal equations; NaN: there is none."""
    try:
        return np.asarray(np.linalg.inv(system))
    except np.linalg.LinAlgError:
        return np.full_like(system, np.nan)


def _add_tilt(problem: Problem, poses: Floats, values: Floats, h: Floats, g: Floats) -> None:
    """Add the derivatives of the gravity prior (`fit.add_priors`) by a turn of gravity."""
    up, variance = measure_lean(problem, poses)
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


def turn_gravity(gravity: Floats, values: Floats) -> Floats:
    """Correct directions of gravity (..., 3) in camera axes."""
    return np.asarray(gravity @ rotation_from_vector(values[list(TILT)]).T)


def depth_from_camera(values: Floats, way: Floats | None = None) -> Floats:
    """Return pose (4, 4) of the depth camera in the camera, which goes a `way` (6,) while depth is late."""
    move = values[list(PLACE)] + (0.0 if way is None else values[TIME] * way)
    mount = np.eye(4)
    mount[:3, :3], mount[:3, 3] = rotation_from_vector(move[3:]), move[:3]
    return mount


def _linearize_frame(
    scene: Scene,
    problem: Problem,
    t: int,
    pose: Floats,
    way: Floats,
    values: Floats,
    width: float,
) -> list[Rows]:
    """Linearise depth and matches of frame `t` at a pose (4, 4)."""
    out, read, matches = [], problem.readings[t], problem.matches[t]
    if read is not None and (read.depth > 0).any():
        out.append(_depth_rows(scene, problem, read, pose, way, values, width))
    if len(matches):
        out.append(_image_rows(matches, pose, float(values[IMAGE]), width))
    return out


def _depth_rows(
    scene: Scene,
    problem: Problem,
    readings: Readings,
    pose: Floats,
    way: Floats,
    values: Floats,
    width: float,
) -> Rows:
    """Return distances to the planes that readings hit; residuals and weights as of `depth_system`."""
    noise, read = problem.options.noise, readings.depth > 0
    mount = pose @ depth_from_camera(values, way)
    rotation = mount[:3, :3]
    inside = readings.directions[read] * np.exp([-values[FOCAL], -values[FOCAL], 0.0])
    hits = scene.caster.cast(mount[:3, 3], inside @ rotation.T)
    hit = hits.triangle >= 0
    inside, z = inside[hit], readings.depth[read][hit].astype(np.float64) * np.exp(values[SCALE])
    aims = inside @ rotation.T
    normals = problem.surfaces.normals[hits.triangle[hit]].astype(np.float64)
    slant = np.sum(normals * aims, axis=1)
    e = slant * (z - hits.distance[hit])
    facing = np.abs(np.sum((normals @ rotation) * readings.normals[read][hit], axis=1))
    low, high = noise.facing
    share = np.clip((facing - low) / (high - low), 0.0, 1.0)
    variance = ((noise.floor + noise.slope * z**2) * slant) ** 2 + noise.surface**2
    ratio = e**2 / (variance * width**2)
    count = max(1, int(read.sum()))
    worth = READINGS / max(count, 0.25 * len(readings.depth))
    j = np.zeros((len(e), 6 + COUNT))
    j[:, :3], j[:, 3:6] = normals, np.cross(aims * z[:, None], normals)
    own = np.concatenate([j[:, :3] @ pose[:3, :3], j[:, 3:6] @ pose[:3, :3]], axis=1)
    wider = (inside * (1.0, 1.0, 0.0) * z[:, None]) @ rotation.T
    j[:, 6 + SCALE], j[:, 6 + FOCAL] = slant * z, -np.sum(normals * wider, axis=1)
    j[:, 6 + TIME], j[:, 6 + np.array(PLACE)] = own @ way, own
    missed = 1.0 - float(np.sum(share / (1.0 + ratio))) / count
    return Rows(j, e, worth * share / (1.0 + ratio) ** 2 / variance, missed)


def _image_rows(matches: PointMatches, pose: Floats, focal: float, width: float) -> Rows:
    """Return reprojection errors; residuals and weights as of `pixel_system`, `focal` the logarithm."""
    away = matches.points - pose[:3, 3]
    at = away @ pose[:3, :3]
    ahead = at[:, 2] > 0.05
    away, at, sigma = away[ahead], at[ahead], matches.sigma[ahead]
    rays = matches.rays[ahead] * np.exp(-focal)
    xy = at[:, :2] / at[:, 2:]
    e = matches.focal * (xy - rays)
    ratio = np.sum(e**2, axis=1) / (sigma * width) ** 2
    w = 1.0 / (1.0 + ratio) ** 2
    w *= min(1.0, POINTS / max(float(w.sum()), 1.0)) / sigma**2
    # d(pixel)/d(shift) = -f/z (r_row - xy r_3), with r the columns of the rotation
    shift = pose[:3, :2].T - xy[..., None] * pose[:3, 2]
    shift *= -(matches.focal / at[:, 2])[:, None, None]
    j = np.zeros((len(at), 2, 6 + COUNT))
    j[..., :3], j[..., 3:6] = shift, np.cross(away[:, None], shift)
    j[..., 6 + IMAGE] = matches.focal * rays
    missed = float(np.mean(ratio / (1.0 + ratio))) if len(at) else 1.0
    return Rows(j.reshape(-1, 6 + COUNT), e.ravel(), np.repeat(w, 2), missed)


_SAME = 1e-3  # of an image's width: intrinsics of one view
_ALIKE = 0.01  # focal lengths that are off by one factor
_DEVICE = 0.2  # cameras of one device stand no further apart [m]: depth or images are late


@dataclass(frozen=True, eq=False)
class CameraCorrection:
    """Corrections of a camera, by `calibrate_camera`."""

    values: Floats = field(default_factory=lambda: np.zeros(COUNT))
    """(COUNT,)"""
    errors: Floats = field(default_factory=lambda: np.zeros(COUNT))
    """(COUNT,) standard deviations."""

    def frames(self, frames: Sequence[Frame]) -> list[Frame]:
        """Return frames of one capture as their camera should have them."""
        mount = depth_from_camera(self.values) if self.values[list(PLACE)].any() else None
        return [self._frame(f, mount) for f in frames]

    def _frame(self, frame: Frame, mount: Floats | None) -> Frame:
        depth, labels, images = frame.depth_camera, frame.label_camera, frame.images
        shared = share_view(frame.camera, labels)
        depth = None if depth is None else scale_focal(depth, self.values[FOCAL])
        if mount is not None or self.values[SCALE]:
            images = CorrectedImages(images, float(np.exp(self.values[SCALE])), depth, mount)
        return replace(
            frame,
            camera=scale_focal(frame.camera, self.values[IMAGE]),
            depth_camera=depth,
            label_camera=scale_focal(labels, self.values[IMAGE if shared else FOCAL])
            if labels
            else None,
            images=images,
            gravity=turn_gravity(frame.gravity, self.values),
        )

    def calibration(self) -> Calibration:
        """Return the correction as users see it."""
        factors, errors = np.exp(self.values), self.errors
        return Calibration(
            focal_factor=(float(factors[IMAGE]), float(errors[IMAGE])),
            depth_focal_factor=(float(factors[FOCAL]), float(errors[FOCAL])),
            depth_scale=(float(factors[SCALE]), float(errors[SCALE])),
            camera_from_depth=depth_from_camera(self.values),
            gravity_turn=self.values[list(TILT)],
        )

    def choose_answer(
        self, query: PoseQuery, before: PoseEstimate, after: PoseEstimate
    ) -> PoseEstimate:
        """Return the better answer of those before and after mending, with what was found."""
        return choose_camera(
            before, after, self.calibration(), self.sentence(query.frames[-1]),
            tilt_only=not self.values[: TILT[0]].any(), implausible=self._late,
        )  # fmt: skip

    @property
    def _late(self) -> bool:
        return bool(np.linalg.norm(self.values[list(PLACE[:3])]) > _DEVICE)

    def sentence(self, frame: Frame) -> str:
        """Describe the fault, and the right entries of `camera.json`."""
        return " ".join([*self._focal(frame), *self._scale(frame), *self._offset(), *self._tilt()])

    def _focal(self, frame: Frame) -> list[str]:
        image, depth = self.values[[IMAGE, FOCAL]]
        said = []
        if image:
            fits = scale_focal(frame.camera, image)
            both = " (depth likewise)" if abs(depth - image) < _ALIKE else ""
            said.append(
                f"The focal length is {_percent(image)} than in the intrinsics{both}: fx "
                f"{fits.fx:.1f}, fy {fits.fy:.1f} would fit."
            )
        if depth and abs(depth - image) >= _ALIKE and frame.depth_camera is not None:
            fits = scale_focal(frame.depth_camera, depth)
            said.append(
                f"The focal length of the depth camera is {_percent(depth)} than in its "
                f"intrinsics: fx {fits.fx:.1f}, fy {fits.fy:.1f} would fit."
            )
        return said

    def _scale(self, frame: Frame) -> list[str]:
        if not self.values[SCALE]:
            return []
        factor, images = float(np.exp(self.values[SCALE])), frame.images
        how = f"{abs(1.0 / factor - 1.0):.1%} too {'short' if factor > 1 else 'long'}"
        unit = images.unit if isinstance(images, LazyImages) else None
        correction = (
            f"{unit.source} {unit.per_metre / factor:.5g}" if unit else f"{factor:.3f} times them"
        )
        return [f"Depth readings are {how}: {correction} would fit."]

    def _offset(self) -> list[str]:
        place = self.values[list(PLACE)]
        if not place.any():
            return []
        way, turn = np.linalg.norm(place[:3]), np.degrees(np.linalg.norm(place[3:]))
        apart = f"{100 * way:.0f} cm and {turn:.1f} degrees"
        late = (
            "; this is too far for one device, so one of the streams is probably delayed"
            if self._late
            else ""
        )
        return [
            f"Depth and images do not share a viewpoint: their cameras are {apart} apart{late}."
        ]

    def _tilt(self) -> list[str]:
        turn = np.degrees(self.values[list(TILT)])
        if not turn.any():
            return []
        x, y, z = turn + 0.0
        off = f"Gravity is {np.linalg.norm(turn):.1f} degrees off"
        return [f"{off}: a rotation by {x:.1f}, {y:.1f}, {z:.1f} degrees in camera axes would fit."]


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedImages:
    """Images whose depth is brought to scale, and to where the camera was."""

    images: Images
    factor: float
    camera: Camera | None
    """Camera of the depth images."""
    mount: Floats | None
    """(4, 4) pose of the depth camera in the camera; None: they are one."""

    def rgb(self) -> NDArray[np.uint8]:
        """See `Frame.rgb`."""
        return self.images.rgb()

    def labels(self) -> NDArray[np.int32] | None:
        """See `Frame.labels`."""
        return self.images.labels()

    def depth(self) -> NDArray[np.float32] | None:
        """See `Frame.depth`."""
        return self.correct_depth(self.images.depth())

    def correct_depth(self, depth: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
        """Correct depth readings (h, w) [m]."""
        if depth is None:
            return None
        scaled = (depth * np.float32(self.factor)).astype(np.float32)
        if self.mount is None or self.camera is None:
            return scaled
        return reproject_depth(scaled, self.camera, self.mount)


def correct_depth(frame: Frame, depth: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    """Correct depth readings (h, w) [m] of a frame whose images are corrected."""
    return frame.images.correct_depth(depth) if isinstance(frame.images, CorrectedImages) else depth


def reproject_depth(
    depth: NDArray[np.float32], camera: Camera, seen_from_camera: Floats
) -> NDArray[np.float32]:
    """Reproject depth (h, w) [m] into the same camera at another pose; NaN: unknown.

    `seen_from_camera`: (4, 4) pose of the camera that read it, in the axes of the one that would.
    """
    v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
    rays = camera.directions(np.stack([u, v], axis=1) + 0.5)
    points = rays * depth[v, u, None] @ seen_from_camera[:3, :3].T + seen_from_camera[:3, 3]
    at = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = ((at >= 0) & (at < (camera.width, camera.height))).all(axis=1)
    x, y = at[inside].astype(np.int64).T
    out = np.full(depth.shape, np.inf, np.float32)
    np.minimum.at(out, (y, x), points[inside, 2].astype(np.float32))
    return np.where(np.isfinite(out), out, np.float32(np.nan))


def scale_focal(camera: Camera, logarithm: float) -> Camera:
    """Scale the focal length of a camera by the logarithm of the factor."""
    factor = float(np.exp(logarithm))
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor) if logarithm else camera


def share_view(camera: Camera, other: Camera | None) -> bool:
    """Return whether two cameras have one view, in images of any size."""
    if other is None:
        return False
    same = camera.resize(other.width, other.height)
    pairs = [(getattr(same, k), getattr(other, k)) for k in ("fx", "fy", "cx", "cy")]
    return all(abs(a - b) < _SAME * other.width for a, b in pairs)


def _percent(logarithm: float) -> str:
    factor = float(np.exp(logarithm))
    return f"{abs(factor - 1.0):.1%} {'longer' if factor > 1.0 else 'shorter'}"


OFF = 0.04
"""Least logarithm of a factor that is corrected: depth of real sensors is off by 1 to 3 %."""
TILTED = 0.0175
"""Least turn [rad] of gravity that is corrected."""
CLEAR = 4.0
"""Least number of standard errors of a corrected unknown."""
SUSPECT = 0.02
"""Least logarithm in one linear step at the refined pose that starts a camera correction."""
PLAUSIBLE = 0.25
"""Largest logarithm; beyond, the pose is of another place."""
ENOUGH = 300
"""Least number of matches that tell the focal length of images."""
DULL = 0.35
"""Correlation of images with the map at a pose by depth, below which both may not be of one place."""
APART = (0.03, 0.012)
"""Way [m] and turn [rad] between depth and images from which on they are not of one view."""
ALIKE = 0.5
"""Largest difference of the turns of gravity that two halves of the frames find, as a share of their mean."""
GAIN = 0.04
"""Least share of the robust cost that a correction saves."""
TRIAL_MODES, TRIAL_FRAMES, TRIAL_READINGS = 4, 5, 500
"""Numbers of modes, frames, and readings a frame in a trial."""
TRIAL = (10.0, 10.0, 6.0, 6.0, 4.0)
"""Kernels of a trial [standard deviations]."""
LEAST, MOST = 6, 12
"""Least number of frames that tell a camera from a place, and largest number for a correction."""
ROUNDS = 4
SETTLED = 0.003
"""Largest change in the last round."""


def measure_scale_error(refiner: Refiner, trajectory: FittedTrajectory) -> float:
    """Return the logarithm by which the scale or focal length of depth looks off; 0: neither does.

    One linear step at the fitted poses, which tells that something is wrong better than by how much. Rows
    *focal length* and *depth scale*.
    """
    if not refiner.has_depth:
        return 0.0
    poses = (
        trajectory.poses
        if trajectory.lags is None
        else trajectory.lags.depth_poses(trajectory.poses)
    )
    free = [SCALE, FOCAL]
    search = calibrate_camera(refiner.scene, refiner.problem(), poses, free, TRIAL[:1])
    off = [search.values[k] for k in free if abs(search.values[k]) > CLEAR * search.errors[k]]
    return float(max(off, key=abs, default=0.0))


def find_camera_correction(
    window: Window, estimate: PoseEstimate, refining: RefineSetup
) -> CameraCorrection | None:
    """Find a correction of the camera of a window's frames; None: no clear fault."""
    told, found = estimate.refinement, diagnostics_of(estimate).refinement
    refined = told is not None and told.accepted
    certain = estimate.status is Status.OK and refined and not (found and found.camera)
    few = len(window) < LEAST or not refining.options.joint or estimate.best is None
    if few or certain:
        return None
    # depth tells enough at few places, and lags are told from frame to frame
    rows = np.arange(len(window))[-MOST:]
    case = _CameraSearch(_part(window, rows), refining)
    if not case.refiner(case.window).has_depth:
        return None
    starts = [estimate.trajectory[-len(rows) :]]
    if not refined:
        steps, levels = between(window.poses[-1], window.poses[rows]), window.levels[rows]
        modes = estimate.modes[:TRIAL_MODES]
        starts = [pose_matrix(compose(mode.pose, steps), levels) for mode in modes]
    poses = starts[0] if len(starts) == 1 else case.nearest(starts)
    correction = case.search(poses.copy())
    return correction if correction is not None and case.is_confirmed(poses) else None


def _part(window: Window, rows: NDArray[np.int64]) -> Window:
    return Window(window.query, window.scorer, [window.observations[i] for i in rows])


@dataclass(eq=False)
class _CameraSearch:
    """Search of a camera correction for the frames of a window."""

    window: Window
    refining: RefineSetup
    correction: CameraCorrection = field(default_factory=CameraCorrection)

    def refiner(self, window: Window, readings: int | None = None) -> Refiner:
        """Make a refiner of the frames with the correction so far."""
        frames = self.correction.frames([s.frame for s in window.observations])
        seen = [
            replace(s, frame=f, depth=correct_depth(f, s.depth))
            for s, f in zip(window.observations, frames, strict=True)
        ]
        mended = Window(window.query, window.scorer, seen)
        options = self.refining.options
        options = replace(options, readings=readings or options.readings)
        return Refiner.of(mended, options, None)

    def nearest(self, starts: list[Floats]) -> Floats:
        """Return the start (T, 4, 4) from which frames fit best with a free scale and focal length."""
        rows = spread(len(self.window), TRIAL_FRAMES)
        refiner = self.refiner(_part(self.window, rows), TRIAL_READINGS)
        problem, free = refiner.problem(), [SCALE, FOCAL]
        best, cost = starts[0], np.inf
        for start in starts:
            fit = calibrate_camera(refiner.scene, problem, start[rows], free, TRIAL)
            if fit.cost < cost and np.abs(fit.values).max() < PLAUSIBLE:
                best, cost = fit.poses[-1] @ np.linalg.inv(start[rows[-1]]) @ start, fit.cost
        return best

    def is_confirmed(self, poses: Floats) -> bool:
        """Return whether each half of the frames (poses (T, 4, 4)) has a correction that holds for the other.

        It lowers the cost of frames that it was not fitted to. Turns of gravity, which cost nothing as
        poses may lean, must be alike.
        """
        halves = np.array_split(np.arange(len(poses)), 2)
        parts = [_CameraSearch(_part(self.window, rows), self.refining) for rows in halves]
        if any(part.search(poses[rows]) is None for part, rows in zip(parts, halves, strict=True)):
            return False
        turns = [part.correction.values[list(TILT)] for part in parts]
        if np.linalg.norm(turns[0] - turns[1]) > ALIKE * np.linalg.norm(turns[0] + turns[1]) / 2.0:
            return False
        if not any(part.correction.values[: TILT[0]].any() for part in parts):
            return True
        for own, other, rows in ((0, 1, halves[1]), (1, 0, halves[0])):
            plain = _CameraSearch(parts[other].window, self.refining)
            before, after = (
                calibrate_camera(refiner.scene, refiner.problem(), poses[rows], []).cost
                for refiner in (
                    plain.refiner(plain.window, TRIAL_READINGS),
                    parts[own].refiner(plain.window, TRIAL_READINGS),
                )
            )
            if after > (1.0 - GAIN) * before:
                return False
        return True

    def search(self, poses: Floats) -> CameraCorrection | None:
        """Find the clear faults, from poses (T, 4, 4) nearby; None: none."""
        seen = self.window.observations
        coloured = self.window.scene.has_colours and any(s.rgb is not None for s in seen)
        for number in range(ROUNDS):
            refiner, matches = self.refiner(self.window), None
            free = [SCALE, FOCAL, *TILT]
            if coloured and number:
                matches = refiner.match(matching_stages(None, near=True)[0], poses)
                free += [IMAGE] if sum(map(len, matches)) >= ENOUGH else []
            poses, moved = self._select_unknowns(refiner, refiner.problem(matches), poses, free)
            if number and moved < SETTLED:
                break
        values = np.abs(self.correction.values[[SCALE, FOCAL, IMAGE, *TILT]])
        return (
            self.correction if self.correction.values.any() and values.max() < PLAUSIBLE else None
        )

    def _select_unknowns(
        self, refiner: Refiner, problem: Problem, poses: Floats, free: list[int]
    ) -> tuple[Floats, float]:
        """Fit poses with the unknowns that are clearly off, apply these, and return their largest change."""
        before, unknowns, least = self.correction.values, list(free), np.full(COUNT, OFF)
        tilt = list(TILT)
        least[tilt] = TILTED
        while True:
            fit = calibrate_camera(refiner.scene, problem, poses, unknowns)
            off, errors = np.abs(before + fit.values), fit.errors.copy()
            off[tilt], errors[tilt] = np.linalg.norm(off[tilt]), errors[tilt].max()
            sure = off / np.maximum(least, CLEAR * errors)
            weak = min((sure[k] for k in unknowns), default=1.0)
            if weak >= 1.0:
                break
            unknowns = [k for k in unknowns if sure[k] > weak]  # the three of a tilt go together
        usual = [k for k in unknowns if before[k] or k in TILT]  # poses lean without a cost, too
        if usual != unknowns:
            plain = calibrate_camera(refiner.scene, problem, poses, usual)
            if fit.cost > (1.0 - GAIN) * plain.cost:
                fit, unknowns = plain, usual
        if IMAGE in free and not before[list(PLACE)].any():
            fit, unknowns = self._offset(refiner, problem, fit, unknowns)
        values, errors = before.copy(), self.correction.errors.copy()
        out = [k for k in free if k not in unknowns]
        values[unknowns] += fit.values[unknowns]
        errors[unknowns] = fit.errors[unknowns]
        values[out] = errors[out] = 0.0
        frame = self.window.observations[0].frame
        if IMAGE not in free and share_view(frame.camera, frame.depth_camera):
            values[IMAGE], errors[IMAGE] = values[FOCAL], errors[FOCAL]
        self.correction = CameraCorrection(values, errors)
        return fit.poses, float(np.abs(values - before).max())

    def _offset(
        self, refiner: Refiner, problem: Problem, fit: CalibratedPoses, unknowns: list[int]
    ) -> tuple[CalibratedPoses, list[int]]:
        """Return the fit with depth apart from the images, if that is clear."""
        apart = calibrate_camera(refiner.scene, problem, fit.poses, [*unknowns, *PLACE])
        place, errors = apart.values[list(PLACE)], apart.errors[list(PLACE)]
        away = np.linalg.norm(place[:3]) > APART[0] or np.linalg.norm(place[3:]) > APART[1]
        clear = (np.abs(place) > CLEAR * errors).any()
        if away and clear and apart.cost < (1.0 - GAIN) * fit.cost:
            return apart, [*unknowns, *PLACE]
        return fit, unknowns
