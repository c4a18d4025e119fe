"""Poses, rotations, covariances and cameras."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import (
    Camera,
    LocalPlane,
    angle_between,
    bearing,
    between,
    compose,
    level_from_camera,
    pose_matrix,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    rotation_z,
    split_pose,
    vector_from_rotation,
    wrap_angle,
)
from placegraph.errors import OptionError

longitudes = st.floats(-180, 180)
latitudes = st.floats(-80, 80)
planes = st.builds(LocalPlane, longitudes, latitudes)
metres = st.floats(-20_000, 20_000)
vectors = st.tuples(metres, metres)
angles = st.floats(-50, 50)


@given(planes, vectors)
def test_plane_to_lonlat_and_back(plane, point):
    back = plane.to_plane(plane.to_lonlat(point))
    assert np.allclose(back, point, rtol=0, atol=1e-6)


@given(planes, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_lonlat_to_plane_and_back(plane, d_lon, d_lat):
    lonlat = (plane.longitude + d_lon, plane.latitude + d_lat)
    back = plane.to_lonlat(plane.to_plane(lonlat))
    assert abs(back[1] - lonlat[1]) < 1e-10
    # the same meridian may be written as 180 or -180
    assert abs((back[0] - lonlat[0] + 180) % 360 - 180) < 1e-10
    assert -180 <= back[0] <= 180


@given(planes)
def test_origin_is_zero_and_axes_point_east_and_north(plane):
    assert np.allclose(plane.to_plane((plane.longitude, plane.latitude)), 0)
    east = plane.to_plane((plane.longitude + 0.01, plane.latitude))
    north = plane.to_plane((plane.longitude, plane.latitude + 0.01))
    assert east[0] > 0
    assert abs(east[1]) < 1e-9
    assert north[1] > 0
    assert abs(north[0]) < 1e-9


@given(latitudes, st.floats(0.001, 0.2))
def test_date_line_is_no_wall(latitude, degrees):
    plane = LocalPlane(180 - degrees / 2, latitude)
    there = plane.to_plane((-180 + degrees / 2, latitude))
    assert math.isclose(there[0], degrees * plane.metres_per_degree[0], rel_tol=1e-9)


def test_scalars_lists_and_stacks_of_points_keep_their_shape():
    plane = LocalPlane(9.5, 47.1)
    points = np.zeros((4, 3, 2))
    assert plane.to_plane(points).shape == plane.to_lonlat(points).shape == (4, 3, 2)
    assert plane.to_plane([[9.5, 47.1]]).shape == (1, 2)
    assert bearing(points).shape == (4, 3)
    assert np.all(points == 0), "arguments must not be written to"


@pytest.mark.parametrize(
    ("latitude", "per_longitude", "per_latitude"),
    # Published lengths of a degree on WGS84 [m].
    [(0, 111_319.5, 110_574.3), (45, 78_846.8, 111_131.7), (60, 55_800.0, 111_412.2)],
)
def test_lengths_of_a_degree(latitude, per_longitude, per_latitude):
    got = LocalPlane(0, latitude).metres_per_degree
    assert np.allclose(got, (per_longitude, per_latitude), rtol=0, atol=0.5)


@given(st.floats(-70, 70), st.sampled_from([-1, 1]))
def test_scale_over_a_city_is_as_promised(latitude, side):
    origin = LocalPlane(7.42, latitude)
    degrees = side * 15_000 / origin.metres_per_degree[1]
    there = LocalPlane(7.42, latitude + degrees)
    ratio = np.divide(there.metres_per_degree, origin.metres_per_degree)
    assert abs(ratio[0] - 1) <= 0.0024 * abs(math.tan(math.radians(latitude))) + 3e-5
    assert abs(ratio[1] - 1) < 1e-4


@pytest.mark.parametrize(
    ("delta", "degrees"),
    [
        ((0, 1), 0), ((1, 1), 45), ((1, 0), 90), ((0, -1), 180), ((-1, 0), 270), ((-1, 1), 315),
        ((-1e-300, 1.0), 0),
    ],
)  # fmt: skip
def test_bearings_of_the_compass(delta, degrees):
    assert math.isclose(math.degrees(bearing(delta)), degrees, abs_tol=1e-12)


@given(vectors)
def test_bearing_and_length_give_the_vector_back_and_the_way_back_is_opposite(vector):
    length = math.hypot(*vector)
    b = float(bearing(vector))
    assert 0 <= b < 2 * math.pi
    assert np.allclose((length * math.sin(b), length * math.cos(b)), vector, atol=1e-6)
    back = bearing(np.negative(vector))
    assert length < 1e-3 or math.isclose(float(angle_between(b, back)), math.pi, abs_tol=1e-9)


@given(angles, angles, angles, st.integers(-5, 5))
def test_angle_between_is_a_metric_on_directions(a, b, c, turns):
    ab, ba, bc, ac = (float(angle_between(*pair)) for pair in ((a, b), (b, a), (b, c), (a, c)))
    assert 0 <= ab <= math.pi
    assert math.isclose(ab, ba, abs_tol=1e-12)
    assert float(angle_between(a, a)) == 0
    assert ac <= ab + bc + 1e-9
    assert math.isclose(float(angle_between(a + 2 * math.pi * turns, b)), ab, abs_tol=1e-9)


near = st.floats(-100, 100)
turns = st.floats(-math.pi, math.pi, exclude_max=True)
poses = st.tuples(near, near, near, turns).map(np.array)
numbers = st.floats(-1, 1)
gravities = (
    st.tuples(numbers, numbers, numbers).map(np.array).filter(lambda g: np.linalg.norm(g) > 0.05)
)
quaternions = (
    st.tuples(numbers, numbers, numbers, numbers)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.05)
)


def is_rotation(matrices):
    """Orthonormal and right-handed, all of them."""
    square = matrices @ np.swapaxes(matrices, -1, -2)
    np.testing.assert_allclose(square, np.broadcast_to(np.eye(3), square.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(matrices), 1.0, atol=1e-9)


def same_pose(a, b):
    np.testing.assert_allclose(a[..., :3], b[..., :3], atol=1e-8)
    np.testing.assert_allclose(wrap_angle(a[..., 3] - b[..., 3]), 0.0, atol=1e-8)


@given(st.floats(-1000, 1000))
def test_wrapped_angles_point_the_same_way(angle):
    wrapped = float(wrap_angle(angle))
    assert -math.pi <= wrapped < math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


def test_half_a_turn_has_one_name():
    assert wrap_angle(math.pi) == wrap_angle(-math.pi) == -math.pi
    assert wrap_angle([0.0, 3 * math.pi]).tolist() == [0.0, -math.pi]


def test_a_camera_held_upright_looks_along_x():
    level = level_from_camera((0, 9.81, 0))  # of any length
    forward, right, down = level @ (0, 0, 1), level @ (1, 0, 0), level @ (0, 1, 0)
    assert (forward.tolist(), right.tolist(), down.tolist()) == ([1, 0, 0], [0, -1, 0], [0, 0, -1])


@pytest.mark.parametrize("pitch", [-90, -60, -1, 0, 1, 30, 90])
def test_pitching_keeps_the_heading(pitch):
    a = math.radians(pitch)
    level = level_from_camera((0, math.cos(a), math.sin(a)))
    forward = level @ (0, 0, 1)
    np.testing.assert_allclose(forward, (math.cos(a), 0, -math.sin(a)), atol=1e-12)
    np.testing.assert_allclose(level @ (1, 0, 0), (0, -1, 0), atol=1e-12)


@given(gravities, st.floats(0.01, 100))
def test_tilt_brings_gravity_down_by_the_smallest_turn(gravity, length):
    level = level_from_camera(gravity)
    is_rotation(level)
    unit = gravity / np.linalg.norm(gravity)
    np.testing.assert_allclose(level @ unit, (0, 0, -1), atol=1e-8)
    np.testing.assert_allclose(level_from_camera(gravity * length), level, atol=1e-9)
    # the angle of the rotation is that between gravity and the upright camera's down
    least = level_from_camera((0, 1, 0)).T @ level
    cosine = (np.trace(least) - 1) / 2
    assert math.isclose(cosine, float(unit[1]), abs_tol=1e-8)


@pytest.mark.parametrize("off", [0.0, 1e-300, 1e-14, 1e-11, 1e-8, 1e-6, 1e-3])
def test_a_camera_held_upside_down(off):
    level = level_from_camera((off, -1.0, 0.0))
    is_rotation(level)
    np.testing.assert_allclose(level @ (off, -1.0, 0.0), (0, 0, -1), atol=1e-3)
    np.testing.assert_allclose(level @ (0, 0, 1), (1, 0, 0), atol=1e-6)
    level = level_from_camera((off, -1.0, off))
    is_rotation(level)
    pose, tilt = split_pose(pose_matrix((1, 2, 3, 0.5), level))
    np.testing.assert_allclose(pose_matrix(pose, tilt)[:3, :3], rotation_z(0.5) @ level, atol=1e-7)


@given(poses, gravities)
def test_pose_and_tilt_come_out_of_the_matrix_again(pose, gravity):
    level = level_from_camera(gravity)
    matrix = pose_matrix(pose, level)
    is_rotation(matrix[:3, :3])
    assert matrix[3].tolist() == [0, 0, 0, 1]
    got, tilt = split_pose(matrix)
    same_pose(got, pose)
    np.testing.assert_allclose(tilt, level, atol=1e-7)


@given(quaternions, st.tuples(near, near, near))
def test_any_rigid_pose_is_a_pose_and_a_tilt(quaternion, at):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_quaternion(quaternion)
    matrix[:3, 3] = at
    np.testing.assert_allclose(pose_matrix(*split_pose(matrix)), matrix, atol=1e-7)


def test_stacks_of_poses_are_made_one_by_one(rng):
    pose, gravity = rng.normal(size=(5, 7, 4)), rng.normal((0, 3, 0), size=(5, 7, 3))
    level = level_from_camera(gravity)
    matrix = pose_matrix(pose, level)
    assert matrix.shape == (5, 7, 4, 4)
    one = pose_matrix(pose[3, 2], level_from_camera(gravity[3, 2]))
    np.testing.assert_allclose(matrix[3, 2], one, atol=1e-12)
    got, tilt = split_pose(matrix)
    assert got.shape == (5, 7, 4)
    assert tilt.shape == (5, 7, 3, 3)
    same_pose(got, pose)
    # one tilt for many poses
    assert pose_matrix(pose, np.eye(3)).shape == (5, 7, 4, 4)


@given(poses, poses)
def test_the_step_between_leads_there(a, b):
    step = between(a, b)
    same_pose(compose(a, step), b)
    assert -math.pi <= step[3] < math.pi
    assert math.isclose(
        float(np.linalg.norm(step[:3])), float(np.linalg.norm((b - a)[:3])), abs_tol=1e-8
    )


@given(poses, poses)
def test_composing_multiplies_matrices(a, b):
    together = pose_matrix(a, np.eye(3)) @ pose_matrix(b, np.eye(3))
    np.testing.assert_allclose(pose_matrix(compose(a, b), np.eye(3)), together, atol=1e-9)


@given(turns, turns)
def test_yaws_add_up(a, b):
    np.testing.assert_allclose(rotation_z(a) @ rotation_z(b), rotation_z(a + b), atol=1e-12)
    np.testing.assert_allclose(rotation_z(math.pi / 2) @ (1, 0, 0), (0, 1, 0), atol=1e-15)


@given(quaternions)
def test_quaternions_and_rotations(quaternion):
    rotation = rotation_from_quaternion(quaternion)
    is_rotation(rotation)
    back = quaternion_from_rotation(rotation)
    assert back[3] >= 0
    assert math.isclose(float(np.linalg.norm(back)), 1.0, abs_tol=1e-12)
    unit = quaternion / np.linalg.norm(quaternion)
    assert min(np.abs(back - unit).max(), np.abs(back + unit).max()) < 1e-7
    np.testing.assert_allclose(rotation_from_quaternion(-quaternion), rotation, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("angle", [0.0, 1e-9, math.pi / 2, math.pi - 1e-9, math.pi])
def test_quaternions_of_half_turns(axis, angle):
    quaternion = np.zeros(4)
    quaternion[axis], quaternion[3] = math.sin(angle / 2), math.cos(angle / 2)
    back = quaternion_from_rotation(rotation_from_quaternion(quaternion))
    assert min(np.abs(back - quaternion).max(), np.abs(back + quaternion).max()) < 1e-12


@given(st.tuples(*[st.floats(-1.7, 1.7)] * 3))
def test_rotation_vectors_and_rotations(vector):
    rotation = rotation_from_vector(vector)
    is_rotation(rotation)
    assert np.allclose(rotation @ vector, vector, atol=1e-9)  # the axis stays
    assert np.allclose(vector_from_rotation(rotation), vector, atol=1e-7)
    assert np.allclose(rotation_from_vector(np.negative(vector)), rotation.T)


def test_a_turn_about_z_is_a_yaw():
    assert np.allclose(rotation_from_vector((0.0, 0.0, 0.3)), rotation_z(0.3))
    assert np.allclose(vector_from_rotation(rotation_z(-1e-9)), (0.0, 0.0, -1e-9), atol=1e-15)
    half = math.sqrt(0.5)
    assert np.allclose(rotation_from_quaternion((0, 0, half, half)), rotation_z(math.pi / 2))


PLAIN = Camera(640, 360, 460.0, 455.0, 318.0, 181.5)
WIDE = Camera(640, 480, 300.0, 305.0, 322.0, 236.0, (-0.25, 0.07, 0.001, -0.0008))
RATIONAL = Camera(
    640, 480, 520.0, 520.0, 320.0, 240.0, (0.3, -0.2, 0.0006, 0.0011, 0.05, 0.35, -0.15, 0.03)
)
cameras = st.sampled_from([PLAIN, WIDE, RATIONAL])


def test_the_principal_point_is_straight_ahead_and_what_lies_behind_has_no_pixel():
    ray = PLAIN.directions((318.0, 181.5))
    assert ray.tolist() == [0, 0, 1]
    # one focal length to the right of it is 45 degrees to the right, and below is down
    np.testing.assert_allclose(PLAIN.directions((318 + 460, 181.5 + 455)), (1, 1, 1))
    uv = PLAIN.project([[0, 0, 1], [0, 0, 0], [0.1, 0, -1]])
    assert np.isnan(uv).tolist() == [[False, False], [True, True], [True, True]]


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


def test_distortion_is_opencvs():  # as in calib3d
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
    # the radius shrinks from 61 degrees
    folded = replace(FISHEYE, distortion=(-0.3, 0.0, 0.0, 0.0))
    assert np.isnan(folded.project((math.tan(math.radians(62)), 0.0, 1.0))).all()
    edge = folded.project((math.tan(math.radians(60)), 0.0, 1.0))
    assert math.isclose(folded.directions(edge)[0], math.tan(math.radians(60)), rel_tol=1e-3)


@given(cameras, st.integers(20, 2000), st.integers(20, 2000), st.floats(0, 1), st.floats(0, 1))
def test_a_resized_image_shows_the_same(camera, width, height, across, down):
    small = camera.resize(width, height)
    a = camera.directions((across * camera.width, down * camera.height))
    b = small.directions((across * width, down * height))
    np.testing.assert_allclose(a, b, atol=1e-9)
    back = small.resize(camera.width, camera.height)
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
        ({"fy": 1e98}, "less than 1e9"),
        ({"cx": -(10**400)}, "must be finite numbers"),
        ({"cx": math.inf}, "must be finite numbers"),
        ({"distortion": (0.1, math.nan, 0, 0)}, "must be finite numbers"),
        ({"distortion": (0.1, 0.2)}, "4, 5 or 8"),
        ({"distortion": (0.1,) * 5, "model": "fisheye"}, "fisheye model 4"),
        ({"model": "fov"}, "model is 'fov'; choose one of opencv, fisheye"),
    ],
)
def test_cameras_that_are_none(change, says):
    numbers = {"width": 640, "height": 360, "fx": 460.0, "fy": 455.0, "cx": 318.0, "cy": 181.5}
    with pytest.raises(OptionError, match=says):
        Camera(**numbers | change)
