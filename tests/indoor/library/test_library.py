import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import placegraph as pg
from placegraph.core.estimate import PoseEstimate, PoseMode, SceneEstimate, SceneMode, Status
from placegraph.core.geo import Anchor
from placegraph.errors import InputError, MapError, OptionError, PlacegraphError
from placegraph.indoor.library import SceneLibrary, localize, make_library
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.pose.agreement import CONFIDENCE, Agreement
from placegraph.indoor.status import Diagnostics, choose_scene


@pytest.fixture(scope="session")
def folder(maps, tmp_path_factory):
    folder = tmp_path_factory.mktemp("homes")
    library = SceneLibrary("labels")
    for name, scene in maps.items():
        scene.save(folder / f"{name}.scene")
        library.add(name, folder / f"{name}.scene")
    library.save(folder / "homes.library")
    return folder


def test_scenes_come_and_go(maps):
    library = SceneLibrary("labels")
    assert len(library) == 0
    for name, scene in maps.items():
        library.add(name, scene)
    assert library.names == tuple(maps) == tuple(library)
    library.remove("study")
    assert "study" not in library
    assert library.own_index.starts[-1] == sum(len(maps[n]) for n in library)
    with pytest.raises(OptionError, match="'study' is not a scene of this library"):
        library.remove("study")
    with pytest.raises(OptionError, match=r"remove it first, or choose another name\."):
        library.add("parlour", maps["parlour"])
    for name in ("", "a/b"):
        with pytest.raises(OptionError, match="without a slash"):
            library.add(name, maps["study"])
    assert repr(library) == "SceneLibrary(2 scenes by labels)"


def test_a_file_holds_what_was_saved(folder, by_labels, rooms):
    opened = pg.open_map(folder / "homes.library")
    assert isinstance(opened, SceneLibrary)
    assert opened.names == by_labels.names
    film = rooms["study"].film(4)
    for name in opened:
        one, other = opened.entry(name).signature, by_labels.entry(name).signature
        assert one.graph.ids == other.graph.ids
        assert one.graph.relations == other.graph.relations
        assert one.attributes == other.attributes
        np.testing.assert_array_equal(one.panoramas, other.panoramas)
        np.testing.assert_allclose(one.graph.positions, other.graph.positions, atol=0.0051)
    told, wanted = (lib.search(film) for lib in (opened, by_labels))
    assert [m.scene for m in told.modes] == [m.scene for m in wanted.modes]
    assert told.best.probability == pytest.approx(wanted.best.probability, abs=0.02)


def test_scenes_that_stand_on_earth_are_found_there(maps, tmp_path):
    anchor = Anchor(9.99, 53.55, 6.0, 0.4, np.eye(4) * 0.01, "Haus", "way/7", "1", 0.75)
    turned = replace(anchor, heading=3.5, probability=0.25)
    maps["study"].anchored(anchor, turned).save(tmp_path / "study.scene")
    maps["bedroom"].save(tmp_path / "bedroom.scene")
    SceneLibrary.open(tmp_path, encoders="labels").save(tmp_path / "a.library")
    found = pg.open_map(tmp_path / "a.library").search("a study with two desks")
    here, there = found.best.earth
    assert here.probability == pytest.approx(0.75 * found.best.probability)
    low, high = maps["study"].bounds
    assert (here.longitude, here.latitude, here.height) == pytest.approx(
        tuple(anchor.to_earth((low + high) / 2))
    )
    width = max(high - low)
    assert np.linalg.eigvalsh(here.covariance[:2, :2])[-1] > width**2 / 12
    assert (here.level, here.building, here.unknown) == ("1", "Haus", ("orientation",))
    assert there.probability == pytest.approx(here.probability / 3)
    assert found.geopose()["unknown"] == ["orientation"]
    json.dumps(found.to_dict(), allow_nan=False)
    kinds = [f["properties"]["kind"] for f in found.geojson()["features"]]
    assert kinds[:4] == ["mode", "ellipse"] * 2


def test_a_folder_is_a_library(folder):
    assert set(pg.open_map(folder).names) == {"parlour", "study", "bedroom"}
    with pytest.raises(InputError, match="contains no scene map"):
        SceneLibrary.open(folder.parent)


