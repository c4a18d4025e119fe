import shutil

import numpy as np
import pytest

import placegraph as pg
from placegraph.core.estimate import Status
from placegraph.demo.flat import SCENE_PLACES, TWIN_FLAT, WINDOW, write_scenes
from placegraph.demo.town import FLAT, TOWN
from placegraph.errors import MapError, OptionError
from placegraph_lab.worlds.shards import write_shards
from placegraph_scale.library.write import NamedEntry
from placegraph_scale.library.write import write_shards as write_library

SAID = (
    WINDOW,
    "I am in the hotel, by the window",
    "I am in the library on Brückenstraße",
    "I am on the square",
    "I am standing on a square. There is a fountain north of me and a café to my east.",
    "I am in the dining room of Zum Anker",
)
TO_A_HUNDREDTH = {"rel": 0.01, "abs": 0.01}


@pytest.fixture(scope="module")
def folders(demo_world, tmp_path_factory):
    plain, shards = (tmp_path_factory.mktemp(name) for name in ("plain", "shards"))
    made = tmp_path_factory.mktemp("made") / "world"
    shutil.copytree(demo_world, made)
    write_scenes(made, demo_world / f"{FLAT}.scene")
    city = pg.build_city(made / f"{TOWN}.osm", plain / f"{TOWN}.city")
    write_shards(city, shards / "WORLD", 15)
    for name, (town, *_) in SCENE_PLACES.items():
        for there in (plain, shards / "WORLD") if town == TOWN else ():
            shutil.copy(made / f"{name}.scene", there)
    return plain, shards / "WORLD"


@pytest.fixture(scope="module")
def both(folders):
    return [pg.open_world(folder) for folder in folders]


@pytest.fixture(scope="module")
def frames(demo_world):
    return pg.open_capture(demo_world / "window")


def same(ours, theirs):
    assert ours.status is theirs.status
    assert [m.where for m in ours.modes[:1]] == [m.where for m in theirs.modes[:1]]
    shares = {m.where: m.probability for m in theirs.modes if m.scene}
    for mode in ours.modes:
        if mode.where in shares:
            assert mode.probability == pytest.approx(shares[mode.where], **TO_A_HUNDREDTH)
    assert ours.best.probability == pytest.approx(theirs.best.probability, **TO_A_HUNDREDTH)
    assert [(e.statement, e.verdict) for e in ours.evidence] == [
        (e.statement, e.verdict) for e in theirs.evidence
    ]


@pytest.mark.parametrize("text", SAID)
def test_a_sentence_is_answered_as_by_plain_maps(both, text):
    plain, shards = both
    ours, theirs = shards.locate(text), plain.locate(text)
    same(ours, theirs)
    assert "Searched" in ours.reason
    assert ours.understood.to_dict() == theirs.understood.to_dict()


@pytest.mark.parametrize(
    "asked",
    [
        {"text": WINDOW},
        {"text": "I am in the hotel, by the window"},
        {},
        {"text": "I am in the hotel", "near": (9.99883, 53.55021), "radius": 50.0},
        {"near": (9.99883, 53.55021), "radius": 20.0, "heading": 1.0},
    ],
)
def test_frames_are_answered_as_by_plain_maps(both, frames, asked):
    plain, shards = both
    ours, theirs = (world.locate(capture=frames, **asked, seed=0) for world in (shards, plain))
    same(ours, theirs)
    assert ours.best.pose is not None
    np.testing.assert_allclose(ours.best.pose.map_from_camera, theirs.best.pose.map_from_camera)
    assert ours.best.earth.longitude == theirs.best.earth.longitude


def test_place_room_and_pose(both, frames):
    found = both[1].locate(WINDOW, frames)
    best = found.best
    assert (found.status, best.scene, best.building) == (Status.OK, TWIN_FLAT, "Bücherhalle")
    assert (best.room, best.level) == ("living room", "1")
    assert any("window" in e.statement and e.verdict == "for" for e in best.evidence)


def test_it_asks_back_for_buildings_and_takes_the_answer(both, frames):
    world = both[1]
    alone = world.locate(capture=frames)
    assert alone.status is Status.AMBIGUOUS
    question = alone.next_question(world)
    told = world.locate(capture=frames, answers=[question.answer("no")])
    assert (told.status, told.best.building in question.text) == (Status.OK, False)


def test_a_shard_where_scenes_stand_may_be_gone(folders, frames, tmp_path):
    world = shutil.copytree(folders[1], tmp_path / "WORLD")
    for shard in (world / "shards").iterdir():
        shard.write_bytes(shard.read_bytes()[:-40])
    found = pg.open_world(world).locate(WINDOW, frames)
    assert found.status is Status.AMBIGUOUS
    assert found.notes
    assert all(".city" in note for note in found.notes)
    assert {m.scene for m in found.modes} == {FLAT, TWIN_FLAT}


def test_scenes_in_library_shards_and_beside_the_folder(both, folders, frames, tmp_path):
    world = shutil.copytree(folders[1], tmp_path / "WORLD")
    library, paths = pg.SceneLibrary(), sorted(folders[1].glob("*.scene"))
    for path in paths:
        library.add(path.stem, path)
        (world / path.name).unlink()
    places = {n: str(folders[1] / f"{n}.scene") for n in library}
    entries = [NamedEntry(n, library.entry(n), place) for n, place in places.items()]
    write_library(world / "homes.shards", entries)
    wanted = both[1].locate(WINDOW, frames)
    same(pg.open_world(world).locate(WINDOW, frames), wanted)
    shutil.rmtree(world / "homes.shards")
    assert not pg.open_world(world).scenes
    beside = pg.open_world([world, *paths])
    same(beside.locate(WINDOW, frames), wanted)
    assert repr(beside).startswith(f"World(0 cities, {len(paths)} scenes, Planet(")


def test_a_world_in_a_folder_of_maps_is_part_of_it(folders, tmp_path):
    shutil.copytree(folders[1], tmp_path / "all" / "WORLD")
    shutil.copy(folders[0] / f"{TOWN}.city", tmp_path / "all")
    world = pg.open_world(tmp_path / "all")
    assert (set(world.towns), len(world.scenes)) == (
        {TOWN, "WORLD"},
        len(pg.open_world(folders[1]).scenes),
    )
    shutil.copy(folders[0] / f"{TOWN}.city", tmp_path / "all" / "WORLD.city")
    with pytest.raises(MapError, match=r"rename one of them\."):
        pg.open_world(tmp_path / "all")


def test_by_the_command_line_and_a_server(folders, demo_world, run):
    from placegraph_serve.places import Places

    frames = ("--capture", demo_world / "window")
    told = run("locate", folders[1], WINDOW, *frames, "--json", "--quiet")
    assert TWIN_FLAT in told.out
    places = Places([folders[1]])
    assert {entry.kind for entry in places.entries()} == {"world", "scene"}
    for name in ("WORLD", None):
        assert "Bücherhalle" in {m.building for m in places.world(name).locate(WINDOW).modes}
    assert places.world("WORLD").towns["WORLD"] is places.world().towns["WORLD"]
    with pytest.raises(OptionError, match="remove it, or serve a world built with `placegraph"):
        Places([folders[0]], scheduler="tcp://127.0.0.1:1")


def test_it_is_no_single_map(folders):
    with pytest.raises(MapError, match="open_world"):
        pg.open_map(folders[1])
