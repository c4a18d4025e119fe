"""All frames in one fit: where it ends, and what each prior holds."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.geometry import level_from_camera, rotation_from_vector
from placegraph.indoor.options import MotionNoise, RefineOptions
from placegraph.indoor.pose.covariance import LEAST
from placegraph.indoor.refine.correspondences import PointMatches
from placegraph.indoor.refine.fit import (
    Lags,
    Problem,
    Solution,
    common_error,
    covariance,
    in_map_axes,
    lag_deviation,
    odometry_errors,
    shift_in_time,
    solve,
    twists,
)
from placegraph.indoor.refine.refiner import DEPTH_WIDTHS

HALL = ((0, 0, 0), (6, 4, 3))

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def problem(kit, hall, walked):
    return kit.problem(hall, walked)


@pytest.fixture(scope="module")
def solution(problem, way):
    return solve(problem, way, DEPTH_WIDTHS)


def sights_of(capture, poses, rng, count=60, sigma=1.0, noise=0.0, wrong=0.0):
    """PointMatches of what the frames' depth shows at true poses, a share of them wrong."""
    out = []
    for frame, pose in zip(capture, poses, strict=True):
        depth, camera = frame.depth(), frame.camera
        v, u = (rng.integers(0, n, count) for n in depth.shape)
        pixels = np.stack([u, v], axis=1) + 0.5
        inside = camera.directions(pixels) * depth[v, u, None]
        points = inside @ pose[:3, :3].T + pose[:3, 3]
        pixels += noise * rng.normal(size=pixels.shape)
        bad = rng.random(count) < wrong
        pixels[bad] = rng.uniform(0, [camera.width, camera.height], (bad.sum(), 2))
        good = np.isfinite(points).all(axis=1)
        out.append(PointMatches.of(points[good], pixels[good], camera, sigma))
    return out


@settings(max_examples=8)
@given(
    st.tuples(*[st.floats(-0.1, 0.1)] * 2, st.floats(-0.04, 0.04)),
    st.tuples(*[st.floats(-1.0, 1.0)] * 2, st.floats(-4.0, 4.0)),
)
def test_a_disturbed_way_through_the_hall_is_found_again(kit, problem, way, shift, turn):
    start = kit.moved(way, shift, turn)
    before = start.copy()
    solution = solve(problem, start, DEPTH_WIDTHS, 6)
    np.testing.assert_array_equal(start, before)
    kit.check_near(solution.poses, way, 0.005, 0.1)


def test_one_frame(kit, hall, walked, way, solution):
    start, five = kit.moved(way[:1], (0.06, -0.05, 0.01), (0, 0, 3.0)), solution
    problem = kit.problem(hall, walked[:1])
    solution = solve(problem, start, DEPTH_WIDTHS, 6)
    assert kit.off(solution.poses[0], way[0])[0] < 0.005
    assert solution.information.shape == (6, 6)
    np.testing.assert_array_equal(solution.lags.values, 0.0)  # nothing is late
    assert solution.lags.find_clear() == {}
    np.testing.assert_array_equal(solution.lags.depth_poses(way[:1]), way[:1])
    _, away = common_error(problem, solution, LEAST)
    assert 0.5 < away < 6.0
    assert np.trace(five.covariance()[:3, :3]) < np.trace(solution.covariance()[:3, :3])


def test_odometry_holds_a_frame_that_saw_nothing(kit, hall, walked, way):
    start = kit.moved(way, (0.08, 0.04, 0), (0, 0, 3.0))
    problem = kit.problem(hall, walked, blind={2, 4})
    solution = solve(problem, start, DEPTH_WIDTHS, 6)
    for t in (2, 4):
        assert kit.off(solution.poses[t], way[t])[0] < 0.005
        assert kit.off(start[t], way[t])[0] > 0.07
    deviations = [np.sqrt(np.trace(solution.covariance(t)[:3, :3])) for t in range(5)]
    assert deviations[2] > deviations[1]
    assert deviations[4] > deviations[2]  # nothing behind it holds the last one
    none = replace(problem, readings=[None] * 5)
    np.testing.assert_allclose(solve(none, start, DEPTH_WIDTHS).poses, start, atol=1e-6)


