"""The rigid motion that brings one cloud of surface points onto another: ICP, point to plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, rotation_from_vector, rotation_z
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.rays import RayCaster
from placegraph.io.mesh.nearest_kernels import nearest

_ROUNDS = 30
_STILL = 1e-5
"""A step below this [m, rad] ends the search."""
_SLIDES = 1e-3
"""A direction along which residuals change less than this share of the best is held fast: a round
table's turn, a picture's slide along its wall."""


@dataclass(frozen=True, slots=True, eq=False)
class Sampled:
    """Points of a surface, evenly by area."""

    points: Floats
    """(N, 3) [m]"""
    normals: Floats
    """(N, 3) unit."""
    colours: NDArray[np.uint8]
    """(N, 3) sRGB"""
    rows: NDArray[np.int32]
    """(N,) rows of the triangles they lie on."""

    def __len__(self) -> int:
        return len(self.points)

    def some(self, count: int) -> Sampled:
        """At most `count` of the points."""
        step = max(1, -(-len(self) // count))
        return Sampled(
            self.points[::step], self.normals[::step], self.colours[::step], self.rows[::step]
        )

    def moved(self, motion: Floats) -> Sampled:
        """The same surface elsewhere."""
        return Sampled(
            moved(motion, self.points), self.normals @ motion[:3, :3].T, self.colours, self.rows
        )


def sample(
    mesh: Mesh, triangles: NDArray[np.int64], count: int, rng: Generator, most: float = np.inf
) -> Sampled:
    """About `count` points on some triangles of a mesh, at most `most` a square metre."""
    corners = mesh.vertices[mesh.triangles[triangles]].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    total = float(lengths.sum())
    count = int(min(count, np.ceil(most * total / 2.0))) if total > 0 else 0
    # evenly along the running sum of areas: as many on each triangle as its area says
    at = (np.arange(count) + rng.uniform(size=count)) / max(count, 1) * total
    which = np.minimum(np.searchsorted(np.cumsum(lengths), at), len(triangles) - 1)
    u, v = rng.uniform(size=(2, count))
    over = u + v > 1.0
    u[over], v[over] = 1.0 - u[over], 1.0 - v[over]
    shares = np.stack([1.0 - u - v, u, v], axis=1)
    rows = triangles[which].astype(np.int32)
    return Sampled(
        points=np.einsum("nc,nck->nk", shares, corners[which]),
        normals=normals[which] / np.maximum(lengths[which], 1e-12)[:, None],
        colours=mesh.colour_at(rows, u.astype(np.float32), v.astype(np.float32)),
        rows=rows,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """How well a motion brings points onto a surface."""

    motion: Floats
    """(4, 4) target_from_source"""
    share: float
    """Of the source's points that lie within the reach asked for of the target."""
    rms: float
    """Of their distances [m]; infinite where there are none."""


def register(
    source: Floats, target: Sampled, start: Floats, *, reach: float, upright: bool = True,
    within: float = 0.03,
) -> Registration:  # fmt: skip
    """Motion (4, 4) target_from_source near `start` that brings points (N, 3) onto a surface.

    Parameters
    ----------
    source, target
        Points, and the surface they belong to.
    start
        (4, 4) where to begin.
    reach
        Farthest that a point may be from the surface at first [m]; it shrinks to `within`.
    upright
        Turn about z alone.
    within
        What counts as fitting [m].
    """
    motion = np.array(start, np.float64)
    limit = reach
    for _ in range(_ROUNDS):
        points = moved(motion, source)
        rows = nearest(points, target.points, limit)
        close = rows >= 0
        if np.count_nonzero(close) < 6:
            break
        step = _step(
            points[close], target.points[rows[close]], target.normals[rows[close]], upright
        )
        motion = step @ motion
        size = max(float(np.abs(step[:3, 3]).max()), float(np.abs(step[:3, :3] - np.eye(3)).max()))
        if size < _STILL and limit <= 2 * within:
            break
        limit = max(2 * within, 0.8 * limit)
    return fit(source, target, motion, within)


def fit(source: Floats, target: Sampled, motion: Floats, within: float) -> Registration:
    """How well a motion does as it is; distances are along the target's normals."""
    points = moved(motion, source)
    rows = nearest(points, target.points, 2.0 * within)
    off = np.einsum("nk,nk->n", points - target.points[rows], target.normals[rows])
    close = (rows >= 0) & (np.abs(off) < within)
    rms = float(np.sqrt(np.mean(off[close] ** 2))) if close.any() else np.inf
    return Registration(motion, float(close.mean()) if len(close) else 0.0, rms)


def touching(
    points: Floats, normals: Floats, caster: RayCaster, within: float
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Triangles (N,) of a mesh that points of another surface lie on, from either side; -1: none.

    Rays are cast along the normals (N, 3), so that sparse points tell of whole surfaces; both sides
    are asked since something thin may lie on what is meant.
    """
    found = []
    for side in (normals, -normals):
        hits = caster.cast(points + within * side, -side)
        found.append(np.where(hits.distance <= 2.0 * within, hits.triangle, -1))
    return found[0], found[1]


def _step(points: Floats, onto: Floats, normals: Floats, upright: bool) -> Floats:
    """Small motion (4, 4), by least squares of distances along the normals, about their middle."""
    middle = points.mean(axis=0)
    arm = np.cross(points - middle, normals)
    turns = arm[:, 2:] if upright else arm
    jacobian = np.concatenate([normals, turns], axis=1)
    error = np.einsum("nk,nk->n", onto - points, normals)
    weight = 1.0 / (1.0 + (error / max(float(np.median(np.abs(error))) * 3.0, 1e-4)) ** 2)
    information = jacobian.T @ (jacobian * weight[:, None])
    values, axes = np.linalg.eigh(information)
    known = values > _SLIDES * values[-1]
    right = axes.T @ (jacobian.T @ (weight * error))
    solved = axes[:, known] @ (right[known] / values[known])
    vector = np.array([0.0, 0.0, solved[3]]) if upright else solved[3:]
    rotation = rotation_from_vector(vector)
    return rigid(rotation, solved[:3] + middle - rotation @ middle)


def rigid(rotation: Floats, shift: Floats) -> Floats:
    """(4, 4) of a rotation (3, 3) followed by a shift (3,)."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation, shift
    return out


def inverse(motion: Floats) -> Floats:
    """The rigid motion (4, 4) back."""
    back: Floats = motion[:3, :3].T
    return rigid(back, -back @ motion[:3, 3])


def about(middle: Floats, yaw: float, to: Floats) -> Floats:
    """(4, 4) that turns by `yaw` [rad] about the upright through a point, and brings it to another."""
    rotation = rotation_z(yaw)
    return rigid(rotation, to - rotation @ middle)


def moved(motion: Floats, points: Floats) -> Floats:
    """Points (N, 3) after a rigid motion (4, 4)."""
    out: Floats = points @ motion[:3, :3].T + motion[:3, 3]
    return out
