"""What holds of every matcher that runs here."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.indoor.refine.matching.conftest import draw_texture, warp

from placegraph.errors import OptionError
from placegraph.indoor.refine.matching import MATCHERS, Matcher, matcher
from placegraph.indoor.refine.matching.matches import Warp, thin_matches, to_normalised, to_pixels

SHIFT = np.array([12.0, -7.0])
SIDES = st.integers(1, 4000)


def grid(height, width):
    """Normalised coordinates (h, w, 2) of the pixels of an image."""
    y, x = ((2.0 * np.arange(n) + 1.0) / n - 1.0 for n in (height, width))
    return np.stack(np.meshgrid(x, y), axis=-1).astype(np.float32)


def shifted(height, width, view, by):
    """Warp of a query to a view (height, width) that is shifted by (x, y) px of the query."""
    own = grid(height, width)
    there = to_normalised(to_pixels(own, (height, width)) + by, view).astype(np.float32)
    return own, there


@given(SIDES, SIDES, st.floats(-1, 1), st.floats(-1, 1))
def test_pixels_come_back(height, width, x, y):
    pixels = to_pixels(np.array([[x, y]]), (height, width))
    assert np.allclose(to_normalised(pixels, (height, width)), [[x, y]], atol=1e-12)


@pytest.mark.parametrize("resolution", [(112, 112), (90, 160), (37, 61)])
def test_a_shift_is_recovered_at_any_resolution(rng, resolution):
    pixels = to_pixels(grid(*resolution), resolution)  # centres lie at a half
    v, u = np.mgrid[: resolution[0], : resolution[1]] + 0.5
    assert np.allclose(pixels, np.stack([u, v], axis=-1), atol=1e-4)
    own = grid(*resolution)
    there = to_normalised(to_pixels(own, (180, 320)) + SHIFT, (200, 340))
    warp = Warp(own, there.astype(np.float32), rng.random(resolution, np.float32))
    found = thin_matches([warp], (180, 320), (200, 340), count=400, least=0.0)
    assert 200 < len(found) <= 400
    assert np.allclose(found.rendered - found.query, SHIFT, atol=1e-3)
    assert (np.diff(found.confidence) <= 0).all()
    # both directions share the count
    own, there = shifted(64, 64, (64, 64), (5, 3))
    forth = Warp(own, there, rng.random((64, 64), np.float32))
    found = thin_matches([forth, forth], (64, 64), (64, 64), count=100, least=0.0)
    assert 50 < len(found) <= 100
    assert np.allclose(found.rendered - found.query, (5, 3), atol=1e-3)


def test_the_surest_of_each_block_is_taken(rng):
    own = grid(40, 60)
    certainty = rng.random((40, 60), np.float32)
    found = thin_matches([Warp(own, own, certainty)], (40, 60), (40, 60), count=24, least=0.0)
    assert len(found) == 24
    cells = {(int(y) // 10, int(x) // 10) for x, y in found.query}
    assert len(cells) == 24
    best = certainty.reshape(4, 10, 6, 10).max(axis=(1, 3)).ravel()
    assert np.allclose(np.sort(found.confidence), np.sort(best))


def test_unsure_masked_and_outside_matches_are_left_out():
    own, there = shifted(50, 80, (50, 80), (30, 0))
    sure = np.ones((50, 80), np.float32)
    sure[:25] = 0.01
    sure[30, 30] = np.nan
    mask = np.zeros((50, 80), bool)
    mask[:, 40:70] = True
    found = thin_matches(
        [Warp(own, there, sure)], (50, 80), (50, 80), count=4000, least=0.05, mask=mask, margin=2
    )
    x = found.rendered[:, 0]
    assert len(found) > 500
    assert ((x >= 42) & (x < 68) & (found.query[:, 1] > 25)).all()
    assert np.isfinite(found.confidence).all()
    nothing = thin_matches([Warp(own, there, 0 * sure)], (50, 80), (50, 80), count=9, least=0.05)
    assert len(nothing) == 0


@given(st.integers(1, 70), st.integers(1, 70), st.integers(1, 500))
def test_never_more_than_asked_for(height, width, count):
    own = grid(height, width)
    warp = Warp(own, own, np.ones((height, width), np.float32))
    found = thin_matches([warp], (height, width), (height, width), count=count, least=0.0)
    assert 1 <= len(found) <= count


@pytest.fixture(scope="module", params=["sift", "xfeat"])
def any_matcher(request):
    if request.param == "sift":
        yield matcher("sift")
        return
    pytest.importorskip("kornia", reason="needs kornia: pip install 'placegraph[xfeat]'")
    torch = pytest.importorskip("torch", reason="PyTorch is not installed (extra learn)")
    before = torch.get_num_threads()
    torch.set_num_threads(1)  # so small is the network
    weights = request.getfixturevalue("shared") / "weights/xfeat.pt"
    yield matcher("xfeat", weights=weights)
    torch.set_num_threads(before)


@pytest.mark.parametrize(("value", "size"), [(0, (33, 47)), (255, (90, 160))])
def test_blank_and_burnt_out_images_match_nothing(any_matcher, picture, value, size):
    empty = np.full((*size, 3), value, np.uint8)
    noisy = empty.copy()
    noisy[::7, ::5] ^= 1
    for query, view in ((empty, picture), (picture, empty), (empty, empty), (noisy, picture)):
        (found,) = any_matcher.match(query, [view])
        assert len(found) == 0
        assert found.query.shape == found.rendered.shape == (0, 2)


@pytest.mark.parametrize("size", [(1, 1), (7, 9), (1, 300), (33, 15)])
def test_tiny_images_are_no_trouble(any_matcher, picture, rng, size):
    tiny = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    for found in (*any_matcher.match(tiny, [picture, tiny]), *any_matcher.match(picture, [tiny])):
        assert np.isfinite(found.query).all()
        assert found.query.shape == found.rendered.shape


def test_points_lie_in_their_images(any_matcher, rng):
    query, view = draw_texture(rng, 151, 203), draw_texture(rng, 97, 131)
    view[20:80, 20:100] = query[40:100, 60:140]
    (found,) = any_matcher.match(query, [view])
    for points, image in ((found.query, query), (found.rendered, view)):
        assert (points >= 0).all()
        assert (points <= [image.shape[1], image.shape[0]]).all()


def test_grey_images_and_odd_sizes_are_welcome(any_matcher, rng):
    picture = draw_texture(rng, 181, 275)
    grey = picture[:, :, 1]
    (found,) = any_matcher.match(grey, [np.repeat(grey[:, :, None], 3, axis=2)])
    assert len(found) > 50
    assert np.mean(np.linalg.norm(found.query - found.rendered, axis=1) < 1.5) > 0.9


def test_no_match_lies_outside_the_mask(any_matcher, picture):
    mask = np.zeros(picture.shape[:2], bool)
    mask[60:180, 100:260] = True
    (found,) = any_matcher.match(picture, [picture], masks=[mask])
    assert len(found) > 30
    x, y = found.rendered.T
    assert ((x >= 104) & (x < 256) & (y >= 64) & (y < 176)).all()
    (nothing,) = any_matcher.match(picture, [picture], masks=[np.zeros_like(mask)])
    assert len(nothing) == 0


def test_the_query_is_matched_with_each_view_by_itself(any_matcher, picture):
    views = [warp(picture, np.array([[1, 0, dx], [0, 1, 0], [0, 0, 1.0]])) for dx in (5, -11)]
    for found, view in zip(any_matcher.match(picture, views), views, strict=True):
        (alone,) = any_matcher.match(picture, [view])
        assert np.array_equal(found.query, alone.query)
        assert np.array_equal(found.rendered, alone.rendered)
        assert (np.diff(found.confidence) <= 0).all()
        assert len(found) > 100


@pytest.mark.parametrize(
    ("query", "views", "masks", "named"),
    [
        (np.zeros((9, 9, 3)), [], None, "query"),
        (np.zeros((9, 9, 4), np.uint8), [], None, "query"),
        (np.zeros((0, 9, 3), np.uint8), [], None, "query"),
        (np.zeros((9, 9), np.uint8), [np.zeros((9, 9), np.uint8), np.zeros(9)], None, r"views\[1\]"),
        (np.zeros((9, 9), np.uint8), [np.zeros((9, 9), np.uint8)], [], "masks"),
        (np.zeros((9, 9), np.uint8), [np.zeros((9, 9), np.uint8)], [np.ones((9, 8), bool)], r"masks\[0\]"),
        (np.zeros((9, 9), np.uint8), [np.zeros((9, 9), np.uint8)], [np.ones((9, 9))], r"masks\[0\]"),
    ],
)  # fmt: skip
def test_what_is_no_image_is_refused(any_matcher, query, views, masks, named):
    with pytest.raises(OptionError, match=named):
        any_matcher.match(query, views, masks=masks)


def test_names_and_options_that_are_none_are_told(any_matcher, picture):
    assert isinstance(any_matcher, Matcher)
    assert any_matcher.name in MATCHERS
    assert any_matcher.match(picture, []) == []
    query, view = picture.copy(), picture.copy()
    query.flags.writeable = view.flags.writeable = False
    any_matcher.match(query, [view], masks=[np.ones(view.shape[:2], bool)])
    assert np.array_equal(query, picture)
    for name, options, words in (
        ("superglue", {}, r"'superglue'.*'sift'.*"),
        ("sift", {"contrasts": 0.1}, r"'sift' has no option 'contrasts'.*contrast"),
        ("sift", {"weights": "somewhere.pt"}, "'weights'"),
    ):
        with pytest.raises(OptionError, match=words):
            matcher(name, **options)
