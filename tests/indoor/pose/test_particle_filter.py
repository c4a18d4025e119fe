"""The particle filter: its equations, on likelihoods that can be written down."""

from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.geometry import between, compose, wrap_angle
from placegraph.indoor.options import FilterOptions, MotionNoise
from placegraph.indoor.pose.particle_filter import ParticleFilter, Particles, kld_count, run_pass

OPTIONS = FilterOptions()
PAPER = FilterOptions.paper()
FEWEST = OPTIONS.min_particles
SPREAD = np.array([0.1, 0.1, 0.1, 0.08])
seeds = st.integers(0, 2**32 - 1)


def near(poses, target, spread=SPREAD):
    """A Gaussian log-likelihood (N,) around a pose: a scorer whose views are poses."""
    error = poses - target
    error[:, 3] = wrap_angle(error[:, 3])
    return -0.5 * np.sum((error / spread) ** 2, axis=1)


def filter_of(poses, rng, options=OPTIONS, scorer=near, most=2000):
    return ParticleFilter(scorer, options, rng, Particles.uniform(np.array(poses, float)), most)


def scattered(rng, count, box=3.0):
    return rng.uniform((-box, -box, 1.4, -np.pi), (box, box, 1.8, np.pi), (count, 4))


@given(seeds, st.integers(30, 300), st.floats(-4, 4))
@settings(max_examples=50)
def test_sharp_likelihoods_leave_a_tenth_effective(seed, count, sharpness):
    values = np.random.default_rng(seed).normal(size=count) * 10.0**sharpness
    filter_ = filter_of(np.zeros((count, 4)), None, scorer=lambda _, view: view)
    filter_.reweight(values)
    got = filter_.particles
    wanted = max(4.0, 0.1 * count)
    untouched, _ = Particles.uniform(np.zeros((count, 4))).reweight(values)
    if untouched.effective() >= wanted:
        np.testing.assert_allclose(got.log_weights, untouched.log_weights)
    else:
        # a bisection of twelve steps; below a thousandth nothing is flattened any further
        lowest = Particles.uniform(np.zeros((count, 4))).reweight(1e-3 * values)[0].effective()
        assert got.effective() >= min(wanted, lowest) * 0.999
        assert got.effective() <= max(wanted * 1.3, lowest * 1.001)
    order = np.argsort(values)
    assert (np.diff(got.log_weights[order]) >= -1e-9).all()


def test_the_papers_likelihood_is_left_as_it_is(rng):
    """Eq. 2 is the paper's; its particles may die."""
    values = np.append(np.zeros(199), 50.0)
    filter_ = filter_of(np.zeros((200, 4)), rng, PAPER, scorer=lambda _, view: view)
    filter_.reweight(values)
    assert filter_.particles.effective() == pytest.approx(1.0, abs=1e-6)
    expected, _ = Particles.uniform(np.zeros((200, 4))).reweight(values)
    np.testing.assert_array_equal(filter_.particles.log_weights, expected.log_weights)
    gentle = filter_of(np.zeros((200, 4)), rng, scorer=lambda _, view: view)
    gentle.reweight(values)
    assert gentle.particles.effective() > 19


def test_resampling_to_as_many_as_kld_says_between_bounds(rng):
    for box, most in ((0.01, 2000), (0.3, 2000), (1.5, 2000), (3.0, 90)):
        filter_ = filter_of(scattered(rng, 500, box) * (1, 1, 1, box / 3), rng, most=most)
        wanted = kld_count(filter_.particles, OPTIONS)
        filter_.resample()
        assert len(filter_.particles) == np.clip(wanted, FEWEST, most)
        np.testing.assert_allclose(filter_.particles.weights, 1 / len(filter_.particles))
    filter_ = filter_of(np.tile([1.0, 2, 1.6, 0], (500, 1)), rng)
    filter_.resample()
    assert len(filter_.particles) == FEWEST


