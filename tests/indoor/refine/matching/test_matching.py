"""What holds of every matcher that runs here."""

import numpy as np
import pytest

from placegraph.errors import OptionError
from placegraph.indoor.refine.matching import MATCHERS, Matcher, matcher


@pytest.fixture(scope="module", params=["sift", "xfeat", "xfeat dense"])
def any_matcher(request):
    if request.param == "sift":
        pytest.importorskip("cv2", reason="needs OpenCV: pip install 'placegraph[sift]'")
        return matcher("sift")
    pytest.importorskip("kornia", reason="needs kornia: pip install 'placegraph[xfeat]'")
    weights = request.getfixturevalue("shared") / "weights/xfeat.pt"
    return matcher("xfeat", weights=weights, dense="dense" in request.param)


def test_it_is_a_matcher(any_matcher):
    assert isinstance(any_matcher, Matcher)
    assert any_matcher.name in MATCHERS


@pytest.mark.parametrize("value", [0, 128, 255])
@pytest.mark.parametrize("size", [(90, 160), (33, 47)])
def test_blank_and_burnt_out_images_match_nothing(any_matcher, picture, value, size):
    empty = np.full((*size, 3), value, np.uint8)
    noisy = empty.copy()
    noisy[::7, ::5] ^= 1
    for query, view in ((empty, picture), (picture, empty), (empty, empty), (noisy, picture)):
        (found,) = any_matcher.match(query, [view])
        assert len(found) == 0
        assert found.query.shape == found.rendered.shape == (0, 2)


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (7, 9), (8, 8), (1, 300), (33, 15)])
def test_tiny_images_are_no_trouble(any_matcher, picture, rng, size):
    tiny = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    for found in (*any_matcher.match(tiny, [picture, tiny]), *any_matcher.match(picture, [tiny])):
        assert np.isfinite(found.query).all()
        assert found.query.shape == found.rendered.shape


def test_points_lie_in_their_images(any_matcher, texture, rng):
    query, view = texture(rng, 151, 203), texture(rng, 97, 131)
    view[20:80, 20:100] = query[40:100, 60:140]
    (found,) = any_matcher.match(query, [view])
    for points, image in ((found.query, query), (found.rendered, view)):
        assert (points >= 0).all()
        assert (points <= [image.shape[1], image.shape[0]]).all()


def test_grey_images_and_odd_sizes_are_welcome(any_matcher, texture, rng):
    picture = texture(rng, 181, 275)
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


def test_the_query_is_matched_with_each_view_by_itself(any_matcher, picture, warped):
    views = [warped(picture, np.array([[1, 0, dx], [0, 1, 0], [0, 0, 1.0]])) for dx in (5, -11)]
    for found, view in zip(any_matcher.match(picture, views), views, strict=True):
        (alone,) = any_matcher.match(picture, [view])
        assert np.array_equal(found.query, alone.query)
        assert np.array_equal(found.rendered, alone.rendered)
        assert (np.diff(found.confidence) <= 0).all()
        assert len(found) > 100


def test_nothing_to_match_with(any_matcher, picture):
    assert any_matcher.match(picture, []) == []


def test_images_are_left_as_they_were(any_matcher, picture):
    query, view = picture.copy(), picture.copy()
    query.flags.writeable = view.flags.writeable = False
    any_matcher.match(query, [view], masks=[np.ones(view.shape[:2], bool)])
    assert np.array_equal(query, picture)


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


def test_unknown_names_are_told_the_known_ones():
    with pytest.raises(OptionError, match=r"'superglue'.*'sift'.*"):
        matcher("superglue")


def test_unknown_options_are_told_the_known_ones():
    pytest.importorskip("cv2")
    with pytest.raises(OptionError, match=r"'sift' has no option 'contrasts'.*contrast"):
        matcher("sift", contrasts=0.1)
    with pytest.raises(OptionError, match="'weights'"):
        matcher("sift", weights="somewhere.pt")
