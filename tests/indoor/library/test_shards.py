"""Shards say what the library of the same scenes says, and read next to nothing to open."""

import json
import shutil

import numpy as np
import pytest

from placegraph import SceneLibrary, SearchOptions
from placegraph.errors import InputError, MapError, OptionError
from placegraph.indoor.language import read
from placegraph.indoor.library import library_of
from placegraph.indoor.library.scenes import Entry
from placegraph.indoor.library.shard_columns import Listed, write_shards
from placegraph.indoor.library.shards import SceneShards
from placegraph_lab.tables.retrieval.retrieval_scale import varied

SCENES = 60
TEXTS = ("a study with two desks", "a bed next to a wardrobe", "a room with a plant but no sofa")


@pytest.fixture(scope="module")
def signatures(maps):
    library = library_of(maps)
    known = {name: library.entry(name).signature for name in library}
    return known | varied(known, SCENES - len(known), np.random.default_rng(0))


@pytest.fixture(scope="module")
def large(signatures):
    """The library that is read."""
    out = SceneLibrary()
    for name, signature in signatures.items():
        out.insert(name, Entry(signature, None))
    return out


def listed(signatures):
    return [Listed(name, Entry(s, None)) for name, s in signatures.items()]


@pytest.fixture(scope="module")
def shards(signatures, tmp_path_factory):
    """All in one shard, so that the same is usual as in the library."""
    return write_shards(tmp_path_factory.mktemp("shards") / "one", listed(signatures))


def test_texts_are_answered_as_by_the_library(shards, large):
    for text in TEXTS:
        np.testing.assert_allclose(
            shards.text_scores(read(text)), large.texts.scores(read(text)), atol=1e-6
        )
        ours, theirs = shards.search(text), large.search(text)
        assert ours.best.scene == theirs.best.scene
        assert ours.best.probability == pytest.approx(theirs.best.probability, abs=0.01)
        assert ours.status is theirs.status


def test_captures_are_answered_as_by_the_library(shards, large, rooms):
    for name, room in rooms.items():
        film = room.film(3)
        ours, theirs = shards.search(film, closely=SCENES), large.search(film)
        assert ours.best.scene == theirs.best.scene == name
        assert ours.best.probability == pytest.approx(theirs.best.probability, abs=0.05)
        pruned = shards.search(film, closely=16)
        assert pruned.best.scene == name


def test_many_shards_are_one_library(shards, signatures, tmp_path, rooms):
    several = write_shards(tmp_path / "several", listed(signatures), size=17)
    assert (len(several), len(several.shards)) == (SCENES, 4)
    assert [several.name(i) for i in range(SCENES)] == list(signatures)
    for name, room in rooms.items():
        assert several.search(room.film(3)).best.scene == name
    for text in TEXTS:  # another sample says what is usual: nearly as likely
        one = {m.scene: m.probability for m in shards.search(text, most=SCENES).modes}
        for mode in several.search(text).modes:
            assert mode.probability == pytest.approx(one[mode.scene], abs=0.05)


def test_nothing_is_read_to_open(shards, monkeypatch):
    monkeypatch.setattr("placegraph.indoor.library.signature_file.read_map", None)
    again = SceneShards.open(shards.folder)
    assert len(again) == SCENES
    for shard in again.shards:
        assert not any(name in vars(shard) for name in ("columns", "_kept"))


def test_scenes_by_their_map_files(rooms, tmp_path):
    made = SceneLibrary()
    for name, room in rooms.items():
        room.scene.save(tmp_path / f"{name}.scene")
        made.add(name, tmp_path / f"{name}.scene")
    scenes = [Listed(n, made.entry(n), f"../{n}.scene") for n in made]
    shards = write_shards(tmp_path / "shards", scenes)
    found = shards.search("a study with two desks")
    assert found.best.scene == "study"
    assert any(e.verdict == "for" for e in found.best.evidence)
    near = shards.library(found.stats["rows"][:2])
    assert near.names[0] == "study"
    (tmp_path / "study.scene").write_bytes(b"another")
    with pytest.raises(MapError, match="another map"):
        shards.library(found.stats["rows"][:1])


# --- bad input ---


def test_nothing_to_write_and_nothing_asked(tmp_path, shards):
    with pytest.raises(OptionError, match="no scene"):
        write_shards(tmp_path / "none", [])
    with pytest.raises(OptionError, match="size"):
        write_shards(tmp_path / "none", [], size=0)
    with pytest.raises(OptionError, match="says nothing of a place"):
        shards.search("I do not know")
    with pytest.raises(OptionError, match="most"):
        shards.search("a sofa", most=0)
    with pytest.raises(OptionError, match="row"):
        shards.name(SCENES)
    with pytest.raises(InputError, match="no map file"):
        shards.library([0])


