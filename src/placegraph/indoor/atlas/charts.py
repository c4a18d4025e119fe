"""Charts: pieces of a surface that lie flat in a texture, each nearly a plane and of one object."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.atlas.chart_kernels import absorb, grow, overlapping, turns
from placegraph.indoor.atlas.share import share

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.mesh import Mesh

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

    def grouped(self, within: Floats | None = None) -> tuple[Ints, Ints]:
        """Triangles chart by chart, and where each chart starts (C + 1,).

        `within` (T,): what triangles of one chart are sorted by, ascending.
        """
        return _grouped(self.of, len(self.sizes), within)


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
    axes = np.zeros((0, 2, 3))
    for round_ in range(ROUNDS):
        first = len(axes)
        count = grow(normals, areas, neighbours, order, of, first, CONE)
        if round_ == 0:
            planes = _planes(doubled, of, count)
            small = np.bincount(of, areas, count) < SMALL * texel**2
            absorb(normals, neighbours, of, planes, small, STEEP)
        axes = _settled(points, doubled, of, axes, texel * longest)
        flat = _flat(points, of, axes)
        plane = np.cross(axes[:, 0], axes[:, 1])  # away from who looks at the surface
        steep = -np.einsum("tk,tk->t", normals, plane[of]) < STEEP
        rows, starts = flat.grouped(-areas)
        cell = np.maximum(texel, flat.sizes.max(axis=1) / longest)
        twice, cells = np.zeros(len(of), bool), cell[:, None]
        corners = flat.corners / cells[of][:, None]
        share(overlapping, len(cell), corners, rows, starts, flat.sizes / cells, twice)
        bad = (of >= first) & ((steep & (areas > 0)) | twice)
        if not bad.any():
            return flat
        of[bad] = -1
    single = np.flatnonzero(of < 0)  # whatever cannot lie with others lies alone
    of[single] = len(axes) + np.arange(len(single))
    return _flat(points, of, _settled(points, doubled, of, axes, np.inf))


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


def _settled(points: Floats, doubled: Floats, of: Ints, axes: Floats, limit: float) -> Floats:
    """Axes (C, 2, 3), right and down, of all charts: those of new ones are added.

    New charts longer than `limit` [m] are halved until they are not; `of` is changed in place.
    """
    first = len(axes)
    _compact(of, first)
    fresh = np.flatnonzero(of >= first)
    while True:
        count = int(of.max()) + 1 - first
        own = of[fresh] - first
        made = _axes(_planes(doubled[fresh], own, count))
        flat = _flat(points[fresh], own, made)
        rows, starts = flat.grouped()
        angle = turns(flat.corners, rows, starts, _ANGLES, _GAIN)
        cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
        right, down = made[:, 0], made[:, 1]
        made = np.stack([cosine * right + sine * down, cosine * down - sine * right], axis=1)
        flat = _flat(points[fresh], own, made)
        middle = flat.corners.mean(axis=1)  # (F, 2)
        long_ = flat.sizes.max(axis=1) > limit
        along = np.take_along_axis(middle, flat.sizes.argmax(axis=1)[own][:, None], axis=1)[:, 0]
        beyond = long_[own] & (along > 0.5 * flat.sizes.max(axis=1)[own])
        # a chart whose triangles all lie on one side cannot be halved there
        some = np.bincount(own, beyond, count)
        beyond &= (some < np.bincount(own, minlength=count))[own]
        if not beyond.any():
            return np.concatenate([axes, made])
        of[fresh[beyond]] += count
        _compact(of, first)


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


def _flat(points: Floats, of: Ints, axes: Floats) -> Charts:
    """Charts of triangles (T, 3, 3) laid on planes with these axes (C, 2, 3)."""
    corners = np.einsum("tkn,tan->tka", points, axes[of])
    rows, starts = _grouped(of, len(axes), None)
    filled = np.diff(starts) > 0
    low, high = np.zeros((len(axes), 2)), np.zeros((len(axes), 2))
    low[filled] = np.minimum.reduceat(corners.min(axis=1)[rows], starts[:-1][filled])
    high[filled] = np.maximum.reduceat(corners.max(axis=1)[rows], starts[:-1][filled])
    return Charts(of, corners - low[of][:, None], high - low)


def _grouped(of: Ints, count: int, within: Floats | None) -> tuple[Ints, Ints]:
    rows = np.argsort(of, kind="stable") if within is None else np.lexsort((within, of))
    starts = np.searchsorted(of[rows], np.arange(count + 1))
    return rows, starts.astype(np.int64)
