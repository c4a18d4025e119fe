import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import OptionError
from placegraph.indoor.mapping.change.moves import clumps

CELLS = st.lists(st.tuples(*[st.integers(-4, 4)] * 3), max_size=40)


def by_hand(cells):
    """Clumps by flooding, in order of their first cell."""
    left, number, found = set(cells), {}, 0
    for cell in cells:
        if cell not in left:
            continue
        queue = [cell]
        left.discard(cell)
        while queue:
            here = queue.pop()
            number[here] = found
            near = [c for c in left if max(abs(a - b) for a, b in zip(c, here, strict=True)) <= 1]
            left.difference_update(near)
            queue += near
        found += 1
    return [number[c] for c in cells]


@given(CELLS)
def test_cells_that_touch_are_one_clump(cells):
    found = clumps(np.array(cells, np.int64).reshape(-1, 3)).tolist()
    wanted = by_hand(cells)
    pairs = set(zip(found, wanted, strict=True))
    assert len(pairs) == len(set(found)) == len(set(wanted))


def test_cells_a_million_apart_are_refused():
    with pytest.raises(OptionError, match="larger"):
        clumps(np.array([[0, 0, 0], [1 << 21, 0, 0]]))
