"""The benchmark of encoders: what each is asked with, what it writes, and what it is worth in a room."""

import json

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.indoor.build import build_scene
from placegraph.io.capture.capture import open_capture
from placegraph_lab.tables.indoor.metrics import Answer
from placegraph_lab.tables.indoor.windows import Window, true_poses
from placegraph_lab.tables.named import indoor_semantics as script
from placegraph_lab.tables.named.indoor_semantics import (
    LABELS,
    NONE,
    OTHERS,
    TERMS,
    Row,
    ask,
    case,
    report,
)
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.walks import stroll, write_walk

ROOM = """
[flat]
name = Room
height = 2.6
[drawing]
##########====##
#SSS       pp  #
#SSS       1   #
#SSS  TTT    BB#
#     TTT    BB#
#              +
#LL        2   +
#LL  CCCCCC    #
################
[legend]
1 room: label=study walls=wallpaper palegoldenrod floor=parquet sienna
2 spot:
S sofa: look=fabric darkred trim=fabric firebrick
B shelf: label=bookcase height=2.1
T table: label=desk look=wood burlywood
C cabinet: label=sideboard height=0.8 look=wood peru
L lamp:
p picture:
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """Scene map and a window of five frames of a small room."""
    folder = tmp_path_factory.mktemp("semantics")
    drawing, rng = Flat.parse(ROOM), np.random.default_rng(1)
    interior = drawing.furnish(rng)
    interior.write_glb(folder / "flat.glb")
    scene = build_scene(folder / "flat.glb", None)
    walk = stroll(drawing, rng, frames=5, through="12")
    write_walk(
        interior, walk, folder / "walk", rng, camera=Camera(160, 90, 100.0, 100.0, 80.0, 45.0)
    )
    capture = open_capture(folder / "walk")
    return scene, Window("walk", capture, true_poses(folder / "walk")[-1])


@pytest.mark.parametrize("name", [LABELS, pytest.param(OTHERS, marks=pytest.mark.all)])
def test_noisy_labels_find_the_pose(world, name):
    scene, window = world
    got = ask(case("house", name, "semantic + depth + colour"), scene, window, device="cpu")
    assert got.within(0.25, 5.0), got
    assert got.frames == 5


def answer(position, rotation):
    return Answer("w", "seq01", None, None, position, rotation, "OK", 1.0, True, (), 5, 1.0)


def test_the_report_is_of_the_papers_shape():
    rows = [
        Row(case("house", NONE, "depth"), 5, (answer(0.05, 1.0), answer(0.2, 5.0))),
        Row(case("house", LABELS, "semantic"), 5, (answer(0.05, 6.0), answer(3.0, 90.0))),
    ]
    text = report(rows)
    assert "#### House, 30 % of the labelled patches wrong, 5 frames" in text
    depth, labels = (
        next(x for x in text.splitlines() if x.startswith(f"| {n} ")) for n in ("–", "labels")
    )
    cells = [c.strip() for c in depth.split("|")[1:-1]]
    assert cells[:8] == ["–", "depth", "2", "0.125 m 3.0°", "0.125 m 3.0°", ".50", "1.00", ".50"]
    cells = [c.strip() for c in labels.split("|")[1:-1]]
    assert cells[5:8] == [".00", ".50", ".00"]
    assert "Table 7, 3RScan" in text
    assert "| .35 | .61 |" in " ".join(text.split())
    written = rows[1].record()
    assert (written["row"], written["length"]) == (f"house: {LABELS}: semantic", 5)


@pytest.fixture
def asked(monkeypatch, shared):  # noqa: ARG001  # the benchmark's data
    """The script, its maps replaced by names and its answers by numbers."""
    asked = []

    def fake(case, scene, window, *, seed, device):  # noqa: ARG001
        assert scene == case.place
        asked.append((case.name, window.name, seed))
        return answer(0.05, 1.0)

    monkeypatch.setattr(script, "ask", fake)
    monkeypatch.setattr(script, "available", list)
    monkeypatch.setattr(script.SemanticBench, "scene", lambda _, name: name)
    return asked


@pytest.fixture
def run(measure, tmp_path):
    def go(*options):
        places = ("--cache", tmp_path / "cache", "--out", tmp_path / "out.json")
        result = measure("indoor_semantics", *places, *options)
        return result.exit_code, result.output

    return go


def test_it_goes_on_where_it_was_cut(asked, run, tmp_path):
    options = ("--only", "house: labels: *", "--every", "13")
    code, text = run(*options)
    assert code == 0, text
    windows = len({window for _, window, _ in asked})
    assert len(asked) == 4 * (windows + 1)
    written = json.loads((tmp_path / "out.json").read_text())
    assert [r["row"].rpartition(": ")[2] for r in written["rows"]] == list(TERMS)
    assert written["every"] == 13
    asked.clear()
    assert run(*options) == (0, text)
    assert not asked
    run(*options, "--fresh")
    assert len(asked) == 4 * (windows + 1)
