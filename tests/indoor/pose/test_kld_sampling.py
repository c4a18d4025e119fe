"""Particles: log weights, effective size, Fox's bound, resampling, modes and moments."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import wrap_angle
from placegraph.indoor.likelihood.score import log_sum
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.pose.local_fit import moments
from placegraph.indoor.pose.particle_filter import Particles, kld_bound, kld_count, resample
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


OPTIONS = FilterOptions()


def bound(bins):
    return kld_bound(bins, OPTIONS.kld_error, OPTIONS.kld_confidence)


def test_bins_of_yaw_close_the_circle():
    poses = np.zeros((6, 4))
    poses[:, 3] = np.deg2rad(5.0) + 2 * np.pi * np.arange(-3, 3)
    assert kld_count(Particles.uniform(poses), OPTIONS) == 1
    poses = np.zeros((1000, 4))
    poses[:, 3] = np.linspace(-7, 7, 1000)
    assert kld_count(Particles.uniform(poses), OPTIONS) == bound(36)


def test_weightless_particles_are_never_drawn(rng):
    particles = of_weights([0, 1, 0, 1, 0], np.arange(5)[:, None] * np.ones(4))
    for _ in range(50):
        drawn = resample(particles, 7, rng)
        assert set(drawn.poses[:, 0].tolist()) <= {1, 3}


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
