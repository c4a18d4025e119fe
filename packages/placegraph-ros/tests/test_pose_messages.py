import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.estimate import PassRecord, PoseEstimate, Status
from placegraph.core.geometry import (
    level_from_camera,
    pose_matrix,
    rotation_from_quaternion,
    rotation_from_vector,
    rotation_z,
    vector_from_rotation,
)
from placegraph_ros.message import FrameIds
from placegraph_ros.pose_messages import (
    UPRIGHT_BASE,
    base_pose,
    estimate_messages,
    particles,
    pose_messages,
    rig_message,
)

VECTORS = st.lists(st.floats(-3, 3), min_size=3, max_size=3)


def rigid(turn, move):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_from_vector(turn), move
    return matrix


def moved(matrix, delta):
    out = matrix.copy()
    out[:3, 3] += delta[:3]
    out[:3, :3] = rotation_from_vector(delta[3:]) @ matrix[:3, :3]
    return out


@given(VECTORS, VECTORS, VECTORS, VECTORS, st.integers(0, 99))
def test_the_covariance_is_that_of_the_base(turn, move, mount_turn, mount_move, seed):
    map_from_camera, base_from_camera = rigid(turn, move), rigid(mount_turn, mount_move)
    root = np.random.default_rng(seed).normal(size=(6, 6)) * 1e-6
    center, covariance = base_pose(map_from_camera, root @ root.T, base_from_camera)
    steps = []
    for delta in root.T:  # every column is one deviation
        there = moved(map_from_camera, delta) @ np.linalg.inv(base_from_camera)
        turned = vector_from_rotation(there[:3, :3] @ center[:3, :3].T)
        steps.append([*(there[:3, 3] - center[:3, 3]), *turned])
    np.testing.assert_allclose(covariance, np.transpose(steps) @ steps, atol=1e-15)


def test_ros_order_of_a_robot_that_looks_along_y():
    map_from_camera = pose_matrix([1.0, 2.0, 1.6, np.pi / 2], level_from_camera([0, 1, 0]))
    mount = UPRIGHT_BASE.copy()
    mount[0, 3] = 0.5
    unsure = np.diag([0, 0, 0, 0, 0, 0.01])
    told, ridden, moving = pose_messages(
        map_from_camera, unsure, 5.0, base_from_camera=mount, map_from_odom=rigid([0, 0, 1], [1, 2, 3])
    )  # fmt: skip
    assert told.type.endswith("PoseWithCovarianceStamped")
    place = told.fields["pose"]["pose"]["position"]
    np.testing.assert_allclose([*place.values()], [1.0, 1.5, 1.6], atol=1e-12)
    covariance = told.fields["pose"]["covariance"]
    x, yaw = 0, 5
    expected = np.zeros((6, 6))
    expected[yaw, yaw], expected[x, x] = 0.01, 0.01 * 0.5**2
    expected[x, yaw] = expected[yaw, x] = 0.01 * 0.5
    np.testing.assert_allclose(covariance, expected.ravel(), atol=1e-15)
    assert ridden.fields["pose"] == told.fields["pose"]
    frames = (ridden.fields["header"]["frame_id"], ridden.fields["child_frame_id"])
    assert frames == ("map", "base_link")
    (tf,) = moving.fields["transforms"]
    assert (moving.topic, tf["header"]["frame_id"], tf["child_frame_id"]) == ("tf", "map", "odom")
    turned = rotation_from_quaternion([*tf["transform"]["rotation"].values()])
    np.testing.assert_allclose(turned, rotation_z(1.0), atol=1e-12)


@given(VECTORS, VECTORS)
def test_the_tree_leads_from_the_map_to_the_camera(turn, move):
    map_from_camera, odom_from_camera = rigid(turn, move), rigid(move, turn)
    names = FrameIds(camera="optical")
    map_from_odom = map_from_camera @ np.linalg.inv(odom_from_camera)
    messages = pose_messages(map_from_camera, np.eye(6), 1.0, names, map_from_odom=map_from_odom)
    tree = [*messages[-1].fields["transforms"], *rig_message(None, 1.0, names).fields["transforms"]]
    links = {}
    for link in tree:
        matrix = np.eye(4)
        quaternion = [*link["transform"]["rotation"].values()]
        assert quaternion[3] >= 0
        assert np.linalg.norm(quaternion) == pytest.approx(1.0)
        matrix[:3, :3] = rotation_from_quaternion(quaternion)
        matrix[:3, 3] = [*link["transform"]["translation"].values()]
        links[link["header"]["frame_id"], link["child_frame_id"]] = matrix
    odom_from_base = odom_from_camera @ np.linalg.inv(UPRIGHT_BASE)
    there = links["map", "odom"] @ odom_from_base @ links["base_link", "optical"]
    np.testing.assert_allclose(there, map_from_camera, atol=1e-9)
    np.testing.assert_allclose(UPRIGHT_BASE[:3, :3] @ [0, 0, 1], [1, 0, 0])  # looks ahead


