import sys

import numpy as np
import pytest
from tests.indoor.refine.matching.conftest import measure_errors, warp

from placegraph.errors import MissingExtraError, OptionError
from placegraph.indoor.refine.matching import matcher

pytest.importorskip("cv2", reason="needs OpenCV: pip install 'placegraph[sift]'")


@pytest.fixture(scope="module")
def sift():
    return matcher("sift")


@pytest.mark.parametrize(
    "homography",
    [[[1, 0, 3.5], [0, 1, 2.25], [0, 0, 1]], [[1.1, 0.05, -9], [-0.04, 0.95, 6], [2e-4, -1e-4, 1]]],
)
def test_a_homography_is_recovered(sift, picture, homography):
    h = np.array(homography, float)
    (found,) = sift.match(picture, [warp(picture, h)])
    off = measure_errors(found, h)
    assert len(found) > 150
    assert np.mean(off < 1.0) > 0.97
    assert np.median(off) < 0.2


def test_points_are_counted_from_the_corner_of_the_first_pixel(sift, picture):
    # were centres at 0, the points of a picture of twice the size would be half a pixel off
    twice = np.diag([2.0, 2.0, 1.0])
    (found,) = sift.match(picture, [warp(picture, twice, (640, 480))])
    assert len(found) > 100
    assert np.abs(np.median(found.rendered - 2 * found.query, axis=0)).max() < 0.1


def test_light_does_not_matter(sift, picture):
    h = np.array([[1, 0, 6], [0, 1, 3], [0, 0, 1.0]])
    shade = np.linspace(0.35, 1.0, 320)[None, :, None] * [1.0, 0.85, 0.7]
    (found,) = sift.match((picture * shade).astype(np.uint8), [warp(picture, h)])
    assert len(found) > 80
    assert np.mean(measure_errors(found, h) < 2.0) > 0.95


@pytest.mark.parametrize(("upright", "equalise"), [(False, 0.0), (True, 3.0)])
def test_the_same_again(picture, upright, equalise):
    h = np.array([[1, 0, 4.5], [0, 1, 0], [0, 0, 1.0]])
    a, b = (
        matcher("sift", upright=upright, equalise=equalise).match(picture, [warp(picture, h)])[0]
        for _ in range(2)
    )
    for name in ("query", "rendered", "confidence"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_only_features_that_turn_with_the_camera_survive_a_turn(picture):
    c, s = np.cos(0.9), np.sin(0.9)
    h = np.array([[c, -s, 160 - 160 * c + 120 * s], [s, c, 120 - 160 * s - 120 * c], [0, 0, 1]])
    view = warp(picture, h)
    (turning,) = matcher("sift", upright=False).match(picture, [view])
    (upright,) = matcher("sift", upright=True).match(picture, [view])
    right = [np.sum(measure_errors(m, h) < 1.5) for m in (turning, upright)]
    assert right[0] > 80
    assert right[1] < right[0] / 4


def test_without_opencv_it_says_what_to_install(monkeypatch):
    for options in ({"features": 0}, {"ratio": 1.5}, {"contrast": -1}):
        with pytest.raises(OptionError, match=next(iter(options))):
            matcher("sift", **options)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[sift\]"):
        matcher("sift")
