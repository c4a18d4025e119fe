"""Maps of a folder: opened lazily, bad ones named, foreign ones left alone."""

import shutil
from dataclasses import replace

import pytest

import placegraph as pg
from placegraph.core.estimate import Status
from placegraph.demo.flat import TWIN_FLAT, WINDOW, write_scenes
from placegraph.demo.town import FLAT, TOWNS
from placegraph.errors import InputError, MapError, MissingExtraError, OptionError, PlacegraphError


def test_maps_are_opened_when_they_are_asked_for_and_kept(folder):
    world = pg.open_world(folder)
    assert set(world.cities) == {"west", "east"}
    assert not world.cities._opened
    assert world.cities["west"] is world.cities["west"]
    assert {path.name for path, _ in world.ignored} == {"west.osm", "east.osm"}
    with pytest.raises(OptionError, match="'north' is not a map"):
        world.cities["north"]


def test_bad_files_are_named_all(folder, tmp_path):
    (tmp_path / "broken.city").write_bytes((folder / "west.city").read_bytes()[:40])
    shutil.copy(folder / "west.city", tmp_path / "west.scene")
    with pytest.raises(MapError, match=r"(?s)broken.city.*west.scene contains a city map"):
        pg.open_world(tmp_path)
    shutil.copy(folder / "west.city", tmp_path / "twin.city")
    (tmp_path / "more").mkdir()
    shutil.copy(folder / "west.city", tmp_path / "more" / "twin.city")
    with pytest.raises(MapError, match="the same name"):
        pg.open_world([tmp_path / "twin.city", tmp_path / "more"])


def test_a_place_without_maps(tmp_path):
    for place in (tmp_path, tmp_path / "nothing"):
        with pytest.raises(InputError):
            pg.open_world(place)


def test_scenes_of_a_library_belong_to_the_world(folder, tmp_path):
    library = pg.SceneLibrary()
    library.add("reading", folder / "reading.scene")
    library.save(tmp_path / "all.library")
    world = pg.open_world([tmp_path])
    assert set(world.scenes) == {"reading"}
    assert world.library.entry("reading") is world.libraries["all"].entry("reading")


def test_a_map_that_changed_since_its_library_was_made_is_compared_anew(folder, films, tmp_path):
    shutil.copy(folder / "reading.scene", tmp_path)
    library = pg.SceneLibrary()
    library.add("reading", tmp_path / "reading.scene")
    library.save(tmp_path / "all.library")
    scene = pg.open_map(tmp_path / "reading.scene")
    scene.anchored(replace(scene.anchors[0], level="3")).save(tmp_path / "reading.scene")
    best = pg.open_world(tmp_path).locate(capture=films["study"]).best
    assert (best.scene, best.level) == ("reading", "3")


def test_a_link_to_itself_is_refused_by_name(tmp_path):
    (tmp_path / "a.scene").symlink_to(tmp_path / "a.scene")
    with pytest.raises(PlacegraphError, match=r"a\.scene"):
        pg.open_world(tmp_path)


@pytest.fixture(scope="module")
def town(demo_world, tmp_path_factory):
    """The world that `placegraph demo` leaves."""
    folder = tmp_path_factory.mktemp("demo") / "world"
    shutil.copytree(demo_world, folder)
    for name in TOWNS[1:]:
        pg.build_city(folder / f"{name}.osm", folder / f"{name}.city")
    write_scenes(folder, demo_world / f"{FLAT}.scene")
    return pg.open_world(folder)


@pytest.fixture(scope="module")
def frames(demo_world):
    """Three frames taken by a window."""
    return pg.open_capture(demo_world / "window")


@pytest.mark.all
def test_in_the_library_on_its_street_by_the_window(town, frames):
    found = town.locate(WINDOW, frames)
    best = found.best
    assert (found.status, best.scene, best.building) == (Status.OK, TWIN_FLAT, "Bücherhalle")
    assert (best.room, best.level) == ("living room", "1")
    assert any("window" in e.statement and e.verdict == "for" for e in best.evidence)


@pytest.mark.all
def test_identical_flats_are_told_apart_by_the_sentence(town, frames):
    alone = town.locate(None, frames)
    assert alone.status is Status.AMBIGUOUS
    assert {m.scene for m in alone.modes} == {FLAT, TWIN_FLAT}
    told = town.locate("I am in the hotel, by the window", frames)
    assert (told.status, told.best.scene) == (Status.OK, FLAT)


@pytest.mark.all
def test_a_sentence_that_fits_two_towns_is_told_apart_by_the_frames(town, frames):
    alone = town.locate(WINDOW)
    assert alone.status is Status.AMBIGUOUS
    likely = [m for m in alone.modes if m.probability > 0.1]
    assert {m.building for m in likely} == {"Bücherhalle", "Stadtbücherei"}
    assert {round(m.longitude) for m in likely} == {10, 11}
    assert town.locate(WINDOW, frames).best.longitude == pytest.approx(9.9887, abs=0.001)


@pytest.mark.all
def test_of_two_libraries_in_town_the_street_is_believed(town):
    told = town.locate("I am in the library on Brückenstraße")
    assert told.best.building == "Stadtbibliothek"
    assert sum(m.probability for m in told.modes if m.building == "Stadtbibliothek") > 0.8


@pytest.mark.all
@pytest.mark.parametrize(
    "text",
    [
        "I am on the square",
        "I am standing on a square. There is a fountain north of me and a café to my east.",
        "I am in the park",
    ],
)
def test_open_ground_is_no_building(town, text):
    """A promenade along the library's wall is called a square, too."""
    found = town.locate(text)
    assert found.best.scene == ""
    assert sum(m.probability for m in found.modes if m.scene) < 0.1


@pytest.mark.parametrize(
    ("file", "open_it"), [("usual.shard", pg.open_map), ("world.json", pg.open_world)]
)
def test_shards_without_their_plugin_name_the_extra(file, open_it, tmp_path, monkeypatch):
    (tmp_path / file).touch()
    monkeypatch.setattr("placegraph.core.plugins.plugins", lambda _group: {})
    with pytest.raises(MissingExtraError, match=r"placegraph\[scale\]"):
        open_it(tmp_path)
