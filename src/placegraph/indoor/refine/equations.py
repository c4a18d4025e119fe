"""What each frame says of its own pose, by depth and by matches: normal equations of six unknowns.

What a frame sees errs together: the map is off where it looks, or it looked at another moment. So each
frame as a whole may be astray by a variance component, which is estimated from the frames.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.indoor.refine.depth import Kernel
from placegraph.indoor.refine.fit_kernels import depth_system, pixel_system

if TYPE_CHECKING:
    from placegraph.indoor.refine.solve import Problem

READINGS = 200.0
"""Independent readings that the depth of one frame is worth: neighbours err together."""
POINTS = 40.0
"""Independent points that the matches of one frame are worth at most."""
ASTRAY = (0.006, 0.004)
"""What a frame sees errs together, as by the map where it looks or by the moment when it looked: usual
deviations [m], [rad] of a frame as a whole ..."""
WITNESSES = 4
"""... which are believed as if so many errors had shown them."""


class Says(NamedTuple):
    """What one sense says of T poses: normal equations of each frame."""

    information: Floats
    """(T, 6, 6)"""
    gradient: Floats
    """(T, 6)"""

    def allowed(self, astray: Floats) -> Says:
        """The same, where each frame as a whole may be astray by deviations (2,) [m], [rad]."""
        sure = np.repeat(1.0 / np.square(astray), 3)
        kept = sure[:, None] * np.linalg.inv(self.information + np.diag(sure))
        return Says(kept @ self.information, np.einsum("tij,tj->ti", kept, self.gradient))

    def astray(self, before: Floats, step: Floats) -> Floats:
        """Deviations (2,) by which frames seem astray once their poses have gone a step (T, 6)."""
        told = self.information.any(axis=(1, 2))
        left = self.gradient + np.einsum("tij,tj->ti", self.information, step)
        sure = np.diag(np.repeat(1.0 / np.square(before), 3))
        off = np.linalg.solve(self.information + sure, left[..., None])[told, :, 0]
        return usual_errors(off, ASTRAY, WITNESSES)


def usual_errors(errors: Floats, before: tuple[float, float], witnesses: int) -> Floats:
    """Root mean squares (2,) of shifts and turns (N, 6), with what was believed before."""
    squares = np.square(errors).reshape(-1, 2, 3).sum(axis=(0, 2))
    count = witnesses + 3 * len(errors)
    return np.asarray(np.sqrt((witnesses * np.square(before) + squares) / count))


def depth_says(
    problem: Problem, poses: Floats, shares: Floats, width: float
) -> tuple[Says, Floats, float]:
    """What depth says at poses (T, 4, 4); parameters as of `matches_say`, and of `Solution`.

    With it: sums of weights and numbers of readings of objects (N, 2), and the mean robust cost.
    """
    noise = problem.options.noise
    kernel = Kernel(noise.floor, noise.slope, noise.surface, noise.facing, width)
    told, total = np.zeros((problem.objects, 2)), np.zeros(3)
    h, g = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6))
    for t, seen in enumerate(problem.readings):
        if seen is None:
            continue
        block, slope, of_objects, sums = depth_system(
            problem.surfaces,
            shares,
            np.ascontiguousarray(poses[t, :3, :3]),
            np.ascontiguousarray(poses[t, :3, 3]),
            seen.directions,
            seen.depth,
            seen.normals,
            kernel,
        )
        # few readings are not worth more than they are
        worth = READINGS / max(float(sums[0]), 0.25 * len(seen.depth), 1.0)
        h[t], g[t] = worth * block, worth * slope
        told += of_objects
        total += sums
    return Says(h, g), told, float(total[1] / total[0]) if total[0] else np.nan


def matches_say(problem: Problem, poses: Floats, width: float) -> Says:
    """What matched points say at poses (T, 4, 4), by a kernel of a width in standard deviations."""
    h, g = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6))
    for t, seen in enumerate(problem.sights):
        if not len(seen):
            continue
        block, slope, total = pixel_system(
            np.ascontiguousarray(poses[t, :3, :3]),
            np.ascontiguousarray(poses[t, :3, 3]),
            seen.points,
            seen.rays,
            seen.sigma,
            seen.focal,
            width,
        )
        worth = min(1.0, POINTS / max(total, 1.0))
        h[t], g[t] = worth * block, worth * slope
    return Says(h, g)
