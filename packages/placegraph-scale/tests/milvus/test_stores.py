import json

import numpy as np
import pytest
from tests.vectors.test_stores import URI, shipped  # noqa: F401  # a fixture

from placegraph.vectors import EmbeddedStore, Origin, Vectors, load_store, open_store
from placegraph_scale.milvus import MilvusStore, Server


@pytest.fixture
def reach(monkeypatch, server):
    monkeypatch.setattr(Server, "connect", classmethod(lambda *_: server))


@pytest.mark.usefixtures("reach")
def test_both_back_ends_by_one_call(rng, cloud, tmp_path):
    columns, origin = cloud(rng, 50), Origin("m", "n")
    a = load_store(tmp_path / "a.vectors", Vectors.of(*columns), name="a", origin=origin, bits=32)
    b = load_store(URI, Vectors.of(*columns), name="a", origin=origin)
    assert (type(a), type(b)) == (EmbeddedStore, MilvusStore)
    for opened in (open_store(tmp_path / "a.vectors", origin=origin), open_store(URI, name="a")):
        assert (len(opened), opened.origin) == (50, origin)
        found = opened.search(columns[1][:6], 5).ids
        np.testing.assert_array_equal(found, a.search(columns[1][:6], 5).ids)


@pytest.mark.usefixtures("shipped", "reach")
def test_the_command_loads_a_server_and_resumes(run, fake, harbour, harbour_file):
    fake.plan = {"insert": ["dead"]}
    failed = run("city", "embed", harbour_file, "--store", URI)
    assert (failed.code, failed.out) == (9, "")
    fake.dead = False
    assert run("city", "embed", harbour_file, "--store", URI).code == 11
    half = run("city", "stores", URI)
    assert half.out.count("incomplete: finish it") == 1
    done = run("city", "embed", harbour_file, "--store", URI, "--resume", "--json")
    assert done.json["cells"] == len(harbour.cells)
    assert done.json["store"] == URI
    (told,) = run("city", "stores", URI, "--json").json
    assert (told["name"], told["complete"], told["rows"]) == ("harbour", True, len(harbour.cells))
    assert told["collection"] in run("city", "stores", URI).out
    dropped = run("city", "stores", URI, "--drop", told["collection"], "--json")
    assert json.loads(dropped.out)["name"] == "harbour"
    assert run("city", "stores", URI).out == "The server has no placegraph stores.\n"
    assert run("city", "stores", URI, "--drop", "x").code == 10
