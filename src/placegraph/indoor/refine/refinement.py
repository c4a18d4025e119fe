"""Refinement of an estimate, and of any pose that somebody knows roughly."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import MissingExtraError, OptionError
from placegraph.estimate import PoseEstimate, PoseMode, Refinement, Status
from placegraph.geometry import between, compose, pose_matrix, split_pose, wrap
from placegraph.indoor.likelihood.observe import COARSE, FINE
from placegraph.indoor.likelihood.scorer import Scorer
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.pose import polish
from placegraph.indoor.pose.frames import chosen_frames
from placegraph.indoor.pose.sequence import Sequence_
from placegraph.indoor.pose.verdict import evidence_at, verdict
from placegraph.indoor.refine.judge import BENT, Judgement, judged
from placegraph.indoor.refine.matching import Matcher
from placegraph.indoor.refine.options import RefineOptions
from placegraph.indoor.refine.refiner import Fitted, Refiner
from placegraph.indoor.render import checked_pose

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.random import Generator
    from numpy.typing import ArrayLike

    from placegraph.formats.capture.capture import Capture
    from placegraph.formats.capture.frame import Frame
    from placegraph.geometry import Floats
    from placegraph.indoor.likelihood.observe import Sighting
    from placegraph.indoor.map.scene import Scene

    Progress = Callable[[str, int, int], None]

MOST = 30
"""Frames that are refined together, the newest."""


def chosen_matcher(matcher: str | Matcher, device: str = "auto") -> Matcher | None:
    """The matcher of a name; None: the guided one, which the refiner makes itself.

    Raises as `placegraph.indoor.refine.matching.matcher` does.
    """
    if not isinstance(matcher, str):
        if not isinstance(matcher, Matcher):
            raise OptionError(
                f"matcher is {matcher!r}; give a name, or an object with name and match."
            )
        return matcher
    if matcher in {"auto", "guided"}:
        return None
    from placegraph.indoor.refine.matching import matcher as made

    return made(matcher, device="cuda" if device.startswith("cuda") else "cpu")


def refine_estimate(
    estimate: PoseEstimate,
    scene: Scene,
    sightings: Sequence[Sighting],
    *,
    matcher: Matcher | None = None,
    options: RefineOptions | None = None,
    device: str = "auto",
    progress: Progress | None = None,
    sequence: Sequence_ | None = None,
) -> PoseEstimate:
    """The estimate with its best mode refined, or with the reason why the coarse pose stands.

    Parameters
    ----------
    estimate
        Of the frames of `sightings`, in their order; one that is `LOST` is returned as it is.
    sightings
        Frames as they were read. Senses that were switched off for the filter are off here too.
    matcher
        See `chosen_matcher`; the guided one if not given.
    options
        `RefineOptions`; what measured best if not given.
    device, progress
        As of `localize`.
    sequence
        Finds the evidence of the refined pose; without it, that of the coarse one stands.

    """
    best = estimate.best
    if best is None or estimate.status is Status.LOST:
        return estimate
    kept = list(sightings[-MOST:])
    coarse = estimate.trajectory[-len(kept) :]
    refiner = _refiner(scene, kept, options or RefineOptions(), matcher, device)
    fitted, judgement = _tried(refiner, coarse, coarse, progress)
    return _told(estimate, refiner, fitted, judgement, sequence)


def _refiner(
    scene: Scene,
    sightings: Sequence[Sighting],
    options: RefineOptions,
    matcher: Matcher | None,
    device: str,
) -> Refiner:
    return Refiner(
        scene=scene,
        frames=[s.frame for s in sightings],
        depths=[s.depth for s in sightings],
        queries=[s.rgb for s in sightings],
        options=options,
        matcher=matcher,
        device=device,
    )


def _told(
    estimate: PoseEstimate,
    refiner: Refiner,
    fitted: Fitted | None,
    judgement: Judgement,
    sequence: Sequence_ | None,
) -> PoseEstimate:
    """The estimate with what became of its best mode."""
    coarse, trajectory = estimate.modes[0], estimate.trajectory
    best = coarse
    if judgement.accepted and fitted is not None:
        before = trajectory[: len(trajectory) - len(fitted.poses)]
        trajectory = np.concatenate([before, fitted.poses])
        best = _moved_to(coarse, fitted)
        if sequence is not None:
            best = replace(best, explain=evidence_at(sequence, best.pose))
    matcher = refiner.matcher.name if refiner.matcher else "guided"
    seconds = {stage: round(value, 4) for stage, value in refiner.seconds.items()}
    stats = {**judgement.stats, **refiner.stats, "matcher": matcher, "seconds": seconds}
    if fitted is not None and not judgement.accepted:
        stats["candidate"] = fitted.poses[-1].tolist()  # what was refused
    status, reason = estimate.status, estimate.reason
    if status is Status.OK and stats.get("motion", 0.0) > BENT:
        status, reason = Status.AMBIGUOUS, _BENT
    if status is Status.OK and judgement.doubt:
        status, reason = Status.AMBIGUOUS, f"One place fits, but {judgement.doubt}."
    return replace(
        estimate,
        status=status,
        reason=reason,
        modes=(best, *estimate.modes[1:]),
        trajectory=trajectory,
        refinement=Refinement(
            judgement.accepted, judgement.reason, coarse, estimate.trajectory, stats
        ),
    )


_BENT = (
    "One place fits, but there the frames contradict the odometry, or the camera's intrinsics do."
)


def _tried(
    refiner: Refiner,
    coarse: Floats,
    start: Floats,
    progress: Progress | None,
) -> tuple[Fitted | None, Judgement]:
    """Fit and judgement; where something is not installed, what can be done without it."""
    try:
        fitted = refiner.fitted(start, progress)
        return fitted, judged(refiner, coarse, fitted)
    except MissingExtraError as error:
        if refiner.matcher is not None:
            raise
        if not refiner.has_depth:
            return None, Judgement(False, f"Not refined: {error}", {})
    refiner.options = replace(refiner.options, images=False)
    fitted = refiner.fitted(start, progress)
    return fitted, judged(refiner, coarse, fitted)


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


def refine(
    scene: Scene,
    capture: Capture | Sequence[Frame],
    map_from_camera: ArrayLike,
    *,
    frames: slice | Sequence[int] | None = None,
    matcher: str | Matcher = "auto",
    options: RefineOptions | None = None,
    seed: int = 0,
    device: str = "auto",
    progress: Progress | None = None,
) -> PoseEstimate:
    """The pose of the last frame, from where it is roughly known to have been taken.

    For those who know where they are from elsewhere: a marker, a map of Wi-Fi, the last session.
    Where there is depth, the neighbourhood is searched first, as wide as `RefineOptions.reach` says.

    Parameters
    ----------
    capture, frames, seed, device, progress
        As of `localize`.
    map_from_camera
        (4, 4) of the last frame chosen, to about 0.3 m and 15 degrees. Of more than 30 frames the
        newest 30 are used.
    matcher
        How images are matched with renderings: ``auto`` or ``guided`` (no extra needed), ``sift``,
        ``xfeat``, ``roma``, ``romav2`` (extras of these names), or a `Matcher`.
    options
        `RefineOptions`; what measured best if not given.

    Returns
    -------
    PoseEstimate
        `OK` at the refined pose, or `AMBIGUOUS` at the pose that was given, with the reason in
        `refinement`.

    Raises
    ------
    OptionError
        The pose is not rigid, no frame is chosen, or an option is out of its range.
    InputError
        An image is broken, or a matcher's weights are.
    MissingExtraError
        The matcher or the device asked for needs an extra.

    """
    options = options or RefineOptions()
    if seed < 0:
        raise OptionError(f"seed is {seed}; a seed is not negative.")
    given = checked_pose(map_from_camera)
    matching = chosen_matcher(matcher, device)
    chosen = chosen_frames(capture, frames)[-MOST:]
    filtering = FilterOptions(depth=options.depth, colour=bool(options.images))
    scorer = Scorer(scene, filtering.likelihood, device)
    sequence = Sequence_.of(scene, chosen, None, filtering, scorer)
    odometry = np.stack([f.odometry for f in chosen])
    coarse = given @ np.linalg.inv(odometry[-1]) @ odometry
    start = coarse
    if any(s.depth is not None for s in sequence.sightings):
        start = _searched(sequence, given, options, np.random.default_rng(seed))
    refiner = _refiner(scene, sequence.sightings, options, matching, device)
    refiner.known = coarse, np.maximum(_reach(options), _SHARPEST)
    fitted, judgement = _tried(refiner, coarse, start, progress)
    told = _told(_given(scene, chosen, coarse, options), refiner, fitted, judgement, sequence)
    status, reason = _status(sequence, told)
    return replace(told, status=status, reason=reason)


def _status(sequence: Sequence_, told: PoseEstimate) -> tuple[Status, str]:
    """What the filter's verdict says of the pose, were it the only one; not OK where it was given."""
    assert told.best is not None and told.refinement is not None  # noqa: S101, PT018  made so
    pose = told.best.pose
    views = sequence.round(FINE, rounds=0)
    values = sequence.scorer.together(pose[None], views.views, views.steps)
    fit = polish.Fit(pose, float(values[0]), polish.NARROWEST, pose[None], values)
    alone = verdict(sequence, [fit])
    if alone.status is Status.OK and not told.refinement.accepted:
        return Status.AMBIGUOUS, told.refinement.reason
    return alone.status, alone.reason


