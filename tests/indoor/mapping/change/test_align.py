import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.change.align import (
    invert_rigid,
    register,
    sample_surface,
    transform_points,
    turn_about,
)

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 0.4, 0], [0, 0.7, 0], [0.2, 0.1, 0.9]], float)
FACES = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
SHIFT = st.tuples(*[st.floats(-0.08, 0.08)] * 3)


@pytest.fixture(scope="module")
def tent():
    return sample_surface(Mesh.plain(CORNERS, FACES), np.arange(6), 3000, np.random.default_rng(0))


@settings(max_examples=15)
@given(st.floats(-0.12, 0.12), SHIFT)
def test_an_upright_motion_is_found_again(tent, yaw, shift):
    truth = turn_about(tent.points.mean(axis=0), yaw, tent.points.mean(axis=0) + shift)
    source = transform_points(invert_rigid(truth), tent.points[::10])
    found = register(source, tent, np.eye(4), reach=0.4)
    off = invert_rigid(truth) @ found
    assert np.linalg.norm(transform_points(off, tent.points) - tent.points, axis=1).max() < 0.02


def test_a_plane_is_not_slid_along_itself():
    wall = Mesh.plain([[0, 0, 0], [4, 0, 0], [4, 0, 3], [0, 0, 3]], [[0, 1, 2], [0, 2, 3]])
    points = sample_surface(wall, np.arange(2), 2000, np.random.default_rng(0))
    source = points.points[points.points[:, 0] < 2.0] + (0.5, 0.05, 0.0)
    found = register(source, points, np.eye(4), reach=0.3)
    assert abs(found[0, 3]) < 0.01
    assert found[1, 3] == pytest.approx(-0.05, abs=5e-3)
