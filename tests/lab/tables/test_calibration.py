"""Calibration error on cases that can be worked out by hand."""

import numpy as np
import pytest

from placegraph.errors import OptionError
from placegraph_lab.tables.statistics import reliability


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
