"""Meshes to cast rays at, and rays that are like none or like all."""

import numpy as np
import pytest

from placegraph.indoor.rays import RayCaster, embree
from placegraph.io.mesh.gltf import read_glb

BOX = np.array(
    [
        [[0, 2, 1], [1, 2, 3]],
        [[4, 5, 6], [5, 7, 6]],
        [[0, 1, 4], [1, 5, 4]],
        [[2, 6, 3], [3, 6, 7]],
        [[0, 4, 2], [2, 4, 6]],
        [[1, 3, 5], [3, 7, 5]],
    ]
).reshape(12, 3)


def _soup(number, rng, size=0.1):
    centres = rng.uniform((0, 0, 0), (10, 8, 3), (number, 1, 3))
    corners = centres + rng.normal(0, size, (number, 3, 3))
    corners[::50] = corners[1::50][: len(corners[::50])]
    corners[7::100, 2] = corners[7::100, 1]
    return corners.reshape(-1, 3), np.arange(3 * number).reshape(-1, 3)


def _sphere(levels):
    vertices = np.array(
        [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float
    )
    triangles = np.array(
        [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]]
    )
    for _ in range(levels):
        vertices, triangles = _subdivided(vertices, triangles)
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    return vertices, triangles


def _subdivided(vertices, triangles):
    pairs = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, row = np.unique(pairs, axis=0, return_inverse=True)
    ab, bc, ca = (row.reshape(-1, 3) + len(vertices)).T
    a, b, c = triangles.T
    smaller = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
    return np.concatenate([vertices, vertices[edges].mean(axis=1)]), smaller


def _box(low, high):
    corners = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij")).reshape(3, -1).T
    return np.asarray(low) + corners * (np.asarray(high, float) - low), BOX


def _anyhow(number, rng, low, high):
    return rng.uniform(low, high, (number, 3)), rng.normal(size=(number, 3))


def _tiles(poses, rng, low, high, rows=24, columns=48):
    y, x = np.mgrid[:rows, :columns]
    y, x = (a.reshape(rows // 4, 4, columns // 4, 4).swapaxes(1, 2).ravel() + 0.5 for a in (y, x))
    rays = np.stack([np.full(len(x), columns * 0.7), columns / 2 - x, rows / 2 - y], axis=1)
    yaw = rng.uniform(0, 2 * np.pi, poses)
    c, s, o = np.cos(yaw), np.sin(yaw), np.zeros(poses)
    turn = np.stack([c, -s, o, s, c, o, o, o, o + 1], axis=1).reshape(-1, 3, 3)
    directions = np.einsum("nij,rj->nri", turn, rays / (columns * 0.7)).reshape(-1, 3)
    return np.repeat(rng.uniform(low, high, (poses, 3)), len(x), axis=0), directions


@pytest.fixture(scope="session")
def soup():
    return _soup


@pytest.fixture(scope="session")
def sphere():
    return _sphere


@pytest.fixture(scope="session")
def box():
    return _box


@pytest.fixture(scope="session")
def subdivided():
    return _subdivided


@pytest.fixture(scope="session")
def anyhow():
    return _anyhow


@pytest.fixture(scope="session")
def tiles():
    return _tiles


@pytest.fixture(scope="session")
def house(shared):
    model = read_glb(shared / "data/house/map/house.glb")
    return model.vertices, model.triangles


@pytest.fixture(params=["embree", "bvh"])
def caster(request):
    if request.param == "embree" and (reason := embree.obstacle()):
        pytest.skip(reason)
    return lambda *mesh: RayCaster(*mesh, backend=request.param)


def _differing(a, b, tolerance=1e-5):
    tie = (a.triangle >= 0) & (b.triangle >= 0)
    far = np.maximum(a.distance, 1.0)[tie]
    tie[tie] = np.abs(a.distance[tie] - b.distance[tie]) <= tolerance * far
    return float(np.mean((a.triangle != b.triangle) & ~tie))


@pytest.fixture(scope="session")
def differing():
    return _differing
