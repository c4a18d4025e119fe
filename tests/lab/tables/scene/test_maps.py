import json

import numpy as np
import pytest

from placegraph.indoor.build import build_scene
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.metrics import Answer
from placegraph_lab.tables.indoor.refine import RefineOutcome
from placegraph_lab.tables.indoor.windows import Window
from placegraph_lab.tables.named import scene_maps
from placegraph_lab.tables.named import scene_maps as script
from placegraph_lab.tables.named.scene_maps import (
    FULL,
    Maps,
    Place,
    Run,
    Size,
    WindowRunner,
    findings,
    study,
)
from placegraph_lab.tables.runner import Journal
from placegraph_lab.worlds.flat.flat import Flat

DEFAULT = Size("default", ("--detail", "default"))
ROOM = """
[flat]
name = Cell
height = 2.5
[drawing]
##########
#SS      #
#SS  TT  #
#    TT  #
##########
[legend]
S sofa:
T table:
"""


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """Folder of data with a small room instead of the house."""
    folder = tmp_path_factory.mktemp("data")
    Flat.parse(ROOM).furnish(np.random.default_rng(0)).write_glb(folder / "room.glb")
    return folder


@pytest.fixture
def maps(room, tmp_path, monkeypatch):
    """Maps of the room, built in this process; `commands` are those that would have run."""
    monkeypatch.setitem(scene_maps.PLACES, "house", Place("Room", "room.glb", (), ()))
    commands = []

    def run(arguments):
        commands.append(arguments)
        out, detail = arguments[arguments.index("-o") + 1], "default"
        if "--detail" in arguments:
            detail = arguments[arguments.index("--detail") + 1]
        build_scene(arguments[2], out, detail=detail)
        told = {"seconds": len(commands), "left_out": {}, "notes": ["It is a room."]}
        return Run(json.dumps(told), 2.0 * len(commands), 100 * len(commands))

    monkeypatch.setattr(scene_maps, "run", run)
    made = Maps(room, tmp_path / "net.tflite", tmp_path, Journal(tmp_path / "journal.jsonl"))
    made.commands = commands
    return made


def test_a_map_is_measured_once(maps):
    made = maps.measure_map("house", DEFAULT)
    assert [c[:2] for c in maps.commands] == [["scene", "build"]] * 4  # the first warms
    assert (made.build_seconds, made.command_seconds, made.peak_bytes) == (3.0, 6.0, 400)
    scene = SceneMap.open(maps.path("house", DEFAULT))
    assert (made.objects, made.triangles) == (len(scene), len(scene.mesh))
    assert made.labelled == made.objects
    assert made.bytes == maps.path("house", DEFAULT).stat().st_size
    assert sum(made.parts.values()) == made.bytes
    assert made.open_seconds > 0
    assert maps.measure_map("house", DEFAULT) == made
    assert maps.scene("house", DEFAULT).graph.ids == scene.graph.ids
    assert len(maps.commands) == 4


def test_smaller_maps_lie_near_the_full_one(maps):
    small = maps.measure_distances("house", Size("small", ("--detail", "small")))
    assert 0 < small.mean <= small.most <= small.maximum < 0.05


def answer(name, position, rotation=1.0, place="seq00"):
    return Answer(
        window=name, place=place, changed=False, coverage=None, position=position,
        rotation=rotation, status="OK", probability=0.9, among_modes=True,
        whitened=(0.0,) * 6, frames=5, seconds=0.1,
    )  # fmt: skip


@pytest.fixture
def asking(maps, monkeypatch):
    """What asks about two windows; on the full map the second is right, on the other the first."""
    asked = []

    def ask(job, scene, window, *, seed, device):  # noqa: ARG001
        asked.append((job.row, window.name, seed))
        full = scene.mesh.steps()[0] < 0.0005  # m: others lie on a coarser grid
        right = full == (window.place == "b")
        return answer(window.place, 0.01 if right else 3.0)

    def refine(job, scene, window, *, matcher, seed, device):
        after = ask(job, scene, window, seed=seed, device=device)
        assert matcher == "auto"
        return RefineOutcome(before=(0.2, 10.0), after=after, accepted=True)

    class Frame:
        index = 0

    windows = [Window(name, (Frame(),), np.eye(4)) for name in ("a", "b")]
    monkeypatch.setattr(scene_maps, "house_windows", lambda *_, **__: windows)
    monkeypatch.setattr(scene_maps, "ask", ask)
    monkeypatch.setattr(scene_maps.indoor_refine, "ask", refine)
    made = WindowRunner(maps, 5, 9)
    made.asked = asked
    return made


def test_both_maps_get_the_same_windows_and_go_on_where_they_were_cut(asking):
    rows = [r for r in findings() if r.name == "none: depth + colour, 5 frames"]
    full, default = study(asking, rows, {"house": [DEFAULT]})
    assert (full.size, default.size) == ("full", "default")
    assert full.steps == (0, 0)
    assert default.steps == (1, -1)
    assert [a.window for a in default.answers] == [a.window for a in default.full] == ["a", "b"]
    seeds = [seed for _, _, seed in asking.asked]
    assert seeds == [1, 0, 0] * 2  # each map is warmed once
    assert study(asking, rows, {"house": [DEFAULT]}) == [full, default]
    assert len(asking.asked) == 6
    study(replaced(asking, seed=7), rows, {"house": [FULL]})
    assert [seed for _, _, seed in asking.asked[6:]] == [8, 7, 7]


def replaced(asking, **options):
    return WindowRunner(asking.maps, asking.every, asking.office_every, **options)


@pytest.fixture
def faked(maps, asking, monkeypatch):
    """The benchmark itself."""
    monkeypatch.setattr(script, "Maps", lambda *_: maps)
    monkeypatch.setattr(script, "WindowRunner", lambda *_, **__: asking)


@pytest.mark.usefixtures("faked")
def test_it_prints_and_writes_what_it_measured(measure, tmp_path):
    out = tmp_path / "out.json"
    result = measure(
        "scene_maps", "--only", "none: *; house found: *", "--sizes", "default,small",
        "--cache", str(tmp_path), "--out", str(out), "--weights", str(tmp_path / "none.tflite"),
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "extra `segment`" in result.output
    text = result.stdout
    assert "| *SG2Loc*" in text
    default = next(row for row in text.splitlines() if row.startswith("| default"))
    assert "+0.0 ± 50.0" in default  # one of two gained, the other lost, at 5 and at 10 frames
    assert "2 / 2" in default
    written = json.loads(out.read_text())
    assert [m["size"] for m in written["maps"]] == ["full", "default", "small"]
    assert written["maps"][0]["off_m"] is None
    assert written["maps"][1]["off_m"]["maximum"] > 0
    assert {r["row"] for r in written["recall"]} == {
        "none: depth + colour, 5 frames", "none: depth + colour, 10 frames",
    }  # fmt: skip
    assert [size for _, size, _ in written["refined"]] == ["full", "default", "small"]
    assert written["refined"][0][2]["after"]["recall"][0] == 0.5
