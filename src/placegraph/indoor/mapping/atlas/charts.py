"""Charts: pieces of a surface that lie flat in a texture, each nearly a plane and of one object."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.threads import share
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.atlas.chart_kernels import absorb, grow, overlapping, turns

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


CONE = np.cos(np.radians(45.0))
"""Normals of a chart lie within this of their mean as it grows."""
STEEP = np.cos(np.radians(75.0))
"""No triangle of a chart is steeper than this to its plane: it would get too few texels."""
SMALL = 150.0
"""Charts of a smaller area [texels] rather join a neighbour."""
ROUNDS = 6
_ANGLES = np.radians(np.arange(0.0, 90.0, 3.0))
_GAIN = 0.1  # a rectangle that is not upright must be this much smaller


@dataclass(frozen=True, eq=False)
class Charts:
    """C charts of T triangles."""

    of: Ints
    """(T,) chart of each triangle."""
    corners: Floats
    """(T, 3, 2) corners on the chart's plane, from the lowest corner of its rectangle [m]."""
    sizes: Floats
    """(C, 2) width and height of each chart's rectangle [m]."""

    def grouped(self) -> tuple[Ints, Ints]:
        """Triangles chart by chart, and where each chart starts (C + 1,)."""
        return _grouped(self.of, len(self.sizes), None)


def charts_of(mesh: Mesh, neighbours: Ints, texel: float, longest: int) -> Charts:
    """Charts of a mesh: no two triangles of one overlap, and none is longer than `longest` texels.

    A triangle that is longer than that by itself is a chart of its own. `neighbours` as from
    `neighbours_of`; `texel` [m].
    """
    doubled = mesh.normals()
    areas = 0.5 * np.linalg.norm(doubled, axis=1)
    normals = doubled / np.maximum(2.0 * areas, 1e-30)[:, None]
    points = mesh.vertices[mesh.triangles].astype(np.float64)
    order = np.argsort(-areas, kind="stable")
    of = np.full(len(mesh), -1, np.int64)
    laid = _Laid(np.zeros((0, 2, 3)), np.zeros((0, 2)), np.zeros((0, 2)))
    for round_ in range(ROUNDS):
        first = len(laid.axes)
        count = grow(normals, areas, neighbours, order, of, first, CONE)
        if round_ == 0:
            planes = _planes(doubled, of, count)
            small = np.bincount(of, areas, count) < SMALL * texel**2
            absorb(normals, neighbours, of, planes, small, STEEP)
        laid = laid.with_new(points, doubled, of, texel * longest)
        plane = np.cross(laid.axes[:, 0], laid.axes[:, 1])  # away from who looks at the surface
        steep = -np.einsum("tk,tk->t", normals, plane[of]) < STEEP
        bad = (of >= first) & ((steep & (areas > 0)) | _twice(laid, points, of, areas, texel))
        if not bad.any():
            break
        of[bad] = -1
    single = np.flatnonzero(of < 0)  # whatever cannot lie with others lies alone
    if len(single):
        of[single] = len(laid.axes) + np.arange(len(single))
        laid = laid.with_new(points, doubled, of, np.inf)
    used, of = np.unique(of, return_inverse=True)
    laid = _Laid(laid.axes[used], laid.low[used], laid.sizes[used])
    return Charts(of.reshape(-1), laid.corners(points, of.reshape(-1)), laid.sizes)


