import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.mapfile import read_map, write_map
from placegraph.errors import MapError, PlacegraphError, StoreError
from placegraph.maps import open_map
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.map.city import KIND, VERSION
from placegraph.vectors import EmbeddedStore, open_store

TEXT = "I am next to a bench. A bakery is north of me. A church is east of the bakery."


@pytest.fixture(scope="module")
def stored(harbour_file):
    """Metadata and columns of a sound map."""
    file = read_map(harbour_file, KIND, VERSION)
    return file.meta, file.arrays


@pytest.fixture
def forge(stored, tmp_path):
    """Write a map whose checksums are right, but whose metadata or columns are changed."""

    def write(meta=None, **arrays):
        path = tmp_path / "forged.city"
        columns = {k: v for k, v in (stored[1] | arrays).items() if v is not None}
        write_map(path, KIND, VERSION, {**stored[0], **(meta or {})}, columns)
        return path

    return write


def changed(column, index, value):
    column = column.copy()
    column.flat[index] = value
    return column


def test_every_object_can_be_asked(real_city):
    o = real_city.objects
    o.check()
    for i in range(0, len(o), 7):
        kind, number = o.osm(i).split("/")
        assert kind in ("node", "way", "relation")
        assert int(number) == o.osm_id[i]
        assert o.label(i) in o.labels
        assert o.name(i) == "" or o.name(i) in o.names
        parts = o.parts(i)
        assert parts
        assert all(part.shape[1] == 2 and len(part) for part in parts)
        if o.kind[i] == 2:
            assert all((part[0] == part[-1]).all() for part in parts)
        if o.kind[i] == 0:
            np.testing.assert_array_equal(parts[0][0], o.center[i])


def test_labels_are_found_by_label_and_by_key(harbour):
    labels, index = harbour.objects.labels, harbour.label_index
    for row, label in enumerate(labels):
        assert index[label] == [row] or label.endswith("=*")
        assert row in index[label.partition("=")[0] + "=*"]


def test_objects_of_a_token(real_city):
    starts, objects = real_city.token_objects
    o = real_city.objects
    for row, label in list(enumerate(o.labels))[::40]:
        entries = np.flatnonzero(o.label_values == row)
        owners = np.searchsorted(o.label_starts, entries, side="right") - 1
        assert set(objects[starts[row] : starts[row + 1]]) == set(owners), label
    shift = len(o.labels)
    for row in range(0, len(o.names), 11):
        found = objects[starts[shift + row] : starts[shift + row + 1]]
        assert len(found)
        for i in found:
            names = o.name_values[o.name_starts[i] : o.name_starts[i + 1]]
            assert row in names


def test_an_index_is_stored_where_it_is_worth_it(harbour, tmp_path):
    harbour.save(tmp_path / "small.city")
    harbour.save(tmp_path / "quick.city", index=True)
    small, quick = (CityMap.open(tmp_path / f"{name}.city") for name in ("small", "quick"))
    assert small.index is None
    for name, column in harbour.views.arrays().items():
        np.testing.assert_array_equal(quick.index.arrays()[name], column)
    assert quick.digest == small.digest
    assert quick.locate(TEXT).to_dict() == small.locate(TEXT).to_dict()
    assert replace(quick, objects=harbour.objects).index is None, "the index of other objects"


