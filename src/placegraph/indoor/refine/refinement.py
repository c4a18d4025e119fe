"""Refinement of an estimate: its best mode fitted to centimetres, or the reason why not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from placegraph.core.estimate import PoseEstimate, PoseMode, Refinement, Status
from placegraph.core.geometry import Floats, split_pose
from placegraph.errors import MissingExtraError, OptionError, ServiceError
from placegraph.indoor.pose.estimate import evidence_at
from placegraph.indoor.pose.window import Window
from placegraph.indoor.refine.judge import Judgement, judged
from placegraph.indoor.refine.matching import Matcher
from placegraph.indoor.refine.matching import matcher as matcher_named
from placegraph.indoor.refine.options import RefineOptions
from placegraph.indoor.refine.refiner import Fitted, Refiner
from placegraph.indoor.status import RefinementDiagnostics, decide_refined, diagnostics_of

MOST = 30
"""Frames that are refined together, the newest."""


@dataclass(frozen=True, eq=False)
class Refining:
    """How a pose is refined."""

    options: RefineOptions
    matcher: Matcher | None
    """None: the guided one, which the refiner makes itself."""

    @classmethod
    def of(
        cls, options: RefineOptions | None, matcher: str | Matcher, device: str = "auto"
    ) -> Refining:
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


def refined(
    window: Window, estimate: PoseEstimate, refining: Refining, *, explained: bool = False
) -> PoseEstimate:
    """The estimate with its best mode refined, or with the reason why the coarse pose stands.

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
    return tried(window, estimate, refiner, start, explained=explained)


def tried(
    window: Window, estimate: PoseEstimate, refiner: Refiner, start: Floats, *, explained: bool
) -> PoseEstimate:
    """The estimate refined from a start (T, 4, 4) of the window's frames, as in `refined`.

    Where something is not installed, what can be done without it is done.
    """
    coarse, progress = estimate.trajectory[-len(start) :], window.query.progress
    try:
        judgement = judged(refiner, coarse, refiner.fitted(start, progress))
    except MissingExtraError as error:
        if refiner.matcher is not None:
            raise
        if refiner.has_depth:
            refiner.options = replace(refiner.options, images=False)
            judgement = judged(refiner, coarse, refiner.fitted(start, progress))
        else:
            nothing = Fitted(start, None, [], np.full((6, 6), np.nan))
            judgement = Judgement(False, f"Not refined: {error}", nothing, {})
    told = _told(estimate, refiner, judgement)
    best = told.best
    if explained and judgement.accepted and best is not None:
        best = replace(
            best, explain=evidence_at(window, split_pose(told.trajectory[-len(window) :])[0])
        )
        told = replace(told, modes=(best, *told.modes[1:]))
    return told


def _told(estimate: PoseEstimate, refiner: Refiner, judgement: Judgement) -> PoseEstimate:
    """The estimate with what became of its best mode."""
    coarse, trajectory = estimate.modes[0], estimate.trajectory
    best, fitted = coarse, judgement.fitted
    if judgement.accepted:
        before = trajectory[: len(trajectory) - len(fitted.poses)]
        trajectory = np.concatenate([before, fitted.poses])
        best = _moved_to(coarse, fitted)
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


def _moved_to(mode: PoseMode, fitted: Fitted) -> PoseMode:
    """A mode at its refined pose."""
    matrix = fitted.poses[-1]
    into_scene = mode.scene_from_camera @ np.linalg.inv(mode.map_from_camera)
    return replace(
        mode,
        map_from_camera=matrix,
        pose=split_pose(matrix)[0],
        covariance=fitted.covariance,
        scene_from_camera=into_scene @ matrix,
    )
