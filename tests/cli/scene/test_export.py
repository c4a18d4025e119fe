"""`placegraph scene export` and `scene view`, on the command line."""

import json
import urllib.request

import numpy as np
import pytest

from placegraph.cli import scene_render as scene_view
from placegraph.core.estimate import PassRecord, PoseEstimate, Status
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.pose.record import read_run, write_run
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.tum import write_tum
from placegraph_lab.worlds.flat.walks import stroll, write_walk


def fails(result, code, *words):
    assert (result.code, result.out) == (code, "")
    (line,) = result.err.strip().splitlines()
    assert line.startswith("placegraph: ")
    for word in words:
        assert str(word) in line


@pytest.fixture
def room(tmp_path):
    """Map file of two objects."""
    corners = [(0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0), (1, 1, 0), (2, 1, 0), (1, 2, 1)]
    mesh = Mesh.plain(corners, [(0, 1, 2), (0, 2, 3), (4, 5, 6)], [0, 0, 1])
    scene = SceneMap.create(mesh, ["1", "2"], ["floor", "table"], floor=0.0, source="room.ply")
    scene.save(tmp_path / "room.scene")
    return tmp_path / "room.scene"


@pytest.fixture
def way(tmp_path):
    poses = np.stack([np.eye(4)] * 3)
    write_tum(tmp_path / "walk.tum", np.arange(3), poses)
    (tmp_path / "walk.json").write_text(json.dumps({"trajectory": poses.tolist()}))
    return tmp_path / "walk.tum"


@pytest.mark.parametrize("ending", ["glb", "ply", "json"])
def test_export_and_back(run, room, tmp_path, ending):
    out = tmp_path / f"out.{ending}"
    result = run("scene", "export", room, out)
    assert (result.code, result.err) == (0, "")
    assert result.out.startswith(f"{out}: ")
    told = run("scene", "export", room, out, "--json").json  # its own output it may replace
    assert (told["objects"], told["triangles"]) == (2, 3)
    assert told["files"][str(out)] == out.stat().st_size
    labels = ["--labels", tmp_path / "out.labels.json"] if ending == "ply" else []
    back = tmp_path / "back.scene"
    assert run("scene", "build", out, "-o", back, "--quiet", *labels).code == 0
    assert run("scene", "info", back, "--json").json["labels"] == {"floor": 1, "table": 1}


@pytest.mark.parametrize(("ending", "lost"), [("glb", 0), ("ply", 1)])
def test_export_says_what_is_lost(run, tmp_path, ending, lost):
    mesh = Mesh.plain([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 1)], [(0, 1, 2), (0, 2, 3)], [0, 1])
    scene = SceneMap.create(mesh, "ab", ["floor", "ramp"], floor=0.0, relations=[(1, "on", 0)])
    scene.save(tmp_path / "a.scene")
    out = tmp_path / f"a.{ending}"
    assert run("scene", "export", tmp_path / "a.scene", out).out.count("Relations (1)") == lost
    assert len(run("scene", "export", tmp_path / "a.scene", out, "--json").json["lost"]) == lost


def test_export_with_camera_paths(run, room, way, tmp_path):
    out = tmp_path / "out.json"
    paths = ("--camera-path", way, "--camera-path", way.with_suffix(".json"))
    assert run("scene", "export", room, out, *paths, "--quiet").out == ""
    nodes = json.loads(out.read_text())["nodes"]
    assert sorted(n["partition"] for n in nodes)[-6:] == [97] * 3 + [98] * 3


def test_export_refuses(run, room, way, tmp_path):
    out = tmp_path / "work.glb"
    out.write_text("a work of years")
    fails(run("scene", "export", room, out), 7, "work.glb", "--force")
    assert run("scene", "export", room, out, "--force").code == 0
    fails(run("scene", "export", room, room), 7, "the map itself")
    fails(run("scene", "export", room, tmp_path / "a.obj"), 7, "unknown ending")
    fails(run("scene", "export", room, tmp_path / "no" / "a.glb"), 4, "cannot be written")
    fails(run("scene", "export", way, tmp_path / "a.glb"), 4, "not a placegraph map")
    fails(run("scene", "export", room, tmp_path / "a.ply", "--camera-path", way), 7, "no place")
    gone = tmp_path / "no.tum"
    fails(run("scene", "export", room, tmp_path / "a.glb", "--camera-path", gone), 3, "no.tum")


@pytest.fixture
def served(monkeypatch):
    """Let `scene view` end at once; what was served at the address meanwhile."""
    pytest.importorskip("viser", reason="needs viser: pip install 'placegraph[view]'")
    pages = []
    monkeypatch.setattr(scene_view, "wait", lambda: None)
    echo = scene_view.click.echo

    def told(words):
        address = words.split(" at ")[1].split()[0]
        with urllib.request.urlopen(address) as page:  # noqa: S310  # our own
            pages.append(page.status)
        echo(words)

    monkeypatch.setattr(scene_view.click, "echo", told)
    return pages


def test_view_serves_the_map_and_a_run(run, room, way, served, tmp_path):
    history = (PassRecord(8.0, ((0, np.zeros((5, 4)), np.ones(5)),)),)
    write_run(tmp_path / "a.run", PoseEstimate(Status.OK, (), "Well.", history=history))
    options = ("--run", tmp_path / "a.run", "--camera-path", way, "--port", "8123")
    result = run("scene", "view", room, *options)
    assert result.code == 0
    assert result.out.splitlines()[0].startswith(f"{room} at http://127.0.0.1:")
    assert served == [200]


def test_view_refuses(run, room, way, tmp_path):
    fails(run("scene", "view", room, "--capture", tmp_path, "--run", way), 7, "give one")
    fails(run("scene", "view", room, "--frames", "3"), 7, "--capture")
    fails(run("scene", "view", room, "--run", tmp_path / "a.run"), 3, "a.run", "does not exist")
    fails(run("scene", "view", room, "--port", "0"), 7, "port is 0")


def test_a_capture_is_localized_recorded_and_viewed(run, study, served, tmp_path):
    rng = np.random.default_rng(1)
    interior = study.furnish(rng)
    interior.write_glb(tmp_path / "study.glb")
    room = tmp_path / "study.scene"
    assert run("scene", "build", tmp_path / "study.glb", "-o", room, "--quiet").code == 0
    from placegraph.core.geometry import Camera

    walk = stroll(study, rng, frames=3, through="123", height=1.6)
    write_walk(interior, walk, tmp_path / "walk", rng, camera=Camera(80, 45, 57, 57, 40, 22.5))
    recorded = tmp_path / "a.run"
    options = ("--frames", "0:2", "--no-refine", "--record", recorded, "--quiet")
    assert run("scene", "localize", room, tmp_path / "walk", *options).code == 0
    back = read_run(recorded)
    assert back.frames.tolist() == [0, 1]
    assert all(len(record.steps) == 2 for record in back.history)
    options = ("--capture", tmp_path / "walk", "--frames", "0:2", "--quiet", "--port", "8124")
    assert run("scene", "view", room, *options).code == 0
    assert served == [200]


@pytest.mark.parametrize("command", ["export", "view"])
def test_help(command, run):
    result = run("scene", command, "--help")
    assert (result.code, result.err) == (0, "")
    assert f"placegraph scene {command} house.scene" in result.out.replace("\n", " ")
