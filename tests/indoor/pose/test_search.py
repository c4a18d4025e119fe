"""Seeds: poses that fill a box around what the table found."""

import math

import numpy as np
import pytest

from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.pose.search import around

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = PoseSearchOptions()


def test_poses_fill_a_box_around_each_seed(rng):
    seeds = np.array([[1.0, 2.0, 1.6, 0.5], [-3, 0, 1.2, 3.0]])
    got = around(seeds, 4000, 0.4, 0.15, rng)
    assert got.shape == (8000, 4)
    for i, seed in enumerate(seeds):
        own = got[4000 * i : 4000 * (i + 1)] - seed
        np.testing.assert_array_equal(own[0], 0)  # the seed itself takes part
        limits = np.array([0.2, 0.2, 0.2, 0.15])
        assert (np.abs(own) <= limits).all()
        np.testing.assert_allclose(own.std(axis=0), limits / math.sqrt(3), rtol=0.05)
    assert around(np.zeros((0, 4)), 5, 1.0, 1.0, rng).shape == (0, 4)
    np.testing.assert_array_equal(around(seeds, 1, 0.4, 0.1, rng), seeds)