def by_topic(messages):
    return {message.topic: message for message in messages}


@pytest.mark.parametrize(("status", "level"), [("OK", 0), ("AMBIGUOUS", 1), ("LOST", 2)])
def test_a_pose_is_told_only_where_it_is_known(estimate, status, level):
    said = by_topic(estimate_messages(estimate(Status[status]), 7.5, map_from_odom=np.eye(4)))
    known = {"localization/pose", "localization/odometry", "tf"}
    assert known & said.keys() == (known if status == "OK" else set())
    assert len(said["localization/modes"].fields["poses"]) == 2
    (diagnostic,) = said["diagnostics"].fields["status"]
    assert diagnostic["level"] == level
    assert diagnostic["message"] == f"{status}: One place fits."
    told = {pair["key"]: pair["value"] for pair in diagnostic["values"]}
    assert told["table 1"] == "for +3.50"
    assert told["lamp 2"] == "against -2.00 (not at its place in the map)"
    assert all(message.stamp == 7.5 for message in said.values())


def test_nothing_found_is_told_too():
    said = by_topic(estimate_messages(PoseEstimate(Status.LOST, (), "Nothing fits."), 1.0))
    assert said.keys() == {"localization/particle_cloud", "localization/modes", "diagnostics"}
    assert said["localization/modes"].fields["poses"] == []


def test_particles_have_the_modes_means_and_covariances(estimate):
    given = estimate()
    cloud, weights = particles(given, UPRIGHT_BASE)
    assert weights.sum() == pytest.approx(1.0)
    halves = (given.modes, np.split(cloud, 2), np.split(weights, 2))
    for mode, mine, heavy in zip(*halves, strict=True):
        assert heavy.sum() == pytest.approx(mode.probability)
        center, covariance = base_pose(mode.map_from_camera, mode.covariance, UPRIGHT_BASE)
        turns = vector_from_rotation(mine[:, :3, :3] @ center[:3, :3].T)
        deltas = np.concatenate([mine[:, :3, 3] - center[:3, 3], turns], axis=1)
        np.testing.assert_allclose(deltas.mean(axis=0), 0.0, atol=1e-12)
        np.testing.assert_allclose(deltas.T @ deltas / len(mine), covariance, atol=1e-12)


def test_particles_of_the_filter_where_they_were_recorded(estimate, rng):
    steps = tuple((i, rng.normal(size=(5, 4)), np.full(5, 2.0)) for i in range(2))
    given = estimate()
    recorded = PoseEstimate(given.status, given.modes, "", history=(PassRecord(20.0, steps),))
    cloud = by_topic(estimate_messages(recorded, 1.0))["localization/particle_cloud"]
    parts = cloud.fields["particles"]
    assert [part["weight"] for part in parts] == [0.2] * 5
    for part, (x, y, z, yaw) in zip(parts, steps[-1][1], strict=True):
        np.testing.assert_allclose([*part["pose"]["position"].values()], [x, y, z], atol=1e-12)
        ahead = rotation_from_quaternion([*part["pose"]["orientation"].values()])[:, 0]
        across = np.cross([np.cos(yaw), np.sin(yaw), 0.0], ahead)
        assert abs(across[2]) < 0.2  # nearly level, as the camera was held
        assert ahead @ [np.cos(yaw), np.sin(yaw), 0.0] > 0.9


def test_objects_that_agreed_are_green_and_the_others_red(estimate, scene):
    markers = by_topic(estimate_messages(estimate(), 1.0))["localization/objects"].fields["markers"]
    assert markers[0]["action"] == 3  # what was marked before is gone
    boxes = {m["ns"]: m for m in markers if m.get("type") == 1}
    assert boxes["for"]["color"]["g"] > boxes["for"]["color"]["r"]
    assert boxes["against"]["color"]["r"] > boxes["against"]["color"]["g"]
    for row, verdict in enumerate(("for", "against")):
        place = [*boxes[verdict]["pose"]["position"].values()]
        np.testing.assert_allclose(place, scene.graph.positions[row])
    words = {m["ns"]: m["text"] for m in markers if m.get("type") == 9}
    assert words == {"for/names": "table +3.5", "against/names": "Old lamp -2.0"}
