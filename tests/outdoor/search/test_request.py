import numpy as np
import pytest

from placegraph.outdoor.search.request import LocationPrior, Route


@pytest.fixture
def positions(harbour):
    return harbour.views.positions.astype(np.float64)


def test_nothing_known_is_uniform(positions):
    prior = LocationPrior()
    assert not prior.is_informative
    assert np.ptp(prior.evaluate(positions)) == 0
    assert np.exp(prior.evaluate(positions)).sum() == pytest.approx(1.0)


@pytest.mark.parametrize("radius", [10.0, 100.0, 1000.0, 1e5])
def test_near_shifts_probability_within_the_map(radius, positions):
    near = positions[len(positions) // 2] + 3.0
    prior = LocationPrior(near=near, radius=radius)
    assert prior.is_informative
    weights = np.exp(prior.evaluate(positions))
    assert weights.sum() == pytest.approx(1.0, abs=0.1)
    order = np.argsort(np.hypot(*(positions - near).T))
    assert (np.diff(weights[order]) <= 1e-12).all()


def test_half_lies_within_the_radius(rng):
    wide = rng.uniform(-3000, 3000, (40_000, 2))
    weights = np.exp(LocationPrior(near=np.zeros(2), radius=500.0).evaluate(wide))
    within = weights[np.hypot(*wide.T) <= 500.0].sum() / weights.sum()
    assert within == pytest.approx(0.5, abs=0.03)


def test_near_beyond_the_map_is_mostly_off_it(positions):
    far = positions.max(axis=0) + 2000.0
    total = [
        np.exp(LocationPrior(near=far, radius=r).evaluate(positions)).sum()
        for r in (300.0, 1000.0, 1e5)
    ]
    assert total == sorted(total)
    assert total[0] < 1e-6
    assert total[-1] > 0.9


def test_the_way_from_a_listener(positions):
    listener = positions.mean(axis=0)
    north = LocationPrior(listener=listener, routes=(Route(0.0, 0.5, 1.0),)).evaluate(positions)
    delta = positions - listener
    ahead = (delta[:, 1] > 100) & (np.abs(delta[:, 0]) < 50)
    behind = (delta[:, 1] < -100) & (np.abs(delta[:, 0]) < 50)
    assert north[ahead].min() > north[behind].max() + 1
    unsure = LocationPrior(listener=listener, routes=(Route(0.0, 0.5, 0.2),)).evaluate(positions)
    assert np.ptp(unsure) < np.ptp(north)
    assert np.isfinite(north).all()


def test_a_distance_on_the_way_is_where_the_prior_peaks():
    east = np.column_stack([np.arange(0.0, 60_000.0, 20.0), np.zeros(3000)])
    way = Route(np.pi / 2, 0.3, 0.7, 1000.0)
    prior = LocationPrior(listener=np.zeros(2), routes=(way,)).evaluate(east)
    assert np.isfinite(prior).all()
    assert east[np.argmax(prior), 0] == pytest.approx(1000.0, abs=200.0)
