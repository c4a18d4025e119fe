import logging

import numpy as np
import pytest

from placegraph.errors import (
    IncompleteStoreError,
    MissingExtraError,
    OptionError,
    ServiceError,
    StoreError,
)
from placegraph.vectors import Origin, Region, Vectors
from placegraph_scale import milvus
from placegraph_scale.milvus import (
    MilvusStore,
    Server,
    check_uri,
    collection_name,
    drop_store,
    hide_password,
    list_stores,
    load_milvus,
)

HERE = Origin("a map", "a model")
NAME = collection_name("town", HERE)


@pytest.fixture(autouse=True)
def small_batches(monkeypatch):
    monkeypatch.setattr(milvus, "BATCH", 10)


def load(server, content, **options):
    return load_milvus(server, content, **({"name": "town", "origin": HERE} | options))


def holds_all(fake, content, store):
    rows = fake.held[NAME]["rows"]
    assert sorted(r["id"] for r in rows) == content.ids.tolist()
    asked = content.vectors[::5]
    wanted = content.ids[np.argsort(-asked @ content.vectors.T, axis=1, kind="stable")[:, :4]]
    np.testing.assert_array_equal(store.search(asked, 4).ids, wanted)
    assert list(fake.held) == [NAME]


def test_a_load_is_complete_and_searched_by_its_final_name(fake, server, content):
    steps = []
    store = load(server, content, progress=lambda *told: steps.append(told))
    holds_all(fake, content, store)
    assert (len(store), store.dimension, store.origin) == (47, 8, HERE)
    assert fake.calls.count("insert") == 5
    assert "upsert" not in fake.calls
    assert [s for s in steps if s[0] == "loading"] == [("loading", i, 47) for i in range(0, 47, 10)]
    assert {s[0] for s in steps} == {"loading", "indexing", "counting"}
    assert fake.held[NAME]["index"] == "FLAT"
    with store:
        pass
    assert fake.calls[-1] == "close"


def test_fewer_than_asked_for(server, content):
    found = load(server, content).search(content.vectors[:2], 50)
    assert (found.ids[:, 47:] == -1).all()
    assert (found.similarity[:, 47:] == -np.inf).all()
    assert (found.ids[:, :47] >= 0).all()


def test_equal_rows_come_by_their_ids(server):
    rows = Vectors.of([3, 1, 2], [[1.0, 0.0]] * 3, [[0.0, 0.0]] * 3)
    assert load(server, rows).search(np.array([[2.0, 0.0]]), 3).ids.tolist() == [[1, 2, 3]]


def test_queries_in_several_calls(server, content, monkeypatch):
    monkeypatch.setattr(milvus, "TOGETHER", 3)
    store = load(server, content)
    assert store.search(content.vectors, 1).ids[:, 0].tolist() == content.ids.tolist()


@pytest.mark.parametrize(
    "region",
    [
        Region(7.41, 43.73, 7.43, 43.75),
        Region(8.0, 43.0, 9.0, 44.0),
        Region(7.42, -90.0, 7.41, 90.0),
        Region(-180.0, -90.0, 180.0, 90.0),
    ],
)
def test_a_region_holds_what_lies_in_it(server, content, region):
    lon, lat = content.lonlat.T
    west, south, east, north = region
    along = (lon >= west) | (lon <= east) if west > east else (lon >= west) & (lon <= east)
    inside = set(content.ids[along & (lat >= south) & (lat <= north)].tolist())
    found = load(server, content).search(content.vectors[:1], 47, region).ids[0]
    assert set(found.tolist()) - {-1} == inside
    here = Region(lon[7], lat[7], lon[7], lat[7])  # its edges belong to it
    assert load(server, content).search(content.vectors[:1], 1, here).ids == [[content.ids[7]]]


def test_large_stores_have_a_graph(fake, server, content, monkeypatch):
    monkeypatch.setattr(milvus, "LARGE", 40)
    store = load(server, content)
    assert fake.held[NAME]["index"] == "HNSW"
    world = Region(-180.0, -90.0, 180.0, 90.0)
    for n, region, effort in ((10, None, 128), (100, None, 200), (10, world, 1024)):
        assert store.search(content.vectors[:1], n, region).ids[0, 0] == content.ids[0]
        assert fake.effort == {"ef": effort}


def test_a_complete_store_is_not_loaded_again(fake, server, content):
    load(server, content)
    before = fake.calls.count("insert")
    for resume in (False, True):
        holds_all(fake, content, load(server, content, resume=resume))
    assert fake.calls.count("insert") == before


