"""`placegraph scene export` and `scene view`, on the command line."""

import json
import urllib.request

import numpy as np
import pytest
from tests.cli.failing import fails

from placegraph.cli import scene_render as scene_view
from placegraph.core.estimate import PassRecord, PoseEstimate, Status
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.pose.record import read_run, write_run
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.tum import write_tum


@pytest.fixture
def two(tmp_path):
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
def test_export_and_back(run, two, tmp_path, ending):
    out = tmp_path / f"out.{ending}"
    result = run("scene", "export", two, out)
    assert (result.code, result.err) == (0, "")
    assert result.out.startswith(f"{out}: ")
    told = run("scene", "export", two, out, "--json").json  # its own output it may replace
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


def test_export_with_camera_paths(run, two, way, tmp_path):
    out = tmp_path / "out.json"
    paths = ("--camera-path", way, "--camera-path", way.with_suffix(".json"))
    assert run("scene", "export", two, out, *paths, "--quiet").out == ""
    nodes = json.loads(out.read_text())["nodes"]
    assert sorted(n["partition"] for n in nodes)[-6:] == [97] * 3 + [98] * 3


def test_export_refuses(run, two, way, tmp_path):
    out = tmp_path / "work.glb"
    out.write_text("a work of years")
    fails(run("scene", "export", two, out), 7, "work.glb", "--force")
    assert run("scene", "export", two, out, "--force").code == 0
    fails(run("scene", "export", two, two), 7, "is the input map")
    fails(run("scene", "export", two, tmp_path / "a.obj"), 7, "unknown ending")
    fails(run("scene", "export", two, tmp_path / "no" / "a.glb"), 4, "cannot be written")
    fails(run("scene", "export", way, tmp_path / "a.glb"), 4, "not a placegraph map")
    fails(
        run("scene", "export", two, tmp_path / "a.ply", "--camera-path", way),
        7,
        "cannot store them",
    )
    gone = tmp_path / "no.tum"
    fails(run("scene", "export", two, tmp_path / "a.glb", "--camera-path", gone), 3, "no.tum")


@pytest.fixture
def served(monkeypatch):
    pytest.importorskip("viser", reason="needs viser: pip install 'placegraph[view]'")
    pages = []
    monkeypatch.setattr(scene_view, "wait", lambda: None)
    echo = scene_view.click.echo

    def visit_page(words):
        address = words.split(" at ")[1].split()[0]
        with urllib.request.urlopen(address) as page:  # noqa: S310  # our own
            pages.append(page.status)
        echo(words)

    monkeypatch.setattr(scene_view.click, "echo", visit_page)
    return pages


def test_view_serves_the_map_and_a_run(run, two, way, served, tmp_path):
    history = (PassRecord(8.0, ((0, np.zeros((5, 4)), np.ones(5)),)),)
    write_run(tmp_path / "a.run", PoseEstimate(Status.OK, (), "Well.", history=history))
    options = ("--run", tmp_path / "a.run", "--camera-path", way, "--port", "8123")
    result = run("scene", "view", two, *options)
    assert result.code == 0
    assert result.out.splitlines()[0].startswith(f"{two} at http://127.0.0.1:")
    assert served == [200]


def test_view_refuses(run, two, way, tmp_path):
    fails(run("scene", "view", two, "--capture", tmp_path, "--run", way), 7, "remove one")
    fails(run("scene", "view", two, "--frames", "3"), 7, "--capture")
    fails(run("scene", "view", two, "--run", tmp_path / "a.run"), 3, "a.run", "does not exist")
    fails(run("scene", "view", two, "--port", "0"), 7, "port is 0")


def test_a_capture_is_localized_recorded_and_viewed(run, room, served, tmp_path):
    recorded = tmp_path / "a.run"
    options = ("--frames", "0:2", "--no-refine", "--record", recorded, "--quiet")
    assert run("scene", "localize", room.map, room.walk, *options).code == 0
    back = read_run(recorded)
    assert back.frames.tolist() == [0, 1]
    assert all(len(record.steps) == 2 for record in back.history)
    options = ("--capture", room.walk, "--frames", "0:2", "--quiet", "--port", "8124")
    assert run("scene", "view", room.map, *options).code == 0
    assert served == [200]
