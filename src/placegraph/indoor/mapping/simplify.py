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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.simplify_kernels import CollapsePart, collapse, fill_groups

Ints = NDArray[np.int64]
Rows = NDArray[np.int32]

WELD = 1e-4  # Vertices of an object that are nearer than this are one [m]
SLIDE = 2.0  # A texture may slide on its surface by this many times the error bound
TILE = 1_000_000
"""Objects of more triangles are simplified tile by tile, to save memory, and then as a whole."""
TILED = 0.8  # Share of the bounds that tiles may use up
_BATCH = 50_000  # triangles a thread takes at a time


class WedgeMesh(NamedTuple):
    """A mesh whose vertices are places, and whose corners (wedges) know colour and texture."""

    points: Floats  # (V, 3) [m]
    corners: Rows  # (T, 3) rows of points
    wedges: Rows  # (T, 3) rows of values
    values: Floats  # (W, 5) u, v, red, green, blue; colours 0 to 1


def simplify(
    mesh: Mesh,
    *,
    error: float,
    colour: float = np.inf,
    target: int = 0,
    left_out: dict[str, int] | None = None,
) -> Mesh:
    """Simplify a mesh to fewer triangles; objects and textures stay.

    `mesh`: triangles in any order; twins (the same three corners twice) become one.
    `error`: greatest distance of a new vertex from the planes of the triangles it replaces [m]; 0
        joins only what lies in one plane. Textures slide by `SLIDE` times as much at most.
    `colour`: greatest change of colours at vertices, 0 to 1.
    `target`: stop at about this many triangles, even though the bound would allow fewer.
    `left_out`: is told of twins.
    """
    if not len(mesh):
        return mesh
    told = {} if left_out is None else left_out
    vast = int(np.bincount(mesh.object_of).max()) > TILE
    for share in (TILED, 1.0 - TILED) if vast else (1.0,):
        # as far as rounding goes, what lies in one plane is in one plane
        bounds = share * np.array([error, SLIDE * error, colour])
        mesh = _simplify_once(mesh, np.maximum(bounds, [WELD, WELD, 1e-3]), target, told)
    return mesh


def _simplify_once(mesh: Mesh, limits: Floats, target: int, left_out: dict[str, int]) -> Mesh:
    """Simplify a mesh by one round; `limits` as of `collapse`."""
    full, kept = build_wedges(mesh)
    if not len(kept):  # nothing but lines
        return mesh
    lines = ~np.isin(mesh.object_of, mesh.object_of[kept])  # objects that are but a line stay one
    twins = len(mesh) - len(kept) - int(lines.sum())
    if twins:
        name = "triangles twice in one place"
        left_out[name] = left_out.get(name, 0) + twins
    object_of, texture_of = mesh.object_of[kept], mesh.texture_of[kept]
    parts = [tile for rows in batch_objects(object_of) for tile in cut_tiles(full, rows)]
    locked = _find_shared(full, parts)

    def part(rows: Ints) -> tuple[WedgeMesh, Ints]:
        own, fixed = _extract_part(full, rows, locked)
        share = 0 if not target else int(np.ceil(target * len(rows) / len(object_of)))
        edges, border = find_edges(own.corners, own.wedges, texture_of[rows])
        centre = own.points.mean(axis=0)  # near the origin planes are exact
        own.points[:] -= centre
        collapse(
            CollapsePart(own.points, own.corners, edges, border, *own[2:], fixed), share, limits
        )
        own.points[:] += centre
        left = own.corners[:, 0] >= 0
        return _pack_part(own, left), rows[left]

    with ThreadPoolExecutor(2) as pool:  # compiled code works outside the interpreter's lock
        done = list(pool.map(part, parts))
    return _append_triangles(_join_parts(mesh, done, object_of, texture_of), mesh, lines)


def build_wedges(mesh: Mesh) -> tuple[WedgeMesh, Ints]:
    """Weld a mesh to places and wedges; also the rows of its triangles that have three corners, once.

    Vertices of one object at one place become one.
    """
    vertex, owner, node = _split_by_owner(mesh.triangles, mesh.object_of, len(mesh.vertices))
    place = np.rint(mesh.vertices.astype(np.float64) / WELD).astype(np.int64)
    point, first = group_rows(np.column_stack([owner, place[vertex]]))
    points = mesh.vertices[vertex[first]].astype(np.float64)
    corners = point[node]
    kept = _drop_twins(corners)
    row, texture, node = _split_by_owner(node, mesh.texture_of, len(vertex))
    at = vertex[row]
    uv = mesh.uv + np.float32(0.0)  # -0 is 0
    shade = mesh.colours.astype(np.int64) @ (1 << 16, 1 << 8, 1)
    looks = np.column_stack([uv.view(np.int32), shade])[at]
    wedge, first = group_rows(np.column_stack([point[row], texture, looks]))
    at = at[first]
    values = np.column_stack([uv[at].astype(np.float64), mesh.colours[at] / 255.0])
    return WedgeMesh(points, corners[kept], wedge[node[kept]], values), kept


