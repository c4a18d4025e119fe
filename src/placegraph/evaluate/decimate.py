"""Meshes with fewer triangles: quadric edge collapse that keeps the outline of open sheets.

Garland and Heckbert, "Surface simplification using quadric error metrics", 1997. A scan's or a
modeller's mesh becomes the coarse mesh that the paper's maps hold (Sec. 3). Objects never merge.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.errors import OptionError
from placegraph.evaluate.decimate_kernels import collapse
from placegraph.indoor.mesh import Mesh

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]
    Floats32 = NDArray[np.float32]
    Ints = NDArray[np.int32]

WELD = 1e-4
"""Vertices of an object that are nearer than this are one [m]."""
SPACING = 0.02
"""Distance between samples of the colour of a surface [m]."""
MOST_SAMPLES = 4_000_000


def decimate(
    vertices: ArrayLike, triangles: ArrayLike, target: int, group: ArrayLike | None = None
) -> tuple[Floats32, Ints, Ints]:
    """Collapse edges until about `target` triangles are left.

    Parameters
    ----------
    vertices:
        (V, 3) [m].
    triangles:
        (T, 3) rows of vertices.
    target:
        Triangles that are wanted; more are left where collapsing on would tear the surface.
    group:
        (T,) object of a triangle; surfaces of two objects do not merge where they touch.

    Returns
    -------
    vertices
        (V', 3) float32 [m].
    triangles
        (T', 3) int32.
    group
        (T',) int32, zeros where none was given.

    Raises
    ------
    OptionError
        Where `target` is less than 1.
    """
    if target < 1:
        raise OptionError(f"target is {target}; it must be at least 1.")
    points = np.asarray(vertices, np.float64)
    corners = np.asarray(triangles, np.int64)
    owner = np.zeros(len(corners), np.int64) if group is None else np.asarray(group, np.int64)
    points, corners, owner = weld(points, corners, owner)
    if len(corners) > target:
        edges, border = edges_of(corners)
        collapse(points, corners, edges, border, target)
    left = corners[:, 0] >= 0
    used, renamed = np.unique(corners[left], return_inverse=True)
    return (
        points[used].astype(np.float32),
        renamed.reshape(-1, 3).astype(np.int32),
        owner[left].astype(np.int32),
    )


def weld(
    points: NDArray[np.float64], corners: NDArray[np.int64], owner: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Join vertices of one object at one place, drop triangles without three corners, and twins."""
    keys = np.column_stack([np.repeat(owner, 3), np.round(points[corners.ravel()] / WELD)])
    _, first, row = np.unique(keys.astype(np.int64), axis=0, return_index=True, return_inverse=True)
    points = points[corners.ravel()[first]]
    corners = row.reshape(-1, 3)
    a, b, c = np.sort(corners, axis=1).T
    real = np.nonzero((a != b) & (b != c))[0]
    _, once = np.unique(np.stack([a, b, c], axis=1)[real], axis=0, return_index=True)
    kept = real[np.sort(once)]
    return points, corners[kept], owner[kept]


def edges_of(corners: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Edges (E, 2), every one once, and the only face (E,) of a border edge, else -1."""
    pairs = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, first, count = np.unique(pairs, axis=0, return_index=True, return_counts=True)
    return edges, np.where(count == 1, first // 3, -1)


def coarse(mesh: Mesh, target: int, rng: np.random.Generator) -> Mesh:
    """Mesh of about `target` triangles and the same objects, coloured at its vertices alone.

    A vertex gets the mean colour of the surface that is nearer to it than to other vertices of its
    object, from about one sample a `SPACING` squared.
    """
    vertices, triangles, owner = decimate(mesh.vertices, mesh.triangles, target, mesh.object_of)
    points, colours, of = painted_samples(mesh, rng)
    shades = np.full((len(vertices), 3), 255, np.uint8)
    for row in np.unique(owner):
        mine = np.unique(triangles[owner == row])
        shades[mine] = mean_colours(points[of == row], colours[of == row], vertices[mine])
    return Mesh.plain(vertices, triangles, owner, shades)


def painted_samples(
    mesh: Mesh, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.uint8], NDArray[np.int32]]:
    """Points (N, 3) [m] spread over the surface, their colours (N, 3) and objects (N,)."""
    area = 0.5 * np.linalg.norm(mesh.normals(), axis=1)
    grain = max(SPACING**2, float(area.sum()) / MOST_SAMPLES)
    rows = np.repeat(np.arange(len(mesh)), rng.poisson(area / grain) + 1).astype(np.int32)
    root, split = np.sqrt(rng.random(len(rows))), rng.random(len(rows))
    shares = np.stack([1.0 - root, root * (1.0 - split), root * split], axis=1)
    points = np.einsum("nkd,nk->nd", mesh.vertices[mesh.triangles[rows]], shares)
    u, v = shares[:, 1].astype(np.float32), shares[:, 2].astype(np.float32)
    return points, mesh.colour_at(rows, u, v), mesh.object_of[rows]


def mean_colours(
    points: Floats, colours: NDArray[np.uint8], vertices: Floats32
) -> NDArray[np.uint8]:
    """Mean colour (V, 3) of the points (N, 3) nearest to each vertex; of the nearest if none is."""
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(vertices).query(points)
    count = np.bincount(nearest, minlength=len(vertices))
    sums = [np.bincount(nearest, colours[:, k], len(vertices)) for k in range(3)]
    mean = np.stack(sums, axis=1) / np.maximum(count, 1)[:, None]
    bare = np.flatnonzero(count == 0)
    if bare.size:
        mean[bare] = colours[cKDTree(points).query(vertices[bare])[1]]
    return np.rint(mean).astype(np.uint8)


def fine(mesh: Mesh, target: int) -> Mesh:
    """The same surface in about `target` triangles: the largest are cut into four, again and again.

    For measuring time only: a neighbour that was not cut touches three corners with one edge.
    """
    while len(mesh) < target:
        size = np.linalg.norm(mesh.normals(), axis=1)
        count = min(len(mesh), -(-(target - len(mesh)) // 3))
        mesh = quartered(mesh, np.sort(np.argsort(-size, kind="stable")[:count]))
    return mesh


def quartered(mesh: Mesh, rows: NDArray[np.int64]) -> Mesh:
    """Mesh whose triangles `rows` are cut into four at the middles of their edges."""
    corners = mesh.triangles[rows]
    pairs = np.sort(corners[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, middle = np.unique(pairs, axis=0, return_inverse=True)
    middle = middle.reshape(-1, 3) + len(mesh.vertices)
    a, b, c = corners.T
    ab, bc, ca = middle.T
    parts = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    kept = np.ones(len(mesh), bool)
    kept[rows] = False

    def halved(column: NDArray[Any]) -> NDArray[Any]:
        between = column[edges].mean(axis=1)
        if column.dtype == np.uint8:
            between = np.rint(between)
        return np.concatenate([column, between.astype(column.dtype)])

    def shared(column: NDArray[np.int32]) -> NDArray[np.int32]:
        return np.concatenate([column[kept], np.repeat(column[rows], 4)])

    return Mesh(
        vertices=halved(mesh.vertices),
        triangles=np.concatenate([mesh.triangles[kept], parts.astype(np.int32)]),
        object_of=shared(mesh.object_of),
        colours=halved(mesh.colours),
        uv=halved(mesh.uv),
        texture_of=shared(mesh.texture_of),
        textures=mesh.textures,
    )