def test_drifting_odometry_bends(kit, hall, walked, way):
    drift = np.stack([kit.moved(p, (0.01 * t, 0, 0)) for t, p in enumerate(way)])
    bent = replace(kit.problem(hall, walked), odometry=np.linalg.inv(drift[0]) @ drift)
    solution = solve(bent, kit.moved(drift, (0.02, 0.03, 0)), DEPTH_WIDTHS, 6)
    kit.check_near(solution.poses, way, 0.012)


def test_frames_that_are_astray_do_not_bend_the_way(kit, hall, walked, way):
    turns = np.radians([1.5, -1.5, 0.0, 1.5, -1.5])
    elsewhere = way.copy()
    elsewhere[:, :3, :3] = rotation_from_vector(np.outer(turns, (0, 0, 1))) @ way[:, :3, :3]
    seen = kit.frames(hall, elsewhere, odometry=np.linalg.inv(way[0]) @ way)
    solution = solve(
        kit.problem(hall, seen, gravity=np.stack([f.gravity for f in walked])), way, DEPTH_WIDTHS, 6
    )
    kit.check_near(solution.poses, way, 1.0, 0.5)


@pytest.mark.parametrize("tilt_deg", [0.4, 1.5])
def test_gravity_is_a_prior_not_a_cage(kit, hall, walked, way, tilt_deg):
    turn = level_from_camera([np.sin(np.radians(tilt_deg)), np.cos(np.radians(tilt_deg)), 0.0])
    turn = turn @ level_from_camera([0.0, 1.0, 0.0]).T
    upright = np.stack([f.gravity for f in walked])
    wrong = upright @ turn.T
    lean = np.degrees(np.arccos(np.clip(np.sum(wrong * upright, axis=1), -1, 1)))
    assert lean.min() > 0.1 * tilt_deg
    problem = kit.problem(hall, walked, gravity=wrong)
    solution = solve(problem, way, DEPTH_WIDTHS, 6)
    assert kit.off(solution.poses[-1], way[-1])[1] < 0.4 * lean.min()
    # without depth, gravity is all there is: half a degree of the start is put right
    problem = kit.problem(hall, walked, blind=range(5))
    start = kit.moved(way, turn_deg=(0.5, 0.5, 0.0))
    found = solve(problem, start, DEPTH_WIDTHS, 6).poses
    up = -np.einsum("tij,tj->ti", found[:, :3, :3], problem.gravity)
    assert np.degrees(np.arccos(np.clip(up[:, 2], -1, 1))).max() < 0.05


def test_covariances_are_positive_definite(solution):
    whole = np.linalg.inv(solution.information)
    for t in range(5):
        np.testing.assert_allclose(
            solution.covariance(t), whole[6 * t : 6 * t + 6, 6 * t : 6 * t + 6], rtol=1e-6
        )
    np.testing.assert_array_equal(solution.covariance(), solution.covariance(4))
    for matrix in (solution.information, *map(solution.covariance, range(5))):
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())
        assert np.linalg.eigvalsh(matrix).min() > 0


def test_along_a_corridor_nobody_knows_how_far(kit, rng):
    corridor = kit.boxes({"corridor": ((0, 0, 0), (60, 2, 2.5))})
    poses = np.stack([kit.standing(30 + 0.1 * i, 0.4, 90.0, 25.0) for i in range(3)])
    capture = kit.frames(corridor, poses)
    problem = kit.problem(corridor, capture)
    solution = solve(problem, poses, DEPTH_WIDTHS)
    along, across, up = np.sqrt(np.diag(solution.covariance())[:3])
    assert along > 0.3
    assert across < 0.01
    assert up < 0.01
    # a start that is off along it stays there; across, it is put right
    found = solve(problem, kit.moved(poses, (0.1, 0.08, 0.0)), DEPTH_WIDTHS).poses[-1]
    assert found[0, 3] == pytest.approx(poses[-1, 0, 3] + 0.1, abs=0.01)
    assert found[1, 3] == pytest.approx(poses[-1, 1, 3], abs=0.003)
    # points say what depth cannot
    problem = kit.problem(corridor, capture, matches=sights_of(capture, poses, rng))
    solution = solve(problem, kit.moved(poses, (0.06, 0.0, 0.0)), DEPTH_WIDTHS, 6)
    assert kit.off(solution.poses[-1], poses[-1])[0] < 0.005
    assert np.sqrt(solution.covariance()[0, 0]) < 0.05


