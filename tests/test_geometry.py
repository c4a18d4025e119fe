"""Geometry: the plane is a plane, bearings are a compass's."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from placegraph.geometry import LocalPlane, angle_between, bearing

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
    [((0, 1), 0), ((1, 1), 45), ((1, 0), 90), ((0, -1), 180), ((-1, 0), 270), ((-1, 1), 315)],
)
def test_bearings_of_the_compass(delta, degrees):
    assert math.isclose(math.degrees(bearing(delta)), degrees, abs_tol=1e-12)


@given(vectors)
def test_bearing_and_length_give_the_vector_back(vector):
    length = math.hypot(*vector)
    b = float(bearing(vector))
    assert 0 <= b < 2 * math.pi
    assert np.allclose((length * math.sin(b), length * math.cos(b)), vector, atol=1e-6)


def test_a_hair_west_of_north_is_north():
    assert bearing((-1e-300, 1.0)) == 0.0


@given(vectors)
def test_the_way_back_is_opposite(vector):
    assume(math.hypot(*vector) > 1e-3)
    there, back = bearing(vector), bearing((-vector[0], -vector[1]))
    assert math.isclose(float(angle_between(there, back)), math.pi, abs_tol=1e-9)


@given(angles, angles, angles)
def test_angle_between_is_a_metric_on_directions(a, b, c):
    ab, ba, bc, ac = (float(angle_between(*pair)) for pair in ((a, b), (b, a), (b, c), (a, c)))
    assert 0 <= ab <= math.pi
    assert math.isclose(ab, ba, abs_tol=1e-12)
    assert float(angle_between(a, a)) == 0
    assert ac <= ab + bc + 1e-9


@given(angles, angles, st.integers(-5, 5))
def test_whole_turns_change_nothing(a, b, turns):
    turned = float(angle_between(a + 2 * math.pi * turns, b))
    assert math.isclose(turned, float(angle_between(a, b)), abs_tol=1e-9)
