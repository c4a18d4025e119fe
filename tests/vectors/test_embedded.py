"""The embedded store against numpy, and its file."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.mapfile import read_map, write_map
from placegraph.errors import InputError, MapError, OptionError, StoreError
from placegraph.maps import open_map
from placegraph.vectors import EmbeddedStore, Origin, Region, embedded
from placegraph.vectors.lists import make_lists


def search_is_exact(store, ids, vectors, queries, n, exact, inside=None, region=None):
    wanted, cosines = exact(ids, vectors, queries, n, inside)
    found = store.search(queries, n, region)
    there = wanted.shape[1]  # as many as there are rows; the store pads
    assert (found.ids[:, there:] == -1).all()
    assert (found.similarity[:, there:] == -np.inf).all()
    np.testing.assert_array_equal(found.ids[:, :there], wanted)
    np.testing.assert_allclose(found.similarity[:, :there], cosines, atol=2e-6)
    assert found.ids.dtype == np.int64
    assert found.similarity.dtype == np.float32


@pytest.mark.parametrize(("count", "n"), [(1, 1), (3, 10), (200, 10), (200, 200), (1000, 50)])
def test_neighbours_are_those_of_numpy(rng, cloud, exact, count, n):
    ids, vectors, lonlat = cloud(rng, count, 16)
    store = EmbeddedStore.of(ids, vectors, lonlat, bits=32)
    assert (len(store), store.dimension) == (count, 16)
    search_is_exact(store, ids, vectors, rng.standard_normal((7, 16)), n, exact)


@given(st.data())
def test_equal_rows_come_by_their_ids(data):
    rows = data.draw(st.lists(st.sampled_from([(1, 0), (0, 1), (-1, 0), (0, -2)]), min_size=1))
    ids = np.array(data.draw(st.permutations(range(len(rows)))))
    n = data.draw(st.integers(1, len(rows) + 2))
    store = EmbeddedStore.of(ids, np.array(rows, float), np.zeros((len(rows), 2)), bits=8)
    found = store.search(np.array([[1.0, 0.0]]), n).ids[0]
    ranks = sorted(zip(-np.array(rows)[:, 0].clip(-1, 1), ids.tolist(), strict=True))
    wanted = [i for _, i in ranks][:n]
    assert found.tolist() == wanted + [-1] * (n - len(wanted))


@pytest.mark.parametrize("lists", [False, True])
def test_a_region_holds_what_lies_in_it(rng, cloud, exact, lists):
    ids, vectors, lonlat = cloud(rng, 400)
    store = EmbeddedStore.of(ids, vectors, lonlat, bits=32, lists=lists)
    queries = rng.standard_normal((5, 8))
    for region in (
        Region(7.41, 43.73, 7.43, 43.75), Region(-180.0, -90.0, 180.0, 90.0),
        Region(8.0, 43.0, 9.0, 44.0), Region(7.43, -90.0, -7.0, 90.0),
    ):  # fmt: skip
        west, south, east, north = region
        inside = (lonlat[:, 1] >= south) & (lonlat[:, 1] <= north)
        if west > east:
            inside &= (lonlat[:, 0] >= west) | (lonlat[:, 0] <= east)
        else:
            inside &= (lonlat[:, 0] >= west) & (lonlat[:, 0] <= east)
        search_is_exact(store, ids, vectors, queries, 400, exact, inside, region)


def test_the_edges_of_a_region_belong_to_it():
    place = [[7.4123456, 43.7123456]]
    store = EmbeddedStore.of([5], [[1.0, 0.0]], place)
    here = Region(*place[0], *place[0])
    assert store.search(np.ones((1, 2)), 1, here).ids.tolist() == [[5]]
    beside = here._replace(west=here.west + 2e-7, east=here.east + 2e-7)
    assert store.search(np.ones((1, 2)), 1, beside).ids.tolist() == [[-1]]


def test_lists_find_nearly_all_and_hold_every_row_once(rng):
    centers = rng.standard_normal((40, 16))
    vectors = centers[rng.integers(40, size=6000)] + 0.4 * rng.standard_normal((6000, 16))
    ids, lonlat = np.arange(6000), np.zeros((6000, 2))
    plain = EmbeddedStore.of(ids, vectors, lonlat, bits=32)
    listed = EmbeddedStore.of(ids, vectors, lonlat, bits=32, lists=True)
    assert listed.lists is not None
    assert len(listed.lists.centers) == 154
    assert sorted(listed.ids) == list(range(6000))
    queries = centers + 0.4 * rng.standard_normal((40, 16))
    # 256 lists are opened, which is all of 154
    np.testing.assert_array_equal(plain.search(queries, 10).ids, listed.search(queries, 10).ids)


def test_few_probes_find_most(rng, monkeypatch):
    monkeypatch.setattr(embedded, "PROBES", 3)
    centers = rng.standard_normal((40, 16))
    vectors = centers[rng.integers(40, size=6000)] + 0.4 * rng.standard_normal((6000, 16))
    columns = np.arange(6000), vectors, np.zeros((6000, 2))
    queries = centers + 0.4 * rng.standard_normal((40, 16))
    wanted = EmbeddedStore.of(*columns, bits=32).search(queries, 10).ids
    found = EmbeddedStore.of(*columns, bits=32, lists=True).search(queries, 10).ids
    recall = np.mean([len(set(a) & set(b)) / 10 for a, b in zip(wanted, found, strict=True)])
    assert 0.8 < recall < 1.0


def test_more_lists_are_opened_where_there_are_too_few_rows(rng, cloud, monkeypatch):
    monkeypatch.setattr(embedded, "PROBES", 1)
    ids, vectors, lonlat = cloud(rng, 100)
    found = EmbeddedStore.of(ids, vectors, lonlat, lists=True).search(vectors[:9], 5).ids
    lists = make_lists(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
    assert np.diff(lists.starts).min() < 5  # some lists alone would not do
    assert (found[:, :3] >= 0).all()
    assert (found[:, 0] == ids[:9]).all()


def test_lists_of_equal_and_of_opposite_vectors():
    rows = np.tile([[1.0, 0.0], [-1.0, 0.0]], (50, 1)).astype(np.float32)
    lists = make_lists(rows)
    assert sorted(lists.order) == list(range(100))
    assert np.isfinite(lists.centers).all()
    np.testing.assert_array_equal(lists.order, make_lists(rows).order)


def test_large_stores_are_kept_in_lists(monkeypatch, rng, cloud):
    monkeypatch.setattr(embedded, "LARGE", 50)
    assert EmbeddedStore.of(*cloud(rng, 49)).lists is None
    assert EmbeddedStore.of(*cloud(rng, 50)).lists is not None


@pytest.mark.parametrize(("bits", "error"), [(32, 1e-6), (16, 1e-3), (8, 1.5e-2)])
def test_bits_cost_little(rng, cloud, exact, bits, error):
    ids, vectors, lonlat = cloud(rng, 500, 32)
    queries = rng.standard_normal((20, 32))
    store = EmbeddedStore.of(ids, vectors, lonlat, bits=bits)
    wanted, _ = exact(ids, vectors, queries, 500)
    found = store.search(queries, 500)
    rank = np.argsort(wanted, axis=1), np.argsort(found.ids, axis=1)
    _, cosines = exact(ids, vectors, queries, 500)
    a = np.take_along_axis(cosines, rank[0], axis=1)
    b = np.take_along_axis(found.similarity, rank[1], axis=1)
    assert np.abs(a - b).max() < error
    assert store.rows.dtype == (np.int8 if bits == 8 else np.float32)


@pytest.mark.parametrize("lists", [False, True])
@pytest.mark.parametrize("bits", [8, 16, 32])
def test_what_is_saved_is_what_is_searched(rng, cloud, tmp_path, bits, lists):
    origin = Origin("a map", "a model")
    ids, vectors, lonlat = cloud(rng, 300, 16)
    store = EmbeddedStore.of(ids, vectors, lonlat, origin=origin, bits=bits, lists=lists)
    store.save(tmp_path / "a.vectors")
    with EmbeddedStore.open(tmp_path / "a.vectors", origin) as opened:
        assert (opened.origin, opened.bits, len(opened)) == (origin, bits, 300)
        queries, region = rng.standard_normal((9, 16)), Region(7.41, 43.0, 7.43, 44.0)
        for where in (None, region):
            a, b = store.search(queries, 20, where), opened.search(queries, 20, where)
            np.testing.assert_array_equal(a.ids, b.ids)
            np.testing.assert_array_equal(a.similarity, b.similarity)


def test_no_queries_no_answers(rng, cloud):
    found = EmbeddedStore.of(*cloud(rng, 5)).search(np.zeros((0, 8), np.float32), 3)
    assert found.ids.shape == found.similarity.shape == (0, 3)


def test_other_bits(rng, cloud):
    with pytest.raises(OptionError, match="bits is 4; choose one of 8, 16, 32"):
        EmbeddedStore.of(*cloud(rng, 5), bits=4)


@pytest.fixture
def file(rng, cloud, tmp_path):
    path = tmp_path / "a.vectors"
    EmbeddedStore.of(*cloud(rng, 60), origin=Origin("m", "n"), bits=8, lists=True).save(path)
    return path


def test_a_store_of_another_map_or_model_is_refused(file):
    for origin, what in ((Origin("x", "n"), "map"), (Origin("m", "x"), "model")):
        with pytest.raises(StoreError, match=rf"a\.vectors holds vectors of another {what}; make"):
            EmbeddedStore.open(file, origin)
    assert EmbeddedStore.open(file).origin == Origin("m", "n")


def test_files_that_are_none(file, harbour_file):
    with pytest.raises(InputError, match=r"no\.vectors does not exist.*placegraph city embed"):
        EmbeddedStore.open(file.with_name("no.vectors"))
    with pytest.raises(MapError, match="is a city map, not a vectors map"):
        EmbeddedStore.open(harbour_file)
    with pytest.raises(MapError, match="holds vectors of a city's cells and is no map"):
        open_map(file)


@given(place=st.floats(0.0, 1.0, exclude_max=True), bit=st.integers(0, 7))
def test_a_damaged_file_is_refused(tmp_path_factory, place, bit):
    path = tmp_path_factory.mktemp("damaged") / "a.vectors"
    EmbeddedStore.of([1, 2], [[1.0, 0.0], [0.5, 1.0]], [[0.0, 0.0], [1.0, 1.0]]).save(path)
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 1 << bit
    path.write_bytes(data)
    with pytest.raises((MapError, InputError)):
        EmbeddedStore.open(path)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("ids", lambda a: a[:-1]),
        ("ids", lambda a: -a - 1),
        ("ids", lambda a: a * 0),
        ("positions", lambda a: a[:, :1]),
        ("positions", lambda a: a[:-1]),
        ("vectors", lambda a: a[:, :-1]),
        ("vectors", lambda a: a.astype(np.float32)),
        ("vectors", lambda a: a[:0]),
        ("steps", lambda a: a * np.float32(np.nan)),
        ("steps", lambda a: a[:-1]),
        ("starts", lambda a: a[::-1]),
        ("starts", lambda a: a + 1),
        ("starts", lambda a: a[:-1]),
        ("starts", lambda a: a[:0]),
        ("centers", lambda a: a[:, :-1]),
        ("centers", lambda a: a * np.float32(np.inf)),
        ("bits", lambda _: 7),
        ("bits", lambda _: 16),
        ("bits", lambda _: None),
        ("grain", lambda _: 1.0),
    ],
)
def test_columns_that_contradict_each_other(file, name, change):
    held = read_map(file, "vectors", 1)
    meta, arrays = dict(held.meta), dict(held.arrays)
    where = meta if name in meta else arrays
    where[name] = change(where[name])
    write_map(file, "vectors", 1, meta, arrays)
    with pytest.raises(MapError):
        EmbeddedStore.open(file)
