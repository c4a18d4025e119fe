"""Frames and odometry agree on a course: rigid where odometry is good, bent where it drifts."""

from itertools import accumulate

import numpy as np
import pytest

from placegraph.core.geometry import between, compose, wrap_angle
from placegraph.indoor.options import MotionNoise
from placegraph.indoor.pose.local_fit import (
    USUAL,
    Chain,
    QuadraticFactors,
    Trajectory,
    solve_trajectory,
)

NOISE = MotionNoise(0.01, 0.03, 0.005, 0.02)
KNOWN = np.array([0.02, 0.02, 0.02, 0.006])
"""How well a frame knows its own pose [m, rad]."""


def chained(steps, start=(0.0, 0.0, 0.0, 0.0)):
    return np.array(list(accumulate(steps, compose, initial=np.array(start))))


def walk(count=12):
    return chained(np.tile([0.15, 0.02, 0.0, 0.08], (count - 1, 1)), (1.0, 2.0, 1.5, 3.0))


def drifting(truth, degrees, rng, systematic):
    steps = between(truth[:-1], truth[1:])
    errors = np.ones(len(steps)) if systematic else rng.normal(size=len(steps))
    steps[:, 3] += np.deg2rad(degrees) * errors
    steps[:, :3] *= 1.0 + 0.02 * degrees
    return Chain.of(chained(steps), NOISE)


def observe_poses(truth, rng, rows=slice(None)):
    """What frames say of their poses, each with its own error."""
    factors = QuadraticFactors.zeros(truth + rng.normal(size=truth.shape) * KNOWN)
    factors.information[rows] = np.diag(1.0 / KNOWN**2)
    return factors


def settled(chain, factors, start, steps=12):
    course = Trajectory.start(chain, start, np.array([0.1, 0.1, 0.1, 0.05]))
    for _ in range(steps):
        course = solve_trajectory(chain, course, factors)
    return course


def errors_of(course, truth):
    error = course.poses - truth
    error[:, 3] = wrap_angle(error[:, 3])
    return error


@pytest.mark.parametrize("systematic", [False, True])
@pytest.mark.parametrize("degrees", [1.0, 2.0])
def test_drift_is_found(rng, degrees, systematic):
    truth = walk()
    chain = drifting(truth, degrees, rng, systematic)
    course = settled(chain, observe_poses(truth, rng), truth[-1])
    error = errors_of(course, truth)
    assert np.abs(error[:, 3]).max() < 3 * KNOWN[3]
    assert np.linalg.norm(error[-1, :3]) < 0.06
    assert course.scales[3] > 2 * USUAL
    rigid = errors_of(Trajectory.start(chain, truth[-1], KNOWN), truth)
    assert np.abs(rigid[:, 3]).max() > np.abs(error[:, 3]).max()


def test_where_odometry_is_good_the_chain_is_stiff():
    truth, rng = walk(), np.random.default_rng(0)
    chain = Chain.of(between(truth[:1], truth), NOISE)
    ends, scales = [], []
    for _ in range(40):
        course = settled(chain, observe_poses(truth, rng), truth[-1])
        ends.append(errors_of(course, truth)[-1])
        scales.append(course.scales)
    assert (np.std(ends, axis=0) < 0.7 * KNOWN).all()
    assert (np.median(scales, axis=0) < USUAL).all()


def test_a_frame_that_says_nothing_follows_its_neighbours(rng):
    truth = walk()
    chain = Chain.of(between(truth[:1], truth), NOISE)
    course = settled(chain, observe_poses(truth, rng, rows=slice(0, 6)), truth[-1])
    led = compose(course.poses[5], between(truth[5], truth[6:]))
    np.testing.assert_allclose(course.poses[6:, :3], led[:, :3], atol=0.02)
    sd = np.sqrt(np.einsum("tii->ti", course.covariances))
    assert (sd[-1] > sd[5]).all()


def test_bends_cost(rng):
    truth = walk()
    factors = observe_poses(truth, rng)
    good = settled(Chain.of(between(truth[:1], truth), NOISE), factors, truth[-1])
    chain = drifting(truth, 2.0, rng, systematic=True)
    bent = settled(chain, factors, truth[-1])
    assert bent.cost(chain) > good.cost(Chain.of(between(truth[:1], truth), NOISE)) + 5.0


def test_a_single_frame_goes_where_it_is_seen(rng):
    truth = walk(1)
    factors = observe_poses(truth, rng)
    chain = Chain.of(np.zeros((1, 4)), NOISE)
    course = settled(chain, factors, truth[0] + 0.05)
    np.testing.assert_allclose(course.poses, factors.at, atol=1e-3)
    assert course.cost(chain) == 0.0
