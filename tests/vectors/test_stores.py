from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from placegraph.core import plugins
from placegraph.core.mapfile import read_map, write_map
from placegraph.errors import InputError, MapError, MissingExtraError, OptionError, StoreError
from placegraph.maps import open_map
from placegraph.outdoor.network.network import EncodedCity, GraphTransformer
from placegraph.outdoor.network.weights import Shape
from placegraph.vectors import EmbeddedStore, Origin, Region, Vectors, list_stores, open_store
from placegraph.vectors.stores import GRAIN, checked_queries, is_uri, unit

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
        (0, [4, 4], "not unique"), (0, [4, -1], "negative"),
        (0, np.array([4, 2**63 + 1], np.uint64), "negative"),
        (0, [4.0, 2.0], "one integer a vector"), (0, [4], "one integer a vector"),
        (1, [[0.0, 0.0], [1.0, 0.0]], "zero or not finite"),
        (1, [[np.nan, 0.0], [1.0, 0.0]], "zero or not finite"),
        (1, [[1e200, 1e200], [1.0, 0.0]], "zero or not finite"), (1, [1.0, 2.0], "rows, dimension"),
        (1, [["a"], ["b"]], "rows, dimension"), (1, np.zeros((0, 2)), "at least one vector"),
        (2, [[7.4, 43.7]], "longitude and latitude"),
        (2, [[7.4, 91.0], [0.0, 0.0]], "longitude and latitude"),
        (2, [[np.nan, 0.0], [0.0, 0.0]], "longitude and latitude"),
    ],
)  # fmt: skip
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
    with pytest.raises(OptionError, match="is not a region"):
        Region(*box).validate()


def test_a_region_may_cross_the_date_line():
    assert Region(179.0, -1.0, -179.0, 1.0).validate().crosses_date_line
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


def test_a_map_keeps_its_digest_and_another_has_another(
    harbour, harbour_file, make_city, hafenstadt
):
    mark = harbour.digest
    assert open_map(harbour_file).digest == mark
    assert make_city(hafenstadt, cell_size=40.0).digest != mark
    assert make_city(hafenstadt, edge_distance=40.0).digest != mark
    assert len(mark) == 32


URI = "http://fake:19530"


@dataclass
class Scatter:
    """A model that throws every place somewhere."""

    digest: str = "scattered"
    shape: Shape = field(default_factory=Shape)

    def word_vectors(self, words):
        return np.zeros((len(words), 1), np.float32)

    def embed_places(self, places, _vectors):
        return np.random.default_rng(len(places)).standard_normal((len(places), 64))


@pytest.fixture
def shipped(monkeypatch):
    def default(*, printed):
        return Scatter(shape=Shape(printed=printed))

    monkeypatch.setattr(GraphTransformer, "default", default)


def test_addresses_of_files_and_of_servers():
    assert is_uri(URI)
    assert is_uri("HTTPS://host")
    for file in ("a.vectors", "folder/http/a", "http.vectors", Path("http://a"), "http:"):
        assert not is_uri(file)


def test_positions_are_the_centres_of_the_cells(harbour):
    wanted = [(cell.longitude, cell.latitude) for cell in harbour.cells.values()]
    np.testing.assert_allclose(harbour.cells.lonlat, wanted, rtol=0, atol=1e-12)


def test_a_city_is_embedded_into_a_file(harbour, tmp_path):
    path = tmp_path / "town.vectors"
    made = EncodedCity(harbour, Scatter()).save_embeddings(path, name="town")
    origin = Origin(harbour.digest, "scattered")
    with open_store(path, origin=origin) as opened:
        assert isinstance(opened, EmbeddedStore)
        assert opened.ids.tolist() == harbour.cells.points.tolist()
        assert (made.origin, opened.origin, opened.dimension) == (origin, origin, 64)
    with pytest.raises(StoreError, match="another model"):
        open_store(path, origin=Origin(origin.map, "trained later"))


def test_embeddings_that_are_there_are_used(harbour, tmp_path):
    rows = np.eye(len(harbour.cells))[::-1]
    encoded = EncodedCity(harbour, Scatter())
    vars(encoded)["embeddings"] = rows
    made = encoded.save_embeddings(tmp_path / "a", name="a")
    cells = made.search(np.eye(len(rows))[:1], 1).ids
    assert cells.tolist() == [[harbour.cells.points[-1]]]


