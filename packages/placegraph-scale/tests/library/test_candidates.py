import shutil
from pathlib import Path

import numpy as np
import pytest

import placegraph as pg
from placegraph.core.mapfile import read_map, write_map
from placegraph.errors import InputError, MapError, PlacegraphError
from placegraph.indoor.library.library import Entry
from placegraph.world import open_world
from placegraph_lab.tables.scene.search import draw_variations
from placegraph_scale.library import candidates
from placegraph_scale.library.shards import SceneShards
from placegraph_scale.library.write import NamedEntry, write_shards

ASKED = (
    {"text": "I am in the Stadtbibliothek, in a room with two desks."},
    {"text": "There is a bed next to a wardrobe."},
    {"text": "I am in the Hotel Hansa on the Lange Straße, by a sofa.", "near": (9.99, 53.55)},
    {"text": "I am in a room with a sofa.", "near": (13.40, 52.52), "radius": 300.0},
    {"near": (13.40, 52.52)},
    {"text": "The bakery is north of me."},
)


@pytest.fixture(scope="module")
def maps_and_library(folder, tmp_path_factory):
    read, mapped = (tmp_path_factory.mktemp(name) for name in ("read", "mapped"))
    scenes = tmp_path_factory.mktemp("scenes")
    library = pg.SceneLibrary()
    for path in sorted(folder.glob("*.scene")):
        shutil.copy(path, scenes)
        library.add(path.stem, scenes / path.name)
    for there in (read, mapped):
        for city in folder.glob("*.city"):
            shutil.copy(city, there)
    library.save(read / "all.library")
    library = pg.open_map(read / "all.library")
    listed = [
        NamedEntry(n, library.entry(n), str(library.entry(n).path.resolve())) for n in library
    ]
    write_shards(mapped / "all.shards", listed)
    return read, mapped


@pytest.fixture(scope="module")
def both(maps_and_library):
    return [open_world(path) for path in maps_and_library]


def same(ours, theirs):
    assert ours.status is theirs.status
    assert [m.where for m in ours.modes] == [m.where for m in theirs.modes]
    chances = ([m.probability for m in e.modes] for e in (ours, theirs))
    np.testing.assert_allclose(*chances, rtol=0.01, atol=1e-4)
    assert ours.elsewhere == pytest.approx(theirs.elsewhere, rel=0.01, abs=1e-4)
    assert ours.reason == theirs.reason
    assert [e.statement for e in ours.evidence] == [e.statement for e in theirs.evidence]


@pytest.mark.parametrize("asked", ASKED)
def test_what_is_said_is_answered_as_by_the_library(both, asked):
    read, mapped = both
    same(mapped.locate(**asked), read.locate(**asked))


@pytest.mark.parametrize("room", ["study", "bedroom"])
def test_frames_are_answered_as_by_the_library(both, films, room):
    read, mapped = both
    ours, theirs = (world.locate(None, films[room], refine=False) for world in (mapped, read))
    same(ours, theirs)
    assert ours.best.pose is not None


@pytest.mark.parametrize("names", [["reading"], ["suite", "twin"]])
def test_scenes_that_nothing_tells_apart_are_looked_into(folder, films, tmp_path, names):
    library = pg.SceneLibrary()
    for name in names:
        library.add(name, folder / f"{name}.scene")
    paths = {n: str(folder / f"{n}.scene") for n in library}
    entries = [NamedEntry(n, library.entry(n), path) for n, path in paths.items()]
    write_shards(tmp_path / "all.shards", entries)
    world, room = open_world(tmp_path), "study" if len(names) == 1 else "parlour"
    for asked in (
        {"text": "There is a sofa." if len(names) > 1 else "I am in a room with two desks."},
        {"near": (9.99, 53.55), "radius": 1e6},
        {"capture": films[room], "refine": False},
    ):
        found = world.locate(**asked)
        assert {m.scene for m in found.modes} == set(names)
        assert sum(m.probability for m in found.modes) > 0.8


def test_few_are_opened_and_the_others_are_weighed(both, monkeypatch):
    monkeypatch.setattr(candidates, "LIKELIEST", 1)
    read, mapped = both
    for asked in ASKED[:4]:
        ours, theirs = mapped.locate(**asked), read.locate(**asked)
        shares = {m.where: m.probability for m in theirs.modes}
        for mode in ours.modes:
            assert mode.probability == pytest.approx(shares[mode.where], rel=0.01, abs=1e-3)
        assert ours.elsewhere == pytest.approx(theirs.elsewhere, rel=0.01, abs=1e-3)


def test_shards_and_scenes_beside_each_other(maps_and_library, folder, tmp_path):
    _, mapped = maps_and_library
    shutil.copytree(mapped, tmp_path / "world")
    shutil.copy(folder / "twin.scene", tmp_path / "world" / "again.scene")
    found = open_world(tmp_path / "world").locate("I am in a room with a sofa.", top=30)
    by_scene = {}
    for mode in found.modes:
        by_scene[mode.scene] = by_scene.get(mode.scene, 0.0) + mode.probability
    assert by_scene["again"] == pytest.approx(by_scene["twin"], rel=1e-3)


