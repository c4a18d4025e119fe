import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.indoor.map.mesh import Mesh
from placegraph_lab.tables.scene.surface import REACH, distances


def sheet(height=0.0, side=2.0):
    """A level square around the z axis."""
    x = side / 2
    corners = [[-x, -x, height], [x, -x, height], [x, x, height], [-x, x, height]]
    return Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])


@pytest.mark.parametrize(
    ("point", "distance"),
    [
        ((0.2, -0.3, 0.0), 0.0), ((0.2, -0.3, 0.25), 0.25), ((0.2, -0.3, -0.25), 0.25),
        ((1.3, 0.4, 0.4), 0.5), ((1.3, 1.4, 0.0), 0.5), ((0.0, 0.0, 0.999), 0.999),
        ((0.0, 0.0, 5.0), REACH), ((1e6, 0.0, 0.0), REACH),
    ],
)  # fmt: skip
def test_points_beside_a_square(point, distance):
    assert distances(np.array([point]), sheet()) == pytest.approx([distance], abs=1e-6)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1))
def test_no_point_of_the_triangles_is_nearer(seed):
    rng = np.random.default_rng(seed)
    soup = Mesh.plain(rng.uniform(-1, 1, (15, 3)), rng.permutation(15).reshape(5, 3))
    points = rng.uniform(-1.5, 1.5, (20, 3))
    shares = rng.dirichlet((1, 1, 1), 4000)
    dense = np.einsum("nk,tkd->tnd", shares, soup.vertices[soup.triangles]).reshape(-1, 3)
    apart = np.linalg.norm(points[:, None] - dense, axis=2).min(axis=1)
    found = distances(points, soup)
    assert (found <= apart + 1e-6).all()
    assert (apart - found)[apart < REACH].max(initial=0.0) < 0.15  # samples lie that dense
