"""A capture too long to be fitted together: followed from frame to frame, with a pose for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import (
    Floats,
    between,
    compose,
    level_from_camera,
    pose_matrix,
    split_pose,
)
from placegraph.errors import OptionError
from placegraph.indoor.pose.query import leveled
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.track.tracker import Tracker


def follow(tracker: Tracker, frames: Sequence[Frame]) -> PoseEstimate:
    """The last pose of a long capture, and a trajectory of poses as they were known.

    Frames before the pose was first known are led back from there by odometry.
    """
    if tracker.query.prior is not None:
        raise OptionError(
            f"prior: a capture of {len(frames)} frames is tracked, which starts without one; "
            "choose fewer frames."
        )
    known: list[Floats | None] = []
    for i, frame in enumerate(frames):
        estimate = tracker.update(frame)
        sure = estimate.status is Status.OK and estimate.best is not None
        known.append(estimate.best.map_from_camera if sure and estimate.best else None)
        if tracker.query.progress:
            tracker.query.progress("tracking", i + 1, len(frames))
    rows = [i for i, matrix in enumerate(known) if matrix is not None]
    stats = {"known": len(rows), "frames": len(frames)} | tracker.scorer.stats()
    if not rows:
        return replace(estimate, stats=stats, diagnostics=None)
    trajectory = _filled(known, rows, frames)
    if estimate.best is not None:
        trajectory[-1] = estimate.best.map_from_camera
    stamped = np.array([f.index for f in frames])
    return replace(estimate, trajectory=trajectory, frames=stamped, stats=stats, diagnostics=None)


def _filled(known: list[Floats | None], rows: list[int], frames: Sequence[Frame]) -> Floats:
    """Matrices (T, 4, 4): unknown ones by odometry from the nearest known, the earlier of two."""
    poses = leveled(frames)
    out = np.empty((len(frames), 4, 4))
    for i, matrix in enumerate(known):
        if matrix is not None:
            out[i] = matrix
            continue
        near = min(rows, key=lambda r: (abs(r - i), r))
        anchor = known[near]
        assert anchor is not None  # noqa: S101  rows are known
        pose = compose(split_pose(anchor)[0], between(poses[near], poses[i]))
        out[i] = pose_matrix(pose, level_from_camera(frames[i].gravity))
    return out
