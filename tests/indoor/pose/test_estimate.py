"""Probabilities of poses by how far frames fit there, and poses on Earth."""

import math
from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geo import Anchor
from placegraph.indoor.map.rooms import find_room_name
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.pose.covariance import DRIFT, LEAST, map_error, pose_covariance
from placegraph.indoor.pose.estimate import weigh_by_confidence


def test_the_likeliest_pose_is_not_where_frames_do_not_fit():
    """Depth alone put cameras of the office before bare walls, whatever the colours said."""
    shares = np.array([0.9, 0.08, 0.015, 0.005])
    got = weigh_by_confidence(shares, np.array([-8.2, 1.3, -8.0]))
    assert got.argmax() == 1
    assert got[1] > 0.95
    assert got[3] <= min(got[0], got[2])  # nobody looked
    np.testing.assert_allclose(weigh_by_confidence(shares, np.full(3, 5.0)), shares)
    np.testing.assert_allclose(
        weigh_by_confidence(shares, np.full(3, -np.inf)), shares
    )  # labels alone
    assert got.sum() == pytest.approx(1.0)


def test_a_map_is_less_true_where_no_camera_made_it(room):
    """Bags of the office were off by 2.7 deviations where the other half was mapped."""
    here = np.array([1.0, 1.0, 1.5])
    made = replace(room, viewpoints=here[None])
    near, far = (map_error(made, np.add(here, [way, 0, 0])) for way in (0.0, 1.0))
    assert near == LEAST == map_error(room, here), "a mesh has no cameras"
    assert far == pytest.approx(np.hypot(LEAST, DRIFT))
    more = np.diag(pose_covariance(np.eye(4), far) - pose_covariance(np.eye(4), near))
    assert more[0] == more[1] == pytest.approx(DRIFT**2)
    assert 0 < more[2] < more[0], "floors agree better"
    assert more[5] > 0


HERE = Anchor(
    7.42, 43.73, 50.0, math.radians(30), np.diag([0.01, 0.01, 0.04, 1e-4]), "Library", "way/7", "2", 0.7
)  # fmt: skip
TURNED = Anchor(7.42, 43.73, 50.0, math.radians(210), building="Library", probability=0.3)


def test_a_capture_is_found_on_earth(room, walk):
    anchored = room.anchored(HERE, TURNED)
    bare = room.localize(walk, seed=1, refine=False)
    found = anchored.localize(walk, seed=1, refine=False)
    best = found.best
    assert bare.best.earth == ()
    np.testing.assert_array_equal(best.map_from_camera, bare.best.map_from_camera)
    here, turned = best.earth
    assert (here.building, here.osm, here.level, here.room) == ("Library", "way/7", "2", "study")
    assert here.probability == pytest.approx(0.7 * best.probability)
    place = HERE.to_earth(best.map_from_camera[:3, 3])
    assert (here.longitude, here.latitude, here.height) == pytest.approx(tuple(place))
    yaw = best.pose[3]
    assert math.cos(here.heading - (math.radians(30) + math.pi / 2 - yaw)) == pytest.approx(1)
    assert math.cos(turned.heading - here.heading) == pytest.approx(-1)
    assert here.covariance[2, 2] == pytest.approx(0.04 + best.covariance[2, 2], rel=1e-6)
    assert found.to_dict()["modes"][0]["earth"][0]["room"] == "study"
    seen = [o for e in found.evidence for o in e.objects]
    assert seen
    assert all(abs(o.latitude - 43.73) < 1e-4 for o in seen)
    kinds = {f["properties"]["kind"] for f in found.geojson()["features"]}
    assert kinds == {"mode", "ellipse", "evidence"}
    refined = anchored.refine(walk, best.map_from_camera)
    again = HERE.to_earth(refined.best.map_from_camera[:3, 3])
    assert refined.geopose()["position"]["h"] == pytest.approx(again[2])


def test_a_tracker_says_it_too(room, walk):
    tracker = room.anchored(HERE).tracker(walk[0].camera, seed=1)
    for frame in walk[:3]:
        best = tracker.update(frame).best
        place = HERE.to_earth(best.map_from_camera[:3, 3])
        assert best.earth[0].longitude == pytest.approx(place[0], abs=1e-12)


def test_rooms_have_the_names_that_most_things_in_them_say(flat):
    named = {find_room_name(flat, position) for position in flat.graph.positions}
    assert named - {""} == {a["room"] for a in flat.attributes if "room" in a}
    sofa = flat.graph.labels.index("sofa")
    x, y, z = flat.graph.positions[sofa]
    assert find_room_name(flat, (x, y, z)) == flat.attributes[sofa]["room"]
    assert find_room_name(flat, (x, y, z + 9)) == find_room_name(flat, (x + 99, y, z)) == ""
    pair = merge_scenes({"a": flat, "b": flat})
    at = pair.graph.positions[len(flat) + sofa]
    assert find_room_name(pair, at) == flat.attributes[sofa]["room"]
