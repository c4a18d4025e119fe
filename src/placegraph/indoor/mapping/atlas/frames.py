"""Colours of a surface from the frames that saw it, by the best views of each texel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.mapping.atlas.view_kernels import OBSERVED, Views, balance, mixed, observe
from placegraph.indoor.mapping.atlas.views import keyframes, looked
from placegraph.indoor.rays import RayCaster
from placegraph.threads import share

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from placegraph.formats.capture.frame import Frame
    from placegraph.indoor.mapping.atlas.baking import ColourOf

    Floats = NDArray[np.float64]
    Bytes = NDArray[np.uint8]

VIEWS = 120
"""Keyframes, at most."""
_POINTS = 20_000  # of the surface, at which exposures are compared
_PRIOR = 10.0  # observations that speak for an exposure like the others'
_ROUNDS = 4
_FAR_OFF = 0.15  # of a logarithm: a highlight or another surface, no exposure


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


def _gains(views: Views, vertices: Floats, triangles: NDArray[Any]) -> NDArray[np.float32]:
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
