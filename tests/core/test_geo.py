"""The Earth: anchors, GeoJSON, tiles."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.estimate import (
    CityEstimate,
    Evidence,
    ObjectRef,
    Place,
    PoseEstimate,
    PoseMode,
    SceneEstimate,
    SceneMode,
    Status,
)  # fmt: skip
from placegraph.core.geo import (
    CAMERA_FROM_BODY,
    Anchor,
    are_in_tile,
    check_zoom,
    ecef_from_enu,
    ecef_from_geodetic,
    geodetic_from_ecef,
    key_at,
    parse_tile_key,
    sort_anchors,
    tile_bounds,
    tile_key,
    tile_ranges,
    tiles_at,
)
from placegraph.core.geojson import ELLIPSE_PROBABILITY
from placegraph.core.geometry import (
    WGS84_A,
    LocalPlane,
    level_from_camera,
    pose_matrix,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from placegraph.errors import GeoPoseError, OptionError

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
    moved = anchor.shift_origin(shift)
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
    shifts = rng.multivariate_normal(np.zeros(4), of_anchor, 4000)
    steps = rng.multivariate_normal(np.zeros(6), of_pose, 4000)
    for (east, north, up, turn), step in zip(shifts, steps, strict=True):
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
        ({"covariance": np.eye(3)}, r"covariance is \(3, 3\)"),
        ({"covariance": -np.eye(4)}, "invalid, because an eigenvalue is negative; give"),
        ({"residuals": (math.nan,)}, "residuals"),
    ],
)
def test_bad_numbers_are_named(changes, named):
    with pytest.raises(OptionError, match=named):
        Anchor(**{"longitude": 7.4, "latitude": 43.7, "height": 0, "heading": 0} | changes)


def test_candidates_are_ranked_and_add_up_to_one():
    likely, other = Anchor(1, 2, 3, 0.1, probability=0.6), Anchor(1, 2, 3, 3.2, probability=0.4)
    assert sort_anchors([other, likely], ["flat"]) == (likely, other)
    with pytest.raises(OptionError, match=r"add up to 1\.20"):
        sort_anchors([likely, likely], ["flat"])
    with pytest.raises(OptionError, match="'attic' is not a scene"):
        sort_anchors([Anchor(1, 2, 3, 0, scene="attic")], ["flat"])


def test_an_anchor_as_json_and_back():
    anchor = Anchor(1, 2, 3, 0.1, np.eye(4), "Library", "way/7", "1", 0.5, "pairs", (0.1, 0.2))
    back = Anchor.from_dict(json.loads(json.dumps(anchor.to_dict())) | {"later": "unknown"})
    assert back.to_dict() == anchor.to_dict()
    with pytest.raises(OptionError, match="level is not text"):
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


CAFE = Evidence(
    "A café is near", "for", 2.0, (ObjectRef("node/1", "amenity=cafe", "Adler", 9.5, 47.1),)
)
MUTE = Evidence("depth", "for", 0.9, note="90% lie on surfaces")
HERE = Anchor(9.5, 47.1, 450.0, 0.3, np.eye(4) * 1e-4, "Library", "way/7", "1", 0.75)


def posed(*anchors):
    matrix = pose_matrix([3.0, 4.0, 1.6, math.pi / 2], level_from_camera((0, 1, 0)))
    earth = tuple(a.pose(matrix, np.eye(6) * 1e-4, probability=0.8, room="study") for a in anchors)
    mode = PoseMode(
        matrix,
        np.zeros(4),
        np.eye(6) * 1e-4,
        0.8,
        "flat",
        matrix,
        earth,
        explain=lambda: (CAFE, MUTE),
    )
    return PoseEstimate(Status.OK, (mode,), "One place fits.")


def city_estimate(longitude=9.5):
    place = Place(longitude, 47.1, 0.9, "cell-7", np.diag([400.0, 100.0]), explain=lambda: (CAFE,))
    return CityEstimate(Status.OK, (place,), "One place fits.")


def strict(plain):
    return json.loads(json.dumps(plain, allow_nan=False))


def test_a_pose_from_images_is_a_geopose():
    said = strict(posed(HERE).geopose())
    assert set(said["position"]) == {"lat", "lon", "h"}
    assert math.hypot(*said["quaternion"].values()) == pytest.approx(1.0)
    assert said["unknown"] == []
    assert said["probability"] == pytest.approx(0.6)
    assert said["accuracy"]["position"] == pytest.approx(math.sqrt(1e-4 * (2 + 25 / 3)), rel=0.1)
    assert (said["status"], said["reason"]) == ("OK", "One place fits.")


def test_a_sentence_pretends_neither_height_nor_orientation():
    said = strict(city_estimate().geopose())
    assert said["position"] == {"lat": 47.1, "lon": 9.5, "h": 0.0}
    assert said["quaternion"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    assert said["unknown"] == ["height", "orientation"]
    assert said["accuracy"] == {"position": pytest.approx(math.sqrt(250.0)), "orientation": None}


@pytest.mark.parametrize(("share", "reaches"), [(0.5, True), (0.96, False)])
def test_the_accuracy_reaches_all_modes_that_matter(share, reaches):
    best = city_estimate().modes[0]
    twin = replace(best, latitude=47.101, probability=1.0 - share)
    both = CityEstimate(Status.AMBIGUOUS, (replace(best, probability=share), twin), "Two fit.")
    metres = both.geopose()["accuracy"]["position"]
    own = best.covariance.trace() / 2.0
    assert metres == pytest.approx(math.sqrt(own) + (111.2 if reaches else 0.0), abs=0.1)


@pytest.mark.parametrize(
    ("estimate", "named"),
    [
        (posed(), r"'flat' is not georeferenced.*`placegraph scene anchor`"),
        (
            SceneEstimate(Status.OK, (SceneMode("flat", 0.9, 3.0),), "It fits."),
            "'flat' is not georeferenced",
        ),
        (PoseEstimate(Status.LOST, (), "It is dark."), "There is no pose. It is dark"),
    ],
)
def test_no_pose_on_earth_is_said_with_its_mend(estimate, named):
    with pytest.raises(GeoPoseError, match=named):
        estimate.geopose()
    if estimate.modes:
        with pytest.raises(GeoPoseError, match=named):
            estimate.geojson()
    else:
        assert estimate.geojson()["features"] == []


def test_modes_ellipses_and_evidence_are_features():
    other = replace(HERE, heading=HERE.heading + math.pi, probability=0.25)
    said = strict(posed(HERE, other).geojson())
    kinds = [f["properties"]["kind"] for f in said["features"]]
    assert kinds == ["mode", "ellipse"] * 2 + ["evidence"] * 2
    first = said["features"][0]["properties"]
    assert (first["mode"], first["candidate"], first["probability"]) == (1, 1, pytest.approx(0.6))
    assert (first["room"], first["building"], first["osm"], first["level"]) == (
        "study", "Library", "way/7", "1",
    )  # fmt: skip
    assert len(said["features"][0]["geometry"]["coordinates"]) == 3
    cafe, mute = said["features"][-2:]
    assert cafe["geometry"]["coordinates"] == [9.5, 47.1]
    assert (cafe["properties"]["id"], cafe["properties"]["verdict"]) == ("node/1", "for")
    assert mute["geometry"] is None


@pytest.mark.parametrize("longitude", [9.5, 179.9999])
def test_an_ellipse_holds_its_share(longitude):
    said = strict(city_estimate(longitude).geojson())
    point, ellipse = said["features"][:2]
    assert len(point["geometry"]["coordinates"]) == 2
    (ring,) = ellipse["geometry"]["coordinates"]
    assert ring[0] == ring[-1]
    ring = np.array(ring)
    assert np.ptp(ring[:, 0]) < 1  # it does not run around the world
    plane = LocalPlane(longitude, 47.1)
    axes = np.abs(plane.to_plane(ring)).max(axis=0)
    assert np.allclose(
        axes, np.sqrt(-2 * math.log(1 - ELLIPSE_PROBABILITY)) * np.array([20, 10]), rtol=0.01
    )
    x, y = ring[:-1].T
    assert (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() > 0  # counter-clockwise


spots = st.tuples(st.floats(-180.0, 179.999), st.floats(-89.9, 89.9))


@given(spots, st.integers(1, 16))
def test_a_place_lies_in_the_tile_of_its_key(place, zoom):
    key = key_at(*place, zoom)
    box = tile_bounds(key)
    assert box.west - 1e-9 <= place[0] <= box.east + 1e-9
    assert box.south - 1e-9 <= place[1] <= box.north + 1e-9
    assert tile_key(*parse_tile_key(key)) == key
    assert key.startswith(key_at(*place, zoom - 1))
    assert are_in_tile(np.array([place]), key).all()


@pytest.mark.parametrize("key", ["4", "01x", "0" * 17, "٣"])
def test_what_is_no_key(key):
    with pytest.raises(OptionError, match="is not a tile key; it must"):
        parse_tile_key(key)


@pytest.mark.parametrize("zoom", [0, 17, -1, 1.5, True, "3"])
def test_what_is_no_zoom(zoom):
    with pytest.raises(OptionError, match="zoom"):
        check_zoom(zoom)


def test_keys_are_those_of_web_maps():  # Bing's quadkeys
    assert tile_key(3, 5, 3) == "213"
    assert tile_key(3 + 8, 5, 3) == "213"  # once around the Earth
    assert key_at(-123.1, 49.25, 3) == "021"
    assert key_at(180.0, 10.0, 3) == key_at(-180.0, 10.0, 3)
    assert tiles_at(np.array([(0.1, 0.1), (-0.1, -0.1)]), 1).tolist() == [[1, 0], [0, 1]]
    assert not are_in_tile(np.array([(0.1, 0.1)]), "2").any()


@given(spots.filter(lambda p: abs(p[1]) < 80), st.integers(8, 15), st.floats(0.0, 3000.0))
def test_a_margin_reaches_every_tile_within_it(place, zoom, margin):
    lonlat = np.array([place])
    west, north, east, south = tile_ranges(lonlat, lonlat, zoom, margin)[0]
    plane = LocalPlane(*place)
    for angle in np.linspace(0.0, 2.0 * np.pi, 9):
        there = plane.to_lonlat(margin * np.array([np.sin(angle), np.cos(angle)]))
        column, row, _ = parse_tile_key(key_at(*there, zoom))
        assert north <= row <= south
        assert any(west <= column + turn <= east for turn in (-(1 << zoom), 0, 1 << zoom))
