import shutil
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from placegraph.core.geo import key_at
from placegraph.errors import InputError, MapError, RequestError
from placegraph.maps import open_map
from placegraph_scale.shards import finish
from placegraph_serve.drawing import AnswerCache
from placegraph_serve.locate import locate
from placegraph_serve.options import ServeOptions
from placegraph_serve.places import Dispatcher, Places


def test_a_folder_is_listed_without_opening_a_map(maps):
    listed = {m["name"]: m for m in Places([maps]).describe_maps()}
    assert {n: m["kind"] for n, m in listed.items()} == {
        "hafenstadt": "city", "home1": "scene", "home2": "scene",
    }  # fmt: skip
    city = Places([maps]).city("hafenstadt")
    west, south, east, north = listed["hafenstadt"]["bounds"]
    where = city.plane.to_lonlat(city.objects.center)
    assert (where > (west, south)).all()
    assert (where < (east, north)).all()
    assert listed["hafenstadt"]["objects"] == len(city.objects)
    assert listed["home1"]["objects"] == len(Places([maps]).scene("home1"))


def test_a_map_is_opened_once_and_anew_when_replaced(maps, tmp_path):
    file = tmp_path / "home.scene"
    shutil.copy(maps / "home1.scene", file)
    places = Places([tmp_path])
    first = places.open("home")
    assert places.open("home") is first
    shutil.copy(maps / "home2.scene", tmp_path / "new")
    (tmp_path / "new").replace(file)
    assert len(places.open("home")) != len(first)
    file.unlink()
    with pytest.raises(RequestError, match="missing on the server") as gone:
        places.open("home")
    assert (gone.value.status, gone.value.code) == (503, "map_gone")


def test_worlds_share_what_is_open_and_outlive_its_file(maps, tmp_path):
    file = tmp_path / "home.scene"
    shutil.copy(maps / "home1.scene", file)
    shutil.copy(maps / "home2.scene", tmp_path)
    places = Places([tmp_path])
    world, alone = places.world(), places.world("home")
    assert world.scenes["home"] is places.scene("home") is alone.scenes["home"]
    assert (set(alone.scenes), len(alone.library)) == ({"home"}, 1)
    file.unlink()  # between two steps of a worker that warms up
    assert len(world.library) == 2
    with pytest.raises(RequestError, match="The file of map 'home' is missing on the"):
        places.world("home")
    assert set(places.world().scenes) == {"home2"}


def test_one_scene_is_asked_alone(maps):
    desk = Dispatcher(Places([maps]), ServeOptions())
    asked = {"text": "A bakery is north of me. I am in the kitchen."}
    assert {m["scene"] for m in locate(desk, asked)["estimate"]["modes"]} > {"home1"}
    told = locate(desk, asked | {"map": "home1"})
    assert {m["scene"] for m in told["estimate"]["modes"]} == {told["map"]} == {"home1"}


def test_maps_of_one_stem_keep_their_endings(maps, tmp_path):
    shutil.copy(maps / "home1.scene", tmp_path / "a.scene")
    shutil.copy(maps / "hafenstadt.city", tmp_path / "a.city")
    assert {e.name for e in Places([tmp_path]).entries()} == {"a.scene", "a.city"}


def test_what_is_no_map_is_refused_at_the_start(tmp_path):
    with pytest.raises(InputError, match="contains no map"):
        Places([tmp_path])
    with pytest.raises(InputError, match="does not exist"):
        Places([tmp_path / "none.city"])
    (tmp_path / "x.city").write_text("no map")
    with pytest.raises(MapError, match="not a placegraph map"):
        Places([tmp_path / "x.city"])


def test_a_map_of_another_name_or_kind_is_told(maps):
    places = Places([maps])
    with pytest.raises(RequestError, match="the maps are: hafenstadt, home1, home2") as unknown:
        places.open("paris")
    assert unknown.value.status == 404
    with pytest.raises(RequestError, match="name one of: home1, home2"):
        places.scene("hafenstadt")


def test_where_a_damaged_map_lies_is_not_told(maps, tmp_path):
    file = tmp_path / "home.scene"
    shutil.copy(maps / "home1.scene", file)
    places = Places([tmp_path])
    file.write_bytes(file.read_bytes()[:2000])
    with pytest.raises(MapError, match=f"^{file.name} is damaged"):
        places.scene("home")
    (listed,) = places.describe_maps()
    assert listed["problem"].startswith(f"{file.name} is damaged")


def test_a_world_in_shards_is_asked_as_a_map(maps, tmp_path):

    town = open_map(maps / "hafenstadt.city")
    key = key_at(town.plane.longitude, town.plane.latitude, 6)
    (tmp_path / "all" / "shards").mkdir(parents=True)
    shutil.copy(maps / "hafenstadt.city", tmp_path / "all" / "shards" / f"{key}.city")
    finish(tmp_path / "all", 6, 150.0)
    places = Places([tmp_path / "all"])
    assert places.only == "all"
    assert places.describe_maps()[0]["objects"] == len(town.objects)
    told = locate(Dispatcher(places, ServeOptions()), {"text": "A bakery is north of me."})
    assert "shards" in told["estimate"]["reason"]
    assert places.world("all") is places.world("all")
    (tmp_path / "all" / "world.json").write_text("{}")
    assert "world build" in places.describe_maps()[0]["problem"]


def test_what_two_ask_for_at_once_is_made_once():
    kept, made = AnswerCache(100), []
    begun, go = threading.Event(), threading.Event()

    def make():
        made.append(1)
        begun.set()
        assert go.wait(60)
        return b"drawn"

    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(kept.get, ("a",), make)
        assert begun.wait(60)
        second = pool.submit(kept.get, ("a",), make)
        go.set()
        assert first.result() == second.result() == b"drawn"
    assert made == [1]


def test_what_was_asked_for_longest_ago_goes_first():
    kept, made = AnswerCache(5), []

    def ask(key):
        return kept.get((key,), lambda: made.append(key) or key.encode() * 2)

    assert [ask(key) for key in "abaca"] == [b"aa", b"bb", b"aa", b"cc", b"aa"]
    assert made == ["a", "b", "c"]
    assert (ask("b"), made[-1], kept.size) == (b"bb", "b", 4)
