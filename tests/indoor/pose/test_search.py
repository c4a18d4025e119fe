"""Seeds of the search; first particles of a pass: around seeds or a prior, or everywhere."""

import math
from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geometry import between, split_pose
from placegraph.errors import OptionError
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.options import FilterOptions, Pass, PoseSearchOptions
from placegraph.indoor.pose.particle_filter import _later, draw_uniform_start
from placegraph.indoor.pose.prior import Prior
from placegraph.indoor.pose.search import (
    draw_near_prior,
    make_rig,
    scatter_poses,
    search,
    select_distinct,
)
from placegraph.indoor.pose.search_kernels import Rig, align_poses
from placegraph.indoor.pose.window import PoseQuery, Window, observe

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = FilterOptions()


def test_poses_about_a_prior(room, rng):
    prior = Prior(2.0, -1.0, z=1.4, yaw=0.7, spread=0.5, turn=0.2)
    got = draw_near_prior(prior, window_of(room, OPTIONS), 20_000, rng)
    np.testing.assert_allclose(got.mean(axis=0), [2.0, -1.0, 1.4, 0.7], atol=0.02)
    np.testing.assert_allclose(got.std(axis=0), [0.5, 0.5, 0.05, 0.2], rtol=0.03)


def test_what_a_prior_leaves_open_is_anything(room, rng):
    got = draw_near_prior(Prior(0.0, 0.0), window_of(room, OPTIONS), 20_000, rng)
    # heights are those of cameras above the floor that is there
    above = got[:, 2] - room.floors[0]
    assert -0.1 < above.min() < 0.2
    assert 2.2 < above.max() < 2.5
    turns = np.histogram(got[:, 3], bins=8, range=(-np.pi, np.pi))[0]
    assert turns.sum() == 20_000
    assert turns.min() > 2200


@pytest.mark.parametrize(
    "change", [{"x": math.nan}, {"z": math.inf}, {"yaw": math.nan}, {"spread": 0}, {"turn": -1}]
)
def test_priors_that_are_none(change):
    with pytest.raises(OptionError, match="prior"):
        Prior(**{"x": 0.0, "y": 0.0} | change)


def window_of(room, options):
    query = PoseQuery(scene=room, options=options)
    return Window(query, Scorer(room, options.likelihood), [])


def test_a_wider_grid_is_as_dense(room, rng, monkeypatch):
    options = FilterOptions(start="uniform", spacing=0.1, per_cell=4, heights=(1.6,))
    table = replace(room.visibility(options), spacing=0.2)
    monkeypatch.setattr(Window, "table", table)
    assert len(draw_uniform_start(window_of(room, options), options, rng)) == 16 * len(table)


def test_later_passes_lie_in_boxes_and_give_every_mode_its_share(rng):
    """Sec. 3.5; of several modes each gets a quarter of an even share at least."""
    spec = Pass(stride=8.0, box=1.6, turn=0.4, particles=4000)
    modes = np.array([[0.0, 0, 1.6, 0], [5, 0, 1.6, 1], [0, 5, 1.6, 2]])
    got = _later(spec, modes, np.array([0.6, 0.2, 0.0]), rng)
    of = np.linalg.norm(got[:, None, :3] - modes[:, :3], axis=2).argmin(axis=1)
    counts = np.bincount(of)
    np.testing.assert_allclose(counts, [1000 / 3 + 2250, 1000 / 3 + 750, 1000 / 3], atol=1)
    assert counts.sum() == 4000, "they add up"
    offset = np.abs(got - modes[of])
    assert (offset <= [0.8, 0.8, 0.8, 0.4]).all()
    assert (offset.max(axis=0) > [0.75, 0.75, 0.75, 0.37]).all()
    one = _later(spec, modes[:1], np.array([1e-9]), rng)
    assert len(one) == 4000


