"""Whether depth would fit the map better were it a little longer, or the image a little wider.

A wrong scale of the depth or a wrong focal length does not stop a fit: the pose moves until the rest
agrees as well as it can. But it leaves residuals that grow with depth, or with the distance from the
optical axis, and one linear step for the sequence's pose and either scale tells them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.indoor.refine.joint import LOOSE, READINGS

if TYPE_CHECKING:
    from placegraph.geometry import Floats
    from placegraph.indoor.map.scene import Scene
    from placegraph.indoor.refine.depth import Readings
    from placegraph.indoor.refine.joint import Problem

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

    Residuals and weights are those of `kernels.depth_system`.
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
