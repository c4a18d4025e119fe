"""Colours of a surface: from the frames that saw it, or from a mesh that has some."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.threads import share
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.surface import Surface
from placegraph.indoor.mapping.atlas.surface_kernels import colours_of, nearest, sorted_cells
from placegraph.indoor.mapping.atlas.view_kernels import (
    OBSERVED,
    Keyframes,
    balance,
    mixed,
    observe,
)
from placegraph.indoor.mapping.atlas.views import keyframes, looked
from placegraph.indoor.rays import RayCaster
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.mapping.atlas.baking import ColourOf


Floats = NDArray[np.float64]
Bytes = NDArray[np.uint8]


VIEWS = 120
"""Keyframes, at most."""
_POINTS = 20_000  # of the surface, at which exposures are compared
_PRIOR = 10.0  # observations that speak for an exposure like the others'
_ROUNDS = 4
_FAR_OFF = 0.15  # of a logarithm: a highlight or another surface, no exposure
REACH = 0.10
"""The other mesh lies within this of the surface [m]."""
_STEP = 1e-4  # [m]
_LAYERS = 3  # of faces that look away


def frame_colours(
    frames: Sequence[Frame],
    poses: ArrayLike,
    vertices: ArrayLike,
    triangles: ArrayLike,
    *,
    texel: float = 0.01,
    views: int = VIEWS,
    progress: Callable[[int, int], None] | None = None,
) -> ColourOf:
    """Colours of a surface as frames saw it.

    Of frames taken from nearly one place the sharpest is kept. A texel looks at those that see it
    near, frontal, away from the image's border and from edges of depth, and not behind something
    else: nearer than the frame's depth, or than the mesh where there is none. Of the five best,
    those that agree are mixed. Before that, each frame's exposure is solved for, a channel at a
    time, over what frames share.

    Parameters
    ----------
    frames
        With colour, optionally depth; their images may be of several sizes.
    poses
        (T, 4, 4) map_from_camera of the frames [m].
    vertices, triangles
        (V, 3) [m] and (T, 3): the surface, the denser the better.
    texel
        Width that a colour is the mean of [m].
    views
        Frames that are kept, at most.
    progress
        Called with frames read and all frames.

    Raises
    ------
    OptionError
        Poses do not fit the frames, there is no frame, no triangle, or an option is out of range.
    InputError
        An image cannot be read.

    """
    where = _checked(poses, len(frames))
    if not (np.isfinite(texel) and texel > 0) or views < 1:
        raise OptionError(f"texel is {texel}, views {views}; they must be greater than 0.")
    caster = RayCaster(vertices, triangles)
    groups = keyframes(where, views)
    seen = looked(frames, where, groups, caster, progress)
    seen = seen._replace(
        gains=_gains(seen, np.asarray(vertices, np.float64), np.asarray(triangles))
    )

    def colour_of(points: Floats, normals: Floats, _: Any) -> tuple[Bytes, Any]:  # noqa: ANN401
        out, known = np.zeros((len(points), 3), np.uint8), np.zeros(len(points), bool)
        share(mixed, len(points), seen, points, normals, texel, out, known)
        return out, known

    return colour_of


def _checked(poses: ArrayLike, count: int) -> Floats:
    where = np.asarray(poses, np.float64)
    if where.shape != (count, 4, 4) or not count or not np.isfinite(where).all():
        raise OptionError(
            f"poses: shape {where.shape} for {count} frames; each of at least one frame needs "
            "a finite 4 x 4 map_from_camera."
        )
    return where


def _gains(views: Keyframes, vertices: Floats, triangles: NDArray[Any]) -> NDArray[np.float32]:
    """What the colours of each view are multiplied by (K, 3), near 1, so that all agree."""
    points, normals = _spread(vertices, triangles, _POINTS)
    rows = np.full((len(points), OBSERVED), -1, np.int64)
    colours = np.zeros((len(points), OBSERVED, 3))
    share(observe, len(points), views, points, normals, 0.04, rows, colours)
    count = len(views.centres)
    fair = (rows >= 0) & (colours.min(axis=2) > 12) & (colours.max(axis=2) < 245)
    fair &= (fair.sum(axis=1) > 1)[:, None]
    logs = np.log(np.maximum(colours, 1.0))
    out = np.ones((count, 3))
    for c in range(3):
        weights = fair.astype(np.float64)
        for _ in range(_ROUNDS):
            matrix, right = _PRIOR * np.eye(count), np.zeros(count)
            balance(rows, logs[:, :, c], weights, matrix, right)
            exposure = np.linalg.solve(matrix, right)
            left = logs[:, :, c] - exposure[rows]
            total = np.maximum(weights.sum(axis=1, keepdims=True), 1e-9)
            off = left - (weights * left).sum(axis=1, keepdims=True) / total
            weights = fair / (1.0 + (off / _FAR_OFF) ** 2) ** 2  # Geman and McClure
        out[:, c] = np.exp(-exposure)
    return np.clip(out, 0.2, 5.0).astype(np.float32)


def _spread(vertices: Floats, triangles: NDArray[Any], count: int) -> tuple[Floats, Floats]:
    """About `count` points (N, 3) spread evenly over a surface, and unit normals (N, 3)."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    doubled = np.cross(b - a, c - a)
    area = np.linalg.norm(doubled, axis=1)
    ends = np.cumsum(area)
    if not ends[-1] > 0:
        return np.zeros((0, 3)), np.zeros((0, 3))
    rows = np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1])
    rows = np.minimum(rows, len(area) - 1)
    # a sequence of low discrepancy (Roberts), folded into the triangle
    uv = (np.arange(count)[:, None] * (0.7548776662, 0.5698402910) + 0.5) % 1.0
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1.0 - uv, uv)
    points = a[rows] + uv[:, :1] * (b - a)[rows] + uv[:, 1:] * (c - a)[rows]
    return points, doubled[rows] / np.maximum(area[rows], 1e-30)[:, None]