@pytest.mark.parametrize(
    ("plan", "left"),
    [
        ({"create_collection": ["dead"]}, 0), ({"create_collection": ["lost answer"]}, 0),
        ({"insert": ["dead"]}, 0), ({"insert": [None, None, "dead"]}, 20),
        ({"insert": [None, "half"]}, 15), ({"insert": [None, "lost answer"]}, 20),
        ({"flush": ["dead"]}, 47), ({"create_index": ["dead"]}, 47),
        ({"load_collection": ["dead"]}, 47), ({"query": [None, "dead"]}, 47),
        ({"rename_collection": ["dead"]}, 47),
    ],
    ids=str,
)  # fmt: skip
def test_a_load_goes_on_where_it_broke_off(fake, server, content, plan, left):
    fake.plan = plan
    with pytest.raises(ServiceError, match=r"Milvus server at http://…@fake:19530 failed to"):
        load(server, content)
    fake.dead, fake.plan = False, {}
    assert sum(len(c["rows"]) for c in fake.held.values()) == left
    begun = bool(fake.held)
    if begun:
        with pytest.raises(IncompleteStoreError, match=r"not loaded completely.*--resume"):
            MilvusStore.on(server, origin=HERE)
        with pytest.raises(IncompleteStoreError, match="is incomplete; resume it with --resume"):
            load(server, content)
    fake.calls.clear()
    holds_all(fake, content, load(server, content, resume=True))
    sent = fake.calls.count("insert") + fake.calls.count("upsert")
    assert sent == 5 - left // 10 if left < 47 else sent == 0


def test_a_rename_whose_answer_was_lost(fake, server, content):
    fake.plan = {"rename_collection": ["lost answer"]}
    with pytest.raises(ServiceError, match="failed to rename collection: deadline exceeded"):
        load(server, content)
    holds_all(fake, content, load(server, content))


def test_a_row_sent_twice_does_not_make_up_for_one_that_is_lost(fake, server, content):
    fake.plan = {"insert": [None, "doubled", None, "forgotten"]}
    store = load(server, content)
    holds_all(fake, content, store)
    assert fake.calls.count("upsert") == 2


def test_a_server_that_keeps_nothing(fake, server, content):
    fake.plan = {"insert": ["forgotten"] * 5, "upsert": ["forgotten"] * 99}
    with pytest.raises(IncompleteStoreError, match="does not store all rows"):
        load(server, content)
    assert list(fake.held) == [NAME + "_loading"]


def test_a_restarted_server_is_given_time_but_not_for_ever(fake, server, content, monkeypatch):
    once = ["refused"]
    fake.plan = {"flush": once * 3, "load_collection": [*once], "create_index": [*once]}
    holds_all(fake, content, load(server, content))
    clock = iter(range(0, 10_000, 7))
    monkeypatch.setattr("placegraph_scale.milvus.monotonic", lambda: next(clock))
    fake.plan, before = {"flush": once * 999}, fake.calls.count("flush")
    with pytest.raises(ServiceError, match="failed to flush: server unavailable for flush"):
        load(server, content, origin=Origin("b", "c"))
    assert 8 <= fake.calls.count("flush") - before <= 10


def test_a_server_that_dies_under_a_search_and_one_that_lost_rows(fake, server, content):
    store = load(server, content)
    with pytest.raises(OptionError, match="at most 16384"):
        store.search(content.vectors[:1], 16_385)
    fake.held[NAME]["rows"].pop()
    with pytest.raises(IncompleteStoreError, match="has 46 of 47 rows; drop it"):
        MilvusStore.on(server, name="town", origin=HERE)
    fake.dead = True
    with pytest.raises(ServiceError, match="failed to search"):
        store.search(content.vectors[:1], 1)


def test_another_map_model_or_dimension(fake, server, content, rng, cloud):
    load(server, content)
    for origin in (
        Origin("not the map that was added", "a model"),
        Origin("a map", "another model"),
    ):
        with pytest.raises(StoreError, match="was made from another map or model"):
            MilvusStore.on(server, name="town", origin=origin)
        with pytest.raises(StoreError, match="has no store of this map and model"):
            MilvusStore.on(server, origin=origin)
    with pytest.raises(OptionError, match=r"3 numbers, the store's vectors 8"):
        MilvusStore.on(server, origin=HERE).search(np.ones((1, 3)), 1)
    wider = Vectors.of(*cloud(rng, 47, 9))
    with pytest.raises(StoreError, match="contains 47 rows of 8 numbers, not 47 of 9; drop it"):
        load(server, wider)
    fake.plan = {"insert": ["dead"]}
    with pytest.raises(ServiceError):
        load(server, content, origin=Origin("b", "c"))
    fake.dead = False
    with pytest.raises(
        StoreError, match=r"_loading on .* contains 47 rows of 8 numbers, not 47 of 9"
    ):
        load(server, wider, origin=Origin("b", "c"), resume=True)


