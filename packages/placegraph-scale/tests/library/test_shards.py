import json

import numpy as np
import pytest

from placegraph import SceneLibrary, SearchOptions
from placegraph.core import mapfile as store
from placegraph.errors import InputError, MapError, OptionError
from placegraph.indoor.language import read
from placegraph.indoor.library import make_library
from placegraph.indoor.library.library import Entry
from placegraph_lab.tables.scene.search import draw_variations
from placegraph_scale.library.shards import SceneShards
from placegraph_scale.library.write import NamedEntry, write_shards

SCENES = 60
TEXTS = ("a study with two desks", "a bed next to a wardrobe", "a room with a plant but no sofa")


@pytest.fixture(scope="module")
def signatures(maps):
    library = make_library(maps)
    known = {name: library.entry(name).signature for name in library}
    return known | draw_variations(known, SCENES - len(known), np.random.default_rng(0))


@pytest.fixture(scope="module")
def large(signatures):
    out = SceneLibrary()
    for name, signature in signatures.items():
        out.insert(name, Entry(signature, None))
    return out


def listed(signatures):
    return [NamedEntry(name, Entry(s, None)) for name, s in signatures.items()]


@pytest.fixture(scope="module")
def shards(signatures, tmp_path_factory):
    return write_shards(tmp_path_factory.mktemp("shards") / "one", listed(signatures))


def test_texts_are_answered_as_by_the_library(shards, large):
    for text in TEXTS:
        np.testing.assert_allclose(
            shards.score_text(read(text)), large.texts.scores(read(text)), atol=1e-6
        )
        ours, theirs = shards.search(text), large.search(text)
        assert ours.best.scene == theirs.best.scene
        assert ours.best.probability == pytest.approx(theirs.best.probability, abs=0.01)
        assert ours.status is theirs.status


def test_captures_are_answered_as_by_the_library(shards, large, rooms):
    for name, room in rooms.items():
        film = room.film(3)
        ours, theirs = shards.search(film), large.search(film)
        assert ours.best.scene == theirs.best.scene == name
        assert ours.best.probability == pytest.approx(theirs.best.probability, abs=0.05)
        pruned = shards.search(film, options=SearchOptions(shortlist=32))
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


@pytest.fixture
def files(rooms, tmp_path):
    library = SceneLibrary()
    for name, room in rooms.items():
        room.scene.save(tmp_path / f"{name}.scene")
        library.add(name, tmp_path / f"{name}.scene")
    return library


def test_scenes_by_their_map_files(files, rooms, tmp_path):
    scenes = [NamedEntry(n, files.entry(n), f"../{n}.scene") for n in files]
    shards = write_shards(tmp_path / "shards", scenes)
    found = shards.search("a study with two desks")
    assert found.best.scene == "study"
    assert any(e.verdict == "for" for e in found.best.evidence)
    near = shards.open_scenes(found.stats["rows"][:2])
    assert near.names[0] == "study"
    posed = shards.localize(rooms["study"].film(3), most=2, refine=False, seed=0)
    assert posed.best.scene == "study"
    (tmp_path / "study.scene").write_bytes(b"another")
    with pytest.raises(MapError, match="not the map that was added"):
        SceneShards.open(tmp_path / "shards").open_scenes(found.stats["rows"][:1])


def test_nothing_to_write_and_nothing_asked(tmp_path, shards):
    for words, ask in (
        ("no scene", lambda: write_shards(tmp_path / "none", [])),
        ("size", lambda: write_shards(tmp_path / "none", [], size=0)),
        (
            "mention a room, its objects, their number, or their",
            lambda: shards.search("I do not know"),
        ),
        ("most", lambda: shards.search("a sofa", most=0)),
        ("row", lambda: shards.name(SCENES)),
    ):
        with pytest.raises(OptionError, match=words):
            ask()
    with pytest.raises(InputError, match="no map file"):
        shards.open_scenes([0])


def test_a_shard_that_is_cut_while_it_is_open_is_named(signatures, tmp_path, rooms, monkeypatch):
    monkeypatch.setattr(
        "placegraph.core.mapfile.ALIGNMENT", 1
    )  # small columns are windows on the file, too
    shards, film = write_shards(tmp_path / "one", listed(signatures)[:9]), rooms["study"].film(3)
    row = shards.search("a study with two desks").stats["rows"][0]
    (tmp_path / "one" / "00000.shard").write_bytes(b"")
    for ask in (
        lambda: shards.search("a sofa"),
        lambda: shards.search(film),
        lambda: shards.name(row),
    ):
        with pytest.raises(MapError, match="changed while it was open"):
            ask()


