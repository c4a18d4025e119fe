import math

import pytest

from placegraph.errors import OptionError
from placegraph.indoor.options import DepthNoise, RefineOptions


@pytest.mark.parametrize(
    "wrong",
    [
        {"views": 0}, {"views": 2.5}, {"views": 1000}, {"readings": -1}, {"least": 0}, {"frames": 0},
        {"frames": 1.5}, {"inlier": 0.0}, {"inlier": math.nan}, {"tilt": 0.0}, {"tilt": -1.0},
        {"tilt": 1e-200}, {"spread": math.inf}, {"spread": 4.0}, {"images": "sometimes"},
        {"images": [1]}, {"images": 1}, {"depth": False, "images": False}, {"depth": "no"},
        {"reach": (-0.1, 0.1)}, {"reach": (0.1, -0.1)}, {"reach": 0.1}, {"reach": (0.1,)},
        {"reach": (0.1, 0.1, 0.1)}, {"reach": (math.inf, 0.1)}, {"reach": (math.nan, 0.1)},
        {"reach": (0.1, 4.0)}, {"noise": None}, {"motion": DepthNoise()}, {"joint": 1}, {"check": None},
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_named(wrong):
    with pytest.raises(OptionError, match=next(iter(wrong)) + r"(?s:.*)\.$"):
        RefineOptions(**wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        {"floor": -0.01}, {"slope": math.nan}, {"surface": math.inf}, {"surface": 0.0},
        {"surface": 1e-200}, {"facing": (0.8, 0.5)}, {"facing": (0.5, 0.5)}, {"facing": (-2.0, 0.5)},
        {"facing": (0.5, 1.5)}, {"facing": (0.1,)}, {"facing": 0.5}, {"facing": (math.nan, 0.9)},
        {"facing": (0, 0.5, 1)},
    ],
)  # fmt: skip
def test_noise_is_a_size_and_cosines_ascend(wrong):
    with pytest.raises(OptionError, match=next(iter(wrong))):
        DepthNoise(**wrong)


def test_the_papers_recipe_is_six_views_of_every_frame():
    paper = RefineOptions.paper()
    assert paper.views == 6
    assert math.degrees(paper.spread) == pytest.approx(45.0)
    assert not paper.depth
    assert paper.images is True
    assert not paper.joint
    assert not paper.check


def test_options_cannot_be_changed_by_accident():
    with pytest.raises(AttributeError):
        RefineOptions().views = 3


def test_what_follows_the_presets_of_the_filter():
    assert RefineOptions.preset("default") == RefineOptions()
    assert RefineOptions.preset("paper") == RefineOptions.preset("coarse") == RefineOptions.paper()
    assert RefineOptions.preset("published") is None
    with pytest.raises(OptionError, match="'papers'"):
        RefineOptions.preset("papers")
