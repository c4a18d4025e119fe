"""Values of label images, looked up."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.indoor.encode.grid import looked_up, majority

VALUES = st.integers(-3, 6) | st.sampled_from([65_534, 65_535, 65_536, 2**31 - 1])


@given(
    st.lists(VALUES, min_size=1, max_size=20),
    st.dictionaries(VALUES.filter(lambda v: v >= 0), st.integers(0, 50), max_size=6),
)
def test_every_value_has_its_row_or_none(values, row_of):
    image = np.array([values], np.int32)
    got = looked_up(image, row_of)
    assert got.dtype == np.int32
    assert got.tolist() == [[row_of.get(v, -1) for v in values]]


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_known_is_nothing_said(count):
    assert (majority(np.full((4, 4), -1, np.int32), (2, 2), count) == -1).all()
