"""Particles: log weights, effective size, Fox's bound, resampling, modes and moments."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2

from placegraph.core.geometry import wrap_angle
from placegraph.indoor.likelihood.score import log_sum
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.pose.local_fit import moments
from placegraph.indoor.pose.particle_filter import BIN, Particles, kld_bound, kld_count, resample
from placegraph.indoor.pose.search import select_distinct

seeds = st.integers(0, 2**32 - 1)
logs = st.lists(st.floats(-1e4, 1e4), min_size=1, max_size=40).map(np.array)


def of_weights(weights, poses=None):
    """Particles of weights (N,) of any sum."""
    weights = np.array(weights, float)
    poses = np.zeros((len(weights), 4)) if poses is None else np.array(poses, float)
    with np.errstate(divide="ignore"):
        return Particles(poses, np.log(weights / weights.sum()))


@given(logs)
def test_sums_of_logs(values):
    top = values.max()
    expected = top + math.log(math.fsum(np.exp(values - top)))
    assert log_sum(values) == pytest.approx(expected, abs=1e-9)
    # whatever is added to all comes out again: no overflow, no underflow
    assert log_sum(values + 1e5) == pytest.approx(log_sum(values) + 1e5, rel=1e-12)


@given(seeds, st.integers(2, 50), st.floats(-1e5, 1e5))
def test_observations_multiply_weights(seed, count, offset):
    """Bayes' rule, in whatever units of likelihood; the evidence is the mean likelihood."""
    rng = np.random.default_rng(seed)
    particles = of_weights(rng.random(count) + 0.01)
    likelihoods = rng.normal(0, 3, count)
    got, evidence = particles.reweight(likelihoods + offset)
    posterior = particles.weights * np.exp(likelihoods)
    np.testing.assert_allclose(got.weights, posterior / posterior.sum(), rtol=1e-6, atol=1e-12)
    assert evidence == pytest.approx(math.log(posterior.sum()) + offset, abs=1e-6)
    assert got.poses is particles.poses
    assert 1 - 1e-9 <= got.effective() <= count + 1e-9
    assert got.effective() == pytest.approx(1 / (got.weights**2).sum(), rel=1e-6)


def test_effective_size_counts_those_that_matter():
    for weights, count in (([1] * 8, 8), ([1, 1, 1, 0, 0], 3), ([1, 0, 0], 1)):
        assert of_weights(weights).effective() == pytest.approx(count)
    assert Particles.uniform(np.zeros((8, 4))).effective() == pytest.approx(8)
    assert len(Particles.uniform(np.zeros((0, 4)))) == 0


@pytest.mark.parametrize("bins", [2, 5, 11, 51, 201, 1001])
@pytest.mark.parametrize("confidence", [0.95, 0.99])
def test_bound_is_half_a_chi_square_quantile(bins, confidence):
    """Fox 2001, Eq. 6-7: n = chi2(k - 1, 1 - delta) / (2 epsilon)."""
    exact = chi2.ppf(confidence, bins - 1) / (2 * 0.05)
    # Wilson and Hilferty's approximation; poorest for one degree of freedom
    got = kld_bound(bins, 0.05, confidence)
    assert got == pytest.approx(exact, rel=0.04 if bins == 2 else 0.011, abs=1)


OPTIONS = FilterOptions()


def bound(bins):
    return kld_bound(bins, OPTIONS.kld_error, OPTIONS.kld_confidence)


def test_bins_are_counted_by_weight(rng):
    centres = (np.arange(10)[:, None] + 0.5) * BIN  # ten bins
    poses = np.repeat(centres, 10, axis=0) + rng.uniform(-0.4, 0.4, (100, 4)) * BIN
    assert kld_count(Particles.uniform(poses), OPTIONS) == bound(10)
    # bins whose weight is less than half a particle's would be drawn from by chance alone
    weights = np.ones(100)
    weights[30:] = 0.01
    assert kld_count(of_weights(weights, poses), OPTIONS) == bound(3)
    weights[35] = 3.0
    assert kld_count(of_weights(weights, poses), OPTIONS) == bound(4)
    assert kld_count(of_weights([1], [[1, 2, 3, 4]]), OPTIONS) == 1


def test_every_axis_has_bins():
    for axis in range(4):
        poses = np.tile(BIN / 2, (7, 1))
        poses[:, axis] += np.arange(7) * BIN[axis]
        assert kld_count(Particles.uniform(poses), OPTIONS) == bound(7)


def test_bins_of_yaw_close_the_circle():
    poses = np.zeros((6, 4))
    poses[:, 3] = np.deg2rad(5.0) + 2 * np.pi * np.arange(-3, 3)
    assert kld_count(Particles.uniform(poses), OPTIONS) == 1
    poses = np.zeros((1000, 4))
    poses[:, 3] = np.linspace(-7, 7, 1000)
    assert kld_count(Particles.uniform(poses), OPTIONS) == bound(36)


