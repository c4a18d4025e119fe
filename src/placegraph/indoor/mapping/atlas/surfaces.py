"""Colours of a surface from another mesh of it: a dense one, or one with textures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.surface import Surface
from placegraph.indoor.mapping.atlas.surface_kernels import colours_of, nearest, sorted_cells
from placegraph.indoor.rays import RayCaster
from placegraph.threads import share

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from placegraph.indoor.mapping.atlas.baking import ColourOf

    Floats = NDArray[np.float64]

REACH = 0.10
"""The other mesh lies within this of the surface [m]."""
_STEP = 1e-4  # [m]
_LAYERS = 3  # of faces that look away


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
