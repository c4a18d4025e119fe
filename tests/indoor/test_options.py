"""Options: what is refused, and what the named recipes are."""

import math
from dataclasses import replace

import numpy as np
import pytest

from placegraph.errors import OptionError
from placegraph.indoor.options import (
    ONE_PASS,
    DepthNoise,
    FilterOptions,
    Likelihood,
    MotionNoise,
    Pass,
    PoseSearchOptions,
    RefineOptions,
)

WRONG = {
    FilterOptions(): [
        {"start": "random"}, {"heights": ()}, {"heights": (1.5, math.nan)}, {"spacing": 0.0},
        {"spacing": math.inf}, {"per_cell": 0}, {"per_cell": 1.5}, {"passes": ()}, {"modes": 0},
        {"modes": 2.5}, {"kld_error": math.nan}, {"kld_confidence": 1.0}, {"injection": 1.0},
        {"injection": -0.1}, {"min_particles": 0}, {"answer": "best"}, {"every": -1.0},
        {"every_metre": math.nan},
    ],
    Likelihood(): [
        {"kind": "laplace"}, {"wrong": 0.0}, {"wrong": 1.0}, {"sharpness": -1.0},
        {"object_patches": 0.0}, {"depth_floor": 0.0}, {"depth_slope": -0.1},
        {"depth_gain": math.nan}, {"depth_clip": math.nan}, {"colour_weight": -1.0}, {"sigma": -1.0},
    ],
    Pass(20.0, 0.4, 0.1, 100): [
        {"stride": 0.0}, {"particles": 0}, {"particles": 99.5}, {"box": -0.4}, {"turn": math.nan},
    ],
    MotionNoise(): [{"translation": -1.0}, {"rotation": math.nan}],
    RefineOptions(): [
        {"views": 0}, {"views": 2.5}, {"views": 1000}, {"readings": -1}, {"least": 0}, {"frames": 0},
        {"frames": 1.5}, {"inlier": 0.0}, {"inlier": math.nan}, {"tilt": 0.0}, {"tilt": -1.0},
        {"tilt": 1e-200}, {"spread": math.inf}, {"spread": 4.0}, {"images": "sometimes"},
        {"images": [1]}, {"images": 1}, {"depth": False, "images": False}, {"depth": "no"},
        {"reach": (-0.1, 0.1)}, {"reach": (0.1, -0.1)}, {"reach": 0.1}, {"reach": (0.1,)},
        {"reach": (0.1, 0.1, 0.1)}, {"reach": (math.inf, 0.1)}, {"reach": (math.nan, 0.1)},
        {"reach": (0.1, 4.0)}, {"noise": None}, {"motion": DepthNoise()}, {"joint": 1}, {"check": None},
    ],
    DepthNoise(): [
        {"floor": -0.01}, {"slope": math.nan}, {"surface": math.inf}, {"surface": 0.0},
        {"surface": 1e-200}, {"facing": (0.8, 0.5)}, {"facing": (0.5, 0.5)}, {"facing": (-2.0, 0.5)},
        {"facing": (0.5, 1.5)}, {"facing": (0.1,)}, {"facing": 0.5}, {"facing": (math.nan, 0.9)},
        {"facing": (0, 0.5, 1)},
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("options", "change"), [(known, change) for known, rows in WRONG.items() for change in rows]
)
def test_values_out_of_range(options, change):
    with pytest.raises(OptionError, match=next(iter(change)) + r"(?s:.*)\.$"):
        replace(options, **change)


@pytest.mark.parametrize("heights", [[1.5, 1.7], np.array([1.5, 1.7])], ids=["list", "array"])
def test_heights_in_any_sequence(heights, room):
    options = FilterOptions(heights=heights, spacing=1.0)
    assert len(room.visibility(options)) > 0


def test_a_search_gets_a_filter():
    search = PoseSearchOptions(heights=(1.2,))
    assert search.particle_filter is None
    filtered = search.with_filter(record=True)
    assert filtered.particle_filter is filtered
    assert (filtered.heights, filtered.record, filtered.passes) == ((1.2,), True, ONE_PASS)
    assert filtered.with_filter(answer="mle") == replace(filtered, answer="mle")


def test_only_some_terms():
    options = FilterOptions(modes=3).only(depth=True)
    assert (options.semantic, options.depth, options.colour) == (False, True, False)
    assert options.modes == 3
    with pytest.raises(OptionError, match="all off"):
        options.only()


def test_the_papers_numbers():
    """Sec. 3.1-3.5 and 4.1: grid 0.2 m, strides 20, 8, 4, sigma of Eq. 1 and of Eq. 2."""
    paper = FilterOptions.paper()
    assert (paper.start, paper.spacing, paper.per_cell) == ("uniform", 0.2, 3)
    assert paper.heights == (1.5, 1.6, 1.7, 1.8)
    assert paper.likelihood == Likelihood(kind="gaussian", sigma=0.2, depth_clip=0)
    assert [(p.stride, p.box) for p in paper.passes] == [(20, 0), (8, 1.6), (4, 0.8)]
    assert [p.particles for p in paper.passes[1:]] == [paper.min_particles] * 2 == [2500] * 2
    assert (paper.modes, paper.injection, paper.answer) == (1, 0, "mle")
    assert (paper.motion, paper.kld) == (MotionNoise(0.05, 0.0, 0.05, 0.0), True)
    # App. E
    assert FilterOptions.coarse() == replace(paper, passes=paper.passes[:1])


def test_what_the_published_code_does_otherwise():
    published = FilterOptions.published()
    assert published.likelihood == Likelihood(kind="gaussian", sigma=0.6, depth_clip=0.5)
    assert [p.stride for p in published.passes] == [20, 12, 20]
    assert (published.spacing, published.per_cell) == (0.1, 4)
    assert (published.modes, published.pool_modes) == (8, True)
    assert (published.inject_every, published.burn_in) == (5, 1)


def test_presets_by_name():
    assert FilterOptions.preset("default") == PoseSearchOptions()
    for name in ("paper", "published", "coarse"):
        assert FilterOptions.preset(name) == getattr(FilterOptions, name)()
    with pytest.raises(OptionError, match="default, paper, published, coarse"):
        FilterOptions.preset("papers")


def test_the_papers_refinement_is_six_views_of_every_frame():
    paper = RefineOptions.paper()
    assert (paper.views, paper.images, paper.depth) == (6, True, False)
    assert math.degrees(paper.spread) == pytest.approx(45.0)
    assert (paper.joint, paper.check) == (False, False)
    assert RefineOptions.preset("default") == RefineOptions()
    assert RefineOptions.preset("paper") == RefineOptions.preset("coarse") == paper
    assert RefineOptions.preset("published") is None
    with pytest.raises(OptionError, match="'papers'"):
        RefineOptions.preset("papers")