def test_open_map_and_a_folder_of_shards_alone(maps_and_library):
    _, mapped = maps_and_library
    shards = pg.open_map(mapped / "all.shards")
    assert isinstance(shards, SceneShards)
    assert open_world(mapped / "all.shards").locate("two desks").best.scene == "reading"
    with pytest.raises(MapError, match="part of a library in shards"):
        pg.open_map(mapped / "all.shards" / "00000.shard")


def test_by_the_command_line_and_a_server(maps_and_library, run):
    from placegraph_serve.places import Places

    _, mapped = maps_and_library
    told = run("locate", mapped, "There are two desks.", "--json")
    assert "reading" in told.out
    places = Places([mapped])
    assert places.world().locate("There are two desks.").best.scene == "reading"
    listed = {facts["name"]: facts for facts in places.describe_maps()}
    assert (listed["all"]["kind"], listed["all"]["objects"]) == ("shards", 4)


@pytest.fixture(scope="module")
def sharded(maps_and_library, tmp_path_factory):
    read, mapped = maps_and_library
    library = pg.open_map(read / "all.library")
    more = draw_variations(
        {n: library.entry(n).signature for n in library}, 5, np.random.default_rng(0)
    )
    listed = [NamedEntry(n, library.entry(n), str(library.entry(n).path)) for n in library]
    listed += [NamedEntry(n, Entry(s, None)) for n, s in more.items()]
    there = tmp_path_factory.mktemp("sharded")
    shutil.copy(mapped / "west.city", there)
    write_shards(there / "all.shards", listed, size=4)
    return there


@pytest.fixture
def damaged(sharded, tmp_path):
    return Path(shutil.copytree(sharded, tmp_path / "world"))


@pytest.mark.parametrize("fault", ["missing", "cut", "turned", "newer", "another"])
def test_a_shard_that_cannot_be_read_is_named_and_the_rest_answers(damaged, fault):
    shard = damaged / "all.shards" / "00001.shard"
    whole = shard.read_bytes()
    if fault == "missing":
        shard.unlink()
    elif fault == "another":
        shutil.copy(damaged / "all.shards" / "00002.shard", shard)
    elif fault == "newer":
        file = read_map(shard, "shard", 1)
        write_map(shard, "shard", 2, file.meta, file.arrays)
    else:
        middle = len(whole) // 2
        other = bytes([whole[middle] ^ 1])
        shard.write_bytes(
            whole[:-99] if fault == "cut" else whole[:middle] + other + whole[middle + 1 :]
        )
    shards = pg.open_map(damaged / "all.shards")
    assert (len(shards), shards.missing) == (5, 4)
    assert "00001.shard" in shards.notes[0]
    told = shards.search("two desks")
    assert told.best.scene == "reading"
    assert "4 scenes were not searched" in told.reason
    found = open_world(damaged).locate("There are two desks.")
    assert found.best.scene == "reading"
    assert any("00001.shard" in note for note in found.notes)


def test_a_map_that_is_gone_is_named(maps_and_library, damaged, tmp_path):
    read, _ = maps_and_library
    library = pg.open_map(read / "all.library")
    paths = {n: library.entry(n).path for n in library} | {"reading": tmp_path / "gone.scene"}
    listed = [NamedEntry(n, library.entry(n), str(path)) for n, path in paths.items()]
    write_shards(damaged / "all.shards", listed)
    found = open_world(damaged).locate("There is a bed next to a wardrobe.")
    assert found.best.scene == "stacks"
    assert any("gone.scene" in note for note in found.notes)


@pytest.mark.parametrize(
    "column",
    [
        "code_0", "panoramas", "starts", "names_starts", "text_label_units", "stand_starts", "order",
        "vectors_1",
    ],
)  # fmt: skip
def test_a_forged_column_is_refused(damaged, column):
    shard = damaged / "all.shards" / "00001.shard"
    file = read_map(shard, "shard", 1)
    forged = np.array(file.arrays[column])
    forged = forged[:-1] if column in ("order", "vectors_1") else forged + 5
    write_map(shard, "shard", 1, file.meta, file.arrays | {column: forged})
    shards = pg.open_map(damaged / "all.shards")
    assert shards.missing == 4
    assert "00001.shard" in shards.notes[0]


def test_nothing_is_left(damaged):
    for shard in (damaged / "all.shards").glob("0*.shard"):
        shard.write_bytes(b"")
    with pytest.raises(MapError, match="no shard can be read"):
        pg.open_map(damaged / "all.shards")
    with pytest.raises(PlacegraphError, match="no shard can be read"):
        open_world(damaged).locate("two desks")
    (damaged / "all.shards" / "usual.shard").write_bytes(b"nonsense")
    with pytest.raises(MapError):
        pg.open_map(damaged / "all.shards")
    (damaged / "all.shards" / "usual.shard").unlink()
    with pytest.raises(InputError, match="no shards of a library"):
        SceneShards.open(damaged / "all.shards")
