"""Positions of nodes by id: in memory and on disk, in whatever order they came."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.io.osm import pbf
from placegraph.io.osm.pbf import NodeIndex

ids = st.integers(-3, 30) | st.integers(2**33, 2**33 + 5)


@pytest.mark.parametrize("at_once", [3, 1 << 20])
@pytest.mark.parametrize("on_disk", [False, True])
@given(chunks=st.lists(st.lists(ids, min_size=1), max_size=4), asked=st.lists(ids))
def test_what_was_added_last_is_found(on_disk, at_once, chunks, asked, tmp_path_factory):
    index = tmp_path_factory.getbasetemp() / "nodes.index" if on_disk else None
    nodes, known, n = NodeIndex(index, at_once), {}, 0
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


def test_many_in_no_order_are_merged_run_by_run(tmp_path, monkeypatch):
    """No more are sorted at once than may be, about; the file is what it is of nodes in order."""
    monkeypatch.setattr(pbf, "SAMPLE", 4)
    rng, most = np.random.default_rng(3), []
    ids = rng.permutation(np.append(np.arange(0, 9000, 3), 2**34 + 3 * np.arange(40)))
    steps = np.stack([ids % 1000, ids % 77], 1).astype(np.int32)
    sort = pbf._in_order
    monkeypatch.setattr(pbf, "_in_order", lambda i, s: (most.append(len(i)), sort(i, s))[1])
    nodes = NodeIndex(tmp_path / "a", at_once=200)
    for at in range(0, len(ids), 50):
        nodes.add(ids[at : at + 50], steps[at : at + 50])
    found, known = nodes.find(ids)
    assert known.all()
    np.testing.assert_array_equal(found, steps)
    assert not nodes.find(ids + 1)[1].any()
    assert len(most) > 2 * len(ids) // 200 - 3
    assert max(most) < 400
    assert [path.name for path in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").stat().st_size == 12 * len(ids)
    nodes.close()
    assert not list(tmp_path.iterdir())
