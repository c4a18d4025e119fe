"""`placegraph library ...`: from maps to answers."""

import json
import shutil

import numpy as np
import pytest

from placegraph.indoor.build import build_scene
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.worlds.flat.flat import Flat


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """The shipped flat as a map, in a folder."""
    folder = tmp_path_factory.mktemp("maps")
    interior = Flat.load("altbau").furnish(np.random.default_rng(0))
    interior.write_glb(folder / "flat.glb")
    build_scene(folder / "flat.glb", folder / "altbau.scene", detail="small")
    return folder


def test_a_library_from_the_command_line(run, world, tmp_path):
    file = tmp_path / "homes.library"
    built = run("library", "build", world, "-o", file, "--encoder", "labels", "--json")
    assert built.code == 0
    assert built.json["scenes"] == 1
    assert built.json["names"] == ["altbau"]
    added = run("library", "add", file, world / "altbau.scene", "--name", "twin", "--json")
    assert added.json["names"] == ["altbau", "twin"]
    told = run("library", "search", file, "a kitchen with a stove", "--json")
    assert {m["scene"] for m in told.json["modes"]} == {"altbau", "twin"}
    assert told.json["status"] != "OK"
    shown = run("library", "search", file, "a kitchen with a stove")
    assert "altbau" in shown.out
    assert "evidence" in shown.out
    assert run("library", "remove", file, "twin", "--json").json["scenes"] == 1
    info = run("library", "info", file)
    assert info.code == 0
    assert "labels" in info.out


def test_mistakes_have_exit_codes(run, world, tmp_path):
    file = tmp_path / "homes.library"
    assert run("library", "build", tmp_path, "-o", file).code == 3
    assert run("library", "search", tmp_path / "none.library", "a sofa").code == 3
    assert run("library", "build", world, "-o", file, "--encoder", "votes").code == 7
    assert run("library", "add", world, world / "altbau.scene").code == 7
    assert not file.exists()
    assert run("library", "build", world, "-o", file, "--encoder", "labels").code == 0
    failed = run("library", "search", file, "a sofa", "--frames", "1:2")
    assert failed.code == 7
    assert "--frames" in failed.err
    assert run("library", "remove", file, "attic").code == 7
    assert json.loads(run("library", "info", file, "--json").out)["scenes"] == 1


@pytest.fixture(scope="module")
def library(world, tmp_path_factory):
    from placegraph.indoor.library import SceneLibrary

    file = tmp_path_factory.mktemp("library") / "homes.library"
    made = SceneLibrary("labels")
    made.add("altbau", world / "altbau.scene")
    made.save(file)
    return file


def slab(path, label="floor"):
    """Map of a single sheet at the height of a camera: nobody can stand anywhere, nor look around."""
    mesh = Mesh.plain([[0, 0, 1.6], [0.1, 0, 1.6], [0, 0.1, 1.6]], [[0, 1, 2]])
    SceneMap.create(mesh, ["1"], [label], floor=0.0, source=path.name).save(path)
    return path


@pytest.mark.parametrize(
    "query", ["./no/walk", "walk/", "walk.zip", "a sofa and/or a bed", "x.r3d"]
)
def test_a_capture_that_is_not_there_is_no_text(run, library, query):
    asked = run("library", "search", library, query)
    assert asked.code == 3
    assert "does not exist" in asked.err
    assert "--text" in asked.err


