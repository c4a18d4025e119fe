"""Options: what is refused, and what the named recipes are."""

import math
from dataclasses import replace

import numpy as np
import pytest

from placegraph.errors import OptionError
from placegraph.indoor.options import (
    ONE_PASS,
    FilterOptions,
    Likelihood,
    MotionNoise,
    Pass,
    PoseSearchOptions,
)


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (lambda: FilterOptions(semantic=False, depth=False, colour=False), "all off"),
        (lambda: FilterOptions(start="random"), "start"),
        (lambda: FilterOptions(heights=()), "heights"),
        (lambda: FilterOptions(heights=(1.5, math.nan)), "heights"),
        (lambda: FilterOptions(spacing=0.0), "spacing"),
        (lambda: FilterOptions(spacing=math.inf), "spacing"),
        (lambda: FilterOptions(per_cell=0), "per_cell"),
        (lambda: FilterOptions(per_cell=1.5), "per_cell"),
        (lambda: FilterOptions(passes=()), "passes"),
        (lambda: PoseSearchOptions(modes=0), "modes"),
        (lambda: FilterOptions(modes=2.5), "modes"),
        (lambda: FilterOptions(kld_error=math.nan), "kld_error"),
        (lambda: FilterOptions(kld_confidence=1.0), "kld_confidence"),
        (lambda: FilterOptions(injection=1.0), "injection"),
        (lambda: FilterOptions(injection=-0.1), "injection"),
        (lambda: FilterOptions(min_particles=0), "min_particles"),
        (lambda: FilterOptions(answer="best"), "answer"),
        (lambda: FilterOptions(every=-1.0), "every"),
        (lambda: FilterOptions(every_metre=math.nan), "every_metre"),
        (lambda: Likelihood(kind="laplace"), "kind"),
        (lambda: Likelihood(wrong=0.0), "wrong"),
        (lambda: Likelihood(wrong=1.0), "wrong"),
        (lambda: Likelihood(sharpness=-1.0), "sharpness"),
        (lambda: Likelihood(object_patches=0.0), "object_patches"),
        (lambda: Likelihood(depth_floor=0.0), "depth_floor"),
        (lambda: Likelihood(sigma=-1.0), "sigma"),
        (lambda: Likelihood(depth_clip=math.nan), "depth_clip"),
        (lambda: Pass(0.0, 0.4, 0.1, 100), "stride"),
        (lambda: Pass(20.0, 0.4, 0.1, 0), "particles"),
        (lambda: Pass(20.0, 0.4, 0.1, 99.5), "particles"),
        (lambda: Pass(20.0, -0.4, 0.1, 100), "box"),
        (lambda: Pass(20.0, 0.4, math.nan, 100), "turn"),
        (lambda: MotionNoise(translation=-1.0), "translation"),
        (lambda: MotionNoise(rotation=math.nan), "rotation"),
        (lambda: Likelihood(depth_slope=-0.1), "depth_slope"),
        (lambda: Likelihood(depth_gain=math.nan), "depth_gain"),
        (lambda: Likelihood(colour_weight=-1.0), "colour_weight"),
    ],
)
def test_numbers_that_make_no_sense(made, says):
    with pytest.raises(OptionError, match=says):
        made()


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
    assert paper.start == "uniform"
    assert paper.spacing == 0.2
    assert paper.per_cell == 3
    assert paper.heights == (1.5, 1.6, 1.7, 1.8)
    assert [p.stride for p in paper.passes] == [20, 8, 4]
    assert paper.likelihood.kind == "gaussian"
    assert paper.likelihood.sigma == 0.2
    assert paper.likelihood.depth_clip == 0
    assert [p.box for p in paper.passes] == [0, 1.6, 0.8]
    assert [p.particles for p in paper.passes[1:]] == [2500, 2500]
    assert paper.min_particles == 2500
    assert (paper.modes, paper.injection, paper.answer) == (1, 0, "mle")
    assert paper.motion == MotionNoise(0.05, 0.0, 0.05, 0.0)
    assert paper.kld


def test_the_coarse_variant_is_the_first_pass_alone():
    """App. E."""
    coarse = FilterOptions.coarse()
    assert [p.stride for p in coarse.passes] == [20]
    assert replace(coarse, passes=FilterOptions.paper().passes) == FilterOptions.paper()


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
