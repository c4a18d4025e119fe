"""Questions and windows: odometry as level steps, keyframes, frames that are chosen and read."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from placegraph.core.geometry import (
    Camera,
    between,
    level_from_camera,
    pose_matrix,
    rotation_from_quaternion,
    wrap_angle,
)
from placegraph.errors import OptionError
from placegraph.indoor.options import MotionNoise, PoseSearchOptions
from placegraph.indoor.pose.particle_filter import propagate
from placegraph.indoor.pose.window import PoseQuery, chosen_frames, keyframes, level_poses
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

seeds = st.integers(0, 2**32 - 1)
numbers = st.floats(-1, 1)
quaternions = (
    st.tuples(numbers, numbers, numbers, numbers)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.05)
)


def some_walk(rng, count=6):
    """True poses (T, 4), gravity (T, 3) in the camera and matrices (T, 4, 4) of a tilting camera."""
    poses = np.column_stack([rng.uniform(-5, 5, (count, 3)), rng.uniform(-np.pi, np.pi, count)])
    gravity = rng.normal((0, 1, 0), 0.3, (count, 3))
    gravity /= np.linalg.norm(gravity, axis=1, keepdims=True)
    return poses, gravity, pose_matrix(poses, level_from_camera(gravity))


def same_steps(got, expected):
    """The same way, seen from frames that may differ by a shift and a turn about the vertical."""
    steps, wanted = between(got[:-1], got[1:]), between(expected[:-1], expected[1:])
    np.testing.assert_allclose(steps[:, :3], wanted[:, :3], atol=1e-7)
    np.testing.assert_allclose(wrap_angle(steps[:, 3] - wanted[:, 3]), 0.0, atol=1e-7)


@given(seeds, quaternions)
@example(1, (1, 0, 0, 0)).via("level already")
@example(1, (0, 1, 0, 0)).via("upside down")
@example(1, (1, 1, 0, 0)).via("y up")
@example(1, (1, 0, 1, 0)).via("x up")
def test_odometry_at_any_slant_is_set_upright(seed, quaternion):
    poses, gravity, matrices = some_walk(np.random.default_rng(seed))
    slant = np.eye(4)
    slant[:3, :3] = rotation_from_quaternion(quaternion)
    slant[:3, 3] = (7, -3, 2)
    same_steps(level_poses(slant @ matrices, gravity), poses)
    level = level_poses(matrices, gravity)  # stays as it is
    np.testing.assert_allclose(level[:, 2] - level[0, 2], poses[:, 2] - poses[0, 2], atol=1e-8)


def test_noisy_gravity_sets_the_frame_upright_by_its_mean(rng):
    poses, gravity, matrices = some_walk(rng, 400)
    slant = np.eye(4)
    slant[:3, :3] = rotation_from_quaternion((0.3, -0.2, 0.1, 0.9))
    noisy = gravity + rng.normal(0, 0.02, gravity.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    got = level_poses(slant @ matrices, noisy)
    # z of places 10 m apart would be off by 0.2 m for a vertical off by 0.02 rad
    error = (got[:, 2] - poses[:, 2]) - (got[0, 2] - poses[0, 2])
    assert np.abs(error).max() < 0.04


STEP = np.array([0.6, -0.2, 0.1, 0.5])


@pytest.mark.parametrize("step", [STEP, np.zeros(4), np.array([0, 0, 0, 2 * math.pi - 0.1])])
def test_noise_is_a_floor_and_a_share_of_the_step(step, rng):
    noise = MotionNoise(0.02, 0.1, 0.01, 0.2)
    poses = np.tile([3.0, 1.0, 1.6, 2.5], (40_000, 1))
    moved = propagate(poses, step, noise, rng)
    errors = between(poses, moved) - step
    errors[:, 3] = wrap_angle(errors[:, 3])
    way = 0.02 + 0.1 * np.linalg.norm(step[:3])
    turn = 0.01 + 0.2 * abs(float(wrap_angle(step[3])))  # the short way round
    sd = np.array([way, way, way, turn])
    assert (np.abs(errors.mean(axis=0)) < 5 * sd / math.sqrt(len(errors))).all()
    np.testing.assert_allclose(errors.std(axis=0), sd, rtol=0.03)
    correlation = np.corrcoef(errors.T) - np.eye(4)
    assert np.abs(correlation).max() < 0.03


STAMPS = [0, 0.2, 0.4, 0.6, 0.8, 2.0, 2.1]
WAY = [0, 0.1, 0.2, 0.35, 0.4, 0.4, 0.71, 0.72]
TURNS = [3.0, 3.1, -3.1, -3.0, -2.9, -2.8]  # across the half turn


@pytest.mark.parametrize(
    ("stamps", "xs", "yaws", "seconds", "metres", "kept"),
    [
        (range(5), 0.0, 0.0, 0, 0, [0, 1, 2, 3, 4]),
        (STAMPS, 0.0, 0.0, 0.5, 0, [0, 3, 5, 6]),
        (range(8), WAY, 0.0, 0, 0.3, [0, 3, 6, 7]),
        (range(6), 0.0, TURNS, 0, 0.3, [0, 3, 5]),
        (range(6), 0.0, TURNS, 10.0, 0, [0, 5]),  # where only time is asked for, a turn is none
        (range(6), [0, 1.0, 1.0, 1.0, 1.0, 1.0], 0.0, 3.0, 0.5, [0, 1, 4, 5]),
    ],
)
def test_keyframes_by_time_way_turn_or_either(stamps, xs, yaws, seconds, metres, kept):
    poses = np.zeros((len(stamps), 4))
    poses[:, 0], poses[:, 3] = xs, yaws
    assert keyframes(np.array(stamps, float), poses, seconds, metres) == kept


@given(
    st.lists(st.floats(0.01, 2), min_size=1, max_size=30), seeds, st.floats(0, 3), st.floats(0, 3)
)
def test_keyframes_lose_nothing(gaps, seed, seconds, metres):
    stamps = np.cumsum(gaps)
    poses = np.cumsum(np.random.default_rng(seed).normal(0, 0.3, (len(gaps), 4)), axis=0)
    kept = keyframes(stamps, poses, seconds, metres)
    assert kept[0] == 0
    assert kept[-1] == len(gaps) - 1
    assert kept == sorted(set(kept))
    if seconds > 0 or metres > 0:
        for i in set(range(len(gaps))) - set(kept):
            before = max(k for k in kept if k < i)
            assert not seconds or stamps[i] - stamps[before] < seconds
            assert not metres or np.linalg.norm(poses[i, :3] - poses[before, :3]) < metres


CAMERA = Camera(8, 6, 8.0, 8.0, 4.0, 3.0)


@pytest.fixture(scope="module")
def capture():
    image = np.zeros((6, 8, 3), np.uint8)
    frames = [Frame.from_arrays(image, CAMERA, stamp=i / 5, index=i) for i in range(6)]
    return Capture.from_frames(frames)


@pytest.mark.parametrize(
    ("asked", "rows"),
    [
        (None, [0, 1, 2, 3, 4, 5]), (slice(2, 4), [2, 3]), (slice(None, None, 2), [0, 2, 4]),
        (slice(-2, None), [4, 5]), ([1, 3], [1, 3]), ((0,), [0]), (np.array([2, 5]), [2, 5]),
        ([-6, -1], [0, 5]), (range(1, 3), [1, 2]),
    ],
)  # fmt: skip
def test_by_slice_by_rows_or_all(capture, asked, rows):
    assert [f.index for f in chosen_frames(capture, asked)] == rows
    assert [f.index for f in chosen_frames(list(capture), asked)] == rows


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ([], "none of the capture's"), (slice(3, 3), "none of the capture's"),
        (slice(9, 12), "none of the capture's"), ([6], "outside"), ([-7], "outside"),
        ([3, 1], "order of time"), ([1, 1], "each frame once"),
        (slice(None, None, -1), "order of time"), ([1.5], "whole numbers"),
        (["1"], "whole numbers"), ("123", "whole numbers"), (3, "whole numbers"),
    ],
)  # fmt: skip
def test_what_is_refused(capture, asked, says):
    with pytest.raises(OptionError, match=says) as raised:
        chosen_frames(capture, asked)
    assert str(raised.value).startswith("frames")


def test_of_the_frames_chosen_keyframes_are_asked_about(room, capture):
    query = PoseQuery.of(room, capture, frames=slice(1, 6), options=PoseSearchOptions(every=0.35))
    assert [f.index for f in query.frames] == [1, 3, 5]
    assert PoseQuery.of(room).frames == []


def test_what_the_map_cannot_serve_is_not_asked(room, capture):
    assert PoseQuery.of(room, capture).options.colour is room.has_colours is True
    grey = SimpleNamespace(has_colours=False)
    assert not PoseQuery.of(grey, capture).options.colour
    with pytest.raises(OptionError, match="all off"):
        PoseQuery.of(grey, capture, options=PoseSearchOptions().only(colour=True))
