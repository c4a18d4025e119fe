import numpy as np
import pytest

from placegraph.core.geometry import LocalPlane
from placegraph.indoor.refine.matching.matches import Features
from placegraph_lab.tables.named.indoor_colmap import Peer, View, peer
from placegraph_lab.tables.named.speed import (
    COLUMNS,
    Row,
    Triples,
    WordSearch,
    ask_all,
    build_map,
    place_right,
)
from placegraph_lab.tables.outdoor.baselines import Bag
from placegraph_lab.tables.outdoor.places import Note
from placegraph_lab.tables.outdoor.queries import load, make_queries
from placegraph_lab.tables.runner import render

CAFE, BANK = {"amenity": "cafe", "name": "Müller am Markt"}, {"amenity": "bank"}


@pytest.fixture
def square(write_world):
    return write_world([(0.0, 0.0, CAFE), (400.0, 0.0, BANK), (800.0, 0.0, CAFE | {"name": "Ost"})])


def test_words_find_names_and_kinds(square, tmp_path):
    method = WordSearch(square)
    assert build_map(method, tmp_path) >= 0
    raw = load(square).city
    places = raw.plane.to_lonlat(raw.center)
    east = np.argsort(raw.center[:, 0])
    texts = ("I stand at Muller am Markt.", "Near a bank!", "the Ost, or 'so'")
    notes = [Note(t, tuple(places[i])) for t, i in zip(texts, east, strict=True)]
    notes.append(Note("nothing of it", tuple(places[east[0]])))
    found = ask_all(method, tmp_path, notes, place_right)
    assert found["right"] == (0.75, 0.75)
    assert found["count"] == 4
    row = Row("words", "FTS5", build=0.1, map_bytes=2_000_000, **found | {"mean": 0.0021})
    cells = [c.strip() for c in render(COLUMNS, [row]).splitlines()[-1].strip("|").split("|")]
    assert cells[:3] == ["FTS5", ".75/.75", "2.1"]


def test_a_right_place_is_near():
    note = Note("", (8.0, 49.0))
    at = LocalPlane(*note.goal).to_lonlat([[0.0, 101.0]])[0]
    assert place_right(note, at) == (False, True)
    assert place_right(note, None) == (False, False)


def test_triples_are_read_as_written(town, tmp_path):
    asked = make_queries(town, n=8)
    method = Triples(town, names=False)
    method.build(tmp_path)
    ask = method.open(tmp_path)
    bag = Bag.of(load(town), "triples", reach=30.0, longest=25.0)
    assert [ask(q).tolist() for q in asked] == [bag.locate(q, 1)[0].tolist() for q in asked]


@pytest.mark.parametrize(("size", "ratio"), [(140, 0.8), (140, 1.0)])
def test_features_are_read_as_written(tmp_path, size, ratio):
    rng = np.random.default_rng(0)
    vectors = np.abs(rng.standard_normal((90, 128))).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    views = [View(rng.random((n, 3)), vectors[s : s + n]) for s, n in ((0, 50), (50, 0), (50, 40))]
    made = peer(views, lambda _: Features(np.zeros((0, 2)), vectors[:0]), size, ratio, rng)
    made.save(tmp_path / "map.npz")
    read = Peer.open(tmp_path / "map.npz", made.features)
    assert [len(v.points) for v in read.views] == [50, 0, 40]
    assert read.megabytes == made.megabytes
    for before, after in zip(made.views, read.views, strict=True):
        np.testing.assert_allclose(after.points, before.points, atol=1e-6)
        assert (before.vectors * after.vectors).sum(axis=1) == pytest.approx(1.0, abs=2e-4)