@pytest.mark.parametrize(("metres", "within"), [(0.06, 0.035), (0.15, 0.01), (0.4, 0.01)])
def test_moved_furniture_is_weighted_down(kit, way, metres, within):
    changed = kit.boxes({"hall": HALL, "chest": ((3 + metres, 1.4, 0), (3.5 + metres, 1.8, 0.9))})
    scene = kit.boxes({"hall": HALL, "chest": ((3, 1.4, 0), (3.5, 1.8, 0.9))})
    problem = kit.problem(scene, kit.frames(changed, way))
    solution = solve(problem, kit.moved(way, (0.03, 0.03, 0), (0, 0, 1.0)), DEPTH_WIDTHS, 6)
    assert kit.off(solution.poses[-1], way[-1])[0] < within  # 6 cm is within the kernel
    assert solution.shares[0] == 1.0
    if metres > 0.1:
        assert solution.shares[1] < 0.9
        still = solve(kit.problem(scene, kit.frames(scene, way)), way, DEPTH_WIDTHS)
        assert still.shares.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("wrong", [0.0, 0.3])
def test_points_alone(kit, hall, walked, way, rng, wrong):
    matches = sights_of(walked, way, rng, wrong=wrong)
    problem = kit.problem(hall, walked, matches=matches, blind=range(5))
    start = kit.moved(way, (0.05, -0.04, 0.02), (0.2, 0.2, 2.0))
    solution = solve(problem, start, ((10.0, 20.0), (5.0, 6.0), (3.0, 3.0)), 6)
    kit.check_near(solution.poses[-1], way[-1], 0.01, 0.2)
    assert np.isnan(solution.cost)


@settings(max_examples=20)
@given(st.integers(0, 99), st.floats(-3.0, 3.0))
def test_errors_of_odometry_do_not_depend_on_the_frames_of_reference(kit, way, seed, yaw):
    rng = np.random.default_rng(seed)
    noise = MotionNoise(0.01, 0.1, 0.02, 0.2)
    options = RefineOptions(motion=noise)
    odometry = np.linalg.inv(way[0]) @ way
    poses = np.stack([kit.moved(p, 0.02 * rng.normal(size=3), rng.normal(size=3)) for p in way])
    elsewhere = kit.standing(3.0, 1.0, np.degrees(yaw))

    def made(frames):
        return Problem(None, (), (), frames, np.zeros((5, 3)), np.arange(5.0), 0, options)

    first, deviations = odometry_errors(made(odometry), poses)
    second, same = odometry_errors(made(elsewhere @ odometry), poses)
    np.testing.assert_allclose(first, second, atol=1e-9)
    np.testing.assert_allclose(deviations, same, atol=1e-9)
    nothing, _ = odometry_errors(made(odometry), kit.moved(way, (1, 2, 3), (0, 0, 40)))
    np.testing.assert_allclose(nothing, 0.0, atol=1e-6)
    way_of = np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(deviations[:, 0], 0.01 + 0.1 * way_of, atol=1e-9)


def test_never_less_than_the_fits_own(problem, solution):
    more = covariance(problem, solution, LEAST) - solution.covariance()
    assert np.linalg.eigvalsh(more).min() > 0
    np.testing.assert_allclose(more, np.diag(np.diag(more)), atol=1e-12)
    assert np.sqrt(more[0, 0]) >= LEAST - 1e-9
    assert more[2, 2] < more[0, 0]  # height is known better
    assert np.sqrt(more[3, 3]) <= problem.options.tilt + 1e-9
    loose = covariance(problem, solution, 0.1) - solution.covariance()
    assert np.sqrt(loose[0, 0]) == pytest.approx(0.1), "the map's own error"


