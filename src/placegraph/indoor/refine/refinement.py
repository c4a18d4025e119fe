"""Refinement of an estimate: its best mode fitted to centimetres, or the reason why not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from placegraph.core.estimate import PoseEstimate, PoseMode, Refinement, Status
from placegraph.core.geometry import Floats, between, compose, pose_matrix, split_pose, wrap_angle
from placegraph.errors import MissingExtraError, OptionError, ServiceError
from placegraph.indoor.likelihood.observe import COARSE, FINE
from placegraph.indoor.pose import local_fit
from placegraph.indoor.pose.covariance import FITTED
from placegraph.indoor.pose.estimate import estimate_pose, evidence_at
from placegraph.indoor.pose.window import Chain, PoseQuery, Window, observe
from placegraph.indoor.refine.camera_correction import find_camera_correction
from placegraph.indoor.refine.confidence import Confirmation, confirm_fit
from placegraph.indoor.refine.matching import Matcher
from placegraph.indoor.refine.matching import matcher as matcher_named
from placegraph.indoor.refine.options import RefineOptions
from placegraph.indoor.refine.refiner import FittedTrajectory, Refiner
from placegraph.indoor.status import (
    UNDECIDED,
    RefinementDiagnostics,
    decide_given,
    decide_refined,
    diagnostics_of,
)

MOST = 30
"""Frames that are refined together, the newest."""


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
        """With a matcher by its name, or one of one's own; raises as `matching.matcher` does."""
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
    """Return the estimate with its best mode refined, or with the reason why the coarse pose stands.

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
    """Return the estimate refined from a start (T, 4, 4) of the window's frames, as in `refine_estimate`.

    Where something is not installed, what can be done without it is done.
    """
    coarse, progress = estimate.trajectory[-len(start) :], window.query.progress
    try:
        judgement = confirm_fit(refiner, coarse, refiner.fitted(start, progress))
    except MissingExtraError as error:
        if refiner.matcher is not None:
            raise
        if refiner.has_depth:
            refiner.options = replace(refiner.options, images=False)
            judgement = confirm_fit(refiner, coarse, refiner.fitted(start, progress))
        else:
            nothing = FittedTrajectory(start, None, [], np.full((6, 6), np.nan))
            judgement = Confirmation(False, f"Not refined: {error}", nothing, {})
    told = _told(estimate, refiner, judgement)
    best = told.best
    if explained and judgement.accepted and best is not None:
        best = replace(
            best, explain=evidence_at(window, split_pose(told.trajectory[-len(window) :])[0])
        )
        told = replace(told, modes=(best, *told.modes[1:]))
    return told


def _told(estimate: PoseEstimate, refiner: Refiner, judgement: Confirmation) -> PoseEstimate:
    """Return the estimate with what became of its best mode."""
    coarse, trajectory = estimate.modes[0], estimate.trajectory
    best, fitted = coarse, judgement.fitted
    if judgement.accepted:
        before = trajectory[: len(trajectory) - len(fitted.poses)]
        trajectory = np.concatenate([before, fitted.poses])
        # a mode at its refined pose
        matrix = fitted.poses[-1]
        into_scene = coarse.scene_from_camera @ np.linalg.inv(coarse.map_from_camera)
        best = replace(
            coarse,
            map_from_camera=matrix,
            pose=split_pose(matrix)[0],
            covariance=fitted.covariance,
            scene_from_camera=into_scene @ matrix,
        )
    matcher = refiner.matcher.name if refiner.matcher else "guided"
    seconds = {stage: round(value, 4) for stage, value in refiner.seconds.items()}
    stats = {**judgement.stats, **refiner.stats, "matcher": matcher, "seconds": seconds}
    if fitted.solution is not None and not judgement.accepted:
        stats["candidate"] = fitted.poses[-1].tolist()  # what was refused
    found = RefinementDiagnostics(
        accepted=judgement.accepted,
        doubt=judgement.doubt,
        motion=judgement.motion,
        has_depth=refiner.has_depth,
        landmarks=refiner.landmark_matches,
        shift=judgement.shift,
        turn_deg=judgement.turn_deg,
        camera=judgement.camera,
    )
    status, reason = decide_refined(estimate, found)
    return replace(
        estimate,
        status=status,
        reason=reason,
        modes=(best, *estimate.modes[1:]),
        trajectory=trajectory,
        refinement=Refinement(
            judgement.accepted, judgement.reason, coarse, estimate.trajectory, stats
        ),
        diagnostics=replace(diagnostics_of(estimate), refinement=found),
    )


_NEARLY = np.array([0.03, 0.03, 0.02, 0.015])
_SHARPEST = 1e-3  # nobody knows a pose better than this [m], [rad]


def refine(query: PoseQuery, given: Floats, refining: RefineSetup) -> PoseEstimate:
    """Return the pose of the last frame asked about, from where (4, 4) it is roughly known to be.

    Where there is depth, the neighbourhood is searched first. Errors: `SceneMap.refine`.
    """
    query = replace(query, frames=query.frames[-MOST:])
    window, estimate = _refined(query, given, refining)
    mend = find_camera_correction(window, estimate, refining)
    if mend is None:
        return estimate
    mended = replace(query, frames=mend.frames(query.frames))
    return mend.chosen(query, estimate, _refined(mended, given, refining)[1])


def _refined(query: PoseQuery, given: Floats, refining: RefineSetup) -> tuple[Window, PoseEstimate]:
    """Return the answer if the camera is as it is said to be, and the frames that it rests on."""
    window = observe(query)
    odometry = np.stack([f.odometry for f in query.frames])
    coarse = given @ np.linalg.inv(odometry[-1]) @ odometry
    start = coarse
    if any(s.depth is not None for s in window.sightings):
        start = _searched(window, given, refining.options)
    refiner = Refiner.of(window, refining.options, refining.matcher)
    refiner.known = coarse, np.maximum(_reach(refining.options), _SHARPEST)
    told = refine_from(
        window, _given(window, coarse, refining.options), refiner, start, explained=True
    )
    assert told.best is not None  # noqa: S101  it was given
    # the status that the window has at this pose, were it the only one
    chain = Chain.of(split_pose(told.trajectory)[0], window.options.motion)
    covariance = told.best.covariance[np.ix_(FITTED, FITTED)]
    fit = replace(local_fit.Fit.at(chain, told.best.pose), covariance=covariance)
    return window, decide_given(told, estimate_pose(window, [fit]))


def _searched(window: Window, given: Floats, options: RefineOptions) -> Floats:
    """Return trajectory (T, 4, 4) of the best pose near a given one, by the filter's own likelihood."""
    rng = np.random.default_rng(window.query.seed)
    pose, _ = split_pose(given)
    reach = _reach(options)[[0, 1, 2, 5]]
    wide = local_fit.fit_level(window, COARSE, rounds=4)
    fit = local_fit.fit_pose(window.scorer, pose, reach, wide, rng)
    spread = np.maximum(fit.spread, _NEARLY)
    narrow = local_fit.fit_level(window, FINE, rounds=2)
    fit = local_fit.fit_pose(window.scorer, fit.pose, spread, narrow, rng)
    # what no reading holds, such as the height between bare walls, wanders off
    off = fit.pose - pose
    off[3] = wrap_angle(off[3])
    found = pose + np.clip(off, -3.0 * reach, 3.0 * reach)
    return pose_matrix(compose(found, between(fit.pose, fit.poses)), window.levels)


def _reach(options: RefineOptions) -> Floats:
    """Return standard deviations (6,) [m], [rad] of a pose that somebody gave."""
    way, turn = options.reach
    return np.array([way, way, 0.3 * way, turn, turn, turn])


def _given(window: Window, coarse: Floats, options: RefineOptions) -> PoseEstimate:
    """Return an estimate of a given pose, before any frame is used."""
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