def test_what_is_unfinished_is_no_library(signatures, tmp_path):
    scenes, folder = listed(signatures)[:9], tmp_path / "several"
    assert len(write_shards(folder, scenes, size=3).shards) == 3

    def cut():
        yield from scenes[:5]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_shards(folder, cut(), size=2)
    with pytest.raises(InputError, match="no shards of a library"):
        SceneShards.open(folder)
    again = write_shards(folder, scenes[:4], size=2)
    assert (len(again), len(again.shards)) == (4, 2)
    (folder / "00001.shard").unlink()
    left = SceneShards.open(folder)
    assert (len(left), left.missing) == (2, 2)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"shards": []}, "no shards"),
        ({"shards": [{"file": "../00000.shard", "scenes": 60}]}, "no shards"),
        ({"shards": [{"file": "00000.shard", "scenes": 59}]}, "contains 60 scenes, not 59"),
        ({"encoders": []}, "contradict"),
        ({"encoders": [{"name": "labels", "key": "labels other"}]}, "was encoded by labels other"),
        ({"encoders": 3}, "the file lists no encoders"),
        ({"labels": []}, "contradict"),
    ],
)
def test_a_head_that_is_forged(shards, tmp_path, change, told):
    folder = copied(shards, tmp_path)
    head = store.read_map(folder / "usual.shard", "shard", 1)
    store.write_map(tmp_path / "usual.shard", "shard", 1, head.meta | change, head.arrays)
    with pytest.raises(MapError, match=told):
        SceneShards.open(tmp_path)


@pytest.mark.parametrize("value", [-1e30, np.nan, np.inf])
@pytest.mark.parametrize("column", ["text_much", "text_label_counts"])
def test_usual_texts_that_are_forged(column, value, shards, tmp_path):
    folder = copied(shards, tmp_path)
    head = store.read_map(folder / "usual.shard", "shard", 1)
    numbers = head.arrays[column].copy()
    numbers[0] = value
    store.write_map(folder / "usual.shard", "shard", 1, head.meta, head.arrays | {column: numbers})
    with pytest.raises(MapError, match="contradict"):
        SceneShards.open(folder)


@pytest.mark.parametrize(
    ("column", "told"),
    [("earth", b"[{"), ("earth", b'[{"a": 1}]'), ("earth", b"1"), ("paths", b"a\0b")],
)
def test_what_a_shard_tells_of_a_scene_may_be_forged(column, told, shards, tmp_path):
    folder = copied(shards, tmp_path)
    path = folder / "00000.shard"
    held = store.read_map(path, "shard", 1)
    starts = np.minimum(np.arange(SCENES + 1), 1) * len(told)
    forged = {column: np.frombuffer(told, np.uint8), f"{column}_starts": starts}
    store.write_map(path, "shard", 1, held.meta, held.arrays | forged)
    with pytest.raises(MapError):
        getattr(SceneShards.open(folder), column.rstrip("s"))(0)


def copied(shards, folder):
    for file in shards.shards[0].folder.glob("*.shard"):
        (folder / file.name).write_bytes(file.read_bytes())
    return folder


def test_two_scenes_of_one_name_and_an_older_write(signatures, tmp_path):
    twice = listed(signatures)[:3]
    with pytest.raises(OptionError, match="Two scenes are named"):
        write_shards(tmp_path, [*twice, twice[0]])
    assert len(write_shards(tmp_path, twice, size=1).shards) == 3
    assert len(write_shards(tmp_path, twice).shards) == 1
    assert sorted(f.name for f in tmp_path.glob("*.shard")) == [
        "00000.shard", "beside.shard", "usual.shard",
    ]  # fmt: skip


def test_options_are_those_of_a_library(shards, rooms):
    film = rooms["study"].film(3)
    found = shards.search(film, options=SearchOptions(geometry=False), frames=slice(2), most=3)
    assert len(found.modes) == 3


def test_on_the_command_line(files, tmp_path, run, monkeypatch):
    monkeypatch.chdir(tmp_path)
    files.save(tmp_path / "rooms.library")
    told = run("library", "shard", "rooms.library", "-o", "rooms.shards", "--json")
    assert json.loads(told.out)["scenes"] == 3
    found = run("library", "search", "rooms.shards", "a study with two desks", "--json")
    assert json.loads(found.out)["modes"][0]["scene"] == "study"
    (tmp_path / "more.library").write_bytes((tmp_path / "rooms.library").read_bytes())
    twice = run(
        "library", "shard", "rooms.library", "more.library", "-o", "two.shards", "--size", "2"
    )
    assert "6 scenes in 3 shards" in twice.out
    assert SceneShards.open("two.shards").name(3).startswith("more: ")