def surface_colours(
    vertices: ArrayLike, triangles: ArrayLike, colours: ArrayLike, *, reach: float = REACH
) -> ColourOf:
    """Colours of a dense mesh: vertices (V, 3) [m], triangles (T, 3), colours (V, 3) uint8.

    Parameters and errors otherwise as of `mesh_colours`.
    """
    return mesh_colours(Mesh.plain(vertices, triangles, colours=colours), reach=reach)


def mesh_colours(mesh: Mesh, *, texel: float = 0.01, reach: float = REACH) -> ColourOf:
    """Colours of a mesh of the same surface, with textures or without.

    A point has the colour that a ray along its normal, or against it, meets within `reach` [m],
    rather on a face that looks the same way; where there is none, that of the nearest vertex within
    twice `reach`; else none. Textures are averaged over `texel` [m].

    Raises `OptionError` where the mesh has no triangle or `reach` is no length.
    """
    if not (np.isfinite(reach) and reach > 0):
        raise OptionError(f"reach is {reach}; it must be a length in metres, as {REACH}.")
    caster = RayCaster(mesh.vertices, mesh.triangles)
    surface = Surface.of(mesh)
    normals = mesh.normals()
    low = mesh.bounds()[0]
    grid = sorted_cells(mesh.vertices, low, 2.0 * reach)
    first_of = np.zeros(len(mesh.vertices), np.int64)  # a triangle and a corner of each vertex
    first_of[mesh.triangles.ravel()] = np.arange(mesh.triangles.size)

    def colour_of(points: Floats, along: Floats, _: Any) -> tuple[NDArray[np.uint8], Any]:  # noqa: ANN401
        triangle, u, v = _met(caster, normals, points, along, reach)
        bare = np.flatnonzero(triangle < 0)
        rows = np.empty(len(bare), np.int64)
        share(nearest, len(bare), points[bare], mesh.vertices, grid, low, 2.0 * reach, rows)
        found = rows >= 0
        place = first_of[rows[found]]
        triangle[bare[found]] = place // 3
        u[bare[found]], v[bare[found]] = place % 3 == 1, place % 3 == 2
        out = np.zeros((len(points), 3), np.uint8)
        share(colours_of, len(points), surface, triangle, u, v, np.float32(texel), out)
        return out, triangle >= 0

    return colour_of


def _met(
    caster: RayCaster, normals: Floats, points: Floats, along: Floats, reach: float
) -> tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32]]:
    """Triangle (N,), -1: none, and weights of corners 1 and 2 of what lies next to points."""
    best = np.full(len(points), np.inf)
    triangle = np.full(len(points), -1, np.int32)
    u, v = np.zeros(len(points), np.float32), np.zeros(len(points), np.float32)
    for way in (1.0, -1.0):
        rows = np.arange(len(points))
        # from a little behind, so that a surface right at the point is met both ways
        begun = np.full(len(points), -_STEP)
        for _ in range(_LAYERS):
            heading = way * along[rows]
            hits = caster.cast(points[rows] + begun[:, None] * heading, heading)
            far = np.abs(hits.distance + begun)
            same = np.einsum("nk,nk->n", normals[hits.triangle], along[rows]) > 0
            off = far + np.where(same, 0.0, reach)
            met = (hits.triangle >= 0) & (far <= reach)
            nearer = met & (off < best[rows])
            own = rows[nearer]
            best[own], triangle[own] = off[nearer], hits.triangle[nearer]
            u[own], v[own] = hits.u[nearer], hits.v[nearer]
            behind = met & ~same  # the back of something thin: what looks our way may lie behind it
            rows, begun = rows[behind], (begun + hits.distance + _STEP)[behind]
    return triangle, u, v