def neighbours_of(mesh: Mesh) -> Ints:
    """(T, 3) triangle across each side, of the same object, -1: none.

    Vertices at one place count as one. Where more than two triangles share a side, two and two do.
    """
    places = np.ascontiguousarray(mesh.vertices + np.float32(0.0))  # no -0
    _, welded = np.unique(places.view([("", "V12")]).ravel(), return_inverse=True)
    corners = welded.reshape(-1)[mesh.triangles.astype(np.int64)]
    ends = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edge = ends[:, 0] * len(mesh.vertices) + ends[:, 1]
    object_of = np.repeat(mesh.object_of, 3)
    order = np.lexsort((object_of, edge))
    edge, object_of = edge[order], object_of[order]
    new = np.r_[True, (edge[1:] != edge[:-1]) | (object_of[1:] != object_of[:-1])]
    first = np.maximum.accumulate(np.where(new, np.arange(len(edge)), 0))
    odd = (np.arange(len(edge)) - first) % 2 == 1
    second = np.flatnonzero(odd)
    out = np.full(len(edge), -1, np.int64)
    out[order[second]] = order[second - 1] // 3
    out[order[second - 1]] = order[second] // 3
    return out.reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class _Laid:
    """How C charts lie. It stays when a triangle is taken out, so that what was checked holds."""

    axes: Floats
    """(C, 2, 3) right and down, unit vectors."""
    low: Floats
    """(C, 2) where each chart's rectangle starts along them [m]."""
    sizes: Floats
    """(C, 2) [m]"""

    def corners(self, points: Floats, of: Ints) -> Floats:
        """Corners (T, 3, 2) on the charts' rectangles of triangles (T, 3, 3) [m]."""
        return np.einsum("tkn,tan->tka", points, self.axes[of]) - self.low[of][:, None]

    def with_new(self, points: Floats, doubled: Floats, of: Ints, limit: float) -> _Laid:
        """These and the new charts, halved where they are longer than `limit` [m]; changes `of`."""
        first = len(self.axes)
        _compact(of, first)
        fresh = np.flatnonzero(of >= first)
        while True:
            own = of[fresh] - first
            made = _laid(points[fresh], doubled[fresh], own, int(own.max()) + 1)
            middle = made.corners(points[fresh], own).mean(axis=1)  # (F, 2)
            length, side = made.sizes.max(axis=1), made.sizes.argmax(axis=1)
            along = np.take_along_axis(middle, side[own][:, None], axis=1)[:, 0]
            beyond = (length[own] > limit) & (along > 0.5 * length[own])
            # a chart whose triangles all lie on one side cannot be halved there
            beyond &= (np.bincount(own, beyond) < np.bincount(own))[own]
            if not beyond.any():
                pairs = ((self.axes, made.axes), (self.low, made.low), (self.sizes, made.sizes))
                return _Laid(*(np.concatenate(pair) for pair in pairs))
            of[fresh[beyond]] += len(made.axes)
            _compact(of, first)


def _laid(points: Floats, doubled: Floats, of: Ints, count: int) -> _Laid:
    """Charts on their mean planes, upright, or turned where that makes a smaller rectangle."""
    upright = _axes(_planes(doubled, of, count))
    rows, starts = _grouped(of, count, None)
    corners = np.einsum("tkn,tan->tka", points, upright[of])
    angle = turns(corners, rows, starts, _ANGLES, _GAIN)
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    right, down = upright[:, 0], upright[:, 1]
    axes = np.stack([cosine * right + sine * down, cosine * down - sine * right], axis=1)
    corners = np.einsum("tkn,tan->tka", points, axes[of])[rows]
    low = np.minimum.reduceat(corners.min(axis=1), starts[:-1])
    return _Laid(axes, low, np.maximum.reduceat(corners.max(axis=1), starts[:-1]) - low)


def _twice(laid: _Laid, points: Floats, of: Ints, areas: Floats, texel: float) -> NDArray[np.bool_]:
    """Triangles (T,) that lie over a larger one of their chart, on the grid that will be coloured."""
    rows, starts = _grouped(of, len(laid.axes), -areas)
    extents = laid.sizes / texel
    grids = np.maximum(np.ceil(extents - 1e-6), 1.0)
    corners = laid.corners(points, of) / texel + (0.5 * (grids - extents))[of][:, None]
    out = np.zeros(len(of), bool)
    share(overlapping, len(grids), corners, rows, starts, grids, out)
    return out


def _compact(of: Ints, first: int) -> None:
    """Renumber charts from `first` on so that none is empty, in place."""
    fresh = of >= first
    of[fresh] = np.unique(of[fresh], return_inverse=True)[1].reshape(-1) + first


def _planes(doubled: Floats, of: Ints, count: int) -> Floats:
    """Mean unit normals (C, 3); up where a chart has no area."""
    total = np.stack([np.bincount(of, doubled[:, k], count) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.maximum(length, 1e-30), (0.0, 0.0, 1.0))


def _axes(planes: Floats) -> Floats:
    """Right and down (C, 2, 3) as seen by who looks at planes (C, 3): upright where these are."""
    down = np.broadcast_to([0.0, 0.0, -1.0], planes.shape)
    level = np.abs(planes[:, 2:]) > 0.95
    down = np.where(level, (0.0, -1.0, 0.0), down)
    down = down - planes * np.einsum("ck,ck->c", down, planes)[:, None]
    down = down / np.linalg.norm(down, axis=1, keepdims=True)
    return np.stack([np.cross(planes, down), down], axis=1)


def _grouped(of: Ints, count: int, within: Floats | None) -> tuple[Ints, Ints]:
    """As `Charts.grouped`; triangles of one chart ascend by `within` (T,)."""
    rows = np.argsort(of, kind="stable") if within is None else np.lexsort((within, of))
    starts = np.searchsorted(of[rows], np.arange(count + 1))
    return rows, starts.astype(np.int64)
