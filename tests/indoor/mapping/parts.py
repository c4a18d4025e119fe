from dataclasses import replace

import numpy as np

from placegraph.indoor.scene_map import SceneMap

FACES = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]


def cuboid(low, high):
    low, high = np.array(low, float), np.array(high, float)
    corners = [np.where([i >> 2 & 1, i >> 1 & 1, i & 1], high, low) for i in range(8)]
    return np.array(corners), np.array([f for a, b, c, d in FACES for f in ((a, c, b), (a, d, c))])


def lattice(columns, rows):
    """Corners of squares between 0 and 1, first y, then x, and triangles that look up."""
    x, y = np.meshgrid(np.arange(columns + 1), np.arange(rows + 1), indexing="ij")
    a = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    b, c, d = a + rows + 1, a + rows + 2, a + 1
    points = np.stack([x.ravel() / columns, y.ravel() / rows], axis=1)
    return points, np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)


def only(scene, keep):
    mesh, graph = scene.mesh, scene.graph
    rows = np.unique(mesh.object_of[keep])
    place = np.full(len(scene), -1)
    place[rows] = np.arange(len(rows))
    mesh = replace(
        mesh,
        triangles=mesh.triangles[keep],
        object_of=place[mesh.object_of[keep]].astype(np.int32),
        texture_of=mesh.texture_of[keep],
    )
    ids, labels, names = ([c[i] for i in rows] for c in (graph.ids, graph.labels, graph.names))
    floor = float(scene.floors[0])
    return SceneMap.create(mesh, ids, labels, names=names, floor=floor, encoded=scene.encoded)


def sphere(levels):
    vertices = np.array(
        [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float
    )
    triangles = np.array(
        [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]]
    )
    for _ in range(levels):
        vertices, triangles = subdivided(vertices, triangles)
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, triangles


def subdivided(vertices, triangles):
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, row = np.unique(pairs, axis=0, return_inverse=True)
    ab, bc, ca = (row.reshape(-1, 3) + len(vertices)).T
    a, b, c = triangles.T
    smaller = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return np.concatenate([vertices, vertices[edges].mean(axis=1)]), smaller
