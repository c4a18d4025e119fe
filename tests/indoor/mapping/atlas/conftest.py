"""Surfaces to bake, and what must hold of every one that was baked."""

import numpy as np
import pytest

from placegraph.indoor.map.mesh import Mesh


def _grid(columns, rows, step=0.1):
    """Level sheet of 2 * columns * rows triangles that look up, with shared vertices."""
    x, y = np.meshgrid(np.arange(columns + 1), np.arange(rows + 1), indexing="ij")
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) * step
    a = (np.arange(columns)[:, None] * (rows + 1) + np.arange(rows)).ravel()
    b, c, d = a + rows + 1, a + rows + 2, a + 1
    return points, np.stack([a, b, c, a, c, d], axis=1).reshape(-1, 3)


def _sphere(levels, radius=1.0):
    """Sphere of 8 * 4**levels triangles with shared vertices."""
    points = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    rows = np.array(
        [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]]
    )
    for _ in range(levels):
        pairs = np.sort(rows[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, row = np.unique(pairs, axis=0, return_inverse=True)
        ab, bc, ca = (row.reshape(-1, 3) + len(points)).T
        a, b, c = rows.T
        rows = np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)
        points = np.concatenate([points, points[edges].mean(axis=1)])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return radius * points, rows


def _soup(count, rng, size=0.2):
    """Triangles of about `size` [m] anywhere, some of them twice, thin, or without area."""
    corners = rng.uniform(-2, 2, (count, 1, 3)) + rng.normal(0, size, (count, 3, 3))
    corners[:-1:10] = corners[1::10]
    corners[7::20, 2] = corners[7::20, 1]
    corners[8::20, 2] = 0.5 * (corners[8::20, 1] + corners[8::20, 0])
    corners[9::20, 2] = corners[9::20, 1] + 1e-5
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def _inside(uv, size):
    """Texels' centres (N, 2) strictly inside a triangle (3, 2) on a page of this size."""
    corners = uv * size
    low = np.floor(corners.min(axis=0)).astype(int)
    high = np.ceil(corners.max(axis=0)).astype(int)
    x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    texels = np.stack([x.ravel(), y.ravel()], axis=1)
    (ax, ay), b, c = corners[0], corners[1] - corners[0], corners[2] - corners[0]
    area = b[0] * c[1] - b[1] * c[0]
    if abs(area) < 1e-9:
        return texels[:0]
    px, py = texels[:, 0] + 0.5 - ax, texels[:, 1] + 0.5 - ay
    u, v = (px * c[1] - py * c[0]) / area, (b[0] * py - b[1] * px) / area
    return texels[(u > 1e-2) & (v > 1e-2) & (u + v < 1 - 1e-2)]


def _sound(before, after):
    """Same triangles, coordinates inside the pages, nothing mirrored, nothing twice."""
    assert len(after) == len(before)
    assert (after.object_of == before.object_of).all()
    assert (after.vertices[after.triangles] == before.vertices[before.triangles]).all()
    assert (after.colours == 255).all()
    sizes = np.array([t.shape[1::-1] for t in after.textures])
    uv = after.uv[after.triangles] * sizes[after.texture_of][:, None]  # texels
    room = sizes[after.texture_of][:, None] - uv
    assert uv.min() >= 0.99
    assert room.min() >= 0.99  # a bilinear look never leaves the page
    b, c = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    area[np.abs(area) < 1e-4 * np.abs(uv).max()] = 0  # what float32 leaves of slivers
    assert not (area > 0).any()  # v is down: seen from outside, triangles turn the other way
    taken = [np.zeros(t.shape[:2], bool) for t in after.textures]
    for row in np.flatnonzero(area):
        page = after.texture_of[row]
        x, y = _inside(after.uv[after.triangles[row]], sizes[page]).T
        assert not taken[page][y, x].any()
        taken[page][y, x] = True
    return area


def _field(points):
    """Colours of a world: waves of half a metre, and squares of a quarter."""
    waves = 128 + 70 * np.sin(points * (12.0, 9.0, 7.0) + (0, 1, 2))
    squares = np.floor(points * 4 + 0.013).astype(int).sum(axis=1) % 2 * 40
    return np.clip(waves + squares[:, None], 0, 255).astype(np.uint8)


@pytest.fixture(scope="session")
def grid():
    """`grid(columns, rows, step)`: points and triangles of a level sheet."""
    return _grid


@pytest.fixture(scope="session")
def sphere():
    """`sphere(levels, radius)`: points and triangles."""
    return _sphere


@pytest.fixture(scope="session")
def soup():
    """`soup(count, rng)`: points and triangles, also bad ones."""
    return _soup


@pytest.fixture(scope="session")
def sound():
    """`sound(before, after)` asserts what holds of every atlas; signed areas (T,) in texels."""
    return _sound


@pytest.fixture(scope="session")
def field():
    """`field(points)`: colours (N, 3) uint8 of a world."""
    return _field


@pytest.fixture(scope="session")
def spots():
    """`spots(mesh, count, rng)`: triangles, weights u, v and places of points on a mesh."""

    def spread(mesh, count, rng):
        area = np.linalg.norm(mesh.normals(), axis=1)
        rows = rng.choice(len(mesh), count, p=area / area.sum()).astype(np.int32)
        uv = rng.random((count, 2))
        uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv).astype(np.float32)
        a, b, c = np.moveaxis(mesh.vertices[mesh.triangles[rows]].astype(float), 1, 0)
        return rows, uv[:, 0], uv[:, 1], a + uv[:, :1] * (b - a) + uv[:, 1:] * (c - a)

    return spread


@pytest.fixture(scope="session")
def ball(sphere):
    """Mesh of a sphere of 512 triangles, 1 m in radius, of two objects."""
    points, rows = sphere(3)
    return Mesh.plain(points, rows, (np.arange(len(rows)) % 8 > 3).astype(int))
