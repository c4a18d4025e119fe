import numpy as np
import pytest

from placegraph.errors import OptionError
from placegraph_lab.tables.statistics import paired_interval, reliability, wilson_interval


def test_intervals_hold_the_truth_as_often_as_they_say():
    rng, held = np.random.default_rng(1), 0
    for _ in range(200):
        hard = rng.random(150)  # a hard query is hard for both
        a, b = hard < 0.6, hard + 0.2 * rng.random(150) - 0.1 < 0.5
        found = paired_interval([(a, b)], rng, rounds=400)
        assert found.low <= found.mean <= found.high
        held += found.low <= 0.1 <= found.high
    assert 0.89 <= held / 200 <= 0.99


def test_other_queries_are_refused():
    rng = np.random.default_rng(0)
    for bad in ([], [(np.ones(3), np.ones(4))], [(np.ones(0), np.ones(0))]):
        with pytest.raises(OptionError):
            paired_interval(bad, rng)


@pytest.mark.parametrize(
    ("share", "count", "low", "high"),
    [
        (1.0, 4, 0.510, 1.0),
        (0.75, 4, 0.301, 0.954),
        (0.5, 100, 0.404, 0.596),
        (0.0, 20, 0.0, 0.161),
    ],
)
def test_wilsons_interval(share, count, low, high):
    assert wilson_interval(share, count)[1:] == pytest.approx((low, high), abs=5e-4)


def test_calibrated_answers_reach_the_floor(rng):
    confidence = rng.random(20_000)
    right = rng.random(20_000) < confidence
    bins = reliability(confidence, right)
    assert bins.error < 0.02
    errors = []
    for _ in range(200):
        few = rng.random(500)
        errors.append(reliability(few, rng.random(500) < few).error)
    assert np.mean(errors) == pytest.approx(reliability(few, few > 0.5).floor, rel=0.15)


@pytest.mark.parametrize(
    ("confidence", "right"), [([], []), ([1.2], [True]), ([np.nan], [True]), ([0.5], [True, False])]
)
def test_nonsense_is_refused(confidence, right):
    with pytest.raises(OptionError):
        reliability(confidence, right)
