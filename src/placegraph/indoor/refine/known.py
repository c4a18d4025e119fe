"""Refinement of a pose that somebody knows roughly, without a search of the whole map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from placegraph.core.estimate import PoseEstimate, PoseMode
from placegraph.core.geometry import Floats, between, compose, pose_matrix, split_pose, wrap
from placegraph.indoor.likelihood.observe import COARSE, FINE
from placegraph.indoor.pose import polish
from placegraph.indoor.pose.chain import Chain
from placegraph.indoor.pose.covariance import FITTED
from placegraph.indoor.pose.estimate import estimate_pose
from placegraph.indoor.pose.query import PoseQuery
from placegraph.indoor.pose.window import Window, observe
from placegraph.indoor.refine.camera import wrong_camera
from placegraph.indoor.refine.options import RefineOptions
from placegraph.indoor.refine.refinement import MOST, Refining, tried
from placegraph.indoor.refine.refiner import Refiner
from placegraph.indoor.status import UNDECIDED, decide_given

_NEARLY = np.array([0.03, 0.03, 0.02, 0.015])
_SHARPEST = 1e-3  # nobody knows a pose better than this [m], [rad]


def refine(query: PoseQuery, given: Floats, refining: Refining) -> PoseEstimate:
    """The pose of the last frame asked about, from where (4, 4) it is roughly known to be.

    Where there is depth, the neighbourhood is searched first. Errors: `SceneMap.refine`.
    """
    query = replace(query, frames=query.frames[-MOST:])
    window, estimate = _refined(query, given, refining)
    mend = wrong_camera(window, estimate, refining)
    if mend is None:
        return estimate
    mended = replace(query, frames=mend.frames(query.frames))
    return mend.chosen(query, estimate, _refined(mended, given, refining)[1])


def _refined(query: PoseQuery, given: Floats, refining: Refining) -> tuple[Window, PoseEstimate]:
    """The answer if the camera is as it is said to be, and the frames that it rests on."""
    window = observe(query)
    odometry = np.stack([f.odometry for f in query.frames])
    coarse = given @ np.linalg.inv(odometry[-1]) @ odometry
    start = coarse
    if any(s.depth is not None for s in window.sightings):
        start = _searched(window, given, refining.options)
    refiner = Refiner.of(window, refining.options, refining.matcher)
    refiner.known = coarse, np.maximum(_reach(refining.options), _SHARPEST)
    told = tried(window, _given(window, coarse, refining.options), refiner, start, explained=True)
    assert told.best is not None  # noqa: S101  it was given
    # the status that the window has at this pose, were it the only one
    chain = Chain.of(split_pose(told.trajectory)[0], window.options.motion)
    covariance = told.best.covariance[np.ix_(FITTED, FITTED)]
    fit = replace(polish.Fit.at(chain, told.best.pose), covariance=covariance)
    return window, decide_given(told, estimate_pose(window, [fit]))


def _searched(window: Window, given: Floats, options: RefineOptions) -> Floats:
    """Trajectory (T, 4, 4) of the best pose near a given one, by the filter's own likelihood."""
    rng = np.random.default_rng(window.query.seed)
    pose, _ = split_pose(given)
    reach = _reach(options)[[0, 1, 2, 5]]
    wide = polish.round_of(window, COARSE, rounds=4)
    fit = polish.refine(window.scorer, pose, reach, wide, rng)
    spread = np.maximum(fit.spread, _NEARLY)
    narrow = polish.round_of(window, FINE, rounds=2)
    fit = polish.refine(window.scorer, fit.pose, spread, narrow, rng)
    # what no reading holds, such as the height between bare walls, wanders off
    off = fit.pose - pose
    off[3] = wrap(off[3])
    found = pose + np.clip(off, -3.0 * reach, 3.0 * reach)
    return pose_matrix(compose(found, between(fit.pose, fit.poses)), window.levels)


def _reach(options: RefineOptions) -> Floats:
    """Standard deviations (6,) [m], [rad] of a pose that somebody gave."""
    way, turn = options.reach
    return np.array([way, way, 0.3 * way, turn, turn, turn])


def _given(window: Window, coarse: Floats, options: RefineOptions) -> PoseEstimate:
    """What is known before: a pose that somebody gave."""
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
