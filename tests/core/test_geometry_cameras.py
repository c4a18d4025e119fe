"""Cameras are invertible, and bend rays as OpenCV does."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError

PLAIN = Camera(640, 360, 460.0, 455.0, 318.0, 181.5)
WIDE = Camera(640, 480, 300.0, 305.0, 322.0, 236.0, (-0.25, 0.07, 0.001, -0.0008))
RATIONAL = Camera(
    640, 480, 520.0, 520.0, 320.0, 240.0, (0.3, -0.2, 0.0006, 0.0011, 0.05, 0.35, -0.15, 0.03)
)
cameras = st.sampled_from([PLAIN, WIDE, RATIONAL])


def test_the_principal_point_is_straight_ahead():
    ray = PLAIN.directions((318.0, 181.5))
    assert ray.tolist() == [0, 0, 1]
    # one focal length to the right of it is 45 degrees to the right, and below is down
    np.testing.assert_allclose(PLAIN.directions((318 + 460, 181.5 + 455)), (1, 1, 1))


@given(cameras, st.floats(0, 1), st.floats(0, 1), st.floats(0.1, 50))
def test_pixels_to_rays_and_back(camera, across, down, depth):
    uv = np.array([across * camera.width, down * camera.height])
    ray = camera.directions(uv)
    assert ray[2] == 1.0
    np.testing.assert_allclose(camera.project(ray * depth), uv, atol=1e-4)


@given(cameras, st.floats(-0.4, 0.4), st.floats(-0.3, 0.3), st.floats(0.1, 50))
def test_points_to_pixels_and_back(camera, x, y, depth):
    point = np.array([x, y, 1.0]) * depth
    ray = camera.directions(camera.project(point))
    np.testing.assert_allclose(ray * depth, point, atol=1e-4 * depth)


def test_distortion_is_opencvs():
    """The formula of OpenCV's calib3d, written out for one point."""
    x, y = 0.3, -0.2
    k1, k2, p1, p2 = WIDE.distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    expected = (300 * xd + 322, 305 * yd + 236)
    np.testing.assert_allclose(WIDE.project((0.6, -0.4, 2.0)), expected, atol=1e-10)
    k1, k2, p1, p2, k3, k4, k5, k6 = RATIONAL.distortion
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    radial /= 1 + k4 * r2 + k5 * r2**2 + k6 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    assert math.isclose(RATIONAL.project((x, y, 1.0))[0], 520 * xd + 320, abs_tol=1e-10)


FISHEYE = Camera(640, 480, 200.0, 205.0, 322.0, 236.0, (0.02, -0.005, 0.001, 0.0), "fisheye")


def test_a_fisheye_is_opencvs():
    """The formula of OpenCV's fisheye module, written out for one point."""
    x, y = 1.2, -0.7
    r = math.hypot(x, y)
    theta = math.atan(r)
    k1, k2, k3, k4 = FISHEYE.distortion
    bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
    expected = (200 * bent / r * x + 322, 205 * bent / r * y + 236)
    np.testing.assert_allclose(FISHEYE.project((2 * x, 2 * y, 2.0)), expected, atol=1e-10)


@given(st.floats(0, math.radians(84.9)), st.floats(-4, 4))
def test_a_fisheye_sees_far_off_its_axis(angle, around):
    ray = np.array([*math.tan(angle) * np.array([math.cos(around), math.sin(around)]), 1.0])
    np.testing.assert_allclose(FISHEYE.directions(FISHEYE.project(ray)), ray, rtol=1e-6, atol=1e-9)


def test_a_fisheye_has_a_rim():
    assert np.isnan(FISHEYE.directions((4.0, 4.0))[:2]).all()
    assert np.isnan(FISHEYE.project((20.0, 0.0, 1.0))).all()
    folded = replace(
        FISHEYE, distortion=(-0.3, 0.0, 0.0, 0.0)
    )  # the radius shrinks from 61 degrees
    assert np.isnan(folded.project((math.tan(math.radians(62)), 0.0, 1.0))).all()
    edge = folded.project((math.tan(math.radians(60)), 0.0, 1.0))
    assert math.isclose(folded.directions(edge)[0], math.tan(math.radians(60)), rel_tol=1e-3)


def test_what_lies_behind_has_no_pixel():
    uv = PLAIN.project([[0, 0, 1], [0, 0, 0], [0.1, 0, -1]])
    assert np.isnan(uv).tolist() == [[False, False], [True, True], [True, True]]


@given(cameras, st.integers(20, 2000), st.integers(20, 2000), st.floats(0, 1), st.floats(0, 1))
def test_a_resized_image_shows_the_same(camera, width, height, across, down):
    small = camera.resized(width, height)
    a = camera.directions((across * camera.width, down * camera.height))
    b = small.directions((across * width, down * height))
    np.testing.assert_allclose(a, b, atol=1e-9)
    back = small.resized(camera.width, camera.height)
    np.testing.assert_allclose((back.fx, back.cy), (camera.fx, camera.cy))


def test_a_camera_as_plain_numbers():
    assert PLAIN.to_dict() == {
        "width": 640, "height": 360, "fx": 460.0, "fy": 455.0, "cx": 318.0, "cy": 181.5,
    }  # fmt: skip
    assert Camera(**WIDE.to_dict() | {"distortion": WIDE.distortion}) == WIDE
    assert Camera(**FISHEYE.to_dict() | {"distortion": FISHEYE.distortion}) == FISHEYE


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"width": 0}, "greater than 0"),
        ({"fy": -1.0}, "greater than 0"),
        ({"fx": math.nan}, "greater than 0"),
        ({"fx": math.inf}, "greater than 0"),
        ({"width": 10**400}, "greater than 0"),
        ({"fy": 1e98}, "below 1e9"),
        ({"cx": -(10**400)}, "not a number"),
        ({"cx": math.inf}, "not a number"),
        ({"distortion": (0.1, math.nan, 0, 0)}, "not a number"),
        ({"distortion": (0.1, 0.2)}, "4, 5 or 8"),
        ({"distortion": (0.1,) * 5, "model": "fisheye"}, "fisheye 4"),
        ({"model": "fov"}, "model is 'fov'; it is one of opencv, fisheye"),
    ],
)
def test_cameras_that_are_none(change, says):
    numbers = {"width": 640, "height": 360, "fx": 460.0, "fy": 455.0, "cx": 318.0, "cy": 181.5}
    with pytest.raises(OptionError, match=says):
        Camera(**numbers | change)