def _split_by_owner(rows: Rows, of: Rows, count: int) -> tuple[Rows, Rows, Rows]:
    """Split `count` rows so that each belongs to one owner only.

    `rows`: (T, 3), `of`: (T,) their owner. Returns the old row and the owner of each of the N >=
    `count` new rows, and `rows` in terms of these.
    """
    owner = np.zeros(count, np.int32)
    for k in range(3):
        owner[rows[:, k]] = of
    other = owner[rows] != of[:, None]
    if not other.any():
        return np.arange(count, dtype=np.int32), owner, rows
    triangle, corner = np.nonzero(other)
    pairs = of[triangle].astype(np.int64) * count + rows[triangle, corner]
    more, place = np.unique(pairs, return_inverse=True)
    new = rows.copy()
    new[triangle, corner] = count + place
    old = np.concatenate([np.arange(count), more % count]).astype(np.int32)
    return old, np.concatenate([owner, more // count]).astype(np.int32), new


def find_edges(corners: Rows, wedges: Rows, texture_of: Rows) -> tuple[Rows, Ints]:
    """Find edges (E, 2), every one once, and a face (E,) of those that have to stay, else -1.

    These are the edges of one face, of more than two, and the seams: where the texture or its
    coordinates change from one face to the other.
    """
    count = int(corners.max()) + 1
    ends = corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    marks = wedges[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    turned = ends[:, 0] > ends[:, 1]
    ends[turned], marks[turned] = ends[turned][:, ::-1], marks[turned][:, ::-1]
    key = ends[:, 0].astype(np.int64) * count + ends[:, 1]
    order = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[order], prepend=-1))
    lengths = np.diff(starts, append=len(order))
    one, two = order[starts], order[np.minimum(starts + 1, len(order) - 1)]
    smooth = (lengths == 2) & (marks[one] == marks[two]).all(axis=1)
    smooth &= texture_of[one // 3] == texture_of[two // 3]
    return ends[one], np.where(smooth, -1, one // 3)


def batch_objects(object_of: Rows) -> list[Ints]:
    """Batch triangles by object, small objects together, so that threads share the work."""
    order = np.argsort(object_of, kind="stable")
    ends = np.flatnonzero(np.diff(object_of[order], append=-1)) + 1
    group = (ends - 1) // _BATCH  # an object belongs where it ends
    cuts = ends[np.flatnonzero(np.diff(group, append=-1))]
    return [rows for rows in np.split(order, cuts) if len(rows)]


def cut_tiles(full: WedgeMesh, rows: Ints) -> list[Ints]:
    """Cut triangles into boxes of at most `TILE` each."""
    if len(rows) <= TILE:
        return [rows]
    middle = full.points[full.corners[rows, 0]]
    axis = int(np.ptp(middle, axis=0).argmax())
    order = np.argpartition(middle[:, axis], len(rows) // 2)
    halves = np.split(rows[order], [len(rows) // 2])
    return [tile for half in halves for tile in cut_tiles(full, np.sort(half))]


def _find_shared(full: WedgeMesh, parts: list[Ints]) -> NDArray[np.bool_]:
    last = np.empty(len(full.points), np.int32)
    shared = np.zeros(len(full.points), np.bool_)
    for number, rows in enumerate(parts):
        last[full.corners[rows]] = number
    for number, rows in enumerate(parts):
        corners = full.corners[rows]
        shared[corners[last[corners] != number]] = True
    return shared


def _extract_part(
    full: WedgeMesh, rows: Ints, locked: NDArray[np.bool_]
) -> tuple[WedgeMesh, NDArray[np.bool_]]:
    """Extract triangles as a mesh of their own, and which of its points are locked."""
    used, corners = np.unique(full.corners[rows], return_inverse=True)
    looks, wedges = np.unique(full.wedges[rows], return_inverse=True)
    own = WedgeMesh(
        full.points[used],
        corners.reshape(-1, 3).astype(np.int32),
        wedges.reshape(-1, 3).astype(np.int32),
        full.values[looks],
    )
    return own, locked[used]


def _pack_part(own: WedgeMesh, left: NDArray[np.bool_]) -> WedgeMesh:
    wedge, place = own.wedges[left].ravel(), own.corners[left].ravel()
    used, first, corner = np.unique(wedge, return_index=True, return_inverse=True)
    corners = corner.reshape(-1, 3).astype(np.int32)
    return WedgeMesh(own.points[place[first]], corners, corners, own.values[used])


def _join_parts(
    mesh: Mesh, parts: list[tuple[WedgeMesh, Ints]], object_of: Rows, texture_of: Rows
) -> Mesh:
    ends = np.cumsum([len(own.points) for own, _ in parts])
    values = np.concatenate([own.values for own, _ in parts])
    row = np.concatenate([rows for _, rows in parts])
    return Mesh(
        vertices=np.concatenate([own.points for own, _ in parts]).astype(np.float32),
        triangles=np.concatenate(
            [
                own.corners + (end - len(own.points))
                for (own, _), end in zip(parts, ends, strict=True)
            ]
        ).astype(np.int32),
        object_of=object_of[row],
        colours=np.clip(np.rint(255.0 * values[:, 2:]), 0, 255).astype(np.uint8),
        uv=values[:, :2].astype(np.float32),
        texture_of=texture_of[row],
        textures=mesh.textures,
    )


def _append_triangles(mesh: Mesh, other: Mesh, rows: NDArray[np.bool_]) -> Mesh:
    """Append some triangles (T,) of another mesh with the same objects and textures."""
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


def _drop_twins(corners: Rows) -> Ints:
    """Drop triangles without three corners, and all but the first of each set of corners."""
    a, b, c = np.sort(corners, axis=1).T
    real = np.flatnonzero((a != b) & (b != c))
    _, first = group_rows(np.column_stack([a, b, c])[real].astype(np.int64))
    rows: Ints = real[first]
    return rows


def group_rows(keys: NDArray[np.int64]) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Group (N,) int32 of equal rows of keys (N, K) int64, and the first row (G,) of each.

    Groups are numbered in the order in which they are met.
    """
    bits = max(int(2 * len(keys) - 1).bit_length(), 1)
    group = np.empty(len(keys), np.int32)
    first = np.empty(len(keys), np.int64)
    count = fill_groups(np.ascontiguousarray(keys), np.full(1 << bits, -1, np.int32), group, first)
    return group, first[:count].copy()
