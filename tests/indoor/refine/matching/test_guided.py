"""Patches found again near where they should be."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from tests.indoor.refine.matching.conftest import draw_texture

from placegraph.errors import OptionError
from placegraph.indoor.refine.matching.guided import GuidedMatcher
from placegraph.indoor.refine.refine_kernels import corners, search
from placegraph.io.capture.images import lightness, resize_image


@pytest.fixture(scope="module")
def picture():
    return draw_texture(np.random.default_rng(3), 120, 160)


@pytest.fixture(scope="module")
def guided():
    return GuidedMatcher(radius=12)


def shifted(image, dx, dy):
    """The picture's content moved by whole or half pixels (by resampling)."""
    moved = Image.fromarray(image).transform(
        image.shape[1::-1], Image.Transform.AFFINE, (1, 0, -dx, 0, 1, -dy),
        Image.Resampling.BICUBIC,
    )  # fmt: skip
    return np.asarray(moved)


@settings(max_examples=12)
@given(st.floats(-8.0, 8.0), st.floats(-8.0, 8.0))
def test_a_shift_is_found_to_a_fraction_of_a_pixel(guided, picture, dx, dy):
    (found,) = guided.match(shifted(picture, dx, dy), [picture])
    off = found.query - found.rendered - (dx, dy)
    assert len(found) > 60
    assert np.mean(np.abs(off).max(axis=1) < 1.0) > 0.9
    assert np.abs(np.median(off, axis=0)).max() < 0.1
    assert (np.diff(found.confidence) <= 0).all()
    (again,) = guided.match(shifted(picture, dx, dy), [picture])
    np.testing.assert_array_equal(found.query, again.query)
    np.testing.assert_array_equal(found.rendered, again.rendered)


def test_beyond_the_radius_nothing_is_found_there(picture):
    near = GuidedMatcher(radius=4, least=0.8)
    (inside,) = near.match(shifted(picture, 3, 0), [picture])
    (outside,) = near.match(shifted(picture, 9, 0), [picture])
    assert len(inside) > 60
    assert len(outside) < 0.2 * len(inside)
    assert np.abs(outside.query - outside.rendered).max(initial=0) <= 4.5


def test_light_does_not_matter_and_what_shows_nothing_matches_nothing(guided, picture, rng):
    dim = (0.4 * picture + 20).astype(np.uint8)
    (bright,), (dark,) = guided.match(picture, [picture]), guided.match(dim, [picture])
    assert len(dark) > 0.9 * len(bright)
    assert np.abs(dark.query - dark.rendered).max() < 1.0
    for level in (0, 255):
        blank = np.full_like(picture, level)
        assert len(guided.match(blank, [picture])[0]) == 0
        assert len(guided.match(picture, [blank])[0]) == 0
    noise = rng.integers(0, 255, picture.shape).astype(np.uint8)
    assert len(guided.match(noise, [picture])[0]) < 5


def test_queries_of_another_size_keep_their_own_pixels(guided, picture):
    large = np.asarray(Image.fromarray(picture).resize((640, 480), Image.Resampling.BICUBIC))
    (found,) = guided.match(large, [picture])
    assert len(found) > 60
    assert np.abs(np.median(found.query - 4 * found.rendered, axis=0)).max() < 0.3


def test_each_view_by_itself_and_only_where_the_map_shows(guided, picture):
    mask = np.zeros(picture.shape[:2], bool)
    mask[:, :80] = True
    one, other, none = guided.match(
        picture, [picture, picture, picture], masks=[np.ones_like(mask), mask, ~mask & mask]
    )
    assert len(one) > len(other) > 20
    assert other.rendered[:, 0].max() < 80
    assert len(none) == 0


@pytest.mark.parametrize("shape", [(1, 1), (3, 200), (14, 14), (40, 9)])
def test_tiny_images_are_no_trouble(guided, rng, shape):
    image = rng.integers(0, 255, (*shape, 3)).astype(np.uint8)
    (found,) = guided.match(image, [image])
    assert (found.query >= 0).all()
    assert (found.query <= shape[::-1]).all()


def test_a_rival_takes_the_lead_away():
    stripes = np.tile((np.arange(160) // 4 % 2 * 200 + 20).astype(np.uint8), (120, 1))
    rows = (np.arange(120) // 4 % 2 * 30).astype(np.uint8)
    image = np.repeat((stripes + rows[:, None])[..., None], 3, axis=2)
    leading = GuidedMatcher(radius=12, lead=0.2).match(image, [image])[0]
    any_ = GuidedMatcher(radius=12).match(image, [image])[0]
    assert len(leading) == 0
    assert len(any_) > 0
    image = np.array([[[255, 255, 255], [0, 0, 0]], [[255, 0, 0], [0, 255, 0]]], np.uint8)
    np.testing.assert_allclose(lightness(image), [[1, 0], [0.299, 0.587]], atol=1e-6)
    assert resize_image(image, 2, 2) is image
    np.testing.assert_array_equal(resize_image(image, 1, 1)[0, 0], [128, 128, 64])


@pytest.mark.parametrize(
    "wrong",
    [{"radius": 0}, {"half": 1}, {"cell": 1}, {"least": 2}, {"lead": -1}, {"least": np.nan}],
)
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(OptionError, match=next(iter(wrong))):
        GuidedMatcher(**wrong)


def test_corners_are_corners():
    image = np.zeros((60, 60), np.float32)
    image[20:40, 20:40] = 1.0
    seen = np.ones(image.shape, bool)
    at = corners(image, seen, 6, 8)
    true = np.array([[19.5, 19.5], [19.5, 39.5], [39.5, 19.5], [39.5, 39.5]])
    near = np.abs(at[:, None] - true).max(axis=2).min(axis=1)
    assert near.max() < 4.0
    assert len(at) >= 4
    assert len(np.unique((at - 6) // 8, axis=0)) == len(at)
    half = seen.copy()
    half[:, 30:] = False
    assert corners(image, half, 6, 8)[:, 1].max() < 30
    assert len(corners(np.full((60, 60), 0.5, np.float32), seen, 6, 8)) == 0


@settings(max_examples=20)
@given(st.integers(0, 999))
def test_scores_are_zero_mean_normalised_correlations(seed):
    rng = np.random.default_rng(seed)
    view, query = rng.random((2, 40, 40), np.float32)
    query[5:, 3:] += 2.0 * view[:-5, :-3]  # the view, 5 down and 3 right
    at = np.array([[15.0, 16.0], [20.0, 12.0]])
    found = search(view, np.ones((40, 40), bool), query, at, 4, 7, 3)
    for (row, column), (y, x, best, rival) in zip(at.astype(int), found, strict=True):
        assert abs(y - row - 5) < 0.5
        assert abs(x - column - 3) < 0.5
        patch = view[row - 4 : row + 5, column - 4 : column + 5].ravel()
        window = query[row + 1 : row + 10, column - 1 : column + 8].ravel()
        assert best == pytest.approx(np.corrcoef(patch, window)[0, 1], abs=1e-3)
        assert rival < best
    at_middle = np.array([[20.0, 20.0]])
    query[:, 5:] = view[:, :-5]  # 5 right, where the window ends: a best place on the rim is none
    assert search(view, np.ones((40, 40), bool), query, at_middle, 4, 5, 3)[0, 2] == -1.0
