import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from placegraph.indoor.mapping.atlas.bake import filled, pack


@given(st.lists(st.tuples(st.integers(1, 128), st.integers(1, 128)), min_size=1, max_size=60))
def test_rectangles_lie_on_pages_and_nowhere_twice(sizes):
    page, places, pages = pack(np.array(sizes), 128, np.arange(len(sizes)))
    taken = [np.zeros((h, w), int) for w, h in pages]
    for (w, h), k, (x, y) in zip(sizes, page, places, strict=True):
        assert x + w <= pages[k][0]
        assert y + h <= pages[k][1]
        taken[k][y : y + h, x : x + w] += 1
    assert max(t.max() for t in taken) == 1
    assert pages.max() <= 128
    assert all(t.any() for t in taken)


def test_many_rectangles_fill_their_page(rng):
    sizes = rng.integers(3, 40, (2000, 2))
    page, _, pages = pack(sizes, 2048, rng.random(2000))
    assert len(pages) == page.max() + 1 == 1
    assert sizes.prod(axis=1).sum() > 0.8 * pages[0].prod()


def test_what_lies_between_is_smooth():
    texels = np.zeros((37, 50, 3), np.uint8)
    known = np.zeros((37, 50), bool)
    texels[3:10, 4:9], known[3:10, 4:9] = (200, 100, 0), True
    texels[20:30, 40:45], known[20:30, 40:45] = (100, 200, 50), True
    out = filled(texels, known)
    assert (out[known] == texels[known]).all()
    assert (out.min(axis=(0, 1)) >= (100, 100, 0)).all()
    assert (out.max(axis=(0, 1)) <= (200, 200, 50)).all()
    assert np.abs(out[10, 4:9].astype(int) - (200, 100, 0)).max() < 20  # right beside it


def test_a_page_of_which_nothing_is_known_is_one_colour():
    out = filled(np.full((5, 8, 3), 9, np.uint8), np.zeros((5, 8), bool))
    assert len(np.unique(out.reshape(-1, 3), axis=0)) == 1
