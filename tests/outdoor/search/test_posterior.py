"""Probabilities over the whole city: they add up, modes stand apart, nonsense lies elsewhere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.outdoor.search.posterior import (
    APART,
    ELSEWHERE,
    WITHIN,
    Posterior,
    modes,
    posterior,
)

SPACING = 6.67

places = st.lists(
    st.tuples(st.integers(-30, 30), st.integers(-30, 30), st.floats(-12, 12)),
    min_size=1,
    max_size=40,
    unique_by=lambda p: p[:2],
)


def found_of(drawn, unscored=-50.0, step=20.0):
    """Posterior of viewpoints (column, row, score) on a grid."""
    drawn = np.array(drawn, float)
    prior = np.full(len(drawn), -np.log(len(drawn)))
    return posterior(step * drawn[:, :2], drawn[:, 2], prior, unscored)


@given(places, st.floats(-50, 5))
def test_probabilities_add_up(drawn, unscored):
    found = found_of(drawn, unscored)
    assert (found.probabilities >= 0).all()
    total = found.probabilities.sum() + found.elsewhere
    assert total <= 1 + 1e-9
    if unscored < -40:
        assert total == pytest.approx(1.0)


@given(places)
def test_it_is_bayes_rule(drawn):
    found = found_of(drawn, -np.inf)
    weights = np.array([(1 - ELSEWHERE) * np.exp(s) / len(drawn) for _, _, s in drawn])
    total = weights.sum() + ELSEWHERE
    np.testing.assert_allclose(found.probabilities, weights / total, rtol=1e-9)
    assert found.elsewhere == pytest.approx(ELSEWHERE / total)


@given(places, st.integers(1, 8))
def test_modes(drawn, top):
    found = found_of(drawn)
    peaks = modes(found, top, SPACING)
    assert len(peaks) <= top
    probabilities = [m.probability for m in peaks]
    assert probabilities == sorted(probabilities, reverse=True)
    assert all(0 < p <= 1 for p in probabilities)
    assert sum(probabilities) <= found.probabilities.sum() + 1e-9
    for i, mode in enumerate(peaks):
        assert np.isfinite(mode.position).all()
        low, high = found.positions.min(axis=0), found.positions.max(axis=0)
        assert (low - 1e-6 <= mode.position).all()
        assert (mode.position <= high + 1e-6).all()
        np.testing.assert_allclose(mode.covariance, mode.covariance.T, atol=1e-9)
        assert np.linalg.eigvalsh(mode.covariance).min() >= SPACING**2 / 12
        for other in peaks[:i]:
            assert np.hypot(*(mode.position - other.position)) > 5.0, "one place is one mode"


@given(places)
def test_the_first_mode_holds_the_heaviest_surroundings(drawn):
    found = found_of(drawn)
    heaviest = max(
        found.probabilities[np.hypot(*(found.positions - p).T) <= APART].sum()
        for p in found.positions
    )
    assert modes(found, 1, SPACING)[0].probability >= 0.6 * heaviest


def test_a_mode_is_where_its_probability_is():
    found = Posterior(
        np.array([[0.0, 0.0], [20.0, 0.0], [1000.0, 0.0]]), np.array([0.3, 0.3, 0.2]), 0.2
    )
    first, second = modes(found, 5, SPACING)
    np.testing.assert_allclose(first.position, (10, 0))
    assert first.probability == pytest.approx(0.6)
    assert first.covariance[0, 0] == pytest.approx(100 + SPACING**2 / 12 + 1)
    np.testing.assert_allclose(second.position, (1000, 0))
    assert second.probability == pytest.approx(0.2)


def test_probability_is_of_lying_within():
    ring = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0, 2 * np.pi, 60)])
    found = Posterior(
        np.concatenate([0.5 * WITHIN * ring, 2.5 * WITHIN * ring]), np.full(120, 1 / 120), 0.0
    )
    best = modes(found, 20, SPACING)[0]
    distance = np.hypot(*(found.positions - best.position).T)
    assert best.probability == pytest.approx(
        found.probabilities[distance <= WITHIN].sum(), abs=0.02
    )


def test_no_place_at_all():
    nothing = Posterior(np.zeros((0, 2)), np.zeros(0), 1.0)
    assert modes(nothing, 5, SPACING) == []
    none = Posterior(np.zeros((3, 2)), np.zeros(3), 1.0)
    assert modes(none, 5, SPACING) == []


def test_what_was_not_scored_counts():
    sure = [(-50, 0, 12.0), (50, 50, 0.0)]
    best = modes(found_of(sure), 1, SPACING)[0].probability
    assert best > 0.9
    doubtful = modes(found_of(sure, unscored=12.0), 1, SPACING)[0].probability
    assert doubtful < 0.5


@given(places, st.floats(-1e3, 1e3))
def test_extreme_scores_do_not_overflow(drawn, shift):
    found = found_of([(x, y, s + shift) for x, y, s in drawn])
    assert np.isfinite(found.probabilities).all()
    assert 0 <= found.elsewhere <= 1
    for mode in modes(found, 5, SPACING):
        assert np.isfinite(mode.covariance).all()
