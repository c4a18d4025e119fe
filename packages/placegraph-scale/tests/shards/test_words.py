import json
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.errors import InputError, MapError, OptionError
from placegraph.maps import is_world
from placegraph.outdoor.city import CityMap
from placegraph.outdoor.language.words import tokens
from placegraph.outdoor.map.names import NameIndex
from placegraph_scale.folder import digest_of
from placegraph_scale.shards import WorldFile, finish
from placegraph_scale.shards import words as table
from placegraph_scale.shards.words import (
    WordCounts,
    WordTable,
    count_file,
)
from shards_world import ZOOM


def words_of(map_):
    return [*map_.labels, *(f"~{name}" for name in map_.names)]


def test_sums_are_those_of_the_whole(whole, sharded):
    told, table = WorldFile.read(sharded), WordTable.open(sharded / "words.table")
    assert is_world(sharded)
    assert len(told.shards) > 2
    assert sum(s.viewpoints for s in told.shards) == len(whole.views.positions)
    assert sum(s.objects for s in told.shards) == len(whole.objects)
    assert sum(s.cells for s in told.shards) == len(whole.cells)
    rows = {word: i for i, word in enumerate(words_of(whole.objects))}
    words = range(len(rows))
    here = [rows[table.text(word)] for word in words]
    assert np.array_equal(
        table.counts(words), np.bincount(whole.tokens[1], minlength=len(rows))[here]
    )
    shares = [whole.frequency(np.array([t]), np.ones(1, np.float32)) for t in here]
    assert np.allclose(table.shares(words), shares, rtol=1e-3)


def test_the_table_says_where_a_name_is(sharded):
    told, table = WorldFile.read(sharded), WordTable.open(sharded / "words.table")
    (name,) = table.names.find_rows("Rex")
    held = table.entries(len(table.labels) + name)
    holders = [told.shards[i] for i in held.shards[held.objects > 0]]
    assert len(holders) == 1
    assert "Rex" in CityMap.open(told.path(holders[0])).objects.names


def test_what_another_version_counted_is_counted_anew(sharded, tmp_path, monkeypatch):
    (path, *_), at = sorted(sharded.glob("shards/*.city")), tmp_path / "counts"
    found, digest = count_file(path), digest_of(path)
    found.save(at, digest)
    assert WordCounts.load(at, digest).labels == found.labels
    assert WordCounts.load(at, "another") is None
    with monkeypatch.context() as before:
        before.setattr(table, "COUNTS", ("objects", "mass"))
        found.save(at, digest)
    assert WordCounts.load(at, digest) is None


def test_finishing_again_changes_nothing(world):
    before = {p.name: p.read_bytes() for p in world.glob("*.*")}
    finish(world, ZOOM, 150.0, lambda do, paths: [do(path) for path in paths])
    assert {p.name: p.read_bytes() for p in world.glob("*.*")} == before


def test_what_cannot_be_finished_says_why(world, tmp_path):
    with pytest.raises(InputError, match="world build"):
        finish(tmp_path, ZOOM, 150.0)
    with pytest.raises(OptionError, match="overlap"):
        finish(world, ZOOM, -1.0)
    with pytest.raises(MapError, match="not a key of zoom 3"):
        finish(world, 3, 150.0)
    first = next((world / "shards").iterdir())
    first.write_bytes(first.read_bytes()[:-40])
    with pytest.raises(MapError, match=first.name):
        finish(world, ZOOM, 150.0)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"version": 9}, "version"), ({"format": "other"}, "does not describe"),
        ({"zoom": 3}, "another zoom"), ({"shards": []}, "0 shards"), ({"words": None}, "TypeError"),
    ],
)  # fmt: skip
def test_a_world_file_that_is_none_is_refused(world, change, why):
    path = world / "world.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(MapError, match=why):
        WorldFile.read(world)


def test_a_shard_may_not_lie_outside_the_folder(world):
    path = world / "world.json"
    told = json.loads(path.read_text())
    told["shards"][0]["file"] = "../../elsewhere.city"
    path.write_text(json.dumps(told))
    with pytest.raises(MapError, match="shard"):
        WorldFile.read(world)


def test_a_folder_without_one_is_missing_it(tmp_path):
    assert not is_world(tmp_path)
    with pytest.raises(InputError, match="world build"):
        WorldFile.read(tmp_path)


WORDS = ("Rex", "The", "Theatre", "Station", "Stations", "4th", "West", "Street", "Lange", "Straße",
         "12", "Ulica", "Ulicy", "Museum", "of", "Salt")  # fmt: skip
SAID = st.lists(st.sampled_from(WORDS), min_size=1, max_size=4).map(" ".join)


def written(path, names):
    n = len(names)
    counted = WordCounts((), names, np.ones(n, np.int32), *np.ones((3, n), np.float32),
                      1.0, 1.0, 1.0, n, 1, 1)  # fmt: skip
    table.write_table(path, [counted], path.with_name("scratch"))
    return WordTable.open(path).names


