"""`placegraph scene check`, `diff` and `update`, from the command line."""

import numpy as np
import pytest
from PIL import Image

from placegraph.core.geometry import Camera, level_from_camera, pose_matrix
from placegraph.indoor.build import build_scene
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.worlds.flat.walks import Walk, write_walk


@pytest.fixture(scope="module")
def place(study, tmp_path_factory):
    folder = tmp_path_factory.mktemp("place")
    interior = study.furnish(np.random.default_rng(1))
    later = interior.move_object("chair", (0.4, -0.3), 0.4).without("lamp")
    for name, what in (("room", interior), ("later", later)):
        what.write_glb(folder / f"{name}.glb")
        build_scene(folder / f"{name}.glb", folder / f"{name}.scene")
    turn = np.linspace(0.0, 2.0 * np.pi, 10, endpoint=False)
    level = level_from_camera([0.0, np.cos(0.4), np.sin(0.4)])
    x, y = 3.2 + 0.2 * np.cos(turn), 1.5 + 0.2 * np.sin(turn)
    poses = pose_matrix(np.stack([x, y, np.full(10, 1.6), turn], axis=1), level)
    camera = Camera(192, 108, 115.0, 115.0, 96.0, 54.0)
    walk = Walk(0.2 * np.arange(10), poses)
    write_walk(interior, walk, folder / "walk", np.random.default_rng(3), camera=camera)
    return folder


def test_two_maps(run, place, tmp_path):
    done = run(
        "scene", "diff", place / "room.scene", place / "later.scene", "--quiet",
        "-o", tmp_path / "d.json", "--png", tmp_path / "d.png",
    )  # fmt: skip
    assert done.code == 0
    assert "1 moved, 1 vanished" in done.out
    assert "Alignment: estimated" in done.out
    with Image.open(tmp_path / "d.png") as picture:
        assert picture.width == 1200
    told = run("scene", "diff", place / "room.scene", place / "later.scene", "--json").json
    assert {(c["kind"], c["label"]) for c in told["changes"]} == {
        ("moved", "chair"),
        ("vanished", "lamp"),
    }
    new = run(
        "scene", "update", place / "room.scene", tmp_path / "d.json", "-o", tmp_path / "new.scene",
        "--when", "2026-11-21",
    )  # fmt: skip
    assert new.code == 0
    assert "2026-11-21: moved by" in new.out
    again = run("scene", "diff", tmp_path / "new.scene", place / "later.scene", "--json").json
    assert again["changes"] == []


def test_a_map_and_a_capture(run, place):
    done = run("scene", "diff", place / "room.scene", place / "walk", "--json")
    assert done.code == 0
    assert done.json["changes"] == []
    assert done.json["same"]


def test_update_from_a_later_map_in_place(run, place, tmp_path):
    path = tmp_path / "room.scene"
    path.write_bytes((place / "room.scene").read_bytes())
    before = path.read_bytes()
    (tmp_path / "precious").write_bytes(b"precious")
    (tmp_path / ".room.scene.bak.tmp").symlink_to(tmp_path / "precious")
    refused = run("scene", "update", path, "--from", place / "later.scene", "-o", path)
    assert refused.code == 7
    assert path.read_bytes() == before
    done = run(
        "scene", "update", path, "--from", place / "later.scene", "--in-place", "--take", "vanished",
        "--json",
    )  # fmt: skip
    assert done.code == 0
    assert (
        done.json["objects"]
        == len(SceneMap.open(path))
        == len(SceneMap.open(place / "room.scene")) - 1
    )
    assert (tmp_path / "room.scene.bak").read_bytes() == before
    assert (tmp_path / "precious").read_bytes() == b"precious"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("update", "room.scene"), "--from"),
        (("update", "room.scene", "d.json"), "No output is given"),
        (("update", "room.scene", "d.json", "-o", "x.scene", "--in-place"), "exclude each other"),
        (("diff", "room.scene", "later.scene", "--b-from-a", "1,2"), "--b-from-a is '1,2'"),
        (("diff", "room.scene", "later.scene", "--frames", "1:2"), "is a map"),
        (("diff", "room.scene", "walk", "--b-from-a", "1,2,0,0"), "applies only to a second map"),
    ],
)
def test_options_that_contradict_each_other(run, place, monkeypatch, arguments, words):
    monkeypatch.chdir(place)
    done = run("scene", *arguments)
    assert done.code == 7
    assert words in done.err


def test_check_says_what_is_wrong_and_ends_with_its_code(run, place, tmp_path):
    done = run("scene", "check", place / "room.scene")
    assert done.code == 0
    assert "no errors" in done.out
    build_scene(place / "room.glb", tmp_path / "low.scene", floor=-1.0)
    wrong = run("scene", "check", tmp_path / "low.scene", "--json")
    assert wrong.code == 4
    assert wrong.json["errors"] >= 1
    assert any("--floor" in f["mend"] for f in wrong.json["findings"])
    shown = run("scene", "check", tmp_path / "low.scene")
    assert "mend: --floor" in shown.out
    assert run("scene", "check", tmp_path / "none.scene").code == 3
