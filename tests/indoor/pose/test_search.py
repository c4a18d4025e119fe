"""First particles: around seeds, around a prior, everywhere; and what scoring them costs."""

import math

import numpy as np
import pytest

from placegraph.errors import MissingExtraError, OptionError
from placegraph.geometry import compose
from placegraph.indoor.likelihood.observe import combine, sight, views
from placegraph.indoor.likelihood.scorer import Scorer
from placegraph.indoor.likelihood.visibility import floor_under
from placegraph.indoor.options import FilterOptions, Likelihood
from placegraph.indoor.pose.search import Prior, around, everywhere, near_prior

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = FilterOptions()


# --------------------------------------------------------------------------------- seeds


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


# --------------------------------------------------------------------------------- prior


def test_poses_about_a_prior(rng):
    prior = Prior(2.0, -1.0, z=1.4, yaw=0.7, spread=0.5, turn=0.2)
    got = near_prior(prior, 0.0, 20_000, OPTIONS, rng)
    np.testing.assert_allclose(got.mean(axis=0), [2.0, -1.0, 1.4, 0.7], atol=0.02)
    np.testing.assert_allclose(got.std(axis=0), [0.5, 0.5, 0.05, 0.2], rtol=0.03)


def test_what_a_prior_leaves_open_is_anything(rng):
    got = near_prior(Prior(0.0, 0.0), 10.0, 20_000, OPTIONS, rng)
    # heights are those of cameras above the floor that is there
    assert got[:, 2].mean() == pytest.approx(11.65, abs=0.01)
    assert 0.1 < got[:, 2].std() < 0.14
    turns = np.histogram(got[:, 3], bins=8, range=(-np.pi, np.pi))[0]
    assert turns.sum() == 20_000
    assert turns.min() > 2200


@pytest.mark.parametrize(
    "change", [{"x": math.nan}, {"z": math.inf}, {"yaw": math.nan}, {"spread": 0}, {"turn": -1}]
)
def test_priors_that_are_none(change):
    with pytest.raises(OptionError, match="prior"):
        Prior(**{"x": 0.0, "y": 0.0} | change)


# ---------------------------------------------------------------------------- everywhere


def test_the_papers_start(room, rng):
    """Sec. 3.1: so many yaws a free cell and height, all over the free floor."""
    options = FilterOptions(start="uniform", spacing=0.4, per_cell=3, heights=(1.5, 1.7))
    table = room.visibility(options)
    floors = floor_under(room, table.positions[:, :2])
    got = everywhere(table, floors, options, rng)
    assert len(got) == len(table) * 2 * 3
    for low, high in zip(got.min(axis=0)[:2], got.max(axis=0)[:2], strict=True):
        assert low < high
    cells = np.floor((got[:, :2] - table.origin) / table.spacing).astype(int)
    free = table.index[0, cells[:, 0], cells[:, 1]]
    assert (np.bincount(free, minlength=len(table)) == 6).all()
    assert np.unique(got[:, 2]).round(3).tolist() == (room.floors[0] + [1.5, 1.7]).round(3).tolist()
    assert (np.abs(got[:, 3]) <= np.pi).all()
    assert np.histogram(got[:, 3], bins=4)[0].min() > len(got) / 8


def test_layers_do_not_multiply_cells(room, rng):
    options = FilterOptions(start="uniform", spacing=0.5, per_cell=1, heights=(0.8, 1.6))
    table = room.visibility(options)
    assert table.index.shape[0] > 1
    floors = floor_under(room, table.positions[:, :2])
    cells = len(np.unique(table.positions[:, :2], axis=0))
    assert len(everywhere(table, floors, options, rng)) == 2 * cells


# -------------------------------------------------------------------------------- scorer


@pytest.fixture(scope="module")
def seen(room, walk):
    around_ = room.visibility(OPTIONS).background
    return views([sight(f, None, OPTIONS) for f in walk[:3]], 20.0, OPTIONS, around_)


def test_scores_are_counted(room, seen):
    scorer = Scorer(room, OPTIONS.likelihood)
    poses = np.array([[2.0, 1.5, 1.6, 0.1], [2.2, 1.5, 1.6, 0.3]])
    terms = scorer.terms(poses, seen[0])
    assert terms.shape == (2, 3)
    assert scorer.poses == 2
    assert scorer.rays == 2 * len(seen[0].directions)
    values = scorer(poses, seen[0])
    np.testing.assert_allclose(values, combine(terms, seen[0].terms, OPTIONS.likelihood))
    assert scorer.poses == 4
    assert scorer.seconds > 0
    assert scorer.device == "cpu"


def test_a_sequence_is_scored_as_a_rig(room, seen):
    """All frames together: each at the pose that odometry leads to."""
    scorer = Scorer(room, OPTIONS.likelihood)
    poses = np.array([[2.0, 1.5, 1.6, 0.1], [2.2, 1.5, 1.6, 0.3]])
    steps = np.array([[0, 0, 0, 0], [0.2, 0.1, 0, 0.3], [-0.1, 0, 0.02, -1.0]])
    expected = sum(scorer(compose(poses, s), v) for s, v in zip(steps, seen, strict=True))
    np.testing.assert_allclose(scorer.together(poses, seen, steps), expected)
    with pytest.raises(ValueError, match="shorter"):
        scorer.together(poses, seen, steps[:2])


@pytest.mark.parametrize("device", ["gpu", "tpu", "", "cuda:x"])
def test_devices_that_are_none(room, device):
    with pytest.raises((OptionError, MissingExtraError), match=r"device is|install"):
        Scorer(room, Likelihood(), device)
