"""Correction of a camera that is not as the capture says, by frames with depth.

Used for an answer that is not `OK`, whose refinement was refused, or if `measure_scale_error` suspects the
camera. Unknowns, with their rows in docs/benchmarks/indoor.md: scale (*depth scale*) and focal length (*focal
length*) of depth, and a turn of gravity (*tilt*). Gauss-Newton finds them together with the poses: the
normal equations of all poses (`fit`) are bordered by the unknowns that frames have in common. Depth tells
its scale (which grows along the rays) from its focal length (across them). Frames are corrected round by
round; an unknown that is not clearly off stays as given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Calibration, PoseEstimate, Status
from placegraph.core.geometry import (
    Camera,
    Floats,
    cross_matrix,
    rotation_from_vector,
)
from placegraph.core.threads import multiply_matrices
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.pose.window import PoseQuery, Window
from placegraph.indoor.refine.fit import (
    READINGS,
    Problem,
    add_priors,
    measure_lean,
)
from placegraph.indoor.refine.refiner import FittedTrajectory, Refiner
from placegraph.indoor.status import HOPELESS, choose_camera, diagnostics_of
from placegraph.io.capture.frame import Frame, Images, LazyImages

if TYPE_CHECKING:
    from placegraph.indoor.refine.correspondences import Readings
    from placegraph.indoor.refine.refinement import RefineSetup

SCALE, FOCAL = range(2)
"""Unknowns: logarithms of the factors on depth readings and on the focal length of depth."""
TILT = [2, 3, 4]
"""Turn [rad] of gravity, in the axes of the camera: an accelerometer that is mounted aslant."""
COUNT = 5
BEFORE = np.array([0.15, 0.15, 0.1, 0.1, 0.1])
"""Prior standard deviations of the unknowns."""
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
    """Mean robust cost of readings, 0 to 1."""


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
    solved, cost = np.array(free, int), np.nan
    covariance = np.eye(size + len(solved))
    for width in widths:
        h, g, costs = np.zeros((size + COUNT,) * 2), np.zeros(size + COUNT), []
        for t, readings in enumerate(problem.readings):
            if readings is None or not (readings.depth > 0).any():
                continue
            j, e, weights, missed = _linearize_depth(
                scene, problem, readings, poses[t], values, width
            )
            at, weighted = np.r_[6 * t : 6 * t + 6, size : size + COUNT], j.T * weights
            h[np.ix_(at, at)] += multiply_matrices(weighted, j)
            g[at] += weighted @ e
            costs.append(missed)
        upright = replace(problem, gravity=turn_gravity(problem.gravity, values))
        add_priors(upright, poses, start, h[:size, :size], g[:size])
        _add_tilt(upright, poses, values, h, g)
        h[size:, size:] += np.diag(1.0 / BEFORE**2)
        g[size:] += values / BEFORE**2
        unknowns = np.r_[0:size, size + solved]
        try:
            covariance = np.linalg.inv(h[np.ix_(unknowns, unknowns)])
            step = -covariance @ g[unknowns]
        except np.linalg.LinAlgError:
            step = np.full(len(unknowns), np.nan)
        if not np.isfinite(step).all():
            return CalibratedPoses(start.copy(), np.zeros(COUNT), np.zeros(COUNT), np.inf)
        moves = step[:size].reshape(-1, 6)
        poses[:, :3, 3] += moves[:, :3]
        poses[:, :3, :3] = rotation_from_vector(moves[:, 3:]) @ poses[:, :3, :3]
        values[solved] += step[size:]
        cost = float(np.mean(costs)) if costs else np.nan
    errors = np.zeros(COUNT)
    errors[solved] = np.sqrt(np.diag(covariance)[size:])
    return CalibratedPoses(poses, values, errors, cost)


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
    g[own] += down * (down @ values[TILT])


def turn_gravity(gravity: Floats, values: Floats) -> Floats:
    """Correct directions of gravity (..., 3) in camera axes."""
    return np.asarray(gravity @ rotation_from_vector(values[TILT]).T)


def _linearize_depth(
    scene: Scene, problem: Problem, readings: Readings, pose: Floats, values: Floats, width: float
) -> tuple[Floats, Floats, Floats, float]:
    """Linearize distances of readings to the planes that they hit, with the weights of `depth_system`.

    Returns derivatives (R, 6 + COUNT) by a shift [m] and a turn [rad] of the camera in map axes and by
    the unknowns (not the turn of gravity), residuals (R,) [m], weights (R,), and the mean robust cost.
    """
    noise, read = problem.options.noise, readings.depth > 0
    rotation = pose[:3, :3]
    inside = readings.directions[read] * np.exp([-values[FOCAL], -values[FOCAL], 0.0])
    hits = scene.caster.cast(pose[:3, 3], inside @ rotation.T)
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
    wider = (inside * (1.0, 1.0, 0.0) * z[:, None]) @ rotation.T
    j[:, 6 + SCALE], j[:, 6 + FOCAL] = slant * z, -np.sum(normals * wider, axis=1)
    missed = 1.0 - float(np.sum(share / (1.0 + ratio))) / count
    return j, e, worth * share / (1.0 + ratio) ** 2 / variance, missed


_SAME = 1e-3  # of an image's width: intrinsics of one view


@dataclass(frozen=True, eq=False)
class CameraCorrection:
    """Corrections of a camera, by `calibrate_camera`."""

    values: Floats = field(default_factory=lambda: np.zeros(COUNT))
    """(COUNT,)"""
    errors: Floats = field(default_factory=lambda: np.zeros(COUNT))
    """(COUNT,) standard deviations."""

    def frames(self, frames: Sequence[Frame]) -> list[Frame]:
        """Return frames of one capture as their camera should have them."""
        factor, focal = float(np.exp(self.values[SCALE])), float(self.values[FOCAL])

        def correct(camera: Camera | None, depth: Camera | None) -> Camera | None:
            return scale_focal(camera, focal) if camera and share_view(camera, depth) else camera

        return [
            replace(
                f,
                camera=correct(f.camera, f.depth_camera) or f.camera,
                depth_camera=correct(f.depth_camera, f.depth_camera),
                label_camera=correct(f.label_camera, f.depth_camera),
                images=f.images if factor == 1.0 else ScaledDepth(f.images, factor),
                gravity=turn_gravity(f.gravity, self.values),
            )
            for f in frames
        ]

    def choose_answer(
        self, query: PoseQuery, before: PoseEstimate, after: PoseEstimate
    ) -> PoseEstimate:
        """Return the better answer of those before and after mending, with what was found."""
        factors, errors = np.exp(self.values), self.errors
        calibration = Calibration(
            focal_factor=(float(factors[FOCAL]), float(errors[FOCAL])),
            depth_scale=(float(factors[SCALE]), float(errors[SCALE])),
            gravity_turn=self.values[TILT],
        )
        return choose_camera(
            before, after, calibration, self.sentence(query.frames[-1]),
            tilt_only=not self.values[[SCALE, FOCAL]].any(),
        )  # fmt: skip

    def sentence(self, frame: Frame) -> str:
        """Describe the fault, and the right entries of `camera.json`."""
        parts, focal, scale = [], float(self.values[FOCAL]), float(np.exp(self.values[SCALE]))
        if focal and frame.depth_camera is not None:
            both = share_view(frame.camera, frame.depth_camera)
            fits = scale_focal(frame.camera if both else frame.depth_camera, focal)
            factor = float(np.exp(focal))
            parts.append(
                f"The focal length{'' if both else ' of the depth camera'} is "
                f"{abs(factor - 1.0):.1%} {'longer' if factor > 1.0 else 'shorter'} than in its "
                f"intrinsics: fx {fits.fx:.1f}, fy {fits.fy:.1f} would fit."
            )
        if scale != 1.0:
            unit = frame.images.unit if isinstance(frame.images, LazyImages) else None
            fits_ = (
                f"{unit.source} {unit.per_metre / scale:.5g}" if unit else f"{scale:.3f} times them"
            )
            parts.append(
                f"Depth readings are {abs(1.0 / scale - 1.0):.1%} too "
                f"{'short' if scale > 1 else 'long'}: {fits_} would fit."
            )
        turn = np.degrees(self.values[TILT]) + 0.0
        if turn.any():
            parts.append(
                f"Gravity is {np.linalg.norm(turn):.1f} degrees off: a rotation by {turn[0]:.1f}, "
                f"{turn[1]:.1f}, {turn[2]:.1f} degrees in camera axes would fit."
            )
        return " ".join(parts)


@dataclass(frozen=True, slots=True, eq=False)
class ScaledDepth:
    """Images of a frame with depth multiplied by a factor."""

    images: Images
    factor: float

    def rgb(self) -> NDArray[np.uint8]:
        """See `Frame.rgb`."""
        return self.images.rgb()

    def labels(self) -> NDArray[np.int32] | None:
        """See `Frame.labels`."""
        return self.images.labels()

    def depth(self) -> NDArray[np.float32] | None:
        """See `Frame.depth`."""
        depth = self.images.depth()
        return None if depth is None else depth * np.float32(self.factor)


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
ALIKE = 0.5
"""Largest difference of the turns of gravity that two halves of the frames find, as a share of their mean."""
GAIN = 0.04
"""Least share of the robust cost that a correction saves."""
READINGS_EACH = 500
"""Number of depth readings a frame."""
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
    lags, poses, free = trajectory.lags, trajectory.poses, [SCALE, FOCAL]
    if lags is not None:
        poses = lags.depth_poses(poses)
    found = calibrate_camera(refiner.scene, refiner.problem(), poses, free, WIDTHS[:1])
    off = [found.values[k] for k in free if abs(found.values[k]) > CLEAR * found.errors[k]]
    return float(max(off, key=abs, default=0.0))


def find_camera_correction(
    window: Window, estimate: PoseEstimate, refining: RefineSetup
) -> CameraCorrection | None:
    """Find a correction of the camera of a window's frames; None: no clear fault."""
    told, found = estimate.refinement, diagnostics_of(estimate)
    refined = told is not None and told.accepted
    suspected = found.refinement is not None and abs(found.refinement.scale_error) > SUSPECT
    if estimate.status is Status.OK and refined and not suspected:
        return None
    few = len(window) < LEAST or not refining.options.joint or estimate.best is None
    if few or found.searched < HOPELESS:
        return None
    rows = np.arange(len(window))[-MOST:]
    case = _CameraSearch(_part(window, rows), refining)
    if not case.refiner(case.window).has_depth:
        return None
    poses = estimate.trajectory[-len(rows) :]
    correction = case.search(poses)
    return correction if correction is not None and case.is_confirmed(poses) else None


