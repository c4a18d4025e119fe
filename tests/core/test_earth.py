"""Anchors: a map's points on Earth and back, poses as GeoPose has them, what is not known added up."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geo import (
    CAMERA_FROM_BODY,
    Anchor,
    ecef_from_enu,
    ecef_from_geodetic,
    geodetic_from_ecef,
    ranked,
)
from placegraph.core.geometry import (
    WGS84_A,
    LocalPlane,
    level_from_camera,
    pose_matrix,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from placegraph.errors import OptionError

anchors = st.builds(
    Anchor, st.floats(-180, 180), st.floats(-90, 90), st.floats(-500, 9000), st.floats(-7, 7)
)
points = st.tuples(*[st.floats(-1000, 1000)] * 3)
UPRIGHT = level_from_camera((0.0, 1.0, 0.0))


def camera(x, y, z, yaw):
    """An upright camera."""
    return pose_matrix([x, y, z, yaw], UPRIGHT)


@given(anchors, points)
def test_points_to_earth_and_back_to_a_micrometre(anchor, point):
    assert np.allclose(anchor.to_map(anchor.to_earth(point)), point, rtol=0, atol=1e-6)


@given(anchors, points, points)
def test_shifted_maps_stay_where_they_are(anchor, shift, point):
    moved = anchor.shifted(shift)
    here, there = anchor.to_earth(point), moved.to_earth(np.add(point, shift))
    off = ecef_from_geodetic(there) - ecef_from_geodetic(here)
    # an anchor stands upright where its origin is: 1 km away that is a lean of 0.16 mrad
    lean = np.linalg.norm(shift) / 6.3e6
    near_pole = abs(anchor.latitude) > 89.9
    assert near_pole or np.linalg.norm(off) < 1e-6 + 3 * lean * np.linalg.norm(np.add(point, shift))


def test_headings_are_a_compass():
    anchor = Anchor(7.42, 43.73, 50.0, math.radians(90))  # the map's y axis points east
    assert np.allclose(anchor.enu_from_map[:3, :3] @ (0, 1, 0), (1, 0, 0))
    assert np.allclose(anchor.enu_from_map[:3, :3] @ (1, 0, 0), (0, -1, 0))
    lon, lat, height = anchor.to_earth((0.0, 10.0, 2.0))
    assert (lon > 7.42, abs(lat - 43.73) < 1e-9) == (True, True)
    assert height == pytest.approx(52.0, abs=1e-4)


def test_the_standards_identity_is_upright_and_looks_north():
    # a camera that looks along the map's y axis; the map's y axis points north
    pose = Anchor(7.42, 43.73, 50.0, 0.0).pose(camera(0, 0, 0, math.pi / 2))
    assert np.allclose(pose.quaternion, (0, 0, 0, 1))
    assert pose.heading % (2 * math.pi) == pytest.approx(0, abs=1e-9)
    said = pose.geopose()
    assert said["position"] == pytest.approx({"lat": 43.73, "lon": 7.42, "h": 50.0})
    # looking east is a quarter turn clockwise: -90 degrees about up
    east = Anchor(7.42, 43.73, 50.0, 0.0).pose(camera(0, 0, 0, 0.0)).geopose()
    half = math.sqrt(0.5)
    assert east["quaternion"] == pytest.approx({"x": 0, "y": 0, "z": -half, "w": half}, abs=1e-9)


@given(anchors, points, st.floats(-3, 3), st.floats(-1.2, 1.2))
def test_a_geopose_leads_back_to_the_camera(anchor, point, yaw, pitch):
    level = level_from_camera((0.0, math.cos(pitch), math.sin(pitch)))
    matrix = pose_matrix([*point, yaw], level)
    pose = anchor.pose(matrix)
    place = pose.longitude, pose.latitude, pose.height
    body = ecef_from_enu(*place[:2]) @ rotation_from_quaternion(pose.quaternion)
    ecef = anchor.ecef_from_map @ matrix
    assert np.allclose(ecef_from_geodetic(place), ecef[:3, 3], rtol=0, atol=1e-6)
    assert np.allclose(body @ CAMERA_FROM_BODY.T, ecef[:3, :3], atol=1e-8)
    looks = rotation_from_quaternion(pose.quaternion)[:, 1]
    assert np.allclose(
        np.array([math.sin(pose.heading), math.cos(pose.heading)]) * math.hypot(*looks[:2]),
        looks[:2], atol=1e-3,  # verticals differ within a map
    )  # fmt: skip


def test_what_is_not_known_of_map_and_pose_adds_up():
    rng = np.random.default_rng(4)
    of_anchor = np.diag([0.04, 0.09, 0.25, 1e-4]) + 0.001
    of_pose = np.diag([0.01, 0.02, 0.005, 1e-5, 1e-5, 4e-4])
    anchor = Anchor(9.5, 47.1, 450.0, 1.1, of_anchor)
    matrix = camera(30.0, -12.0, 1.6, 0.4)
    pose = anchor.pose(matrix, of_pose)
    to_enu = ecef_from_enu(pose.longitude, pose.latitude).T
    start = to_enu @ (anchor.ecef_from_map @ matrix)[:3, 3]
    body = to_enu @ (anchor.ecef_from_map @ matrix)[:3, :3]
    at_anchor = ecef_from_enu(anchor.longitude, anchor.latitude)
    origin, drawn = anchor.ecef_from_map[:3, 3], []
    for _ in range(4000):
        east, north, up, turn = rng.multivariate_normal(np.zeros(4), of_anchor)
        step = rng.multivariate_normal(np.zeros(6), of_pose)
        true = matrix.copy()
        true[:3, 3] += step[:3]
        true[:3, :3] = rotation_from_vector(step[3:]) @ true[:3, :3]
        ecef = at_anchor @ Anchor(0, 0, 0, anchor.heading + turn).enu_from_map[:3, :3]
        at = to_enu @ (origin + at_anchor @ (east, north, up) + ecef @ true[:3, 3])
        turned = to_enu @ ecef @ true[:3, :3]
        drawn.append([*(at - start), *vector_from_rotation(turned @ body.T)])
    deviations = np.sqrt(np.diag(pose.covariance))
    assert np.allclose(np.std(drawn, axis=0), deviations, rtol=0.06)
    correlation = np.corrcoef(np.transpose(drawn))
    said = pose.covariance / np.outer(deviations, deviations)
    assert np.abs(correlation - said).max() < 0.06


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"longitude": 181}, "longitude is 181"),
        ({"latitude": math.nan}, "latitude is nan"),
        ({"height": math.inf}, "height is inf"),
        ({"heading": math.nan}, "heading is nan"),
        ({"probability": 0}, "probability is 0"),
        ({"covariance": np.eye(3)}, r"covariance \(3, 3\)"),
        ({"covariance": -np.eye(4)}, "variances is negative"),
        ({"residuals": (math.nan,)}, "residuals"),
    ],
)
def test_bad_numbers_are_named(changes, named):
    with pytest.raises(OptionError, match=named):
        Anchor(**{"longitude": 7.4, "latitude": 43.7, "height": 0, "heading": 0} | changes)


def test_candidates_are_ranked_and_add_up_to_one():
    likely, other = Anchor(1, 2, 3, 0.1, probability=0.6), Anchor(1, 2, 3, 3.2, probability=0.4)
    assert ranked([other, likely], ["flat"]) == (likely, other)
    with pytest.raises(OptionError, match=r"add up to 1\.20"):
        ranked([likely, likely], ["flat"])
    with pytest.raises(OptionError, match="'attic' is no scene"):
        ranked([Anchor(1, 2, 3, 0, scene="attic")], ["flat"])


def test_an_anchor_as_json_and_back():
    anchor = Anchor(1, 2, 3, 0.1, np.eye(4), "Library", "way/7", "1", 0.5, "pairs", (0.1, 0.2))
    back = Anchor.from_dict(json.loads(json.dumps(anchor.to_dict())) | {"later": "unknown"})
    assert back.to_dict() == anchor.to_dict()
    with pytest.raises(OptionError, match="level is no text"):
        Anchor.from_dict(anchor.to_dict() | {"level": 3})


places = st.tuples(st.floats(-180, 180), st.floats(-90, 90), st.floats(-1e5, 1e5))


@given(places)
def test_there_and_back_to_a_micrometre(place):
    ecef = ecef_from_geodetic(place)
    back = geodetic_from_ecef(ecef)
    assert np.abs(ecef_from_geodetic(back) - ecef).max() < 1e-6
    assert abs(back[1] - place[1]) < 1e-10
    assert abs(back[2] - place[2]) < 1e-6


@pytest.mark.parametrize(
    ("place", "ecef"),
    [
        ((0, 0, 0), (WGS84_A, 0, 0)),
        ((180, 0, 10), (-WGS84_A - 10, 0, 0)),
        ((77, 90, 5), (0, 0, 6_356_757.314245)),
        # as PROJ has it (EPSG:4979 to 4978)
        ((8.5, 47.3, 400.0), (4_285_907.494674, 640_533.166769, 4_664_740.889652)),
    ],
)
def test_places_that_are_known(place, ecef):
    assert np.allclose(ecef_from_geodetic(place), ecef, rtol=0, atol=1e-3)


@given(places)
def test_axes_are_a_frame_and_up_is_up(place):
    axes = ecef_from_enu(*place[:2])
    assert np.allclose(axes @ axes.T, np.eye(3))
    assert np.linalg.det(axes) > 0
    higher = ecef_from_geodetic((*place[:2], place[2] + 1.0)) - ecef_from_geodetic(place)
    assert np.allclose(higher, axes[:, 2], atol=1e-8)


@given(st.floats(-180, 180), st.floats(-80, 80), st.floats(-500, 500), st.floats(-500, 500))
def test_the_plane_of_a_city_touches_here(lon, lat, east, north):
    ecef = ecef_from_geodetic((lon, lat, 0.0)) + ecef_from_enu(lon, lat) @ (east, north, 0.0)
    on_plane = LocalPlane(lon, lat).to_plane(geodetic_from_ecef(ecef)[:2])
    assert np.allclose(on_plane, (east, north), atol=0.25)
