"""Whether images or depth would fit a camera with other intrinsics: wrong ones fit well elsewhere.

Seen by a camera of a focal length ten percent too long, a room fits its images from a few hand's
breadths farther away, and nothing but the fit's own curve over focal lengths tells. Depth tells more:
a wrong scale of it, or a wrong focal length, leaves residuals that grow with depth, or with the
distance from the optical axis, and one linear step for the window's pose and either scale tells them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.indoor.refine.solve import LOOSE, READINGS, solve

if TYPE_CHECKING:
    from collections.abc import Sequence

    from placegraph.geometry import Floats
    from placegraph.indoor.map.scene import Scene
    from placegraph.indoor.refine.depth import Readings
    from placegraph.indoor.refine.match import Sights
    from placegraph.indoor.refine.solve import Problem

TRIED = (0.9, 0.95, 1.05, 1.1)
"""Factors on the focal length that are tried."""
BETTER = 0.05
"""Share of the robust cost that another focal length must save. At the right one the shared data save
up to 0.03, where maps are blurred; at one ten percent off, sharp maps save 0.05 to 0.5, blurred ones
less than this: there the curve tells nothing."""
ENOUGH = 300
"""Matches below which the curve tells nothing."""
_WIDTHS = ((6.0, 6.0), (3.0, 3.0))
_COMPARED = 3.0  # width of the kernel by which costs are compared


def better_focal(problem: Problem, poses: Floats) -> float:
    """Factor on the focal length that fits the matches clearly better; 1 where none does.

    Poses (T, 4, 4) are fitted anew for each, to the matches alone.
    """
    if sum(map(len, problem.sights)) < ENOUGH:
        return 1.0
    images = replace(problem, readings=[None] * len(poses))
    costs = {k: _cost(images, poses, k) for k in (1.0, *TRIED)}
    best = min(costs, key=lambda k: costs[k])
    return best if costs[best] < (1.0 - BETTER) * costs[1.0] else 1.0


def _cost(problem: Problem, poses: Floats, factor: float) -> float:
    """Mean robust cost, 0 to 1, of the matches seen by a camera of another focal length."""
    sights = [replace(s, rays=s.rays / factor) for s in problem.sights]
    solution = solve(replace(problem, sights=sights), poses, _WIDTHS)
    return _mean_cost(sights, solution.poses)


def _mean_cost(sights: Sequence[Sights], poses: Floats) -> float:
    ratios = np.concatenate(
        [(s.errors(p) / (_COMPARED * s.sigma)) ** 2 for s, p in zip(sights, poses, strict=True)]
    )
    return float(np.mean(1.0 - 1.0 / (1.0 + ratios)))


OFF = 0.05
"""Share by which a scale is off that is refused. Of right cameras in the shared house and office it
was at most 0.03, mostly below 0.006; a focal length or a depth off by a tenth gave 0.02 to 0.09,
since the step is one of many: not every wrong one is found."""
CLEAR = 4.0
"""Standard errors that it must be off by, too."""
_WIDTH = 10.0  # of the robust kernel [standard deviations]: what is off has to have a say


class Scale(NamedTuple):
    """By which share something should grow, and the standard error of it."""

    share: float
    error: float

    @property
    def wrong(self) -> bool:
        """Whether it is clearly off."""
        return abs(self.share) > max(OFF, CLEAR * self.error)


def scales(scene: Scene, problem: Problem, poses: Floats) -> dict[str, Scale]:
    """Scales of the depth and of the image (`depth`, `image`) at fitted poses (T, 4, 4).

    Each by itself, with the pose of the whole sequence left free; empty without depth.
    """
    rows = [
        _rows(scene, problem, seen, pose, poses[-1, :3, 3])
        for seen, pose in zip(problem.readings, poses, strict=True)
        if seen is not None and (seen.depth > 0).any()
    ]
    if not rows:
        return {}
    j, e, w = (np.concatenate(column) for column in zip(*rows, strict=True))
    # readings of one frame are not worth more than the fit took them for
    w *= min(1.0, READINGS * len(rows) / max(1, len(e)))
    return {"depth": _step(j[:, :7], e, w), "image": _step(j[:, [0, 1, 2, 3, 4, 5, 7]], e, w)}


def _step(j: Floats, e: Floats, w: Floats) -> Scale:
    """Last unknown of one weighted step."""
    prior = np.append(np.repeat(1.0 / np.square(LOOSE), 3), 1.0)
    h = j.T @ (w[:, None] * j) + np.diag(prior)
    inverse = np.linalg.inv(h)
    return Scale(float(-(inverse @ (j.T @ (w * e)))[6]), float(np.sqrt(inverse[6, 6])))


def _rows(
    scene: Scene, problem: Problem, seen: Readings, pose: Floats, pivot: Floats
) -> tuple[Floats, Floats, Floats]:
    """Derivatives (R, 8) by shift, turn, scale of depth and of image; residuals and weights (R,).

    Residuals and weights are those of `fit_kernels.depth_system`.
    """
    rotation, noise = pose[:3, :3], problem.options.noise
    read = seen.depth > 0
    inside = seen.directions[read].astype(np.float64)
    hits = scene.caster.cast(pose[:3, 3], inside @ rotation.T)
    hit = hits.triangle >= 0
    inside, z = inside[hit], seen.depth[read][hit].astype(np.float64)
    aims = inside @ rotation.T
    normals = problem.surfaces.normals[hits.triangle[hit]].astype(np.float64)
    slant = np.sum(normals * aims, axis=1)
    e = slant * (z - hits.distance[hit])
    facing = np.abs(np.sum((normals @ rotation) * seen.normals[read][hit], axis=1))
    low, high = noise.facing
    variance = ((noise.floor + noise.slope * z**2) * slant) ** 2 + noise.surface**2
    share = np.clip((facing - low) / (high - low), 0.0, 1.0)
    weights = share / (1.0 + e**2 / (variance * _WIDTH**2)) ** 2 / variance
    points = pose[:3, 3] + aims * z[:, None] - pivot
    wider = (inside * (1.0, 1.0, 0.0) * z[:, None]) @ rotation.T
    columns = [normals, np.cross(points, normals), (slant * z)[:, None]]
    columns.append(np.sum(normals * wider, axis=1)[:, None])
    return np.concatenate(columns, axis=1), e, weights
