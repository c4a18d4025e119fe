"""Depth and images that were taken later than their stamps say."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.indoor.refine.lag import Lags, in_map_axes, later, twists, usual_lag
from placegraph.indoor.refine.refiner import DEPTH_WIDTHS
from placegraph.indoor.refine.solve import solve

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def looking_about(kit):
    """Poses (7, 4, 4) of a camera in the hall that turns to and fro."""
    yaws = (0, 8, 14, 12, 4, -6, -10)
    return np.stack([kit.standing(1.2 + 0.04 * i, 2.2, -20 + yaw) for i, yaw in enumerate(yaws)])


@pytest.mark.parametrize("lag", [-0.5, 0.0, 0.4])
def test_how_late_depth_is_is_found(kit, hall, looking_about, lag):
    stamps = np.arange(len(looking_about), dtype=float)
    late = later(looking_about, twists(looking_about, stamps), lag)
    odometry = np.linalg.inv(looking_about[0]) @ looking_about
    capture = kit.frames(hall, late, odometry=odometry)
    start = kit.moved(looking_about, (0.04, -0.03, 0.0), (0.0, 0.0, 1.0))
    solution = solve(kit.problem(hall, capture), start, DEPTH_WIDTHS, 6)
    assert solution.lags.values[0] == pytest.approx(lag, abs=0.05)
    assert solution.lags.values[1] == 0.0  # no image took part
    assert list(solution.lags.clear()) == (["depth"] if lag else [])
    for pose, truth in zip(solution.poses, looking_about, strict=True):
        metres, degrees = kit.off(pose, truth)
        assert metres < 0.01
        assert degrees < 0.4


def test_of_one_frame_nothing_is_late(kit, hall, walked, way):
    solution = solve(kit.problem(hall, walked[:1]), way[:1], DEPTH_WIDTHS)
    np.testing.assert_array_equal(solution.lags.values, 0.0)
    assert solution.lags.clear() == {}
    np.testing.assert_array_equal(solution.lags.of_depth(way[:1]), way[:1])


def test_the_usual_lag_is_some_hundredths_of_a_second_or_part_of_the_time_between():
    assert usual_lag(np.array([0.0])) == usual_lag(np.arange(0, 1, 0.033)) == 0.03
    assert usual_lag(np.arange(10.0)) == pytest.approx(0.3)


@given(st.floats(-0.3, 0.3))
def test_the_way_in_map_axes_is_the_derivative(kit, lag):
    poses = np.stack([kit.standing(1 + 0.3 * i, 2 + 0.1 * i, 20 * i) for i in range(4)])
    twist = twists(poses, np.arange(4.0))
    at, step = later(poses, twist, lag), 1e-5
    moved = (later(poses, twist, lag + step) - at)[:, :3, 3] / step
    told = in_map_axes(poses, twist).reshape(4, 6)
    np.testing.assert_allclose(moved, told[:, :3], atol=1e-6)
    back = Lags(np.array([lag, 0.0]), np.ones(2), twist, 1.0).of_depth(poses)
    np.testing.assert_allclose(back, at)


def test_in_steady_motion_a_lag_is_not_told_from_a_shift_and_stamps_are_believed(kit, hall):
    way = np.stack([kit.standing(1.2 + 0.1 * i, 2.2, -30) for i in range(6)])
    late = later(way, twists(way, np.arange(6.0)), 0.1)
    capture = kit.frames(hall, late, odometry=np.linalg.inv(way[0]) @ way)
    solution = solve(kit.problem(hall, capture), late, DEPTH_WIDTHS)
    assert np.abs(solution.lags.values).max() < 1e-3
