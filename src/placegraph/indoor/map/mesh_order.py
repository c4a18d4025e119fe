"""Triangles in an order that compresses well: fan by fan, vertices numbered as they first appear.

A corner is stored as its distance from the number of vertices seen so far, "high water": 0 is a new
vertex, neighbours are small numbers (Deering's and later formats' vertex cache codes). Entropy is
left to the file's codec. Any order can be written; this one is a third of the size of a scan's own.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.mesh import Mesh


def ordered(mesh: Mesh) -> Mesh:
    """The same mesh, part by connected part and fan by fan, without vertices that nothing uses."""
    from placegraph.indoor.map.mesh_order_kernels import fan_order

    by_object = np.argsort(mesh.object_of, kind="stable")
    corners = mesh.triangles[by_object].astype(np.int64)
    order, number, count = fan_order(corners, len(mesh.vertices))
    rows = by_object[order]
    vertex = np.empty(count, np.int64)
    used = np.flatnonzero(number >= 0)
    vertex[number[used]] = used
    return replace(
        mesh,
        vertices=mesh.vertices[vertex],
        triangles=number[corners[order]].astype(np.int32),
        object_of=mesh.object_of[rows],
        colours=mesh.colours[vertex],
        uv=mesh.uv[vertex],
        texture_of=mesh.texture_of[rows],
    )


def high_water(triangles: NDArray[np.int32]) -> NDArray[np.int32]:
    """Codes (3 T,) of triangles (T, 3)."""
    from placegraph.indoor.map.mesh_order_kernels import code

    codes = np.empty(triangles.size, np.int32)
    code(triangles.ravel(), codes)
    return codes


def from_high_water(codes: NDArray[np.int32]) -> NDArray[np.int32]:
    """Triangles (T, 3) of `high_water` codes (3 T,)."""
    new = (codes == 0).astype(np.int64)
    level = np.cumsum(new) - new
    return (level - codes).astype(np.int32).reshape(-1, 3)
