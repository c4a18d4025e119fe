"""Covariance of a refined pose: the fit's own, and an error common to all frames.

The fit's own covariance takes errors for independent. Errors of a map are not: a wall that stands two
centimetres off does so for every reading of it, and the pose goes with it; more readings do not make a
map truer. Two things tell the order of that error: how far frames, each pulled by what it sees, part
from the way that odometry tells, and how far right matches miss.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.indoor.refine.correspondences import PointMatches
from placegraph.indoor.refine.fit import Problem, Solution, odometry_errors

PULL = 7.0
"""Error common to all frames, in units of how far they part from their way (benchmark)."""
MISS = 0.65
"""Error common to all frames, in units of what matches miss by (benchmark)."""
UNEXPLAINED = 0.02
"""Error common to all frames if no reading of depth were explained [m] (benchmark)."""
LEAST = 0.003
"""No map is truer than this [m]."""
ALONE = 0.015
"""Error of a single frame that no other can tell [m]."""
UPRIGHT = 0.5
"""Share of the error that goes into height: floors and table tops agree better than walls."""
_MEDIAN = 1.4826  # standard deviations in a median absolute deviation


def covariance(problem: Problem, solution: Solution) -> Floats:
    """Return (6, 6) of the last frame of a solution: the fit's own, and what is common to all frames."""
    shift, away = common_error(problem, solution)
    turn = shift / away
    tilt = min(turn, problem.options.tilt)
    common = np.square([shift, shift, UPRIGHT * shift, tilt, tilt, turn])
    return solution.covariance() + np.diag(common)


def common_error(problem: Problem, solution: Solution) -> tuple[float, float]:
    """Return the standard deviation of a trajectory's common error [m], and the mean viewing distance [m].

    The distance makes turns of shifts.
    """
    errors, _ = odometry_errors(problem, solution.poses)
    pulled = PULL * float(np.sqrt(np.mean(errors[:, :3] ** 2))) if len(errors) else ALONE
    unexplained = UNEXPLAINED * float(np.nan_to_num(solution.cost))
    found, away = [LEAST, float(np.hypot(pulled, unexplained))], []
    depths = [r.depth[r.depth > 0] for r in problem.readings if r is not None]
    if any(map(len, depths)):
        away.append(float(np.median(np.concatenate(depths))))
    if any(map(len, problem.sights)):
        missed, far = _missed(problem.sights, solution.poses)
        found.append(MISS * missed)
        away.append(far)
    return max(found), float(np.mean(away)) if away else 1.0


def _missed(sights: Sequence[PointMatches], poses: Floats) -> tuple[float, float]:
    """By how much matches miss, at their distance [m], and that distance [m]."""
    angles, far = [], []
    for seen, pose in zip(sights, poses, strict=True):
        if len(seen):
            angles.append(seen.errors(pose) / seen.focal)
            far.append(np.linalg.norm(seen.points - pose[:3, 3], axis=1))
    distance = float(np.median(np.concatenate(far)))
    return _MEDIAN / np.sqrt(2.0) * float(np.median(np.concatenate(angles))) * distance, distance
