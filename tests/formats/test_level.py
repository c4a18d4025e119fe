"""Up of a reconstruction: of the cameras, then of level surfaces."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import InputError
from placegraph.formats.level import estimated_up, surface_normals, upright
from placegraph.geometry import Camera, level_from_camera, rotation_from_vector, rotation_z

NONE = np.zeros((0, 3))
VECTORS = st.tuples(*[st.floats(-2, 2)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


def cameras(yaws, down=0.3, roll=0.0):
    """Rotations of cameras that look down a little, in a world with z up."""
    gravity = [np.sin(roll), np.cos(down), np.sin(down)]
    return rotation_z(np.asarray(yaws)) @ level_from_camera(gravity)


def degrees(up, tilt):
    return np.degrees(np.arccos(np.clip(up @ tilt[:, 2], -1, 1)))


@given(VECTORS)
def test_cameras_that_look_several_ways(vector):
    tilt = rotation_from_vector(vector)
    up, how = estimated_up(tilt @ cameras([0.0, 0.4, 1.2, 1.9]), NONE)
    assert degrees(up, tilt) < 1e-4
    assert "x axes" in how


def test_cameras_that_look_one_way():
    up, how = estimated_up(cameras([0.0, 0.05]), NONE)
    assert degrees(up, np.eye(3)) == pytest.approx(np.degrees(0.3), abs=0.5)
    assert "on average" in how


@given(VECTORS, st.integers(0, 99))
def test_level_surfaces_say_it_exactly(vector, seed):
    rng = np.random.default_rng(seed)
    tilt = rotation_from_vector(vector)
    floor = np.tile([0.0, 0.0, 1.0], (300, 1)) * rng.choice([-1, 1], (300, 1))
    walls = np.tile([1.0, 0.0, 0.0], (900, 1))
    noisy = np.concatenate([floor, walls]) + 0.02 * rng.standard_normal((1200, 3))
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    up, how = estimated_up(tilt @ cameras([0.0, 0.05], roll=0.05), noisy @ tilt.T)
    assert degrees(up, tilt) < 0.5
    assert "surfaces" in how


def test_no_common_up():
    with pytest.raises(InputError, match="no common up"):
        estimated_up(np.stack([np.eye(3), np.diag([1.0, -1, -1])]), NONE)


def test_normals_of_a_plane():
    camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0)
    normal = np.array([0.2, -0.9, -0.4]) / np.linalg.norm([0.2, -0.9, -0.4])
    v, u = np.mgrid[:30, :40]
    rays = camera.directions(np.stack([u + 0.5, v + 0.5], axis=-1))
    with np.errstate(divide="ignore"):
        depth = -1.5 / (rays @ normal)
    depth[(depth < 0) | (depth > 20)] = np.nan
    found = surface_normals(depth.astype("f4"), camera)
    assert len(found) > 100
    np.testing.assert_allclose(np.abs(found @ normal), 1.0, atol=1e-4)


@given(VECTORS, VECTORS)
def test_upright(up, ahead):
    up = np.array(up) / np.linalg.norm(up)
    turn = upright(up, np.array(ahead))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(turn @ up, [0, 0, 1], atol=1e-9)
    assert np.linalg.det(turn) > 0