@pytest.mark.parametrize("description", ["", "{}", "[1]", '{"placegraph": 2}', "no JSON", "null"])
def test_what_is_not_ours(fake, server, content, description):
    load(server, content)
    fake.held[NAME]["description"] = description
    assert list_stores(server) == ()
    with pytest.raises(StoreError, match="has no store 'town'"):
        MilvusStore.on(server, name="town", origin=HERE)
    with pytest.raises(StoreError, match="contains a collection not made by placegraph"):
        load(server, content)
    with pytest.raises(StoreError, match="has no placegraph store"):
        drop_store(server, NAME)
    assert list(fake.held) == [NAME]


def test_stores_by_name_or_by_origin(fake, server, content):
    load(server, content)
    load(server, content, origin=Origin("b", "c"))
    load(server, content, name="town hall", origin=Origin("d", "e"))
    with pytest.raises(StoreError, match="was made from another map or model"):
        MilvusStore.on(server, name="town", origin=Origin("d", "e"))
    fake.held["somebody_elses"] = {"description": "", "dim": 3}
    assert [s.name for s in list_stores(server)].count("town") == 2
    assert all(s.complete for s in list_stores(server))
    assert MilvusStore.on(server, origin=HERE).info.collection == NAME
    assert MilvusStore.on(server, name="town", origin=HERE).info.collection == NAME
    assert MilvusStore.on(server, name="town hall").info.origin == Origin("d", "e")
    with pytest.raises(StoreError, match="give name, map and model"):
        MilvusStore.on(server, name="town")
    with pytest.raises(StoreError, match="has no store 'village'"):
        MilvusStore.on(server, name="village", origin=HERE)
    with pytest.raises(OptionError, match="its name, or the map and the model"):
        MilvusStore.on(server)
    assert drop_store(server, NAME).rows == 47
    assert NAME not in fake.held
    assert "somebody_elses" in fake.held
    with pytest.raises(StoreError, match="has no placegraph store 'somebody_elses'"):
        drop_store(server, "somebody_elses")


@pytest.mark.parametrize(
    ("name", "plain"),
    [("monaco", "monaco"), ("São Paulo (2025)", "Sao_Paulo_2025"), ("東京", "map"), ("", "map"),
     ("a" * 300, "a" * 100), ("_x-y_", "x_y")],
)  # fmt: skip
def test_collections_have_names_that_milvus_allows(name, plain):
    assert collection_name(name, HERE) == f"placegraph_{plain}_{HERE.version}"


@pytest.mark.parametrize(
    ("uri", "timeout", "words"),
    [
        *((uri, 1.0, "is not an address of a Milvus server")
          for uri in ("", "localhost:19530", "ftp://a:1", "http://", "http://a:x", "a.db")),
        *(("http://127.0.0.1:1", seconds, "timeout is") for seconds in (0.0, -1.0, 1e9, float("nan"))),
    ],
)  # fmt: skip
def test_addresses_and_times_that_are_none(uri, timeout, words):
    with pytest.raises(OptionError, match=words):
        Server.connect(uri, timeout)


def test_a_password_is_never_shown():
    assert hide_password("http://root:pass@host:1/db") == "http://…@host:1/db"
    assert hide_password("http://host:1") == "http://host:1"
    with pytest.raises(OptionError) as error:
        check_uri("root:pass@host")
    assert "pass" not in str(error.value)


def test_nobody_answers(caplog):
    pytest.importorskip("pymilvus", reason="needs the extra milvus")
    with pytest.raises(
        ServiceError, match=r"at http://…@127\.0\.0\.1:1 failed to connect"
    ) as error:
        Server.connect("http://root:secret@127.0.0.1:1", 0.2)
    assert "secret" not in str(error.value)
    assert caplog.records == []


def test_only_our_own_failures_are_quiet(server, fake, content):
    seen = []
    handler = logging.Handler()
    handler.emit = seen.append
    log = logging.getLogger("pymilvus")
    log.addHandler(handler)
    try:
        store = load(server, content)
        fake.plan = {"search": ["refused"]}
        with pytest.raises(ServiceError):
            store.search(content.vectors[:1], 1)
        log.getChild("decorators").error("somebody else's")
    finally:
        log.removeHandler(handler)
    assert [r.getMessage() for r in seen] == ["somebody else's"]


def test_without_the_extra(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pymilvus", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'placegraph\[milvus\]'"):
        Server.connect("http://127.0.0.1:1")
