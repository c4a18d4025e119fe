"""Positions of nodes by id: in memory and on disk, in whatever order they came."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.formats.place.osm_nodes import Nodes

ids = st.integers(-3, 30) | st.integers(2**33, 2**33 + 5)


@pytest.mark.parametrize("on_disk", [False, True])
@given(chunks=st.lists(st.lists(ids, min_size=1), max_size=4), asked=st.lists(ids))
def test_what_was_added_last_is_found(on_disk, chunks, asked, tmp_path_factory):
    index = tmp_path_factory.getbasetemp() / "nodes.index" if on_disk else None
    nodes, known, n = Nodes(index), {}, 0
    for chunk in chunks:
        steps = np.arange(n, n + 2 * len(chunk), dtype=np.int32).reshape(-1, 2) - 5
        n += 2 * len(chunk)
        known |= dict(zip(chunk, steps.tolist(), strict=True))
        nodes.add(np.array(chunk), steps)
        found, there = nodes.find(np.array(asked, np.int64))
        assert there.tolist() == [i in known for i in asked]
        assert found[there].tolist() == [known[i] for i in asked if i in known]
    nodes.close()
    assert index is None or not index.exists()
