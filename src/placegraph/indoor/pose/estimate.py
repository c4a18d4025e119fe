"""Pose estimates from fits: probabilities, covariance, evidence, diagnostics, and poses on Earth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from placegraph.core.estimate import Evidence, PoseEstimate, PoseMode
from placegraph.core.geo import EarthPose
from placegraph.core.geometry import Floats, between, pose_matrix
from placegraph.indoor.likelihood.observe import FINE
from placegraph.indoor.map.floor import find_storey
from placegraph.indoor.map.rooms import find_room_name
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.pose.agreement import (
    CONFIDENCE,
    Agreement,
    agreement,
    both_odds,
    explain,
    find_contradiction,
    find_image_fault,
    searched_odds,
)
from placegraph.indoor.pose.covariance import lens_covariance, map_error, pose_covariance
from placegraph.indoor.pose.local_fit import Fit, probabilities
from placegraph.indoor.pose.prior import LogPrior
from placegraph.indoor.pose.window import Window, time_stage
from placegraph.indoor.status import RIVAL, Diagnostics, decide_pose, diagnostics_of


def add_earth_poses(scene: Scene, estimate: PoseEstimate) -> PoseEstimate:
    """Add `PoseMode.earth` to each mode, if the map has anchors."""
    if not scene.anchors:
        return estimate
    return replace(estimate, modes=tuple(_add_earth_pose(scene, mode) for mode in estimate.modes))


def _add_earth_pose(scene: Scene, mode: PoseMode) -> PoseMode:
    at = mode.map_from_camera[:3, 3]
    room, (storey, _) = find_room_name(scene, at), find_storey(scene, at)
    poses = [
        a.pose(
            mode.map_from_camera, mode.covariance, probability=mode.probability, room=room,
            storey=storey,
        )
        for a in scene.anchors_of(mode.scene)
    ]  # fmt: skip
    return replace(mode, earth=tuple(poses))


def possible_earth_poses(scene: Scene) -> tuple[EarthPose, ...]:
    """Return the poses on Earth of somebody anywhere in a map, one a candidate anchor, likeliest first."""
    share = 1.0 / len(scene.scenes)
    found = [
        anchor.pose_in_box(box, probability=share)
        for name, box in zip(scene.scenes, scene.scene_bounds, strict=True)
        for anchor in scene.anchors_of(name)
    ]
    return tuple(sorted(found, key=lambda pose: -pose.probability))


_EXPLAINED = 3
"""Number of modes with evidence."""


def estimate_pose(window: Window, candidates: list[Fit]) -> PoseEstimate:
    """Estimate the pose of the last frame from fits, best first."""
    with time_stage(window.seconds, "verdict"):
        judging, looked = window.judging, window.newest
        views = [judging.views(FINE)[i] for i in looked]
        temperature = window.scorer.model.compute_temperature(views)
        candidates, shares = _probabilities(window, candidates, temperature)
        count = max(_EXPLAINED, int((shares > RIVAL).sum()))
        agreed = [agreement_at(window, fit.poses) for fit in candidates[:count]]
        if window.options.likelihood.tempered:
            own = [_own_agreement(window.scene, fit.pose) for fit in candidates[: len(agreed)]]
            odds = [
                both_odds(CONFIDENCE.odds(a), searched_odds(a, its))
                for a, its in zip(agreed, own, strict=True)
            ]
            shares = weigh_by_confidence(shares, np.array(odds))
            order = np.argsort(-shares, kind="stable")
            shares, candidates = shares[order], [candidates[i] for i in order]
            agreed = [agreed[i] for i in order[: len(agreed)]]
        modes = tuple(
            _mode(window, fit, share, agreed[i] if i < len(agreed) else None)
            for i, (fit, share) in enumerate(zip(candidates, shares.tolist(), strict=True))
        )
        poses = candidates[0].poses
        frames = _agreement_of_frames(judging, poses, agreed[0])
        observations, prior = window.observations, window.log_prior
        searched = searched_odds(agreed[0], _own_agreement(window.scene, poses[-1]))
        found = Diagnostics(
            agreement=agreed[0],
            frames=frames,
            ratio_per_frame=agreed[0].ratio,
            image_fault=find_image_fault(judging),
            contradiction=find_contradiction(judging, frames),
            unnamed=any(s.patches is not None and not s.patches.named for s in observations),
            searched=searched,
            unmet="" if prior is None else prior.find_contradictions(modes[0].pose),
        )
        status, reason, found = decide_pose(found, modes)
        if np.isfinite(searched):
            modes = _scale_probabilities(modes, searched)
        return PoseEstimate(
            status=status,
            modes=modes,
            reason=reason,
            trajectory=pose_matrix(poses, window.levels),
            frames=np.array([s.frame.index for s in observations]),
            stats={
                "trust": agreed[0].numbers() | {"probability": modes[0].probability},
                "rival": agreed[1].numbers() if len(agreed) > 1 else {},
                "undecided": found.undecided,
                "fits": found.consistent,
            },
            diagnostics=found,
            map=window.scene,
        )


def _agreement_of_frames(window: Window, poses: Floats, agreed: Agreement) -> Floats:
    """Return the agreement (T, 3) of each frame of the window with its pose (T, 4)."""
    older = len(window) - len(agreed.frames)
    if not older:
        return agreed.frames
    steps = between(poses[-1], poses[:older])
    before = agreement(window.scorer, poses[-1], window.views(FINE)[:older], steps)
    return np.concatenate([before.frames, agreed.frames])


def _probabilities(
    window: Window, candidates: list[Fit], temperature: float
) -> tuple[list[Fit], Floats]:
    """Return the fits, likeliest first, and their probabilities.

    A description is independent of the images, and counts in full. Weights of particles are probabilities
    that include it.
    """
    logs = np.array([f.log_likelihood for f in candidates])
    options = window.options.particle_filter
    if options is not None and options.answer == "mle":
        return candidates, np.exp(logs)
    shares = probabilities(logs, temperature)
    if window.log_prior is None:
        return candidates, shares
    shares *= np.exp(window.log_prior.at(np.stack([f.pose for f in candidates])))
    order = np.argsort(-shares, kind="stable")
    return [candidates[i] for i in order], shares[order] / shares.sum()


def weigh_by_confidence(shares: Floats, odds: Floats) -> Floats:
    """Return probabilities (M,) of fits by their shares (M,), falling, and the log odds (K,) of the first.

    A pose is right if frames fit, and no other place fits better: both are multiplied. Else depth on the
    surfaces of a wrong place, whose colours contradict, would outweigh a place that the map shows in half.
    Later fits are no likelier than the least of the first K.
    """
    if not np.isfinite(odds).all():
        return shares
    out = shares / (1.0 + np.exp(-odds.max()))
    out[: len(odds)] = shares[: len(odds)] / (1.0 + np.exp(-odds))
    out[len(odds) :] = np.minimum(out[len(odds) :], out[: len(odds)].min())
    return np.asarray(out / out.sum())


def _mode(window: Window, fit: Fit, share: float, agreed: Agreement | None) -> PoseMode:
    scene, matrix = window.scene, pose_matrix(fit.pose, window.levels[-1])
    row, newest = scene.scene_at(fit.pose[:2]), window.observations[-1]
    covariance = pose_covariance(fit.covariance, map_error(scene, fit.pose[:3]))
    if newest.depth is None:
        covariance[:3, :3] += lens_covariance(scene, newest.frame.camera, matrix)
    return PoseMode(
        map_from_camera=matrix,
        pose=fit.pose,
        covariance=covariance,
        probability=share,
        scene=scene.scenes[row],
        scene_from_camera=scene.scene_from_map[row] @ matrix,
        explain=tuple
        if agreed is None
        else partial(_explained, window.log_prior, scene, agreed, fit.pose),
    )


def _explained(
    log_prior: LogPrior | None, scene: Scene, agreed: Agreement, pose: Floats
) -> tuple[Evidence, ...]:
    said = () if log_prior is None else log_prior.evidence(pose)
    return said + explain(scene, agreed)


def _own_agreement(scene: Scene, pose: Floats) -> Floats | None:
    """Return the agreement (9,) of the frames that the scene at a pose (4,) was made of; None: unknown."""
    known = scene.own_agreement
    return None if known is None else known[scene.scene_at(pose[:2])]


def agreement_at(window: Window, poses: Floats) -> Agreement:
    """Measure the agreement of the newest frames at poses (T, 4) of all frames."""
    judging, looked = window.judging, window.newest
    views = [judging.views(FINE)[i] for i in looked]
    return agreement(judging.scorer, poses[-1], views, between(poses[-1], poses[looked]))


def evidence_at(window: Window, poses: Floats) -> Callable[[], tuple[Evidence, ...]]:
    """Return a function that describes the evidence of the newest frames at poses (T, 4) of all frames."""
    agreed = agreement_at(window, poses)
    return partial(_explained, window.log_prior, window.scene, agreed, poses[-1])


def _scale_probabilities(modes: tuple[PoseMode, ...], searched: float) -> tuple[PoseMode, ...]:
    """Return modes whose probabilities leave what was not searched its share; log odds `searched`."""
    share = 1.0 / (1.0 + np.exp(-searched)) / sum(mode.probability for mode in modes)
    return tuple(replace(mode, probability=share * mode.probability) for mode in modes)


def judge_refined(
    window: Window,
    estimate: PoseEstimate,
    poses: Floats,
    covariance: Floats,
    correlation: float | None,
) -> PoseEstimate:
    """Decide an estimate again at refined poses (T, 4).

    `covariance`: (6, 6) of the last refined pose. `correlation`: of held-out parts of the images with the
    map; None: not compared.
    """
    before, own = diagnostics_of(estimate), _own_agreement(window.scene, poses[-1])
    agreed, searched, modes = agreement_at(window, poses), np.inf, estimate.modes
    if own is not None and np.isfinite(before.searched):
        searched = searched_odds(agreed, own, np.nan if correlation is None else correlation)
        modes = _scale_probabilities(modes, np.inf)
    refined = (replace(modes[0], covariance=covariance), *modes[1:])
    status, reason, found = decide_pose(
        replace(before, agreement=agreed, searched=searched), refined
    )
    if np.isfinite(searched):
        modes = _scale_probabilities(modes, searched)
    return replace(estimate, status=status, reason=reason, modes=modes, diagnostics=found)