def test_library_and_maps_move_together(folder, tmp_path):
    moved = tmp_path / "elsewhere"
    shutil.copytree(folder, moved)
    library = SceneLibrary.open(moved / "homes.library")
    assert len(library.scene("study"))
    (moved / "study.scene").unlink()
    library = SceneLibrary.open(moved / "homes.library")
    with pytest.raises(InputError, match="map of 'study' is missing"):
        library.scene("study")
    shutil.copy(moved / "bedroom.scene", moved / "study.scene")
    with pytest.raises(MapError, match="not the map that was added as 'study'"):
        library.scene("study")


def test_what_cannot_be_saved(maps, tmp_path):
    with pytest.raises(OptionError, match="empty"):
        SceneLibrary("labels").save(tmp_path / "a.library")
    with pytest.raises(OptionError, match="map in memory"):
        make_library({"study": maps["study"]}, encoders="labels").save(tmp_path / "a.library")
    assert not list(tmp_path.iterdir())


def test_another_encoder_is_refused(folder):
    with pytest.raises(MapError, match="was encoded by labels"):
        SceneLibrary.open(folder / "homes.library", encoders="appearance")
    same = SceneLibrary.open(folder / "homes.library", encoders=pg.encoder("labels"))
    assert len(same) == 3


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_a_damaged_file_is_a_typed_error(folder, tmp_path_factory, data):
    whole = (folder / "homes.library").read_bytes()
    cut = data.draw(st.integers(0, len(whole) - 1))
    path = tmp_path_factory.mktemp("cut") / "homes.library"
    path.write_bytes(whole[:cut])
    with pytest.raises(PlacegraphError):
        SceneLibrary.open(path)


def test_a_text_finds_its_room(by_labels):
    estimate = by_labels.search("a room with a bed and a wardrobe")
    assert estimate.best.scene == "bedroom"
    assert {o.label for e in estimate.evidence for o in e.objects} >= {"bed", "wardrobe"}
    assert by_labels.search("a place with two desks").best.scene == "study"
    assert by_labels.search("a sofa").best.scene == "parlour"


@pytest.mark.parametrize("text", ["", "   ", "hello there"])
def test_a_text_that_says_nothing(by_labels, text):
    with pytest.raises(PlacegraphError, match=r"mention a room|description is empty"):
        by_labels.search(text)


def off(estimate, walk):
    return np.linalg.norm((estimate.best.map_from_camera - walk.map_from_camera[-1])[:3, 3])


@pytest.mark.parametrize("name", ["parlour", "study"])
def test_scene_and_pose_of_a_capture(by_labels, rooms, name):
    room = rooms[name]
    walk = room.walk(21, 8)
    film = room.film(21, 8, depth=True)
    estimate = by_labels.localize(film, refine=False)
    assert estimate.status is Status.OK
    assert estimate.best.scene == name
    assert off(estimate, walk) < 0.1
    np.testing.assert_allclose(estimate.trajectory[-1], estimate.best.map_from_camera, atol=1e-9)
    np.testing.assert_allclose(
        estimate.best.scene_from_camera, estimate.best.map_from_camera, atol=1e-9
    )
    assert estimate.stats["retrieval"][name] > 0.5
    assert estimate.to_dict()["modes"][0]["scene"] == name


LABELS = Agreement(1.0, 0.9, math.nan, math.nan, np.zeros(1), np.zeros(1))


def fitting(odds):
    sharp = replace(LABELS, semantic=math.nan, depth=0.99, constraint=0.99)  # log(held + .01) is 0
    top = CONFIDENCE.odds(sharp)
    return replace(sharp, constraint=math.exp((odds - top) / CONFIDENCE.depth[2]) - 0.01)