def _part(window: Window, rows: NDArray[np.int64]) -> Window:
    return Window(window.query, window.scorer, [window.observations[i] for i in rows])


@dataclass(eq=False)
class _CameraSearch:
    """Search of a camera correction for the frames of a window."""

    window: Window
    refining: RefineSetup
    correction: CameraCorrection = field(default_factory=CameraCorrection)

    def refiner(self, window: Window) -> Refiner:
        """Make a refiner of the frames with the correction so far."""
        frames = self.correction.frames([s.frame for s in window.observations])
        factor = np.float32(np.exp(self.correction.values[SCALE]))
        seen = [
            replace(s, frame=f, depth=None if s.depth is None else s.depth * factor)
            for s, f in zip(window.observations, frames, strict=True)
        ]
        options = replace(self.refining.options, readings=READINGS_EACH, images=False)
        return Refiner.of(Window(window.query, window.scorer, seen), options, None)

    def is_confirmed(self, poses: Floats) -> bool:
        """Return whether each half of the frames (poses (T, 4, 4)) has a correction that holds for the other.

        It lowers the cost of frames that it was not fitted to. Turns of gravity, which cost nothing as
        poses may lean, must be alike.
        """
        halves = np.array_split(np.arange(len(poses)), 2)
        parts = [_CameraSearch(_part(self.window, rows), self.refining) for rows in halves]
        if any(part.search(poses[rows]) is None for part, rows in zip(parts, halves, strict=True)):
            return False
        turns = [part.correction.values[TILT] for part in parts]
        if np.linalg.norm(turns[0] - turns[1]) > ALIKE * np.linalg.norm(turns[0] + turns[1]) / 2.0:
            return False
        if not any(part.correction.values[: TILT[0]].any() for part in parts):
            return True
        for own, other, rows in ((0, 1, halves[1]), (1, 0, halves[0])):
            plain = _CameraSearch(parts[other].window, self.refining)
            before, after = (
                calibrate_camera(refiner.scene, refiner.problem(), poses[rows], []).cost
                for refiner in (plain.refiner(plain.window), parts[own].refiner(plain.window))
            )
            if after > (1.0 - GAIN) * before:
                return False
        return True

    def search(self, poses: Floats) -> CameraCorrection | None:
        """Find the clear faults, from poses (T, 4, 4) nearby; None: none.

        Gravity is doubted last: a turn of it hides much of a wrong scale or focal length.
        """
        for free in ([SCALE, FOCAL], TILT):
            self.correction, start = CameraCorrection(), poses
            for number in range(ROUNDS):
                before = self.correction.values
                start = self._select_unknowns(start, free)
                moved = np.abs(self.correction.values - before).max()
                if moved == 0.0 or (number and moved < SETTLED):
                    break
            if 0.0 < np.abs(self.correction.values).max() < PLAUSIBLE:
                return self.correction
        return None

    def _select_unknowns(self, poses: Floats, free: list[int]) -> Floats:
        """Fit poses (T, 4, 4) with the unknowns that are clearly off, and apply these; return the poses."""
        refiner, unknowns, least = self.refiner(self.window), free, np.full(COUNT, OFF)
        problem, before = refiner.problem(), self.correction.values
        least[TILT] = TILTED
        while True:
            fit = calibrate_camera(refiner.scene, problem, poses, unknowns)
            off, errors = np.abs(before + fit.values), fit.errors.copy()
            off[TILT], errors[TILT] = np.linalg.norm(off[TILT]), errors[TILT].max()
            sure = off / np.maximum(least, CLEAR * errors)
            weak = min((sure[k] for k in unknowns), default=1.0)
            if weak >= 1.0:
                break
            unknowns = [k for k in unknowns if sure[k] > weak]  # the three of a tilt go together
        usual = [k for k in free if before[k]]
        if usual != unknowns and free is not TILT:  # poses lean without a cost
            plain = calibrate_camera(refiner.scene, problem, poses, usual)
            if fit.cost > (1.0 - GAIN) * plain.cost:
                fit, unknowns = plain, usual
        values, errors = np.zeros(COUNT), np.zeros(COUNT)
        values[unknowns] = (before + fit.values)[unknowns]
        errors[unknowns] = fit.errors[unknowns]
        self.correction = CameraCorrection(values, errors)
        return fit.poses
