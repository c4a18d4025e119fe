from dataclasses import replace

import numpy as np

from placegraph.indoor.scene_map import SceneMap


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