def test_modes_come_heaviest_first(rng):
    poses = np.array([[0, 0, 1.6, 0], [0.1, 0, 1.6, 0], [3, 0, 1.6, 0], [0, 0, 1.6, 2]], float)
    filter_ = filter_of(poses, rng)
    filter_.particles, _ = filter_.particles.reweight(np.array([1.0, 2.0, 3.0, 0.5]))
    np.testing.assert_array_equal(filter_.modes(), poses[[2, 1, 3]])
    filter_.options = replace(OPTIONS, modes=1)
    np.testing.assert_array_equal(filter_.modes(), poses[[2]])


def test_a_frame_explained_far_worse_is_noticed(rng):
    filter_ = filter_of(np.zeros((50, 4)), rng, scorer=lambda p, view: np.full(len(p), view))
    for value, dropped in ((10.0, False), (0.0, False), (-30.0, True), (8.0, False)):
        filter_.reweight(value)
        assert filter_.dropped is dropped
    # the running mean: 10, 8, 0.4, ...
    assert filter_.mean_log_likelihood == pytest.approx(0.8 * (0.8 * 8 + 0.2 * -30) + 0.2 * 8)


def test_injected_poses_replace_some_of_every_mode(rng):
    homes = np.repeat(np.arange(5.0), 20)
    filter_ = filter_of(np.column_stack([homes, np.zeros((100, 3))]), rng)
    elsewhere = np.full((40, 4), 9.0)
    filter_.inject(elsewhere)
    at = filter_.particles.poses[:, 0]
    assert (at == 9).sum() == 40
    counts = [(at == home).sum() for home in range(5)]
    assert sum(counts) == 60
    assert min(counts) >= 11
    np.testing.assert_allclose(filter_.particles.weights, 0.01)


def test_at_least_half_stay_and_never_more_than_there_is_room_for(rng):
    filter_ = filter_of(np.zeros((30, 4)), rng, most=40)
    filter_.inject(np.ones((500, 4)))
    stayed = (filter_.particles.poses[:, 0] == 0).sum()
    assert stayed == 15
    assert len(filter_.particles) == 40


def walk(count, step=(0.15, 0.02, 0, 0.08)):
    """True poses (T, 4) and the steps between them; step 0 is none."""
    start, way = np.array([-1.0, 0.5, 1.6, -0.4]), [np.array(step)] * (count - 1)
    true = np.array(list(accumulate(way, compose, initial=start)))
    steps = np.zeros((count, 4))
    steps[1:] = between(true[:-1], true[1:])
    return true, steps


def test_a_pass_follows_the_camera(rng):
    true, steps = walk(12)
    filter_ = filter_of(scattered(rng, 3000), rng, most=3000)
    run = run_pass(filter_, true, steps, range(12))
    error = run.modes[0] - true[-1]
    assert np.linalg.norm(error[:3]) < 0.12
    assert abs(float(wrap_angle(error[3]))) < 0.1
    assert run.counts[0] == 3000
    assert run.counts[-1] < 150
    assert run.counts[-1] >= FEWEST
    assert len(run.counts) == 12
    assert run.particles.weights.sum() == pytest.approx(1)
    assert run.record == ()


def test_without_kld_the_number_stays(rng):
    true, steps = walk(6)
    filter_ = filter_of(scattered(rng, 700), rng, replace(OPTIONS, kld=False), most=700)
    assert run_pass(filter_, true, steps, range(6)).counts == (700,) * 6


def test_steps_are_taken_between_frames_not_before_the_first(rng):
    true, steps = walk(8)
    still = replace(OPTIONS, motion=MotionNoise(0, 0, 0, 0))
    filter_ = filter_of(np.tile(true[0], (FEWEST, 1)), rng, still)
    run = run_pass(filter_, true, steps, range(8))
    np.testing.assert_allclose(run.particles.poses, np.tile(true[-1], (FEWEST, 1)), atol=1e-12)