def test_matches_that_miss_make_it_grow(kit, hall, walked, way, rng):
    found = []
    for miss in (0.0, 2.0, 6.0):
        matches = []
        for frame, pose in zip(walked, way, strict=True):
            inside = rng.uniform([-0.5, -0.4, 2.9], [0.5, 0.4, 3.1], (80, 3))
            pixels = frame.camera.project(inside) + miss * rng.normal(size=(80, 2))
            points = inside @ pose[:3, :3].T + pose[:3, 3]
            matches.append(PointMatches.of(points, pixels, frame.camera, 1.0))
        problem = kit.problem(hall, walked, matches=matches, blind=range(5))
        made = Solution(way, np.eye(30), np.ones(2), np.nan, 1)
        shift, away = common_error(problem, made, LEAST)
        assert away == pytest.approx(3.0, abs=0.15)
        found.append(shift)
    assert found[0] < found[1] < found[2]
    assert found[2] / found[1] == pytest.approx(3.0, rel=0.25)
    nothing = PointMatches.empty()
    bare = kit.problem(hall, walked, matches=[nothing] * 5, blind=range(5))
    assert common_error(bare, made, LEAST) == (pytest.approx(LEAST), 1.0)


@pytest.fixture(scope="module")
def looking_about(kit):
    """Poses (7, 4, 4) of a camera in the hall that turns to and fro."""
    yaws = (0, 8, 14, 12, 4, -6, -10)
    return np.stack([kit.standing(1.2 + 0.04 * i, 2.2, -20 + yaw) for i, yaw in enumerate(yaws)])


@pytest.mark.parametrize("lag", [-0.5, 0.0, 0.4])
def test_how_late_depth_is_is_found(kit, hall, looking_about, lag):
    stamps = np.arange(len(looking_about), dtype=float)
    late = shift_in_time(looking_about, twists(looking_about, stamps), lag)
    odometry = np.linalg.inv(looking_about[0]) @ looking_about
    capture = kit.frames(hall, late, odometry=odometry)
    start = kit.moved(looking_about, (0.04, -0.03, 0.0), (0.0, 0.0, 1.0))
    solution = solve(kit.problem(hall, capture), start, DEPTH_WIDTHS, 6)
    assert solution.lags.values[0] == pytest.approx(lag, abs=0.05)
    assert solution.lags.values[1] == 0.0  # no image took part
    assert list(solution.lags.find_clear()) == (["depth"] if lag else [])
    kit.check_near(solution.poses, looking_about, 0.01, 0.4)


@given(st.floats(-0.3, 0.3))
def test_the_way_in_map_axes_is_the_derivative(kit, lag):
    poses = np.stack([kit.standing(1 + 0.3 * i, 2 + 0.1 * i, 20 * i) for i in range(4)])
    twist = twists(poses, np.arange(4.0))
    at, step = shift_in_time(poses, twist, lag), 1e-5
    moved = (shift_in_time(poses, twist, lag + step) - at)[:, :3, 3] / step
    told = in_map_axes(poses, twist).reshape(4, 6)
    np.testing.assert_allclose(moved, told[:, :3], atol=1e-6)
    back = Lags(np.array([lag, 0.0]), np.ones(2), twist, 1.0).depth_poses(poses)
    np.testing.assert_allclose(back, at)
    assert lag_deviation(np.array([0.0])) == lag_deviation(np.arange(0, 1, 0.033)) == 0.03
    assert lag_deviation(np.arange(10.0)) == pytest.approx(0.3)


def test_in_steady_motion_a_lag_is_not_told_from_a_shift_and_stamps_are_believed(kit, hall):
    way = np.stack([kit.standing(1.2 + 0.1 * i, 2.2, -30) for i in range(6)])
    late = shift_in_time(way, twists(way, np.arange(6.0)), 0.1)
    capture = kit.frames(hall, late, odometry=np.linalg.inv(way[0]) @ way)
    solution = solve(kit.problem(hall, capture), late, DEPTH_WIDTHS)
    assert np.abs(solution.lags.values).max() < 1e-3
