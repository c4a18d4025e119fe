"""Refinement of an estimate: its best mode is fitted, and accepted if held-out samples confirm it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import PoseEstimate, PoseMode, Refinement, Status
from placegraph.core.geometry import (
    Camera,
    Floats,
    between,
    compose,
    pose_matrix,
    split_pose,
    wrap_angle,
)
from placegraph.errors import MissingExtraError, OptionError, ServiceError
from placegraph.indoor.likelihood.observe import COARSE, FINE
from placegraph.indoor.options import RefineOptions
from placegraph.indoor.pose import local_fit
from placegraph.indoor.pose.covariance import FITTED, bound_covariance, lens_covariance
from placegraph.indoor.pose.estimate import estimate_pose, evidence_at, judge_refined
from placegraph.indoor.pose.window import Chain, PoseQuery, Window, observe, time_stage
from placegraph.indoor.rays.trace_kernels import LANES
from placegraph.indoor.refine.camera_correction import (
    OFF,
    find_camera_correction,
    measure_scale_error,
)
from placegraph.indoor.refine.correspondences import (
    FARTHEST,
    SIGMA,
    Readings,
    Surfaces,
    distances,
    held_back,
    measure_move,
    shrink_camera,
)
from placegraph.indoor.refine.fit import odometry_errors
from placegraph.indoor.refine.matching import Matcher
from placegraph.indoor.refine.matching import matcher as matcher_named
from placegraph.indoor.refine.refine_kernels import correlations
from placegraph.indoor.refine.refiner import FittedTrajectory, Refiner
from placegraph.indoor.render import Renderer
from placegraph.indoor.render_kernels import TILE
from placegraph.indoor.status import (
    BENT,
    UNDECIDED,
    RefinementDiagnostics,
    decide_given,
    decide_refined,
    diagnostics_of,
)
from placegraph.io.capture.frame import Frame
from placegraph.io.capture.images import lightness, resize_image

NEAR = 0.1
"""Largest distance [m] of readings from the map's surface that count."""
FINEST = 0.005
"""Least deviation of readings and maps [m]."""
WORST = 10.0
"""Error, in units of the median, beyond which the log-likelihood is constant."""
SMALL = 160
"""Longer side at which images are compared [px]."""
COUNTED = 24
"""Least number of blocks of samples over all frames."""
_HALF = 3
_FEW = 4  # blocks whose spread is none
_ALIKE = 1e-9
_SAME = 0.99  # no window is more alike
_STEP = 2 * TILE  # a window lies in four packets of rays


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutEvidence:
    """Log-likelihoods of C trajectories by the held-out samples of one sense."""

    blocks: Floats
    """(C, B) log-likelihoods, summed up in blocks [nat]"""
    scores: Floats
    """(C, N) log-likelihoods of the informative samples [nat]"""

    @property
    def samples(self) -> int:
        """Return the number of informative samples."""
        return self.scores.shape[1]

    @classmethod
    def of(cls, scores: Sequence[Sequence[Floats]]) -> HeldOutEvidence:
        """Make evidence of scores [nat] of C trajectories, each of T frames, of samples (N,); NaN: none.

        Neighbours err together, so blocks vary more than sums of independent samples would; scores are
        divided by that factor (Kish's design effect).
        """
        frames = [np.stack(of_frame) for of_frame in zip(*scores, strict=True)]
        bands = max(1, -(-COUNTED // max(1, len(frames))))
        parts = [part for f in frames for part in np.array_split(f, bands, axis=1)]
        parts = [part[:, np.isfinite(part).all(axis=0)] for part in parts]
        blocks = np.array([part.sum(axis=1) for part in parts]).reshape(len(parts), len(scores)).T
        samples = np.concatenate([np.zeros((len(scores), 0)), *parts], axis=1)
        count, has_samples = samples.shape[1], np.array([part.shape[1] > 0 for part in parts], bool)
        effect = 1.0
        if count and len(scores) > 1:
            single = np.var(samples[1:] - samples[0], axis=1).sum() * count / has_samples.sum()
            together = np.var(blocks[1:, has_samples] - blocks[0, has_samples], axis=1).sum()
            effect = max(1.0, float(together / max(single, _ALIKE)))
        return cls(blocks / effect, samples)

    def correlation(self, row: int) -> float:
        """Return the mean correlation of the windows of images at a trajectory; NaN without any."""
        alike = np.sqrt(-np.expm1(-2.0 * self.scores[row]))
        return float(alike.mean()) if len(alike) else np.nan

    def gain(self, row: int) -> Floats:
        """Return the gain (B,) of the log-likelihood of a trajectory over the first [nat]."""
        return np.asarray(self.blocks[row] - self.blocks[0])


def standard_errors(gains: Floats) -> float:
    """Return the mean of gains (B,) over its standard error; blocks of 0 do not count."""
    clear_gains = gains[np.abs(gains) > _ALIKE]
    if len(clear_gains) < _FEW:
        return 0.0
    return float(clear_gains.mean() / (clear_gains.std() / np.sqrt(len(clear_gains)) + _ALIKE))


def cauchy_log_likelihood(ratio: Floats) -> Floats:
    """Return Cauchy log-likelihoods of errors in units of the median."""
    return np.asarray(-np.log1p(np.square(np.minimum(ratio, WORST))))


def depth_evidence(
    surfaces: Surfaces, held_out: Sequence[Readings | None], trajectories: Sequence[Floats]
) -> HeldOutEvidence:
    """Measure the evidence of held-out readings of T frames for trajectories (T, 4, 4), by tiles.

    Distances have a Cauchy density as wide as those of the trajectory that fits best.
    """
    found = [
        [np.abs(d).reshape(-1, LANES) for d in distances(surfaces, held_out, poses)]
        for poses in trajectories
    ]
    usual = [_median_distance(np.concatenate(of_one)) for of_one in found]
    width = max(FINEST, min(usual, default=NEAR))
    return HeldOutEvidence.of([[_of_tiles(d / width) for d in of_one] for of_one in found])


def _median_distance(distance: Floats) -> float:
    """Return the median of distances [m] below `NEAR`."""
    near = distance[distance < NEAR]
    return float(np.median(near)) if len(near) else NEAR


def _of_tiles(ratio: Floats) -> Floats:
    """Return mean log-likelihood (N,) of the readings of each tile (N, 16); NaN without a reading."""
    read = ~np.isnan(ratio)
    score = cauchy_log_likelihood(np.where(read, ratio, 0.0))
    count = read.sum(axis=1)
    return np.where(count > 0, score.sum(axis=1) / np.maximum(count, 1), np.nan)


def image_evidence(
    renderer: Renderer,
    frames: Sequence[Frame],
    queries: Sequence[NDArray[np.uint8] | None],
    trajectories: Sequence[Floats],
) -> HeldOutEvidence:
    """Measure the evidence of held-out windows of T images for trajectories (T, 4, 4).

    A window counts by its correlation rho with the rendering at the same place, -log(1 - rho^2) / 2, as one
    sample, since the map's colours err together. Flat windows of the query do not count.
    """
    scores: list[list[Floats]] = [[] for _ in trajectories]
    for t, (frame, query) in enumerate(zip(frames, queries, strict=True)):
        if query is None:
            for out in scores:
                out.append(np.zeros(0))
            continue
        small = shrink_camera(frame.camera, SMALL)
        seen = lightness(resize_image(query, small.width, small.height))
        at = _windows(small)
        wanted = np.zeros((-(-small.height // TILE), -(-small.width // TILE)), bool)
        for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
            wanted[at[:, 0] // TILE + row, at[:, 1] // TILE + column] = True
        for out, poses in zip(scores, trajectories, strict=True):
            drawn = renderer.render(poses[t], small, samples=1, wanted=wanted)
            alike = correlations(seen, lightness(drawn.colour), drawn.mask, at, _HALF)
            out.append(-0.5 * np.log1p(-np.square(np.minimum(alike, _SAME))))
    return HeldOutEvidence.of(scores)


def _windows(camera: Camera) -> NDArray[np.int64]:
    """Return centres (N, 2) row, column of the held-back windows of a camera's images."""
    rows = np.arange(_HALF, camera.height - _STEP + _HALF + 1, _STEP)
    columns = np.arange(_HALF, camera.width - _STEP + _HALF + 1, _STEP)
    at = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    return at[held_back(at[:, ::-1].astype(np.float64) + 0.5, camera)]


def landmark_scores(refiner: Refiner, trajectories: Sequence[Floats]) -> list[list[Floats]]:
    """Return log-likelihoods (N,) of held-out landmarks, of each trajectory (T, 4, 4) and frame.

    Landmarks that no trajectory explains are left out.
    """
    out: list[list[Floats]] = [[] for _ in trajectories]
    for t, (s, frame) in enumerate(zip(refiner.landmarks, refiner.frames, strict=False)):
        kept = s[held_back(s.pixels, frame.camera)]
        off = np.stack([kept.errors(poses[t]) for poses in trajectories]) / kept.unit
        off = off[:, off.min(axis=0) < refiner.options.inlier]
        for scores, of_one in zip(out, off, strict=True):
            scores.append(cauchy_log_likelihood(of_one / (2.0 * SIGMA)))
    return out


FARTHEST_BLIND = (0.6, 0.4)
"""`FARTHEST` without depth [m], [rad]."""
SURE = 1.0
"""Least gain of held-out samples on the refined trajectory [standard errors] ..."""
SURER = 3.0
"""... and with images alone, which are wrong together more easily (benchmark)."""
WITHIN = 7.8
"""Squared distance to a fit, in its deviations, that a coarse pose allows for: 95 %."""

NOTHING = "nothing in the frames can be matched with the map"

FELT = (0.005, float(np.radians(0.2)))
"""Least way [m] or turn [rad] by a sensor's lag that is reported."""


@dataclass(frozen=True, slots=True)
class FitCheck:
    """Check of a refined trajectory."""

    diagnostics: RefinementDiagnostics
    reason: str
    """One sentence."""
    candidate: FittedTrajectory
    """Trajectory that was checked: the full fit, or the fit by depth alone."""
    stats: dict[str, Any]
    correlation: float | None = None
    """Correlation of held-out parts of the images with the map; None: not compared."""

    @property
    def accepted(self) -> bool:
        """Return whether the trajectory is accepted."""
        return self.diagnostics.accepted


def confirm_fit(refiner: Refiner, coarse: Floats, candidate: FittedTrajectory) -> FitCheck:
    """Compare a refined trajectory, and what depth alone makes of it, with the coarse one (T, 4, 4)."""
    check = _check_plausibility(refiner, coarse, candidate)
    ways = [check]
    if candidate.by_depth is not None:
        alone = _check_plausibility(refiner, coarse, candidate.by_depth)
        ways = [way for way in (alone, check) if way.accepted]
        check = ways[-1] if ways else alone
    if not check.accepted:
        return check
    if not refiner.options.check:
        by = check.reason.removesuffix(".")
        return replace(check, reason=f"{by}, unchecked.")
    with time_stage(refiner.seconds, "check"):
        way, against = _choose_candidate(refiner, coarse, ways)
        way = _widen_by_scale(refiner, way)
    if against:
        found = replace(way.diagnostics, accepted=False)
        return replace(way, diagnostics=found, reason=f"Not refined: {against}.")
    reason = f"{way.reason}{_describe_lags(refiner, way.candidate)}"
    return replace(way, reason=reason, candidate=refiner.add_held_back(way.candidate))


def _check_plausibility(refiner: Refiner, coarse: Floats, candidate: FittedTrajectory) -> FitCheck:
    """Check a trajectory by itself: support by data, distance from the start, and odometry."""
    inliers = sum(map(len, candidate.matches))
    shift, turn = measure_move(coarse[-1], candidate.poses[-1])
    stats: dict[str, Any] = {
        "inliers": inliers,
        "shift_m": round(shift, 4),
        "turn_deg": round(float(np.degrees(turn)), 3),
    }
    against, objection, motion = "", "", 0.0
    if candidate.solution is None or (not refiner.has_depth and inliers < refiner.options.least):
        against = f"only {inliers} matches of images with the map agree" if inliers else NOTHING
    if not against and refiner.options.joint:
        way, angle = FARTHEST if refiner.has_depth else FARTHEST_BLIND
        if shift > way or turn > angle:
            far = f"{shift:.1f} m and {np.degrees(turn):.0f} degrees away"
            objection = against = f"the fit ended {far}, at another place"
        else:
            motion = stats["motion"] = _motion_error(refiner, candidate.poses)
            against = "it contradicts the odometry" if motion > BENT else ""
    # images alone do not outweigh depth
    objection = "" if refiner.has_depth else objection
    senses = ["depth"] * refiner.has_depth + [f"{inliers} matches of images"] * bool(inliers)
    by = f"Not refined: {against}." if against else f"Refined by {' and '.join(senses)}."
    found = RefinementDiagnostics(
        accepted=not against, objection=objection, motion=motion, has_depth=refiner.has_depth,
        landmarks=refiner.landmark_matches, shift=stats["shift_m"], turn_deg=stats["turn_deg"],
    )  # fmt: skip
    return FitCheck(found, by, candidate, stats)


def _describe_lags(refiner: Refiner, candidate: FittedTrajectory) -> str:
    """Describe lags of sensors that move a pose enough to matter."""
    if candidate.lags is None:
        return ""
    stamps = np.array([f.stamp for f in refiner.frames], np.float64)
    steps = np.diff(stamps)
    counted = bool(((steps >= 1.0) & (steps == np.rint(steps))).all())
    note = ""
    for what, lag in candidate.lags.find_clear().items():
        way, turn = (
            abs(lag) * np.linalg.norm(part, axis=1).max()
            for part in (candidate.lags.twist[:, :3], candidate.lags.twist[:, 3:])
        )
        if way > FELT[0] or turn > FELT[1]:
            taken = "images were" if what == "images" else "depth was"
            by = f"{abs(lag):.2g} {'frames' if counted else 's'}"
            side = "after" if lag > 0 else "before"
            its = "their stamps" if what == "images" else "its stamp"
            note += f" Note: {taken} taken {by} {side} {its}; this was corrected."
    return note


def _choose_candidate(
    refiner: Refiner, coarse: Floats, ways: Sequence[FitCheck]
) -> tuple[FitCheck, str]:
    """Choose the candidate that held-out samples make likeliest, and return an objection to it, if any.

    Log-likelihoods of the senses add up: none has a veto.
    """
    senses = _evidence(refiner, coarse, [way.candidate for way in ways])
    if not any(e.samples for e in senses.values()):
        return ways[-1], "no held-out pixels can confirm it"
    gains = [np.sum([e.gain(k + 1) for e in senses.values()], axis=0) for k in range(len(ways))]
    row = int(np.argmax([np.sum(gain) for gain in gains]))
    way, z = ways[row], standard_errors(gains[row])
    way.stats["held_back"] = {
        name: {
            "samples": e.samples,
            "gain": round(float(e.gain(row + 1).sum()), 2),
            "z": round(standard_errors(e.gain(row + 1)), 2),
        }
        for name, e in senses.items()
    }
    if "images" in senses and senses["images"].samples:
        way = replace(way, correlation=round(senses["images"].correlation(row + 1), 3))
        way.stats["held_back"]["images"]["alike"] = way.correlation
    # landmarks were found in the whole map: unlike renderings they are not wrong together
    by_landmarks = refiner.landmark_matches is not None
    off = way.candidate.poses[-1, :3, 3] - coarse[-1, :3, 3]
    near = refiner.loose is not None and off @ np.linalg.solve(refiner.loose, off) < WITHIN
    needed = SURE if refiner.has_depth or by_landmarks or near else SURER
    if z < (-SURE if by_landmarks and near else needed):
        return way, "held-out pixels do not fit better than at the coarse pose"
    return way, ""


def _evidence(
    refiner: Refiner, coarse: Floats, candidates: Sequence[FittedTrajectory]
) -> dict[str, HeldOutEvidence]:
    """Measure each sense's evidence for the coarse trajectory and the candidates, in that order."""
    found, looked = {}, set(refiner.image_rows().tolist())
    measured, pictured = [coarse], [coarse]
    for fit in candidates:
        lags = fit.lags
        measured.append(fit.poses if lags is None else lags.depth_poses(fit.poses))
        pictured.append(fit.poses if lags is None else lags.image_poses(fit.poses))
    if refiner.has_depth:
        held_out = [r if t in looked else None for t, r in enumerate(refiner.readings(1))]
        found["depth"] = depth_evidence(refiner.surfaces, held_out, measured)
    landmarks = HeldOutEvidence.of(landmark_scores(refiner, pictured))
    if landmarks.samples >= refiner.options.least:
        found["landmarks"] = landmarks
    queries = [q if t in looked else None for t, q in enumerate(refiner.queries)]
    if refiner.scene.has_colours and any(query is not None for query in queries):
        found["images"] = image_evidence(refiner.renderer, refiner.frames, queries, pictured)
    return found


def _widen_by_scale(refiner: Refiner, way: FitCheck) -> FitCheck:
    """Widen the covariance for an uncertain focal length, or else for a large error of depth's scale.

    The pose may be off along the last frame's optical axis by that share of its median depth.
    """
    read, fit = refiner.readings()[-1], way.candidate
    if not refiner.has_depth:
        covariance = fit.covariance.copy()
        covariance[:3, :3] += lens_covariance(
            refiner.scene, refiner.frames[-1].camera, fit.poses[-1]
        )
        return replace(way, candidate=replace(fit, covariance=covariance))
    factor = measure_scale_error(refiner, fit)
    way = replace(way, diagnostics=replace(way.diagnostics, scale_error=factor))
    depths = np.zeros(0) if read is None else read.depth[read.depth > 0]
    if abs(factor) <= OFF or not len(depths):
        return way
    off = factor * float(np.median(depths)) * fit.poses[-1, :3, 2]
    covariance = fit.covariance.copy()
    covariance[:3, :3] += np.outer(off, off)
    widened = replace(fit, covariance=covariance)
    loose = replace(way.diagnostics, loose=float(np.linalg.norm(off)))
    return replace(way, candidate=widened, diagnostics=loose)


def _motion_error(refiner: Refiner, poses: Floats) -> float:
    """Return the root mean square of the odometry's normalised errors."""
    if len(poses) < 2:
        return 0.0
    errors, deviations = odometry_errors(refiner.problem(), poses)
    return round(float(np.sqrt(np.mean((errors / deviations) ** 2))), 2)


MOST = 30
"""Largest number of frames that are refined together, the newest."""


@dataclass(frozen=True, eq=False)
class RefineSetup:
    """Options and matcher of a refinement."""

    options: RefineOptions
    matcher: Matcher | None
    """None: the guided one, which the refiner makes itself."""

    @classmethod
    def of(
        cls, options: RefineOptions | None, matcher: str | Matcher, device: str = "auto"
    ) -> RefineSetup:
        """Make a setup with a matcher, or its name; raises as `matching.matcher` does."""
        options = options or RefineOptions()
        if not isinstance(matcher, str):
            if not isinstance(matcher, Matcher):
                raise OptionError(
                    f"matcher is {matcher!r}; give a name, or an object with name and match."
                )
            return cls(options, matcher)
        if matcher == "guided" or (matcher == "auto" and options.views == 1):
            return cls(options, None)
        on = "cuda" if device.startswith("cuda") else "cpu"
        if matcher != "auto":
            return cls(options, matcher_named(matcher, device=on))
        try:  # several views are for a matcher that knows no neighbourhood
            return cls(options, matcher_named("roma", device=on))
        except (MissingExtraError, ServiceError):
            return cls(options, matcher_named("sift"))


def refine_estimate(
    window: Window, estimate: PoseEstimate, refining: RefineSetup, *, explained: bool = False
) -> PoseEstimate:
    """Refine the best mode of an estimate, or give the reason why the coarse pose stands.

    Parameters
    ----------
    window
        The newest frames of the estimate; of more than `MOST` the newest are refined, except where
        each is by itself, as in the paper. Senses that were switched off for the filter are off here.
    estimate
        One that is `LOST` is returned as it is, except where a frame decides as in the paper.
    explained
        Find the evidence of the refined pose, too; else that of the coarse one stands.

    """
    lost = estimate.status is Status.LOST and refining.options.joint
    if estimate.best is None or lost:
        return estimate
    if refining.options.joint:
        window = window.last(MOST)
    refiner = Refiner.of(window, refining.options, refining.matcher)
    start = estimate.trajectory[-len(window) :]
    return refine_from(window, estimate, refiner, start, explained=explained)


def refine_from(
    window: Window, estimate: PoseEstimate, refiner: Refiner, start: Floats, *, explained: bool
) -> PoseEstimate:
    """Refine an estimate from a start (T, 4, 4) of the window's frames, as `refine_estimate` does.

    Without PoseLib depth alone is used.
    """
    coarse, progress = estimate.trajectory[-len(start) :], window.query.progress
    refiner.loose = estimate.modes[0].covariance[:3, :3] + _SHARPEST**2 * np.eye(3)
    try:
        check = confirm_fit(refiner, coarse, refiner.fit_trajectory(start, progress))
    except MissingExtraError as error:
        if refiner.matcher is not None:
            raise
        if refiner.has_depth:
            refiner.options = replace(refiner.options, images=False)
            check = confirm_fit(refiner, coarse, refiner.fit_trajectory(start, progress))
        else:
            nothing = FittedTrajectory(start, None, [], np.full((6, 6), np.nan))
            found = RefinementDiagnostics(has_depth=False, landmarks=refiner.landmark_matches)
            check = FitCheck(found, f"Not refined: {error}", nothing, {})
    if check.accepted:
        trajectory, mode = check.candidate, estimate.modes[0]
        refined, covariance = split_pose(trajectory.poses)[0], trajectory.covariance
        if diagnostics_of(estimate).semantic is not None:
            shift = trajectory.poses[-1, :3, 3] - mode.map_from_camera[:3, 3]
            covariance = bound_covariance(covariance, mode.covariance, shift)
            check = replace(check, candidate=replace(trajectory, covariance=covariance))
        estimate = judge_refined(window, estimate, refined, covariance, check.correlation)
    checked = _apply_check(estimate, refiner, check)
    best = checked.best
    if explained and check.accepted and best is not None:
        best = replace(
            best, explain=evidence_at(window, split_pose(checked.trajectory[-len(window) :])[0])
        )
        checked = replace(checked, modes=(best, *checked.modes[1:]))
    return checked


def _apply_check(estimate: PoseEstimate, refiner: Refiner, check: FitCheck) -> PoseEstimate:
    """Apply a check to the best mode of an estimate."""
    coarse, trajectory = estimate.modes[0], estimate.trajectory
    best, candidate = coarse, check.candidate
    if check.accepted:
        before = trajectory[: len(trajectory) - len(candidate.poses)]
        trajectory = np.concatenate([before, candidate.poses])
        # a mode at its refined pose
        matrix = candidate.poses[-1]
        into_scene = coarse.scene_from_camera @ np.linalg.inv(coarse.map_from_camera)
        best = replace(
            coarse,
            map_from_camera=matrix,
            pose=split_pose(matrix)[0],
            covariance=candidate.covariance,
            scene_from_camera=into_scene @ matrix,
        )
    matcher = refiner.matcher.name if refiner.matcher else "guided"
    seconds = {stage: round(value, 4) for stage, value in refiner.seconds.items()}
    stats = {**check.stats, **refiner.stats, "matcher": matcher, "seconds": seconds}
    if candidate.solution is not None and not check.accepted:
        stats["candidate"] = candidate.poses[-1].tolist()  # what was refused
    refined = replace(estimate, modes=(best, *estimate.modes[1:]))
    status, reason = decide_refined(refined, check.diagnostics)
    return replace(
        refined,
        status=status,
        reason=reason,
        trajectory=trajectory,
        refinement=Refinement(check.accepted, check.reason, coarse, estimate.trajectory, stats),
        diagnostics=replace(diagnostics_of(estimate), refinement=check.diagnostics),
    )


_NEARLY = np.array([0.03, 0.03, 0.02, 0.015])
_SHARPEST = 1e-3  # least deviation of a given pose [m], [rad]


def refine(query: PoseQuery, given: Floats, refining: RefineSetup) -> PoseEstimate:
    """Refine the pose of the last frame from a rough one (4, 4).

    With depth, the neighbourhood is searched first. Errors: `SceneMap.refine`.
    """
    query = replace(query, frames=query.frames[-MOST:])
    window, estimate = _refined(query, given, refining)
    correction = find_camera_correction(window, estimate, refining)
    if correction is None:
        return estimate
    mended = replace(query, frames=correction.frames(query.frames))
    return correction.choose_answer(query, estimate, _refined(mended, given, refining)[1])


def _refined(query: PoseQuery, given: Floats, refining: RefineSetup) -> tuple[Window, PoseEstimate]:
    """Refine a given pose with the camera as given; return window and estimate."""
    window = observe(query)
    odometry = np.stack([f.odometry for f in query.frames])
    coarse = given @ np.linalg.inv(odometry[-1]) @ odometry
    start = coarse
    if any(s.depth is not None for s in window.observations):
        start = _searched(window, given, refining.options)
    refiner = Refiner.of(window, refining.options, refining.matcher)
    refiner.prior = coarse, _reach(refining.options)
    refined = refine_from(
        window,
        _estimate_given_pose(window, coarse, refining.options),
        refiner,
        start,
        explained=True,
    )
    assert refined.best is not None  # noqa: S101  it was given
    # the status that the window has at this pose, were it the only one
    chain = Chain.of(split_pose(refined.trajectory)[0], window.options.motion)
    covariance = refined.best.covariance[np.ix_(FITTED, FITTED)]
    fit = replace(local_fit.Fit.at(chain, refined.best.pose), covariance=covariance)
    return window, decide_given(refined, estimate_pose(window, [fit]))


def _searched(window: Window, given: Floats, options: RefineOptions) -> Floats:
    """Search the best pose near a given one by the likelihood of the search: (T, 4, 4)."""
    rng = np.random.default_rng(window.query.seed)
    pose, _ = split_pose(given)
    reach = _reach(options)[[0, 1, 2, 5]]
    wide = local_fit.fit_level(window, COARSE, rounds=4)
    fit = local_fit.fit_pose(window.scorer, pose, reach, wide, rng)
    spread = np.maximum(fit.spread, _NEARLY)
    narrow = local_fit.fit_level(window, FINE, rounds=2)
    fit = local_fit.fit_pose(window.scorer, fit.pose, spread, narrow, rng)
    # directions without readings, such as the height between bare walls, drift away
    off = fit.pose - pose
    off[3] = wrap_angle(off[3])
    found = pose + np.clip(off, -3.0 * reach, 3.0 * reach)
    return pose_matrix(compose(found, between(fit.pose, fit.poses)), window.levels)


def _reach(options: RefineOptions) -> Floats:
    """Return standard deviations (6,) [m], [rad] of a given pose."""
    way, turn = options.reach
    return np.maximum([way, way, 0.3 * way, turn, turn, turn], _SHARPEST)


def _estimate_given_pose(window: Window, coarse: Floats, options: RefineOptions) -> PoseEstimate:
    """Make an estimate of a given pose, before any frame is used."""
    matrix, scene = coarse[-1], window.scene
    row = scene.scene_at(matrix[:2, 3])
    mode = PoseMode(
        map_from_camera=matrix,
        pose=split_pose(matrix)[0],
        covariance=np.diag(np.square(_reach(options))),
        probability=1.0,
        scene=scene.scenes[row],
        scene_from_camera=scene.scene_from_map[row] @ matrix,
    )
    rows = np.array([f.index for f in window.query.frames])
    return PoseEstimate(UNDECIDED, (mode,), "", trajectory=coarse, frames=rows, map=scene)
