"""Modes fitted to a sequence: on likelihoods whose peaks are known, and on a rendered walk."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.indoor.conftest import view_frames

from placegraph.core.geometry import compose, split_pose, wrap_angle
from placegraph.indoor.encode.labels import InstancesEncoder
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.options import MotionNoise, PoseSearchOptions
from placegraph.indoor.pose.covariance import bound_covariance, pose_covariance
from placegraph.indoor.pose.local_fit import (
    NARROWEST,
    SPREAD,
    WIDENED,
    FitLevel,
    fit_modes,
    probabilities,
)
from placegraph.indoor.pose.particle_filter import Particles, heaviest_modes
from placegraph.indoor.pose.window import Chain, level_poses

pytestmark = pytest.mark.usefixtures("one_thread")


class Hills:
    """A scorer whose log-likelihood is the highest of some paraboloids; it counts what it is asked."""

    def __init__(self, *hills):
        self.hills = hills  # (pose, height, standard deviations)
        self.asked = []

    def together(self, poses, _views, _steps):
        self.asked.append(poses.copy())
        values = []
        for pose, height, spread in self.hills:
            error = poses - pose
            error[:, 3] = wrap_angle(error[:, 3])
            values.append(height - 0.5 * np.sum((error / spread) ** 2, axis=1))
        return np.max(values, axis=0)


ALONE = Chain.of(np.zeros((1, 4)), MotionNoise())
"""The odometry of a single frame."""


def level(rounds=4, most=6, gap=60.0):
    return FitLevel(ALONE, np.array([0]), [None], rounds, most, gap)


PEAK = np.array([2.0, -1.0, 1.6, 3.1])  # its yaws lie on both sides of the half turn
NARROW = np.array([0.02, 0.03, 0.02, 0.01])


def error_of(fit, peak=PEAK):
    error = fit.pose - peak
    return np.append(error[:3], wrap_angle(error[3]))


@given(st.integers(0, 2**32 - 1), st.floats(0.3, 4))
@settings(max_examples=40)
def test_a_mode_climbs_its_hill(seed, sharpness):
    rng = np.random.default_rng(seed)
    spread = SPREAD / 2.0**sharpness
    hills = Hills((PEAK, 100.0, spread))
    start = PEAK + rng.uniform(-1.2, 1.2, 4) * SPREAD
    (fit,) = fit_modes(hills, start[None], [level(), level()], rng)
    assert np.abs(error_of(fit) / SPREAD).max() < 0.5
    assert fit.log_likelihood > 98
    first = hills.together(start[None], None, None)[0]
    assert fit.log_likelihood >= first


class Ridge(Hills):
    """A hill on which a step aside and a turn cancel, as before a far wall."""

    def together(self, poses, _views, _steps):
        error = (poses - PEAK) / SPREAD
        across, along = error[:, 1] + error[:, 3], error[:, 1] - error[:, 3]
        squares = 4e4 * across**2 + 400 * along**2 + 400 * error[:, 0] ** 2 + 400 * error[:, 2] ** 2
        return 100.0 - 0.5 * squares


@pytest.mark.parametrize("seed", range(5))
def test_a_mode_follows_a_ridge(seed):
    start = PEAK + np.array([0.0, 1.0, 0.0, -1.0]) * SPREAD
    (fit,) = fit_modes(Ridge(), start[None], [level()] * 3, np.random.default_rng(seed))
    assert fit.log_likelihood > 99


def test_fits_are_as_good_as_they_say(rng):
    hills = Hills((PEAK, 100.0, NARROW))
    (fit,) = fit_modes(hills, PEAK[None] + SPREAD, [level(), level()], rng)
    at_pose = hills.together(fit.pose[None], None, None)[0]
    assert fit.log_likelihood - at_pose <= 1.0
    assert (fit.spread >= NARROWEST).all()
    assert (fit.spread < SPREAD).all()


def test_the_best_of_several_comes_first(rng):
    other = np.array([-3.0, 0, 1.6, 0])
    third = np.array([0.0, 4.0, 1.6, -2.0])
    hills = Hills((PEAK, 80.0, NARROW), (other, 100.0, NARROW), (third, 70.0, NARROW))
    starts = np.stack([PEAK, PEAK + 0.05, third, other]) + SPREAD / 2
    fits = fit_modes(hills, starts, [level(), level()], rng)
    assert len(fits) == 3  # two starts led to one place
    for fit, peak, height in zip(fits, (other, PEAK, third), (100, 80, 70), strict=True):
        assert np.abs(error_of(fit, peak)).max() < 0.06
        assert fit.log_likelihood == pytest.approx(height, abs=2)


def test_places_on_opposite_headings_are_two(rng):
    turned = PEAK + np.array([0, 0, 0, np.pi])
    hills = Hills((PEAK, 50.0, NARROW), (turned, 49.0, NARROW))
    fits = fit_modes(hills, np.stack([turned, PEAK]), [level()], rng)
    assert len(fits) == 2
    assert abs(wrap_angle(fits[0].pose[3] - fits[1].pose[3])) > 3


def test_hopeless_modes_are_left_but_not_forgotten(rng):
    far = np.array([-3.0, 0, 1.6, 0])
    hills = Hills((PEAK, 500.0, NARROW), (far, 20.0, NARROW))
    start = PEAK + SPREAD
    fits = fit_modes(hills, np.stack([far, start]), [level(gap=60.0), level()], rng)
    assert [f.log_likelihood > 400 for f in fits] == [True, False]
    behind = hills.together(start[None], None, None)[0] - 20
    assert fits[0].log_likelihood - fits[1].log_likelihood == pytest.approx(behind, abs=1e-6)
    np.testing.assert_array_equal(fits[1].pose, far)
    near_far = [np.abs(p[:, 0] + 3).min() < 1 for p in hills.asked[1:-1]]
    assert not any(near_far)


def test_only_so_many_modes_take_part(rng):
    peaks = [np.array([3.0 * i, 0, 1.6, 0]) for i in range(6)]
    hills = Hills(*((p, 100.0 - i, NARROW) for i, p in enumerate(peaks)))
    fits = fit_modes(hills, np.stack(peaks), [level(most=2)], rng)
    assert len(fits) == 6
    polished = [not np.allclose(f.spread, SPREAD) for f in fits]
    assert polished == [True, True, False, False, False, False]
    values = [f.log_likelihood for f in fits]
    assert values == sorted(values, reverse=True)


def test_probabilities_by_hand():
    got = probabilities(np.array([0.0, -np.log(4.0) * 3]), 3.0)
    np.testing.assert_allclose(got, [0.8, 0.2])
    assert probabilities(np.array([-5.0]), 2.0).tolist() == [1.0]


def test_what_is_badly_known_has_a_large_variance(rng):
    spread = np.array([0.01, 0.1, 0.02, 0.005])  # along a corridor, say
    (fit,) = fit_modes(Hills((PEAK, 100.0, spread)), PEAK[None] + 0.02, [level(), level()], rng)
    covariance = pose_covariance(fit.covariance, 0.0) / WIDENED
    np.testing.assert_allclose(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0
    sd = np.sqrt(np.diag(covariance))[[0, 1, 2, 5]]
    assert sd[1] > 3 * sd[0]
    # of the order of the likelihood's own: the samples lie about where it is high
    assert (sd[:3] > 0.5 * np.maximum(spread, NARROWEST)[:3]).all()
    assert (sd < 4 * np.maximum(spread, 2 * NARROWEST)).all()


def test_no_pose_is_known_without_error(rng):
    (fit,) = fit_modes(Hills((PEAK, 1e6, NARROW / 100)), PEAK[None], [level()], rng)
    assert (np.diag(pose_covariance(fit.covariance))[[0, 1, 2, 5]] >= NARROWEST**2).all()


def test_the_heaviest_particle_is_the_estimate(rng):
    """Sec. 3.5: one pose; how likely and how exact, the particles about it say."""
    rival = PEAK + np.array([2.0, 0, 0, 0])
    poses = np.concatenate([PEAK + NARROW * rng.normal(size=(300, 4)), rival[None].repeat(100, 0)])
    logs = np.log(np.append(rng.uniform(0.5, 1.0, 300), np.full(100, 0.2)))
    particles, _ = Particles.uniform(poses).reweight(logs)
    best = particles.weights.argmax()
    (fit,) = heaviest_modes(ALONE, particles, 1)
    np.testing.assert_array_equal(fit.pose, poses[best])
    assert np.exp(fit.log_likelihood) == pytest.approx(particles.weights[:300].sum())
    away = poses[:300] - poses[best]
    away[:, 3] = wrap_angle(away[:, 3])
    share = particles.weights[:300] / particles.weights[:300].sum()
    expected = (away * share[:, None]).T @ away + np.diag(NARROWEST**2)
    np.testing.assert_allclose(fit.covariance, expected, rtol=1e-9)
    both = heaviest_modes(ALONE, particles, 5)
    np.testing.assert_allclose([f.pose for f in both], [poses[best], rival], rtol=1e-12)
    assert sum(np.exp(f.log_likelihood) for f in both) == pytest.approx(1.0)


def test_a_walk_is_fitted_to_centimetres(room, walk, truth, rng):
    options = PoseSearchOptions()
    seen = view_frames(room, walk, options, InstancesEncoder(room))
    chain = Chain.of(level_poses(walk.odometry, walk.gravity), options.motion)
    rig = FitLevel(chain, np.arange(len(seen)), seen, 5, 4, 60.0)
    true = split_pose(truth(walk)[-1])[0]
    start = compose(true, np.array([0.15, -0.1, 0.05, 0.05]))
    scorer = Scorer(room, options.likelihood)
    fits = fit_modes(scorer, np.stack([start, compose(start, [1, 0, 0, 0])]), [rig], rng)
    assert np.linalg.norm(error_of(fits[0], true)[:3]) < 0.05
    assert abs(error_of(fits[0], true)[3]) < np.deg2rad(2.5)
    sd = np.sqrt(np.diag(pose_covariance(fits[0].covariance, 0.0) / WIDENED))[[0, 1, 2, 5]]
    assert (sd < [0.15, 0.15, 0.15, 0.1]).all()


@given(st.integers(0, 2**32 - 1))
def test_a_refined_pose_is_nowhere_known_less_than_the_coarse_one(seed):
    rng = np.random.default_rng(seed)
    refined, coarse = ((a := rng.normal(size=(6, 6))) @ a.T + 0.01 * np.eye(6) for _ in range(2))
    shift = rng.normal(size=3)
    bound = bound_covariance(refined, coarse, shift)
    coarse[:3, :3] += np.outer(shift, shift)
    for looser in (refined, coarse):
        assert np.linalg.eigvalsh(looser - bound).min() > -1e-9
    np.testing.assert_allclose(bound_covariance(bound, coarse, 0.0 * shift), bound, atol=1e-9)
    np.testing.assert_allclose(bound_covariance(9.0 * coarse, coarse, 0.0 * shift), coarse)
