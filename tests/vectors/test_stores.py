"""Stores by their address, and the commands `placegraph city embed` and `stores`."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from placegraph.errors import OptionError, StoreError
from placegraph.outdoor.network.encoded import EncodedCity
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.vectors import (
    EmbeddedStore,
    MilvusStore,
    Origin,
    Vectors,
    load_store,
    open_store,
)
from placegraph.vectors.stores import is_uri
from placegraph_scale.milvus.server import Server

URI = "http://fake:19530"


@dataclass
class Scatter:
    """A model that throws every place somewhere."""

    fingerprint: str = "scattered"

    def word_vectors(self, words):
        return np.zeros((len(words), 1), np.float32)

    def embed_places(self, places, _vectors):
        return np.random.default_rng(len(places)).standard_normal((len(places), 64))


@pytest.fixture
def shipped(monkeypatch):
    monkeypatch.setattr(GraphTransformer, "default", staticmethod(Scatter))


@pytest.fixture
def reach(monkeypatch, server):
    """Every address leads to the fake server."""
    monkeypatch.setattr(Server, "connect", classmethod(lambda *_: server))


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
    made = EncodedCity(harbour, Scatter()).keep(path, name="town")
    origin = Origin(harbour.fingerprint, "scattered")
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
    made = encoded.keep(tmp_path / "a", name="a")
    cells = made.search(np.eye(len(rows))[:1], 1).ids
    assert cells.tolist() == [[harbour.cells.points[-1]]]


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


@pytest.mark.usefixtures("shipped", "reach")
def test_the_command_loads_a_server_and_resumes(run, fake, harbour, harbour_file):
    fake.plan = {"insert": ["dead"]}
    failed = run("city", "embed", harbour_file, "--store", URI)
    assert (failed.code, failed.out) == (9, "")
    fake.dead = False
    assert run("city", "embed", harbour_file, "--store", URI).code == 11
    half = run("city", "stores", URI)
    assert half.out.count("half loaded") == 1
    done = run("city", "embed", harbour_file, "--store", URI, "--resume", "--json")
    assert done.json["cells"] == len(harbour.cells)
    assert done.json["store"] == URI
    (told,) = run("city", "stores", URI, "--json").json
    assert (told["name"], told["complete"], told["rows"]) == ("harbour", True, len(harbour.cells))
    assert told["collection"] in run("city", "stores", URI).out
    dropped = run("city", "stores", URI, "--drop", told["collection"], "--json")
    assert json.loads(dropped.out)["name"] == "harbour"
    assert run("city", "stores", URI).out == "No stores of placegraph's.\n"
    assert run("city", "stores", URI, "--drop", "x").code == 10


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ([], "Say where to"),
        (["-o", "a", "--store", URI], "Say where to"),
        (["-o", "a", "--resume"], "--resume is for --store"),
        (["--store", "fake:19530"], "is no address"),
    ],
)
def test_commands_that_say_too_little_or_too_much(run, harbour_file, options, words):
    failed = run("city", "embed", harbour_file, *options)
    assert (failed.code, failed.out) == (OptionError.exit_code, "")
    assert words in failed.err
