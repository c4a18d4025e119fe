"""Odometry between its samples, and what it says of itself."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.estimate import Status
from placegraph.core.geometry import rotation_from_vector
from placegraph.errors import OptionError
from placegraph.indoor.options import MotionNoise
from placegraph.indoor.status import LiveState
from placegraph.indoor.track.belief import (
    AHEAD,
    KEPT,
    MOST,
    Anchor,
    Odometry,
    checked_odometry,
    predict_pose,
)

small = st.floats(-2.0, 2.0)


def rigid(vector):
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_from_vector(vector[:3])
    matrix[:3, 3] = vector[3:]
    return matrix


poses = st.lists(small, min_size=6, max_size=6).map(lambda v: rigid(np.array(v)))


def record(*samples):
    odometry = Odometry()
    for sample in samples:
        odometry.tell(*sample)
    return odometry


@given(poses, poses, poses, st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_between_two_samples(one, other, frame, share):
    odometry = record((1.0, one), (1.5, other))
    np.testing.assert_allclose(odometry.at(1.0).pose, one, atol=1e-9)
    np.testing.assert_allclose(odometry.at(1.5).pose, other, atol=1e-9)
    found = odometry.at(1.0 + 0.5 * share).pose
    checked_odometry(0.0, found, None)
    moved = record((1.0, frame @ one), (1.5, frame @ other)).at(1.0 + 0.5 * share).pose
    np.testing.assert_allclose(moved, frame @ found, atol=1e-6)


@given(poses, st.lists(st.floats(0.0, 0.2), min_size=2, max_size=12), st.floats(0.0, 1.0))
@settings(max_examples=60, deadline=None)
def test_a_straight_way_is_one_however_it_is_sampled(start, gaps, share):
    stamps = np.unique(np.round(np.cumsum(gaps), 6))
    speed = np.array([0.2, 0.1, 0.3])

    def at(stamp):
        pose = start.copy()
        pose[:3, 3] += speed * stamp
        pose[:3, :3] = start[:3, :3] @ rotation_from_vector(np.array([0.0, 0.0, 0.4]) * stamp)
        return pose

    when = share * stamps[-1] + (1.0 - share) * stamps[0]
    odometry = record(*((s, at(s)) for s in stamps))
    np.testing.assert_allclose(odometry.at(when).pose, at(when), atol=1e-9)
    assert odometry.at(when).way == pytest.approx(np.linalg.norm(speed) * (when - stamps[0]))


def test_beyond_the_newest_it_goes_on_and_then_stands():
    step = rigid(np.array([0, 0, 0.1, 0.1, 0, 0]))
    odometry = record((0.0, np.eye(4)), (0.1, step))
    np.testing.assert_allclose(odometry.at(0.2).pose[:3, 3], (0.2, 0, 0), atol=1e-9)
    far = odometry.at(100.0)
    assert far.pose[0, 3] == pytest.approx(1.0 * (0.1 + AHEAD))
    assert odometry.at(-0.01) is None


def test_memory_is_bounded():
    odometry = Odometry()
    for i in range(3 * MOST):
        odometry.tell(i / 1000, np.eye(4))
    assert len(odometry) <= MOST
    slow = record(*((float(i), np.eye(4)) for i in range(100)))
    assert len(slow) <= 2 * KEPT + 2
    assert slow.at(99.0 - KEPT) is not None


@pytest.mark.parametrize(
    ("stamp", "pose", "covariance", "says"),
    [
        (np.nan, np.eye(4), None, "stamp"),
        (0.0, np.full((4, 4), np.nan), None, "odom_from_camera"),
        (0.0, np.eye(3), None, "4x4"),
        (0.0, np.diag([2.0, 1, 1, 1]), None, "not rigid"),
        (0.0, np.diag([-1.0, 1, 1, 1]), None, "not rigid"),
        (0.0, np.eye(4) + 1e200 * np.eye(4, k=3), None, "from the origin"),
        (0.0, 1e200 * np.eye(4), None, "from the origin"),
        (0.0, np.eye(4), np.full((6, 6), np.nan), "covariance"),
        (0.0, np.eye(4), -np.eye(6), "eigenvalue"),
        (0.0, "here", None, "not numbers"),
    ],
)
def test_what_is_no_odometry(stamp, pose, covariance, says):
    with pytest.raises(OptionError, match=says):
        checked_odometry(stamp, pose, covariance)
    assert checked_odometry(0.0, np.eye(4), np.zeros((6, 6)))[2] is None  # zeros say nothing


def test_a_pose_is_less_sure_the_further_odometry_leads():
    here = rigid(np.array([0, 0, 0.3, 1.0, 2.0, 0.0]))
    odometry = record(*((i / 10, rigid(np.array([0, 0, 0, i / 10, 0, 0]))) for i in range(100)))
    anchor = Anchor.of(odometry.at(0.0), here, 1e-4 * np.eye(6), "room")
    last = LiveState(Status.OK, "One place fits.")
    found = [
        predict_pose(anchor, odometry.at(t), MotionNoise(), last, 0.0) for t in (0.0, 1.0, 4.0, 9.0)
    ]
    spread = [np.trace(p.covariance[:3, :3]) for p in found]
    assert np.all(np.diff(spread) > 0)
    np.testing.assert_allclose(found[0].covariance, 1e-4 * np.eye(6))
    np.testing.assert_allclose(found[2].map_from_camera, here @ odometry.at(4.0).pose, atol=1e-9)
    assert found[0].status is Status.OK
    assert found[-1].status is Status.AMBIGUOUS
    assert "The pose is extrapolated by odometry" in found[-1].reason
    # a turn that is not known swings the way gone: across it, not along it
    turned = Anchor.of(odometry.at(0.0), here, np.diag([0, 0, 0, 0, 0, 0.01]), "room")
    shift = turned.spread(odometry.at(4.0), MotionNoise())[:3, :3]
    along, across = here[:3, :3] @ (1, 0, 0), here[:3, :3] @ (0, 1, 0)
    assert across @ shift @ across - along @ shift @ along == pytest.approx((4 * 0.1) ** 2)


def test_what_odometry_says_of_itself_counts():
    grown = record((0.0, np.eye(4), 1e-4 * np.eye(6)), (1.0, np.eye(4), 0.09 * np.eye(6)))
    anchor = Anchor.of(grown.at(0.0), np.eye(4), 1e-4 * np.eye(6), "room")
    spread = anchor.spread(grown.at(1.0), MotionNoise())
    assert spread[0, 0] == pytest.approx(0.09, abs=0.001)
    # one that closed a loop knows better again, and the map's pose is no worse for it
    shrunk = record((0.0, np.eye(4), 0.09 * np.eye(6)), (1.0, np.eye(4), 1e-4 * np.eye(6)))
    anchor = Anchor.of(shrunk.at(0.0), np.eye(4), 1e-4 * np.eye(6), "room")
    assert anchor.spread(shrunk.at(1.0), MotionNoise())[0, 0] < 0.001
