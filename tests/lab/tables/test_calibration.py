"""Calibration error on cases that can be worked out by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import OptionError
from placegraph_lab.tables.statistics import reliability


def test_sure_and_right_or_sure_and_wrong():
    assert reliability(np.ones(50), np.ones(50, bool)).error == 0.0
    assert reliability(np.ones(50), np.zeros(50, bool)).error == 1.0
    assert reliability(np.full(50, 0.8), np.zeros(50, bool)).error == pytest.approx(0.8)


def test_two_bins_by_hand():
    confidence = [0.1, 0.2, 0.7, 0.9]
    bins = reliability(confidence, [False, True, True, True], bins=2)
    assert bins.confidence == pytest.approx([0.15, 0.8])
    assert bins.accuracy == pytest.approx([0.5, 1.0])
    assert bins.error == pytest.approx(0.5 * 0.35 + 0.5 * 0.2)


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


@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=60))
def test_bins_hold_every_answer_once_and_rise(answers):
    confidence, right = np.array([a for a, _ in answers]), np.array([b for _, b in answers])
    bins = reliability(confidence, right)
    assert bins.count.sum() == len(answers)
    assert np.ptp(bins.count) <= 1
    assert (np.diff(bins.confidence) >= -1e-12).all()
    assert 0.0 <= bins.error <= 1.0
    assert np.average(bins.accuracy, weights=bins.count) == pytest.approx(right.mean())


@pytest.mark.parametrize(
    ("confidence", "right"), [([], []), ([1.2], [True]), ([np.nan], [True]), ([0.5], [True, False])]
)
def test_nonsense_is_refused(confidence, right):
    with pytest.raises(OptionError):
        reliability(confidence, right)
