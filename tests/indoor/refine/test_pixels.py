"""Sights: points of the map in a frame's pixels."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.geometry import Camera, rotation_from_vector
from placegraph.indoor.refine.pixels import Sights

BENT = Camera(320, 240, 250.0, 240.0, 158.0, 121.0, (-0.1, 0.02, 0.001, -0.001))


def scattered(seed, count=20):
    """A pose, and points ahead of it with their pixels in a lens that bends."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_vector(rng.normal(size=3)), rng.normal(size=3)
    inside = rng.uniform([-0.4, -0.3, 1], [0.4, 0.3, 5], (count, 3)) * [1, 1, 1]
    return pose, inside @ pose[:3, :3].T + pose[:3, 3], BENT.project(inside)


@given(st.integers(0, 999))
def test_true_pixels_have_no_error_whatever_the_lens(seed):
    pose, points, pixels = scattered(seed)
    sights = Sights.of(points, pixels, BENT, 1.5)
    assert len(sights) == 20
    np.testing.assert_allclose(sights.errors(pose), 0.0, atol=1e-4)
    assert sights.focal == 245.0
    # tolerances are meant for images 640 wide; this one has half as many pixels
    assert (sights.sigma == 0.75).all()
    assert sights.unit == 0.5


def test_errors_are_in_pixels():
    sights = Sights.of(np.array([[0, 0, 2.0]]), np.array([[163.0, 121.0]]), BENT, 1.0)
    assert sights.errors(np.eye(4))[0] == pytest.approx(5.0, rel=0.03)


def test_behind_the_camera_the_error_is_infinite():
    sights = Sights.of(np.array([[0, 0, -2.0], [0, 0, 0.0]]), np.full((2, 2), 100.0), BENT, 1.0)
    assert np.isinf(sights.errors(np.eye(4))).all()


def test_some_of_them_and_none():
    _, points, pixels = scattered(3)
    sights = Sights.of(points, pixels, BENT, 1.0)
    some = sights[np.arange(20) % 2 == 0]
    np.testing.assert_array_equal(some.points, points[::2])
    np.testing.assert_array_equal(some.pixels, pixels[::2])
    assert len(Sights.none()) == 0
    assert len(Sights.of(np.zeros((0, 3)), np.zeros((0, 2)), BENT, 1.0)) == 0
    assert Sights.none().errors(np.eye(4)).shape == (0,)
