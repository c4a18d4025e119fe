import numpy as np
import pytest

from placegraph.core.estimate import PassRecord, PoseEstimate, Status
from placegraph.core.geometry import rotation_from_quaternion, vector_from_rotation
from placegraph_ros.pose_messages import UPRIGHT_BASE, base_pose, estimate_messages, particles


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
    assert told["lamp 2"] == "against -2.00 (not where the map has it)"
    assert all(message.stamp == 7.5 for message in said.values())


def test_nothing_found_is_told_too():
    said = by_topic(estimate_messages(PoseEstimate(Status.LOST, (), "Nothing fits."), 1.0))
    assert said.keys() == {"localization/particle_cloud", "localization/modes", "diagnostics"}
    assert said["localization/modes"].fields["poses"] == []


def test_particles_have_the_modes_means_and_covariances(estimate):
    given = estimate()
    cloud, weights = particles(given, UPRIGHT_BASE)
    assert weights.sum() == pytest.approx(1.0)
    for mode, mine, heavy in zip(
        given.modes, np.split(cloud, 2), np.split(weights, 2), strict=True
    ):
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