@pytest.mark.parametrize("query", ["", " \t"])
def test_no_query_an_empty_one_or_two_are_refused(run, library, query, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    for asked in (("--text", query), (query,)):
        told = run("library", "search", library, *asked)
        assert (told.code, "empty" in told.err) == (7, True)
    for asked in ((), ("a sofa", "--text", "a sofa")):
        told = run("library", "search", library, *asked)
        assert (told.code, "QUERY" in told.err) == (7, True)


def test_a_text_that_looks_like_a_file_or_is_a_folder_is_said_by_text(
    run, library, tmp_path, monkeypatch
):
    for text in ("a stove and/or a sink", "There is a stove.And a sink"):
        told = run("library", "search", library, "--text", text, "--json")
        assert told.code == 0
        assert told.json["modes"][0]["scene"] == "altbau"
    text = "There is a kitchen with a stove. " * 20
    assert run("library", "search", library, text, "--json").json["modes"]
    assert run("library", "search", library, "a stove\0").code == 6  # nor a name, nor a text
    (tmp_path / "kitchen").mkdir()
    monkeypatch.chdir(tmp_path)
    assert run("library", "search", library, "kitchen").code == 3  # no capture
    assert run("library", "search", library, "--text", "kitchen").code == 0


def test_a_word_that_may_be_a_mistyped_folder(run, library):
    told = run("library", "search", library, "wlk02", "--json")
    assert told.json["status"] != "OK"
    assert told.err == "'wlk02' is not a file or folder, so it is read as a description.\n"
    assert run("library", "search", library, "--text", "kitchen").err == ""
    assert run("library", "search", library, "a kitchen").err == ""


def test_two_maps_of_one_name_are_told_before_any_work(run, world, tmp_path, monkeypatch):
    (tmp_path / "other").mkdir()
    shutil.copy(world / "altbau.scene", tmp_path / "other" / "altbau.scene")
    monkeypatch.setattr(SceneMap, "open", None)  # would fail
    told = run("library", "build", world, tmp_path / "other", "-o", tmp_path / "l.library")
    assert told.code == 7
    for file in (world / "altbau.scene", tmp_path / "other" / "altbau.scene"):
        assert str(file) in told.err
    gone = run("library", "build", world, tmp_path / "gone.scene", "-o", tmp_path / "l.library")
    assert (gone.code, "gone.scene does not exist" in gone.err) == (3, True)
    nowhere = run("library", "build", world, "-o", tmp_path / "no" / "l.library")
    assert nowhere.code == 4


def test_a_map_that_cannot_be_added_is_left_out(run, world, tmp_path):
    for name in ("sheet", "nameless"):
        slab(tmp_path / f"{name}.scene", {"sheet": "floor", "nameless": "zzgrblk"}[name])
    (tmp_path / "broken.scene").write_bytes(b"PLACEGRAPH?")
    file = tmp_path / "homes.library"
    told = run("library", "build", world / "altbau.scene", world, tmp_path, "-o", file,
               "--encoder", "labels", "--json")  # fmt: skip
    assert told.code == 0
    assert told.json["names"] == ["altbau"]
    assert told.json["skipped"] == 3
    lines = told.err.splitlines()
    assert len(lines) == 3
    for name in ("sheet", "nameless", "broken"):
        assert any(f"{name}.scene was skipped: " in line for line in lines)
    shown = run("library", "build", world, tmp_path, "-o", file, "--encoder", "labels")
    assert "skipped" in shown.out
    file.unlink()
    none = run("library", "build", tmp_path, "-o", file, "--encoder", "labels")
    assert none.code in {3, 4, 7}
    assert not file.exists()


def test_weights_belong_to_an_encoder_that_has_some(run, world, tmp_path):
    build = ("library", "build", world, "-o", tmp_path / "l.library", "--weights", tmp_path / "w")
    for encoders in ((), ("labels",), ("scenegraphloc", "features")):
        asked = [word for name in encoders for word in ("--encoder", name)]
        told = run(*build, *asked)
        assert (told.code, "--weights applies to" in told.err) == (7, True)


def test_json_has_no_nan(run, library, monkeypatch):
    from placegraph.core.estimate import SceneEstimate

    whole = SceneEstimate.to_dict
    monkeypatch.setattr(
        SceneEstimate, "to_dict", lambda e: whole(e) | {"bad": [float("nan"), {"x": float("-inf")}]}
    )
    told = run("library", "search", library, "a stove", "--json")
    assert json.loads(told.out, parse_constant=pytest.fail)["bad"] == [None, {"x": None}]
