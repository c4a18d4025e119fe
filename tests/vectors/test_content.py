"""Rows, regions and fingerprints that all stores share."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from placegraph.errors import OptionError
from placegraph.maps import open_map
from placegraph.vectors import Origin, Region, Vectors
from placegraph.vectors.content import GRAIN, checked_queries, unit

TWO = ([4, 2], [[3.0, 4.0], [0.0, 2.0]], [[7.4, 43.7], [-180.0, 90.0]])


def test_rows_are_sorted_and_of_unit_length():
    held = Vectors.of(*TWO)
    assert held.ids.tolist() == [2, 4]
    np.testing.assert_allclose(held.vectors, [[0.0, 1.0], [0.6, 0.8]], rtol=1e-6)
    np.testing.assert_allclose(held.lonlat, [[-180.0, 90.0], [7.4, 43.7]], atol=GRAIN / 2)
    assert held.dimension == 2
    assert len(held) == 2


@pytest.mark.parametrize(
    ("which", "value", "words"),
    [
        (0, [4, 4], "not unique"),
        (0, [4, -1], "negative"),
        (0, np.array([4, 2**63 + 1], np.uint64), "negative"),
        (0, [4.0, 2.0], "one integer a vector"),
        (0, [4], "one integer a vector"),
        (1, [[0.0, 0.0], [1.0, 0.0]], "zero or not finite"),
        (1, [[np.nan, 0.0], [1.0, 0.0]], "zero or not finite"),
        (1, [[1e200, 1e200], [1.0, 0.0]], "zero or not finite"),
        (1, [1.0, 2.0], "rows, dimension"),
        (1, [["a"], ["b"]], "rows, dimension"),
        (1, np.zeros((0, 2)), "at least one vector"),
        (2, [[7.4, 43.7]], "longitude and latitude"),
        (2, [[7.4, 91.0], [0.0, 0.0]], "longitude and latitude"),
        (2, [[np.nan, 0.0], [0.0, 0.0]], "longitude and latitude"),
    ],
)
def test_rows_that_are_none(which, value, words):
    columns = list(TWO)
    columns[which] = value
    with pytest.raises(OptionError, match=words):
        Vectors.of(*columns)


@given(arrays(np.float32, (3, 5), elements=st.floats(-(2.0**60), 2.0**60, width=32)))
def test_a_direction_is_cached_or_refused(rows):
    lengths = np.sqrt((rows.astype(float) ** 2).sum(axis=1))
    if (lengths == 0.0).any():
        with pytest.raises(OptionError):
            unit(rows, "Rows")
    else:
        np.testing.assert_allclose(unit(rows, "Rows"), rows / lengths[:, None], atol=2e-7)


def test_queries_that_do_not_fit():
    with pytest.raises(OptionError, match="n is 0"):
        checked_queries(np.ones((1, 4)), 0, 4)
    with pytest.raises(OptionError, match=r"3 numbers, the store's vectors 4.*one model"):
        checked_queries(np.ones((1, 3)), 1, 4)
    with pytest.raises(OptionError, match="zero or not finite"):
        checked_queries(np.zeros((1, 4)), 1, 4)


@pytest.mark.parametrize(
    "box", [(0, 2, 1, 1), (0, -91, 1, 0), (181, 0, 1, 1), (np.nan, 0, 1, 1), (0, 0, 1, np.inf)]
)
def test_regions_that_are_none(box):
    with pytest.raises(OptionError, match="is no region"):
        Region(*box).checked()


def test_a_region_may_cross_the_date_line():
    assert Region(179.0, -1.0, -179.0, 1.0).checked().crosses_date_line
    assert not Region(-179.0, -1.0, 179.0, 1.0).crosses_date_line


def test_origins_tell_what_differs():
    here = Origin("a", "b")
    assert here.differs(Origin("a", "b")) == ""
    assert here.differs(Origin("a", "c")) == "model"
    assert here.differs(Origin("c", "b")) == "map"
    assert here.differs(Origin()) == "map and model"
    versions = {o.version for o in (here, Origin("ab", ""), Origin("", "ab"), Origin("b", "a"))}
    assert len(versions) == 4
    assert all(len(v) == 12 and int(v, 16) >= 0 for v in versions)


def test_a_map_keeps_its_fingerprint_and_another_has_another(
    harbour, harbour_file, make_city, hafenstadt
):
    mark = harbour.fingerprint
    assert open_map(harbour_file).fingerprint == mark
    assert make_city(hafenstadt, cell_size=40.0).fingerprint != mark
    assert make_city(hafenstadt, edge_distance=40.0).fingerprint != mark
    assert len(mark) == 32