@pytest.mark.parametrize(
    ("agreements", "scene", "status"),
    [
        ([LABELS, LABELS], "b", Status.OK),  # labels alone have no odds: a is no rival
        ([fitting(6.5), fitting(6.2)], "a", Status.AMBIGUOUS),
        ([fitting(3.0), fitting(6.2)], "b", Status.OK),
    ],
)
def test_a_pose_that_is_not_sure_in_another_scene(agreements, scene, status):
    stati, names = (Status.AMBIGUOUS, Status.OK), ("a", "b")
    eye, covariance = np.eye(4), np.eye(6)
    answers = [
        PoseEstimate(
            told, (PoseMode(eye, np.zeros(4), covariance, 1.0, name, eye),), "",
            diagnostics=Diagnostics(agreement=agreement),
        )
        for told, name, agreement in zip(stati, names, agreements, strict=True)
    ]  # fmt: skip
    decided = choose_scene(answers)
    assert (decided.modes[0].scene, decided.status) == (scene, status)


@pytest.mark.parametrize("status", [Status.OK, Status.LOST])
def test_poses_decide_where_the_search_is_wrong(maps, rooms, monkeypatch, status):
    def misled(*_, most, **__):
        known = 1.0 if status is Status.OK else 0.01
        told = (("bedroom", 0.998), ("parlour", 0.001), ("study", 0.001))
        modes = tuple(SceneMode(scene=n, probability=known * p, score=p) for n, p in told)
        return SceneEstimate(status, modes[:most], "", 1.0 - known, {"seconds": {}})

    monkeypatch.setattr(SceneLibrary, "search", misled)
    library = make_library(maps, encoders="appearance")
    film = rooms["study"].film(21, 8, depth=True, labels=None)
    estimate = library.localize(film, refine=False)
    assert (estimate.status, estimate.best.scene) == (Status.OK, "study")


def test_a_building_is_searched_by_its_parts(maps, rooms):
    merged = merge_scenes({name: maps[name] for name in ("parlour", "study")})
    library = make_library({"house": merged, "bedroom": maps["bedroom"]}, encoders="labels")
    single = make_library(maps, encoders="labels")
    film = rooms["study"].film(21, 12)
    assert library.search(film).best.scene == "house"
    whole, alone = library.search(film).best, single.search(film).best
    assert whole.probability > 0.6 * alone.probability
    told = {o.label for e in library.search(film).evidence for o in e.objects}
    assert told <= set(merged.graph.labels)


def test_a_description_helps_to_find_the_scene(maps, rooms):
    twins = make_library({"study": maps["study"], "parlour": maps["parlour"]}, encoders="labels")
    film = rooms["study"].film(4, frames=2)
    plain = twins.search(film).best.probability
    told = twins.search(film, description="a room with two desks and a chair").best.probability
    assert told > plain


def test_where_no_scene_fits_no_pose_is_sure(maps, rooms):
    library = make_library({"bedroom": maps["bedroom"]}, encoders="labels")
    film = rooms["study"].film(21, 8)
    assert library.search(film).status is Status.LOST
    assert library.localize(film, refine=False).status is not Status.OK


@pytest.mark.parametrize(
    ("options", "words"), [({"shares": [1.0]}, "computes these itself"), ({"most": 0}, "most")]
)
def test_what_a_library_decides_itself(by_labels, rooms, options, words):
    with pytest.raises(OptionError, match=words):
        by_labels.localize(rooms["study"].film(4), **options)


def test_maps_localized_in_are_kept_until_a_scene_goes(maps, rooms, monkeypatch):
    merged = []

    def counted(scenes):
        merged.append(tuple(scenes))
        return merge_scenes(scenes)

    monkeypatch.setattr(localize, "merge_scenes", counted)
    library = make_library(maps, encoders="labels")
    first, again = (library.localize(rooms["study"].film(21, 8), refine=False) for _ in range(2))
    assert merged == [("study",)]
    np.testing.assert_array_equal(again.best.map_from_camera, first.best.map_from_camera)
    library.remove("parlour")
    library.localize(rooms["study"].film(21, 8), refine=False)
    assert len(merged) == 2


def test_one_of_two_identical_flats_is_never_sure(maps, rooms):
    film = rooms["study"].film(21, 8, depth=True)
    twins = make_library({"here": maps["study"], "there": maps["study"]}, encoders="labels")
    assert (
        make_library({"here": maps["study"]}, encoders="labels").localize(film).status is Status.OK
    )
    estimate = twins.localize(film)
    assert estimate.status is Status.AMBIGUOUS
    assert "another fits nearly as well" in estimate.reason
