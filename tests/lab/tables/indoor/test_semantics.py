import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.indoor.build import build_scene
from placegraph.io.capture.capture import open_capture
from placegraph_lab.tables.indoor.metrics import Answer
from placegraph_lab.tables.indoor.windows import Window, true_poses
from placegraph_lab.tables.named.indoor_semantics import (
    LABELS,
    NONE,
    OTHERS,
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