def _searched(sequence: Sequence_, given: Floats, options: RefineOptions, rng: Generator) -> Floats:
    """Trajectory (T, 4, 4) of the best pose near a given one, by the filter's own likelihood."""
    pose, _ = split_pose(given)
    reach = _reach(options)[[0, 1, 2, 5]]
    fit = polish.refine(
        sequence.scorer,
        pose,
        reach,
        sequence.round(COARSE, rounds=4),
        rng,
    )
    spread = np.maximum(fit.spread, _NEARLY)
    fit = polish.refine(sequence.scorer, fit.pose, spread, sequence.round(FINE, rounds=2), rng)
    # what no reading holds, such as the height between bare walls, wanders off
    off = fit.pose - pose
    off[3] = wrap(off[3])
    found = pose + np.clip(off, -3.0 * reach, 3.0 * reach)
    levels = np.stack([s.level for s in sequence.sightings])
    return pose_matrix(compose(found, between(sequence.poses[-1], sequence.poses)), levels)


_NEARLY = np.array([0.03, 0.03, 0.02, 0.015])
_SHARPEST = 1e-3  # nobody knows a pose better than this [m], [rad]


def _reach(options: RefineOptions) -> Floats:
    """Standard deviations (6,) [m], [rad] of a pose that somebody gave."""
    way, turn = options.reach
    return np.array([way, way, 0.3 * way, turn, turn, turn])


def _given(
    scene: Scene, frames: Sequence[Frame], coarse: Floats, options: RefineOptions
) -> PoseEstimate:
    """What is known before: a pose that somebody gave."""
    matrix = coarse[-1]
    row = scene.scene_at(matrix[:2, 3])
    mode = PoseMode(
        map_from_camera=matrix,
        pose=split_pose(matrix)[0],
        covariance=np.diag(np.square(_reach(options))),
        probability=1.0,
        scene=scene.scenes[row],
        scene_from_camera=scene.scene_from_map[row] @ matrix,
    )
    rows = np.array([f.index for f in frames])
    return PoseEstimate(Status.AMBIGUOUS, (mode,), "", trajectory=coarse, frames=rows)