def kidnapped(rng, options):
    """A camera carried 8 m away after frame 9; poses from elsewhere are drawn around the truth."""
    true, steps = walk(20, step=(0.05, 0, 0, 0))
    true = true.copy()
    true[10:, 0] += 8.0
    asked = []

    def elsewhere(t, count):
        asked.append((t, count))
        return true[t] + rng.normal(size=(count, 4)) * SPREAD

    start = true[0] + rng.normal(size=(100, 4)) * SPREAD
    filter_ = filter_of(start, rng, options, most=200)
    run = run_pass(filter_, true, steps, range(20), elsewhere)
    return np.linalg.norm(run.modes[0, :2] - true[-1, :2]), asked, run


def test_a_kidnapped_camera_is_found_again(rng):
    distance, asked, run = kidnapped(rng, OPTIONS)
    assert distance < 0.2
    # asked about the frame before that at hand, since all take the step to it
    assert asked[0] == (10, 21)
    assert all(count == 21 for _, count in asked)
    assert max(run.counts) <= 200
    distance, asked, _ = kidnapped(rng, replace(OPTIONS, injection=0.0))
    assert distance > 5
    assert not asked


def test_nothing_is_injected_while_all_is_well(rng):
    true, steps = walk(12)
    asked = []
    filter_ = filter_of(true[0] + rng.normal(size=(200, 4)) * SPREAD, rng)
    run_pass(filter_, true, steps, range(12), lambda t, n: asked.append((t, n)))
    assert not asked


def test_frames_that_are_not_scored_only_move_particles(rng):
    true, steps = walk(6)
    asked = []

    def scorer(poses, view):
        asked.append(view)
        return near(poses, view)

    filter_ = filter_of(scattered(rng, 900), rng, replace(OPTIONS, burn_in=2), scorer, most=900)
    run = run_pass(filter_, true, steps, range(6))
    np.testing.assert_array_equal(asked, true[2:])
    assert run.counts[:3] == (900,) * 3  # nothing is drawn anew before anything was said


def test_the_only_frame_is_always_scored(rng):
    true, steps = walk(1)
    filter_ = filter_of(scattered(rng, 500), rng, replace(OPTIONS, burn_in=1))
    run = run_pass(filter_, true, steps, range(1))
    np.testing.assert_array_equal(run.modes[0], run.particles.poses[run.particles.weights.argmax()])


def test_injection_at_every_fifth_frame(rng):
    true, steps = walk(12)
    asked = []

    def elsewhere(t, count):
        asked.append((t, count))
        return scattered(rng, count)

    options = replace(OPTIONS, inject_every=5, kld=False)
    run_pass(filter_of(scattered(rng, 400), rng, options), true, steps, range(12), elsewhere)
    assert asked == [(4, 40), (9, 40)]  # a tenth, before frames 5 and 10


def test_modes_of_all_frames_of_a_pass(rng):
    first, second = np.array([0, 0, 1.6, 0.0]), np.array([3.0, 0, 1.6, 0])
    views, steps = np.array([first, second, second, second]), np.zeros((4, 4))
    start = np.repeat([first, second], 200, axis=0)
    still = replace(PAPER, modes=2, min_particles=2000, motion=MotionNoise(0, 0, 0, 0))
    wide = np.array([1.5, 1.5, 1.5, 1.5])  # a likelihood ratio of e^2
    masses = {}
    for pooled in (False, True):
        filter_ = filter_of(
            start, rng, replace(still, pool_modes=pooled), lambda p, view: near(p, view, wide)
        )
        run = run_pass(filter_, views, steps, range(4))
        np.testing.assert_allclose(run.modes, [second, first], atol=1e-9)
        masses[pooled] = run.masses
    odds = np.exp([-2.0, 2.0, 4.0])  # of the second place, after one, three and four frames
    assert masses[False][1] == pytest.approx(1 / (1 + odds[2]), abs=0.02)
    np.testing.assert_allclose(masses[True], [1 / (1 + 1 / odds[2]), 1 / (1 + odds[0])], atol=0.02)
