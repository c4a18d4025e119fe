import numpy as np
import pytest

from placegraph.vectors import (
    EmbeddedStore,
    Origin,
    Region,
    Vectors,
    list_stores,
    load_store,
    open_store,
)
from placegraph_scale import milvus as milvus_load

COUNT, DIMENSION = 2_500, 64


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    monkeypatch.setattr(milvus_load, "BATCH", 1_000)


@pytest.fixture(scope="module")
def columns(cloud):
    return cloud(np.random.default_rng(4), COUNT, DIMENSION)


@pytest.fixture(scope="module")
def queries():
    return np.random.default_rng(5).standard_normal((30, DIMENSION))


def finds_the_same(store, columns, queries):
    near = EmbeddedStore.of(*columns, bits=32)
    for region in (None, Region(7.41, 43.73, 7.43, 43.75)):
        a, b = store.search(queries, 10, region), near.search(queries, 10, region)
        np.testing.assert_array_equal(a.ids, b.ids)
        np.testing.assert_allclose(a.similarity, b.similarity, atol=2e-6)
    nowhere = Region(1.0, 1.0, 2.0, 2.0)
    assert (store.search(queries[:1], 3, nowhere).ids == -1).all()


def test_both_back_ends_find_the_same(milvus, columns, queries):
    origin = Origin("a map", "a model")
    with load_store(milvus.uri, Vectors.of(*columns), name="Fürst, 2025", origin=origin) as store:
        finds_the_same(store, columns, queries)
    with open_store(milvus.uri, origin=origin) as store:
        assert (len(store), store.dimension, store.origin) == (COUNT, DIMENSION, origin)
        finds_the_same(store, columns, queries)
    (info,) = list_stores(milvus.uri)
    assert info.collection == f"placegraph_Furst_2025_{origin.version}"
    assert (info.name, info.rows, info.complete) == ("Fürst, 2025", COUNT, True)
