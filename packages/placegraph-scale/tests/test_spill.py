"""Things put aside on disk come back as they were, or one error names the file."""

import errno
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import MapError
from placegraph.outdoor.map.extract import Thing, Things, once, text_of, words_of
from placegraph_scale import tiles as spill
from placegraph_scale.tiles import TileFiles, read_frames

words = st.lists(
    st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=9), max_size=3
)
degrees = st.tuples(st.integers(-1800000000, 1800000000), st.integers(-900000000, 900000000))
parts = st.lists(st.lists(degrees, min_size=1, max_size=4), min_size=1, max_size=3)
BENCH = text_of(["amenity=bench"], [])


def thing(i=1, points=((100000000, 500000000),)):
    return Thing(0, i, 0, BENCH, [np.array(points) / 1e7])


def put(folder, *tables):
    """File of tile 0 and its size."""
    spills = TileFiles(folder)
    for things in tables:
        spills.add("0", Things.of(things))
    spills.flush()
    return folder / "0.things", spills.sizes["0"]


@given(st.lists(st.tuples(st.integers(-(1 << 60), 1 << 60), words, parts), min_size=1, max_size=4))
def test_things_come_back(tmp_path_factory, drawn):
    given_ = [
        Thing(2, i, 2, text_of(("a=b", "c=d"), names), [np.array(part) / 1e7 for part in shape])
        for i, names, shape in drawn
    ]
    [back] = read_frames(*put(tmp_path_factory.mktemp("spill"), given_))
    for row, (one, (_, names, _)) in enumerate(zip(given_, drawn, strict=True)):
        found = back.thing(row)
        assert found[:4] == one[:4]
        labels, said = words_of(found.text)
        assert labels == ("a=b", "c=d")
        assert said == tuple(re.sub("[\x1d-\x1f]", " ", name) for name in names)
        for a, b in zip(found.parts, one.parts, strict=True):
            np.testing.assert_array_equal(a, b)


def test_things_in_another_order():
    things = Things.of([thing(1), thing(2, [(0, 0), (5, 5)]), thing(3)])
    some = things.take(np.array([2, 1]))
    assert some.osm_id.tolist() == [3, 2]
    np.testing.assert_array_equal(some.thing(1).parts[0], [(0, 0), (5e-7, 5e-7)])
    both = Things.joined([things, some])
    assert both.osm_id.tolist() == [1, 2, 3, 3, 2]
    np.testing.assert_array_equal(both.thing(4).parts[0], some.thing(1).parts[0])
    low, high = both.ends()
    np.testing.assert_array_equal(high[4] - low[4], (5e-7, 5e-7))


def test_things_of_many_tiles(tmp_path, monkeypatch):
    monkeypatch.setattr(spill, "ROOM", 300)
    spills = TileFiles(tmp_path)
    for i in range(20):
        spills.add("01" if i % 2 else "02", Things.of([thing(i)]))
    spills.flush()
    found = Things.joined(read_frames(tmp_path / "01.things", spills.sizes["01"]))
    assert found.osm_id.tolist() == list(range(1, 20, 2))
    assert (tmp_path / "02.things").stat().st_size == spills.sizes["02"]


@given(at=st.integers(0, 60), cut=st.booleans())
def test_a_damaged_file_is_named(tmp_path_factory, at, cut):
    path, size = put(tmp_path_factory.mktemp("spill"), [thing()])
    data = bytearray(path.read_bytes())
    path.write_bytes(data[:at] if cut else data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    with pytest.raises(MapError, match=r"0\.things is damaged"):
        read_frames(path, size)


def test_the_longest_version_counts():
    things = Things.of([thing(1), thing(1, [(0, 0), (1, 1)]), thing(2)])
    kept = once(things)
    assert kept.osm_id.tolist() == [1, 2]
    assert len(kept.thing(0).parts[0]) == 2
    assert once(kept) is kept


def test_a_full_disk(tmp_path, monkeypatch):
    class Full:
        def __enter__(self):
            raise OSError(errno.ENOSPC, "No space left on device")

        def __exit__(self, *_):
            pass

    spills = TileFiles(tmp_path)
    spills.add("0", Things.of([thing()]))
    monkeypatch.setattr("pathlib.Path.open", lambda *_: Full())
    with pytest.raises(MapError, match=r"0\.things cannot be written: No space left.*goes on"):
        spills.flush()
