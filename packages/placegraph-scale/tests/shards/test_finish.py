import json

import numpy as np
import pytest

from placegraph.errors import InputError, MapError, OptionError
from placegraph.maps import is_world
from placegraph.outdoor.city import CityMap
from placegraph_scale.folder import digest_of
from placegraph_scale.shards import WorldFile, finish
from placegraph_scale.shards import words as table
from placegraph_scale.shards.words import WordCounts, WordTable, count_file
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
    (name,) = table.names.named("Rex")
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
    with pytest.raises(MapError, match="no key of zoom 3"):
        finish(world, 3, 150.0)
    first = next((world / "shards").iterdir())
    first.write_bytes(first.read_bytes()[:-40])
    with pytest.raises(MapError, match=first.name):
        finish(world, ZOOM, 150.0)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"version": 9}, "version"),
        ({"format": "other"}, "does not describe"),
        ({"zoom": 3}, "another zoom"),
        ({"shards": []}, "0 shards"),
        ({"words": None}, "TypeError"),
    ],
)
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


def test_a_damaged_table_is_refused(world):
    path = world / "words.table"
    blob = bytearray(path.read_bytes())
    blob[len(blob) // 2] ^= 255
    path.write_bytes(blob)
    with pytest.raises(MapError, match=r"words\.table"):
        WordTable.open(path)
