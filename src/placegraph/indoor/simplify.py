"""Meshes with fewer triangles: edges are collapsed as long as the surface stays where it was.

Garland and Heckbert, "Surface simplification using quadric error metrics", 1997, decide in which
order; a bound on the distance from all the original planes that a vertex stands for, after Ronfard
and Rossignac, "Full-range approximation of triangulated polyhedra", 1996, decides when to stop. The
outline of open sheets, the borders between materials and between objects are kept like planes of
their own. Texture coordinates follow: where they jump, at a seam, a vertex has several (wedges).
A modeller's or a scan's mesh becomes the coarse mesh that the paper's maps hold (Sec. 3).
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.mesh import Mesh
from placegraph.indoor.simplify_kernels import collapse

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

WELD = 1e-4
"""Vertices of an object that are nearer than this are one [m]."""
SLIDE = 2.0
"""A texture may slide on its surface by this many times the error bound."""
MOST = 1_500_000
"""Meshes of more triangles are first brought to a grid of the error bound, to save memory."""
_BATCH = 50_000  # triangles a thread takes at a time


class Wedged(NamedTuple):
    """A mesh whose vertices are places, and whose corners (wedges) know colour and texture."""

    points: Floats
    """(V, 3) [m]"""
    corners: Ints
    """(T, 3) rows of points."""
    wedges: Ints
    """(T, 3) rows of values."""
    values: Floats
    """(W, 5) u, v, red, green, blue; colours 0 to 1."""


def simplify(
    mesh: Mesh,
    *,
    error: float,
    colour: float = np.inf,
    target: int = 0,
    left_out: dict[str, int] | None = None,
) -> Mesh:
    """Mesh of the same objects and textures in fewer triangles.

    Parameters
    ----------
    mesh
        Triangles in any order; twins (the same three corners twice) become one.
    error
        Greatest distance of a new vertex from the planes of the triangles it replaces [m]; 0 joins
        only what lies in one plane. Textures slide by `SLIDE` times as much at most.
    colour
        Greatest change of colours at vertices, 0 to 1.
    target
        Stop at about this many triangles, even though the bound would allow fewer.
    left_out
        Is told of twins.

    Raises
    ------
    OptionError
        `error`, `colour` or `target` is negative or not a number.

    """
    if not error >= 0 or not colour >= 0 or target < 0:
        raise OptionError(
            f"error is {error}, colour {colour}, target {target}; none may be less than 0."
        )
    if not len(mesh):
        return mesh
    if len(mesh) > MOST:
        mesh = clustered(mesh, max(error, WELD))
    object_of, texture_of = mesh.object_of.astype(np.int64), mesh.texture_of.astype(np.int64)
    whole, kept = wedged(mesh, object_of)
    lines = ~np.isin(object_of, object_of[kept])  # objects that are nothing but a line stay one
    if left_out is not None and len(kept) < len(mesh):
        twins = len(mesh) - len(kept) - int(lines.sum())
        left_out["triangles twice in one place"] = (
            left_out.get("triangles twice in one place", 0) + twins
        )
    object_of, texture_of = object_of[kept], texture_of[kept]
    # as far as rounding goes, what lies in one plane is in one plane
    limits = np.array([max(error, WELD), max(SLIDE * error, WELD), max(colour, 1e-3)])

    def part(rows: Ints) -> tuple[Wedged, Ints]:
        own = _part(whole, rows)
        share = 0 if not target else int(np.ceil(target * len(rows) / len(object_of)))
        edges, border = edges_of(own.corners, own.wedges, texture_of[rows])
        collapse(own.points, own.corners, edges, border, own.wedges, own.values, share, limits)
        return own, rows

    with ThreadPoolExecutor(2) as pool:  # compiled code works outside the interpreter's lock
        parts = list(pool.map(part, batches(object_of)))
    return _with(_mesh(mesh, parts, object_of, texture_of), mesh, lines)


def wedged(mesh: Mesh, object_of: Ints) -> tuple[Wedged, Ints]:
    """Places and wedges of a mesh, and the rows of its triangles that have three corners, once.

    Vertices of one object at one place become one.
    """
    corner = mesh.triangles.astype(np.int64)
    owner = np.repeat(object_of, 3)
    place = np.rint(mesh.vertices.astype(np.float64) / WELD).astype(np.int64)
    point, first = _groups(np.column_stack([owner, place[corner.ravel()]]))
    points = mesh.vertices[corner.ravel()[first]].astype(np.float64)
    corners = point.reshape(-1, 3)
    kept = _once(corners)
    looks = np.column_stack([mesh.uv.view(np.int32), mesh.colours]).astype(np.int64)
    texture = np.repeat(mesh.texture_of.astype(np.int64), 3)
    wedge, first = _groups(np.column_stack([point, texture, looks[corner.ravel()]]))
    at = corner.ravel()[first]
    values = np.column_stack([mesh.uv[at].astype(np.float64), mesh.colours[at] / 255.0])
    return Wedged(points, corners[kept], wedge.reshape(-1, 3)[kept], values), kept


def edges_of(corners: Ints, wedges: Ints, texture_of: Ints) -> tuple[Ints, Ints]:
    """Edges (E, 2), every one once, and a face (E,) of those that have to stay, else -1.

    These are the edges of one face, of more than two, and the seams: where the texture or its
    coordinates change from one face to the other.
    """
    count = int(corners.max()) + 1
    ends = corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    marks = wedges[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    turned = ends[:, 0] > ends[:, 1]
    ends[turned], marks[turned] = ends[turned][:, ::-1], marks[turned][:, ::-1]
    key = ends[:, 0] * count + ends[:, 1]
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    lengths = np.diff(starts, append=len(order))
    one, two = order[starts], order[np.minimum(starts + 1, len(order) - 1)]
    smooth = (lengths == 2) & (marks[one] == marks[two]).all(axis=1)
    smooth &= texture_of[one // 3] == texture_of[two // 3]
    return ends[one], np.where(smooth, -1, one // 3)


def batches(object_of: Ints) -> list[Ints]:
    """Rows of triangles by object, small objects together, so that threads share the work."""
    order = np.argsort(object_of, kind="stable")
    ends = np.flatnonzero(np.diff(object_of[order], append=-1)) + 1
    group = (ends - 1) // _BATCH  # an object belongs where it ends
    cuts = ends[np.flatnonzero(np.diff(group, append=-1))]
    return [rows for rows in np.split(order, cuts) if len(rows)]


def clustered(mesh: Mesh, cell: float) -> Mesh:
    """Mesh whose vertices of one object in one cell of a grid [m] are one."""
    owner = np.zeros(len(mesh.vertices), np.int64)
    owner[mesh.triangles.ravel()] = np.repeat(mesh.object_of, 3)
    cells = np.floor(mesh.vertices / cell).astype(np.int64)
    group, first = _groups(np.column_stack([owner, cells]))
    count = np.bincount(group)[:, None]
    centre = np.stack([np.bincount(group, mesh.vertices[:, k]) for k in range(3)], axis=1) / count
    corners = group[mesh.triangles]
    kept = _once(corners)
    return Mesh(
        vertices=centre.astype(np.float32),
        triangles=corners[kept].astype(np.int32),
        object_of=mesh.object_of[kept],
        colours=mesh.colours[first],
        uv=mesh.uv[first],
        texture_of=mesh.texture_of[kept],
        textures=mesh.textures,
    )


def _part(whole: Wedged, rows: Ints) -> Wedged:
    """Triangles of their own."""
    used, corners = np.unique(whole.corners[rows], return_inverse=True)
    looks, wedges = np.unique(whole.wedges[rows], return_inverse=True)
    return Wedged(
        whole.points[used], corners.reshape(-1, 3), wedges.reshape(-1, 3), whole.values[looks]
    )


def _mesh(mesh: Mesh, parts: list[tuple[Wedged, Ints]], object_of: Ints, texture_of: Ints) -> Mesh:
    """One mesh of what is left of all parts."""
    vertices, triangles, values, rows = [], [], [], []
    count = 0
    for own, part in parts:
        left = own.corners[:, 0] >= 0
        wedge, place = own.wedges[left].ravel(), own.corners[left].ravel()
        used, first, corner = np.unique(wedge, return_index=True, return_inverse=True)
        vertices.append(own.points[place[first]])
        values.append(own.values[used])
        triangles.append(corner.reshape(-1, 3) + count)
        rows.append(part[left])
        count += len(used)
    value, row = np.concatenate(values), np.concatenate(rows)
    return Mesh(
        vertices=np.concatenate(vertices).astype(np.float32),
        triangles=np.concatenate(triangles).astype(np.int32),
        object_of=object_of[row].astype(np.int32),
        colours=np.clip(np.rint(255.0 * value[:, 2:]), 0, 255).astype(np.uint8),
        uv=value[:, :2].astype(np.float32),
        texture_of=texture_of[row].astype(np.int32),
        textures=mesh.textures,
    )


def _with(mesh: Mesh, other: Mesh, rows: NDArray[np.bool_]) -> Mesh:
    """Mesh and some triangles (T,) of another with the same objects and textures."""
    if not rows.any():
        return mesh
    return Mesh(
        vertices=np.concatenate([mesh.vertices, other.vertices]),
        triangles=np.concatenate([mesh.triangles, other.triangles[rows] + len(mesh.vertices)]),
        object_of=np.concatenate([mesh.object_of, other.object_of[rows]]),
        colours=np.concatenate([mesh.colours, other.colours]),
        uv=np.concatenate([mesh.uv, other.uv]),
        texture_of=np.concatenate([mesh.texture_of, other.texture_of[rows]]),
        textures=mesh.textures,
    )


def _groups(keys: Ints) -> tuple[Ints, Ints]:
    """Group (N,) of equal rows of keys (N, K), and the first row (G,) of each."""
    order = np.lexsort(keys.T[::-1])
    ranked = keys[order]
    begins = np.ones(len(keys), np.bool_)
    begins[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    group = np.empty(len(keys), np.int64)
    group[order] = np.cumsum(begins) - 1
    return group, order[begins]


def _once(corners: Ints) -> Ints:
    """Rows of triangles that have three corners, the first of each."""
    a, b, c = np.sort(corners, axis=1).T
    real = np.flatnonzero((a != b) & (b != c))
    _, first = _groups(np.column_stack([a, b, c])[real])
    rows: Ints = np.sort(real[first])
    return rows
