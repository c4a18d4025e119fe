"""Maps of a folder: opened lazily, bad ones named, foreign ones left alone."""

import shutil
from dataclasses import replace

import pytest

import placegraph as pg
from placegraph.errors import InputError, MapError, OptionError, PlacegraphError


def test_maps_are_opened_when_they_are_asked_for_and_kept(folder):
    world = pg.open_world(folder)
    assert set(world.cities) == {"west", "east"}
    assert not world.cities._opened
    assert world.cities["west"] is world.cities["west"]
    assert {path.name for path, _ in world.ignored} == {"west.osm", "east.osm"}
    with pytest.raises(OptionError, match="'north' is no map"):
        world.cities["north"]


def test_bad_files_are_named_all(folder, tmp_path):
    (tmp_path / "broken.city").write_bytes((folder / "west.city").read_bytes()[:40])
    shutil.copy(folder / "west.city", tmp_path / "west.scene")
    with pytest.raises(MapError, match=r"(?s)broken.city.*west.scene holds a city map"):
        pg.open_world(tmp_path)
    shutil.copy(folder / "west.city", tmp_path / "twin.city")
    (tmp_path / "more").mkdir()
    shutil.copy(folder / "west.city", tmp_path / "more" / "twin.city")
    with pytest.raises(MapError, match="one name"):
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
    """As `scene anchor` changes it in its folder."""
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
