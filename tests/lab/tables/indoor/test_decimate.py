import numpy as np

from placegraph.indoor.map.mesh import Mesh
from placegraph_lab.tables.indoor.maps import coarse


def sheet(n, size=2.0, height=lambda x, y: 0.0 * x * y):
    """Square of n x n quads over [0, size]^2."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(0, size, n + 1)] * 2, indexing="ij"))
    points = np.stack([x, y, height(x, y)], axis=1)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    b, c, d = a + n + 1, a + n + 2, a + 1
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def test_coarse_meshes_are_painted_as_the_surface_is(rng):
    points, triangles = sheet(16)
    texture = np.zeros((1, 2, 3), np.uint8)
    texture[0, 0], texture[0, 1] = (200, 40, 0), (0, 40, 200)
    row = np.zeros(len(triangles), np.int32)
    uv = (points[:, :2] / 2.0 * 0.999).astype(np.float32)
    colours = np.full((len(points), 3), 255, np.uint8)
    textured = Mesh(
        points.astype(np.float32), triangles.astype(np.int32), row, colours, uv, row, (texture,)
    )
    mesh = coarse(textured, 60, rng)
    assert len(mesh) <= 60
    left = mesh.vertices[:, 0] < 0.5
    right = mesh.vertices[:, 0] > 1.5
    assert np.abs(mesh.colours[left].astype(int) - (200, 40, 0)).max() <= 1
    assert np.abs(mesh.colours[right].astype(int) - (0, 40, 200)).max() <= 1
