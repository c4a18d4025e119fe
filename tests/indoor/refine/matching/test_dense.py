import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.indoor.refine.matching.dense import Warp, thinned, to_normalised, to_pixels

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


@given(st.integers(1, 300), st.integers(1, 300))
def test_centres_lie_at_a_half(height, width):
    pixels = to_pixels(grid(height, width), (height, width))
    v, u = np.mgrid[:height, :width] + 0.5
    assert np.allclose(pixels, np.stack([u, v], axis=-1), atol=1e-4)


@pytest.mark.parametrize("resolution", [(112, 112), (90, 160), (37, 61)])
def test_a_shift_is_recovered_at_any_resolution(rng, resolution):
    own = grid(*resolution)
    there = to_normalised(to_pixels(own, (180, 320)) + SHIFT, (200, 340))
    warp = Warp(own, there.astype(np.float32), rng.random(resolution, np.float32))
    found = thinned([warp], (180, 320), (200, 340), count=400, least=0.0)
    assert 200 < len(found) <= 400
    assert np.allclose(found.rendered - found.query, SHIFT, atol=1e-3)
    assert (np.diff(found.confidence) <= 0).all()


def test_the_surest_of_each_block_is_taken(rng):
    own = grid(40, 60)
    certainty = rng.random((40, 60), np.float32)
    found = thinned([Warp(own, own, certainty)], (40, 60), (40, 60), count=24, least=0.0)
    assert len(found) == 24
    cells = {(int(y) // 10, int(x) // 10) for x, y in found.query}
    assert len(cells) == 24
    best = certainty.reshape(4, 10, 6, 10).max(axis=(1, 3)).ravel()
    assert np.allclose(np.sort(found.confidence), np.sort(best))


def test_both_directions_share_the_count(rng):
    own, there = shifted(64, 64, (64, 64), (5, 3))
    forth = Warp(own, there, rng.random((64, 64), np.float32))
    back = Warp(grid(64, 64), shifted(64, 64, (64, 64), (5, 3))[1], forth.certainty)
    found = thinned([forth, back], (64, 64), (64, 64), count=100, least=0.0)
    assert 50 < len(found) <= 100
    assert np.allclose(found.rendered - found.query, (5, 3), atol=1e-3)


def test_unsure_masked_and_outside_matches_are_left_out():
    own, there = shifted(50, 80, (50, 80), (30, 0))
    sure = np.ones((50, 80), np.float32)
    sure[:25] = 0.01
    sure[30, 30] = np.nan
    mask = np.zeros((50, 80), bool)
    mask[:, 40:70] = True
    found = thinned(
        [Warp(own, there, sure)], (50, 80), (50, 80), count=4000, least=0.05, mask=mask, margin=2
    )
    x = found.rendered[:, 0]
    assert len(found) > 500
    assert ((x >= 42) & (x < 68) & (found.query[:, 1] > 25)).all()
    assert np.isfinite(found.confidence).all()
    nothing = thinned([Warp(own, there, 0 * sure)], (50, 80), (50, 80), count=9, least=0.05)
    assert len(nothing) == 0


@given(st.integers(1, 70), st.integers(1, 70), st.integers(1, 500))
def test_never_more_than_asked_for(height, width, count):
    own = grid(height, width)
    warp = Warp(own, own, np.ones((height, width), np.float32))
    found = thinned([warp], (height, width), (height, width), count=count, least=0.0)
    assert 1 <= len(found) <= count