def test_what_is_unfinished_is_no_library(signatures, tmp_path):
    scenes, folder = listed(signatures)[:9], tmp_path / "several"
    assert len(write_shards(folder, scenes, size=3).shards) == 3

    def cut():
        yield from scenes[:5]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_shards(folder, cut(), size=2)
    with pytest.raises(InputError, match="no shard of a library"):
        SceneShards.open(folder)
    again = write_shards(folder, scenes[:4], size=2)
    assert (len(again), len(again.shards)) == (4, 2)  # the third is of the library before
    shutil.rmtree(folder / "00001")
    shutil.rmtree(folder / "00002")
    with pytest.raises(InputError, match="holds 1 shards of 2"):
        SceneShards.open(folder)


def test_no_shards(tmp_path):
    with pytest.raises(InputError, match="no shard of a library"):
        SceneShards.open(tmp_path)


@pytest.mark.parametrize("column", ["code_0", "text_scene", "names"])
def test_a_damaged_column_is_named(column, shards, tmp_path):
    copy = copied(shards, tmp_path)
    file = copy / "00000" / f"{column}.npy"
    for content in (b"", file.read_bytes()[:-9], np.lib.format.magic(1, 0) + b"nonsense"):
        file.write_bytes(content)
        with pytest.raises(MapError, match=column):
            SceneShards.open(copy)
    np.save(file, np.zeros(3))
    with pytest.raises(MapError, match=column):
        SceneShards.open(copy)
    file.unlink()
    with pytest.raises(MapError, match=column):
        SceneShards.open(copy)


def test_a_head_that_is_damaged_or_newer(shards, tmp_path):
    copy = copied(shards, tmp_path)
    head = copy / "00000" / "shard.json"
    told = json.loads(head.read_text())
    head.write_text(json.dumps(told | {"version": 99}))
    with pytest.raises(MapError, match="version 99"):
        SceneShards.open(copy)
    for text in ("", "[]", "{}", json.dumps(told | {"columns": 3})):
        head.write_text(text)
        with pytest.raises(MapError, match="damaged"):
            SceneShards.open(copy)


def test_of_other_encoders(shards, tmp_path):
    copy = copied(shards, tmp_path)
    head = copy / "usual/shard.json"
    head.write_text(head.read_text().replace(shards.encoders[0].key, "labels other"))
    with pytest.raises(MapError, match="encoded by others"):
        SceneShards.open(copy)


def copied(shards, folder):
    for file in sorted(shards.folder.rglob("*.*")):
        there = folder / "copy" / file.relative_to(shards.folder)
        there.parent.mkdir(parents=True, exist_ok=True)
        there.write_bytes(file.read_bytes())
    return folder / "copy"


def test_options_are_those_of_a_library(shards, rooms):
    film = rooms["study"].film(3)
    found = shards.search(film, options=SearchOptions(geometry=False), frames=slice(2), most=3)
    assert len(found.modes) == 3


def test_on_the_command_line(rooms, tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    made = SceneLibrary()
    for name, room in rooms.items():
        room.scene.save(tmp_path / f"{name}.scene")
        made.add(name, tmp_path / f"{name}.scene")
    made.save(tmp_path / "rooms.library")
    told = run("library", "shard", "rooms.library", "-o", "rooms.shards", "--json")
    assert json.loads(told.out)["scenes"] == 3
    found = run("library", "search", "rooms.shards", "a study with two desks", "--json")
    assert json.loads(found.out)["modes"][0]["scene"] == "study"
    twice = run(
        "library", "shard", "rooms.library", "rooms.library", "-o", "two.shards", "--size", "2"
    )
    assert "6 scenes in 3 shards" in twice.out
    assert SceneShards.open("two.shards").name(3).startswith("rooms: ")


def test_a_pose_in_the_likeliest(rooms, tmp_path):
    made = SceneLibrary()
    for name, room in rooms.items():
        room.scene.save(tmp_path / f"{name}.scene")
        made.add(name, tmp_path / f"{name}.scene")
    shards = write_shards(tmp_path / "s", [Listed(n, made.entry(n), f"../{n}.scene") for n in made])
    found = shards.localize(rooms["study"].film(3), most=2, refine=False, seed=0)
    assert found.best.scene == "study"