@settings(max_examples=12, deadline=None)
@given(st.lists(SAID, min_size=1, max_size=12, unique=True).map(sorted), SAID)
def test_names_on_disk_mean_what_names_in_memory_mean(tmp_path_factory, names, phrase):
    path = tmp_path_factory.mktemp("names") / "words.table"
    here, there = NameIndex.build(SimpleNamespace(names=names)), written(path, tuple(names))
    for said in (phrase, names[0], phrase.replace("eu", "ue")):
        assert list(there.find_rows(said).items()) == list(here.find_rows(said).items())
        words = tokens(said)
        for k in range(len(words)):
            assert there.longest_name(words, k) == here.longest_name(words, k)


def test_a_misspelt_name_is_found_by_its_words(tmp_path):
    names = written(tmp_path / "words.table", ("Museum of Salt", "Rex", "Station Square"))
    assert names.closest_name("Museum of Slat")[0] == "museum of salt"
    assert names.closest_name("Staton Square")[0] == "station sq"
    assert names.closest_name("Church") is None


@settings(max_examples=12, deadline=None)
@given(st.data())
def test_a_damaged_table_is_named_or_says_what_it_said(tmp_path_factory, data):
    names = tuple(sorted(f"{a} {b}" for a in WORDS for b in WORDS))
    path = tmp_path_factory.mktemp("names") / "words.table"
    whole = written(path, names).find_rows("Rex Theatre")
    blob = bytearray(path.read_bytes())
    blob[data.draw(st.integers(0, len(blob) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(blob)
    with suppress(MapError):
        assert WordTable.open(path).names.find_rows("Rex Theatre") == whole


@pytest.mark.parametrize("off", [99, 1])  # a name that is not there; a way in which none is called
def test_a_forged_posting_is_told(off, tmp_path, monkeypatch):
    def forged(*given, real=table.write_names):
        counts, columns = real(*given)
        return counts, columns | {"postings": columns["postings"] + off}

    monkeypatch.setattr(table, "write_names", forged)
    names = written(tmp_path / "words.table", ("Museum of Salt", "Rex Theatre"))
    with pytest.raises(MapError, match=r"words\.table.*'postings'"):
        names.find_rows("Theatre")


NAMES = ("Rex", "The Rex Theatre", "Rex Theatre", "rex theatre", "Museum", "Museum of Salt", "12 Rex",
         "12 West Street", "Straße", "\U0001f600", "\uffff", "The Salt")  # fmt: skip
LABELS = ("amenity=bank", "amenity=bench", "shop=salt")


@st.composite
def shards(draw):
    found = []
    for _ in range(draw(st.integers(1, 5))):
        labels, names = (
            tuple(sorted(draw(st.sets(st.sampled_from(words))))) for words in (LABELS, NAMES)
        )
        n = len(labels) + len(names)
        objects = np.array(draw(st.lists(st.integers(0, 3), min_size=n, max_size=n)), np.int32)
        mass = objects.astype(np.float32) * 0.5
        found.append(
            WordCounts(labels, names, objects, mass, mass / 3, mass / 9, 1.0, 2.0, 3.0, 4, 5, 6)
        )
    return found


@settings(max_examples=12, deadline=None)
@given(shards())
def test_a_table_is_the_same_however_little_memory_there_is(tmp_path_factory, found):
    folder = tmp_path_factory.mktemp("table")
    for at_once in (2, 1 << 20):
        table.write_table(folder / f"{at_once}", iter(found), folder / "scratch", at_once)
    assert (folder / "2").read_bytes() == (folder / f"{1 << 20}").read_bytes()
    assert sorted(p.name for p in folder.iterdir() if not p.name.startswith(".")) == [
        "1048576",
        "2",
    ]
    made = WordTable.open(folder / "2")
    assert made.labels == tuple(sorted({label for c in found for label in c.labels}))
    assert made.names.names[:] == sorted({name for c in found for name in c.names})
    words = [*made.labels, *made.names.names[:]]
    for row, word in enumerate(words):
        said = [(*c.labels, *c.names) for c in found]
        held = {
            i: int(found[i].objects[texts.index(word)])
            for i, texts in enumerate(said) if word in texts
        }  # fmt: skip
        entries = made.entries(row)
        expected = {i: n for i, n in held.items() if n}
        assert dict(zip(entries.shards.tolist(), entries.objects.tolist(), strict=True)) == expected
        np.testing.assert_array_equal(entries.mass, entries.objects * np.float32(0.5))


def test_a_scratch_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "scratch").write_text("in the way")
    with pytest.raises(MapError, match=r"scratch cannot be written"):
        table.write_table(tmp_path / "words.table", iter(()), tmp_path / "scratch")