@pytest.mark.usefixtures("shipped")
def test_the_command_writes_a_file(run, harbour, harbour_file, tmp_path):
    path = tmp_path / "town.vectors"
    done = run("city", "embed", harbour_file, "-o", path, "--json")
    assert (done.code, done.err) == (0, "")
    assert done.json["cells"] == len(harbour.cells)
    assert done.json["bytes"] == path.stat().st_size
    assert done.json["version"] == open_store(path).origin.version
    small = run("city", "embed", harbour_file, "-o", path, "--bits", "8")
    assert small.out.startswith(f"{path}: {len(harbour.cells):,} cells, 64 numbers each, version")
    assert path.stat().st_size < done.json["bytes"]
    assert run("city", "embed", harbour_file, "-o", path, "--quiet").out == ""


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "The destination is missing"),
        (["-o", "a", "--store", URI], "The destination is missing"),
        (["-o", "a", "--resume"], "--resume applies only to --store"),
        (["--store", "fake:19530"], "is not an address"),
    ],
)
def test_commands_that_say_too_little_or_too_much(run, harbour_file, options, words):
    failed = run("city", "embed", harbour_file, *options)
    assert (failed.code, failed.out) == (OptionError.exit_code, "")
    assert words in failed.err


def test_a_server_takes_an_extra(monkeypatch):
    def absent(name):
        raise ModuleNotFoundError(name=name.partition(".")[0])

    monkeypatch.setattr(plugins, "import_module", absent)
    for ask in (open_store, list_stores):
        with pytest.raises(MissingExtraError, match=r"placegraph\[scale\]"):
            ask(URI)


def test_files_with_inverted_lists_of_earlier_versions_open(rng, cloud, tmp_path):
    store = EmbeddedStore.of(*cloud(rng, 60), bits=8)
    store.save(tmp_path / "a.vectors")
    held = read_map(tmp_path / "a.vectors", "vectors", 1)
    order = rng.permutation(60)
    arrays = {k: v[order] if k != "steps" else v for k, v in held.arrays.items()}
    arrays |= {"starts": np.array([0, 60]), "centers": np.ones((1, 8), np.float32)}
    write_map(tmp_path / "b.vectors", "vectors", 1, held.meta, arrays)
    queries = rng.standard_normal((4, 8))
    found = open_store(tmp_path / "b.vectors").search(queries, 10)
    np.testing.assert_array_equal(found.ids, store.search(queries, 10).ids)


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


def test_a_region_holds_what_lies_in_it(rng, cloud, exact):
    ids, vectors, lonlat = cloud(rng, 400)
    store = EmbeddedStore.of(ids, vectors, lonlat, bits=32)
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


@pytest.mark.parametrize("bits", [8, 16, 32])
def test_what_is_saved_is_what_is_searched(rng, cloud, tmp_path, bits):
    origin = Origin("a map", "a model")
    ids, vectors, lonlat = cloud(rng, 300, 16)
    store = EmbeddedStore.of(ids, vectors, lonlat, origin=origin, bits=bits)
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
    EmbeddedStore.of(*cloud(rng, 60), origin=Origin("m", "n"), bits=8).save(path)
    return path


def test_a_store_of_another_map_or_model_is_refused(file):
    for origin, what in ((Origin("x", "n"), "map"), (Origin("m", "x"), "model")):
        with pytest.raises(
            StoreError, match=rf"a\.vectors contains vectors of another {what}; create"
        ):
            EmbeddedStore.open(file, origin)
    assert EmbeddedStore.open(file).origin == Origin("m", "n")


def test_files_that_are_none(file, harbour_file):
    with pytest.raises(InputError, match=r"no\.vectors does not exist.*placegraph city embed"):
        EmbeddedStore.open(file.with_name("no.vectors"))
    with pytest.raises(MapError, match="is a city map, not a vectors map"):
        EmbeddedStore.open(harbour_file)
    with pytest.raises(MapError, match="contains the vectors of a city's cells,"):
        open_map(file)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("ids", lambda a: a[:-1]), ("ids", lambda a: -a - 1), ("ids", lambda a: a * 0),
        ("positions", lambda a: a[:, :1]), ("positions", lambda a: a[:-1]),
        ("vectors", lambda a: a[:, :-1]), ("vectors", lambda a: a.astype(np.float32)),
        ("vectors", lambda a: a[:0]), ("steps", lambda a: a * np.float32(np.nan)),
        ("steps", lambda a: a[:-1]), ("bits", lambda _: 7), ("bits", lambda _: 16),
        ("bits", lambda _: None), ("grain", lambda _: 1.0),
    ],
)  # fmt: skip
def test_columns_that_contradict_each_other(file, name, change):
    held = read_map(file, "vectors", 1)
    meta, arrays = dict(held.meta), dict(held.arrays)
    where = meta if name in meta else arrays
    where[name] = change(where[name])
    write_map(file, "vectors", 1, meta, arrays)
    with pytest.raises(MapError):
        EmbeddedStore.open(file)