def test_layers_do_not_multiply_cells(room, rng):
    options = FilterOptions(start="uniform", spacing=0.5, per_cell=1, heights=(0.8, 1.6))
    table = room.visibility(options)
    assert table.index.shape[0] > 1
    cells = len(np.unique(table.positions[:, :2], axis=0))
    assert (
        len(draw_uniform_start(window_of(room, options), options, rng)) == 3 * cells
    )  # 1.5 m lies between


def test_poses_fill_a_box_around_each_seed(rng):
    seeds = np.array([[1.0, 2.0, 1.6, 0.5], [-3, 0, 1.2, 3.0]])
    got = scatter_poses(seeds, 4000, 0.4, 0.15, rng)
    assert got.shape == (8000, 4)
    for i, seed in enumerate(seeds):
        own = got[4000 * i : 4000 * (i + 1)] - seed
        np.testing.assert_array_equal(own[0], 0)  # the seed itself takes part
        limits = np.array([0.2, 0.2, 0.2, 0.15])
        assert (np.abs(own) <= limits).all()
        np.testing.assert_allclose(own.std(axis=0), limits / math.sqrt(3), rtol=0.05)
    assert scatter_poses(np.zeros((0, 4)), 5, 1.0, 1.0, rng).shape == (0, 4)
    np.testing.assert_array_equal(scatter_poses(seeds, 1, 0.4, 0.1, rng), seeds)


def test_depth_aligns_poses_from_beyond_a_cell(flat, flat_walk, truth, rng):
    frames = [flat_walk[i] for i in (0, 2)]
    window = window_of_frames(flat, frames)
    steps = between(window.poses[-1], window.poses)
    rig = make_rig(window.views(10.0), steps)
    true = split_pose(truth(flat_walk)[2])[0]
    way = rng.normal(size=(60, 4)) * np.array([1.0, 1.0, 0.4, 0.0])
    way *= 0.4 / np.linalg.norm(way, axis=1, keepdims=True)
    starts = true + way + np.radians([0, 0, 0, 6.0]) * rng.choice([-1.0, 1.0], (60, 1))
    aligned, covariances = align_poses(
        flat.caster.tracer, flat.normals, starts, rig, np.array([0.3, 0.2, 0.1, 0.2, 0.1, 0.05])
    )
    off = np.linalg.norm(aligned[:, :3] - true[:3], axis=1)
    assert np.mean((off < 0.1) & (np.abs(aligned[:, 3] - true[3]) < 0.03)) > 0.6
    close = covariances[off.argmin()]
    np.testing.assert_allclose(close, close.T, atol=1e-9)
    assert (np.sqrt(np.diag(close)) < 0.06).all()
    blind = Rig(rig.origins, rig.directions, np.zeros_like(rig.depths))
    still, free = align_poses(flat.caster.tracer, flat.normals, starts, blind, np.array([0.1]))
    np.testing.assert_array_equal(still, starts)
    np.testing.assert_allclose(free[0], np.diag([0.09, 0.09, 0.04, 0.01]))


def test_one_frame_is_found_to_a_few_centimetres(flat, flat_walk, truth):
    poses, near, ranks = split_pose(truth(flat_walk))[0], [], []
    for i in range(0, len(flat_walk), 3):
        window = window_of_frames(flat, [flat_walk[i]])
        seeds = search(window, np.random.default_rng(0))
        off = np.linalg.norm(seeds[:, :3] - poses[i, :3], axis=1)
        near.append(off.min())
        ranks.append(off.argmin())
        apart = [select_distinct(seeds, -np.arange(len(seeds)), 99, apart=0.2, turned=0.1)]
        assert len(apart[0]) == len(seeds), "no seed twice"
    assert np.median(near) < 0.06
    assert np.mean(np.array(ranks) < 10) > 0.8


def window_of_frames(scene, frames):
    options = PoseSearchOptions().only(depth=True, colour=True)
    return observe(PoseQuery.of(scene, frames, options=options))