def test_a_damaged_column_is_named(harbour_file, tmp_path):
    content = bytearray(harbour_file.read_bytes())
    header = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    start = 20 + int.from_bytes(content[12:16], "little")
    path = tmp_path / "damaged.city"
    for block in header["arrays"]:
        if not block["length"]:
            continue
        bad = content.copy()
        bad[start + block["offset"] + block["length"] // 2] ^= 0xFF
        path.write_bytes(bad)
        with pytest.raises(MapError, match=f"column '{block['name']}'"):
            open_map(path)


@pytest.mark.parametrize(
    "meta",
    [
        {"grain": 0}, {"grain": -1}, {"grain": 1e300}, {"grain": "wide"}, {"grain": None},
        {"origin": [0]}, {"origin": [0, 0, 0]}, {"origin": [400, 0]}, {"origin": [0, 91]},
        {"origin": "here"}, {"grid": [0, 0, 0, 1, 1]}, {"grid": [0, 0, 50, -3, 2]},
        {"grid": [0, 0, 50, 0, 0]}, {"grid": [0, 0, 50, 1, 1]}, {"grid": [1e300, 0, 50, 40, 40]},
        {"grid": [0, 0, 50]}, {"grid": {}}, {"cell_size": 0}, {"cell_size": -5},
        {"edge_distance": -1}, {"cell_size": None}, {"left_out": {"nodes": "many"}},
        {"left_out": 7}, {"left_out": None}, {"cell_size": 0.001}, {"cell_size": 1e5},
        {"grid": [0, 0, 1e-6, 1 << 40, 1 << 40]},
    ],
    ids=str,
)  # fmt: skip
def test_metadata_that_make_no_sense(meta, forge):
    with pytest.raises(MapError, match=r"forged\.city.* contradict each other.*Build it again"):
        open_map(forge(meta))


@pytest.mark.parametrize(
    "name",
    ["osm_type", "osm_id", "kind", "label_counts", "label_values", "name_counts", "name_values",
     "part_counts", "point_counts", "points"],
)  # fmt: skip
def test_columns_that_do_not_fit_each_other(name, forge, stored):
    column = stored[1][name]
    for bad in (None, column[:-1], np.concatenate([column, column[:1]]), column.astype(float)):
        with pytest.raises(MapError, match=r"forged\.city"):
            open_map(forge(**{name: bad}))


@pytest.mark.parametrize(
    ("name", "value"),
    [("kind", 3), ("kind", 255), ("osm_type", 3), ("label_values", -1), ("label_values", 1 << 30),
     ("name_values", -1), ("name_values", 1 << 30), ("part_counts", 0), ("point_counts", 0),
     ("label_counts", 0), ("cells", -1), ("cells", 1 << 40)],
)  # fmt: skip
def test_values_that_point_nowhere(name, value, forge, stored):
    with pytest.raises(MapError, match=r"forged\.city"):
        open_map(forge(**{name: changed(stored[1][name], 3, value)}))


def test_counts_that_overflow_do_not_reach_compiled_code(forge, stored):
    arrays = stored[1]
    three = {name: arrays[name][:3] for name in ("osm_type", "osm_id", "kind", "label_values")}
    counts = [2**31 - 1, 2**31 - 1, 2 + len(arrays["points"])]
    path = forge(
        **three,
        label_counts=np.ones(3, np.uint8),
        name_counts=np.zeros(3, np.uint16),
        name_values=np.zeros(0, np.int32),
        part_counts=np.ones(3, np.uint16),
        point_counts=np.array(counts, np.uint32),
    )
    code = "import sys, placegraph; placegraph.open_map(sys.argv[1])"
    run = subprocess.run(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-c", code, path], capture_output=True, text=True, check=False
    )
    assert run.returncode == 1, run.stderr
    assert "MapError" in run.stderr
    assert "counts are too large" in run.stderr


def test_a_map_of_nothing_is_refused(forge, stored):
    empty = {name: column[:0] for name, column in stored[1].items()}
    with pytest.raises(MapError, match=r"forged\.city"):
        open_map(forge(**empty))


@settings(max_examples=12)
@given(data=st.data())
def test_any_change_is_refused_or_harmless(data, stored, tmp_path_factory):
    meta, arrays = stored
    arrays = dict(arrays)
    name = data.draw(st.sampled_from(sorted(set(arrays) - {"points"})))
    column = arrays[name]
    values = st.floats(width=64)
    if column.dtype.kind != "f":
        limits = np.iinfo(column.dtype)
        values = st.integers(int(limits.min), int(limits.max))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(column) - 1))
        column = changed(column, at, data.draw(values | st.integers(0, 3)))
    path = tmp_path_factory.getbasetemp() / "any.city"
    write_map(path, KIND, VERSION, meta, arrays | {name: column})
    try:
        city = open_map(path)
    except PlacegraphError as error:
        assert str(path) in str(error)  # noqa: PT017
        return
    assert city.locate("I am next to a bench.").status
    for cell in list(city.cells)[:2]:
        city.graph(cell)


def test_tables_of_more_texts_than_are_used(forge):
    with pytest.raises(MapError, match=r"'names': The column holds more than"):
        open_map(forge(names=np.zeros(1_000_000, np.uint8)))


def test_vectors_of_cells_that_the_map_has_not(harbour, tmp_path):
    encoded = harbour.encoded
    ids = harbour.cells.points + 1_000_000
    EmbeddedStore.of(ids, encoded.embeddings, origin=encoded.origin).save(tmp_path / "a.vectors")
    with open_store(tmp_path / "a.vectors") as store, pytest.raises(StoreError, match="cells that"):
        harbour.locate(TEXT, by="dense", store=store)
