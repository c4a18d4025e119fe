"""`placegraph library ...`: from maps to answers."""

import json

import pytest

from placegraph.indoor.build import build_scene
from placegraph.synthetic.flats import Flat


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """The shipped flat as a map, in a folder."""
    import numpy as np

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