@given(seeds, st.integers(1, 40), st.integers(1, 200))
def test_stratified_resampling_is_nearly_fair_every_time(seed, size, count):
    rng = np.random.default_rng(seed)
    weights = rng.random(size) ** 4
    particles = of_weights(weights, np.arange(size)[:, None] * np.ones(4))
    drawn = resample(particles, count, rng)
    assert len(drawn) == count
    np.testing.assert_allclose(drawn.log_weights, -math.log(count))
    times = np.bincount(drawn.poses[:, 0].astype(int), minlength=size)
    share = particles.weights * count
    assert (np.abs(times - share) < 2).all()


def test_weightless_particles_are_never_drawn(rng):
    particles = of_weights([0, 1, 0, 1, 0], np.arange(5)[:, None] * np.ones(4))
    for _ in range(50):
        drawn = resample(particles, 7, rng)
        assert set(drawn.poses[:, 0].tolist()) <= {1, 3}


def test_distinct_by_hand():
    poses = np.array(
        [
            [0, 0, 0, 0],
            [0.5, 0, 0, 0.1],  # near the first
            [2, 0, 0, 0],
            [0.1, 0, 0, np.pi / 2],  # there, but turned
            [2, 0, 0.9, 0],  # another height
            [2.2, 0.2, 0, -0.3],  # near the third
        ],
        float,
    )
    scores = np.array([5.0, 6.0, 1.0, 2.0, 0.5, 3.0])
    assert select_distinct(poses, scores, 8).tolist() == [1, 5, 3, 4]
    assert select_distinct(poses, scores, 2).tolist() == [1, 5]
    assert select_distinct(poses, scores, 8, apart=0.01, turned=0.01).tolist() == [1, 0, 5, 3, 2, 4]
    assert select_distinct(np.zeros((0, 4)), np.zeros(0), 8).tolist() == []
    across = np.array([[0, 0, 0, 3.1], [0, 0, 0, -3.1]])  # the half turn
    assert len(select_distinct(across, np.zeros(2), 8)) == 1


@given(seeds, st.integers(1, 60), st.integers(1, 10))
def test_modes_are_apart_and_cover_what_they_left_out(seed, size, most):
    rng = np.random.default_rng(seed)
    poses = rng.uniform((-2, -2, 1, -np.pi), (2, 2, 2, np.pi), (size, 4))
    scores = rng.integers(0, 10, size).astype(float)
    rows = select_distinct(poses, scores, most, apart=0.7, turned=0.6)
    assert rows[0] == scores.argmax()
    assert (np.diff(scores[rows]) <= 0).all()
    assert 1 <= len(rows) <= most

    def near(a, b):
        close = np.linalg.norm(poses[a, :3] - poses[b, :3]) <= 0.7
        return close and abs(float(wrap_angle(poses[a, 3] - poses[b, 3]))) <= 0.6

    for i, a in enumerate(rows):
        assert not any(near(a, b) for b in rows[:i])
    if len(rows) < most:
        for other in set(range(size)) - set(rows.tolist()):
            assert any(near(other, r) and scores[r] >= scores[other] for r in rows)


def test_moments_of_a_gaussian(rng):
    mean = np.array([1.0, -2.0, 1.6, 3.1])  # yaws lie on both sides of the half turn
    root = np.array([[0.3, 0, 0, 0], [0.1, 0.2, 0, 0], [0, 0, 0.05, 0], [0.05, 0, 0, 0.1]])
    poses = mean + rng.normal(size=(50_000, 4)) @ root.T
    poses[:, 3] = wrap_angle(poses[:, 3])
    got, covariance = moments(poses, np.ones(len(poses)))
    assert np.abs(got[:3] - mean[:3]).max() < 0.01
    assert abs(float(wrap_angle(got[3] - mean[3]))) < 0.005
    np.testing.assert_allclose(covariance, root @ root.T, atol=0.003)


def test_weights_are_counts(rng):
    poses, counts = rng.normal(size=(6, 4)), np.array([1, 2, 0, 4, 1, 3])
    got = moments(poses, counts * 0.7)
    expected = moments(np.repeat(poses, counts, axis=0), np.ones(11))
    np.testing.assert_allclose(got[0], expected[0])
    np.testing.assert_allclose(got[1], expected[1])


@given(seeds, st.floats(-10, 10))
def test_turning_all_turns_the_mean(seed, turn):
    rng = np.random.default_rng(seed)
    poses, weights = rng.normal(0, 0.5, (20, 4)), rng.random(20) + 0.01
    mean, covariance = moments(poses, weights)
    turned = poses + np.array([0, 0, 0, turn])
    turned_mean, turned_covariance = moments(turned, weights)
    assert abs(float(wrap_angle(turned_mean[3] - mean[3] - turn))) < 1e-9
    np.testing.assert_allclose(turned_covariance, covariance, atol=1e-9)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12
