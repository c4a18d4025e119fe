"""A place that was found by looking everywhere counts when it is found where odometry has come to."""

from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.estimate import PoseEstimate, PoseMode, Status
from placegraph.core.geometry import pose_matrix
from placegraph.indoor.track.tracker import SAME_WAY, Confirmation

HERE = (1.0, 2.0, 1.6, 0.5)
STEP = pose_matrix(np.array([0.2, 0.0, 0.0, 0.1]), np.eye(3))


def at(odometry):
    return SimpleNamespace(odometry=odometry)


def found(pose, status=Status.OK):
    mode = PoseMode(
        map_from_camera=pose, pose=np.zeros(4), covariance=np.eye(6), probability=1.0, scene="flat",
        scene_from_camera=pose,
    )  # fmt: skip
    return PoseEstimate(status, (mode,), "One place fits.")


@pytest.fixture
def poses():
    """Poses (4, 4) of two moments: of odometry, and in the map."""
    here, odometry = pose_matrix(np.array(HERE), np.eye(3)), np.eye(4)
    return (odometry, here), (odometry @ STEP, here @ STEP)


def test_the_second_answer_of_one_place_counts(poses):
    again, ((before, here), (now, there)) = Confirmation(), poses
    first = again.confirm("flat", at(before), found(here))
    assert first.status is Status.AMBIGUOUS
    assert first.modes
    assert first.reason == "One place fits; another image must confirm it."
    unsure = found(there, Status.LOST)
    assert again.confirm("flat", at(now), unsure) is unsure
    sure = found(there)
    assert again.confirm("flat", at(now), sure) is sure


def test_an_alias_does_not(poses):
    again, ((before, here), (now, there)) = Confirmation(), poses
    alias = here.copy()
    alias[2, 3] += 1.1 * SAME_WAY
    turned = there @ pose_matrix(np.array([0.0, 0.0, 0.0, 0.3]), np.eye(3))
    for scene, odometry, pose in (
        ("flat", before, alias), ("flat", now, there), ("hall", now, there), ("hall", now, turned),
    ):  # fmt: skip
        assert again.confirm(scene, at(odometry), found(pose)).status is Status.AMBIGUOUS
    assert again.confirm("hall", at(now), found(turned)).status is Status.OK
