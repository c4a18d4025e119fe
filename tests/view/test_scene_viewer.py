"""The viewer: what its scene holds and what its controls do, without a browser."""

import socket
import sys
import urllib.request

import numpy as np
import pytest

from placegraph.core.estimate import PassRecord, PoseEstimate, PoseMode, Status
from placegraph.errors import MissingExtraError, OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from placegraph.view import scene_viewer as showing
from placegraph.view.scene_viewer import open_viewer

pytest.importorskip("viser", reason="needs viser: pip install 'placegraph[view]'")

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
FACES = np.array([(0, 2, 1), (0, 1, 3)])
LABELS = ("floor", "ceiling", "chair", "chair", "table")


@pytest.fixture(scope="module")
def scene():
    """Five objects, two of which share their name."""
    count = len(LABELS)
    mesh = Mesh.plain(
        np.concatenate([CORNERS + np.array([2 * k, 0, 0]) for k in range(count)]),
        np.concatenate([FACES + 4 * k for k in range(count)]),
        np.repeat(np.arange(count), 2),
    )
    return SceneMap.create(
        mesh,
        [f"id{k}" for k in range(count)],
        LABELS,
        floor=0.0,
        names=["", "", "seat", "seat", "my *table*"],
        attributes=[{}, {}, {"colour": "red"}, {}, {}],
        relations=[(2, "next to", 3), (2, "on", 0), (3, "on", 0)],
        source="drawn.glb",
    )


@pytest.fixture(scope="module")
def run():
    """An estimate with two passes of three frames."""
    rng = np.random.default_rng(4)
    history = tuple(
        PassRecord(
            stride, tuple((f, rng.normal(0, 1, (20 + f, 4)), rng.random(20 + f)) for f in range(3))
        )
        for stride in (16.0, 8.0)
    )
    modes = tuple(
        PoseMode(np.eye(4), np.zeros(4), np.eye(6), p, "", np.eye(4)) for p in (0.9, 0.09, 0.001)
    )
    return PoseEstimate(
        Status.OK, modes, "One place fits.", trajectory=np.stack([np.eye(4)] * 3),
        frames=np.arange(3), history=history,
    )  # fmt: skip


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def viewer(scene, run):
    way = np.stack([np.eye(4)] * 4)
    with open_viewer(scene, camera_paths={"walk": way}, run=run, port=free_port()) as opened:
        yield opened


def list_visible(viewer):
    return [handle.visible for handle in viewer.map.objects]


def test_it_serves_a_page_with_paths_modes_and_relations(viewer):
    with urllib.request.urlopen(viewer.address) as page:  # noqa: S310  # our own
        assert b"<html" in page.read()[:2000].lower()
    assert list(viewer.map.paths) == ["walk", "run"]
    assert len(viewer.map.paths["walk"].points) == 3 + 4 * 8
    assert len(viewer.run.modes) == 2  # of the third there is next to nothing
    relations = viewer.map.relations
    assert {kind: len(lines.points) for kind, lines in relations.items()} == {"next to": 1, "on": 2}
    assert not any(lines.visible for lines in relations.values())
    assert relations["next to"].points[0] == pytest.approx(viewer.map.scene.graph.positions[[2, 3]])


def test_ceilings_are_hidden_at_first_and_things_have_names(viewer):
    assert list_visible(viewer) == [True, False, True, True, True]
    labels = viewer.map.labels
    assert {k: v.text for k, v in labels.items()} == {2: "seat", 3: "seat", 4: "my *table*"}
    viewer.map.names.value = False
    assert not any(label.visible for label in labels.values())


def test_an_object_is_picked_described_and_hidden(viewer):
    shown = viewer.map
    shown.choice.value = "seat [id2]"
    assert shown.picked == 2
    about = shown.about.content
    for words in (r"seat \[id2\]", "label: chair", "colour: red", r"next to seat \[id3\]"):
        assert words in about
    assert shown.box.points.reshape(-1, 3).min(axis=0) == pytest.approx([4, 0, 0])
    shown.visible.value = False
    assert list_visible(viewer) == [True, False, False, True, True]
    assert not shown.labels[2].visible
    shown.visible.value = True
    assert list_visible(viewer)[2]
    shown.choice.value = "-"
    assert (shown.picked, shown.box, shown.about.content) == (None, None, "")


def test_one_alone_and_all(viewer):
    viewer.map.pick(4)
    viewer.map.show([4], only=True)
    assert list_visible(viewer) == [False] * 4 + [True]
    viewer.map.show(range(5))
    assert all(list_visible(viewer))
    viewer.map.hide([0, 4])
    assert list_visible(viewer) == [False, True, True, True, False]
    assert not viewer.map.visible.value  # of the object that is picked


def test_slider_and_play_go_through_frames_and_passes(viewer, run, monkeypatch):
    assert "pass 1 of 2, stride 16, frame 0: 20 particles" in viewer.run.said.content
    viewer.run.slider.value = 5
    assert "pass 2 of 2, stride 8, frame 2: 22 particles" in viewer.run.said.content
    _, poses, _ = run.history[1].steps[2]
    assert viewer.run.cloud.points == pytest.approx(poses[:, :3], abs=1e-6)
    assert viewer.run.tails.points[:, 0] == pytest.approx(poses[:, :3], abs=1e-6)
    viewer.run.slider.value = 0
    monkeypatch.setattr(showing, "PAUSE", 0.0)
    viewer.run.play()
    assert viewer.run.slider.value == 5
    assert "pass 2 of 2, stride 8, frame 2" in viewer.run.said.content


def test_many_particles_are_thinned(scene, monkeypatch, run):
    monkeypatch.setattr(showing, "MOST", 10)
    with open_viewer(scene, run=run, port=free_port()) as opened:
        assert len(opened.run.cloud.points) == 10


def test_a_run_without_particles(scene):
    lost = PoseEstimate(Status.LOST, (), "Nothing fits.")
    with open_viewer(scene, run=lost, port=free_port()) as opened:
        assert opened.run.said.content == "No particles were recorded."
        assert opened.run.cloud is None
        assert not opened.map.paths


def test_a_taken_port_leads_to_the_next(scene):
    port = free_port()
    with open_viewer(scene, port=port) as one, open_viewer(scene, port=port) as other:
        assert one.address == f"http://127.0.0.1:{port}"
        assert other.address != one.address


def test_what_cannot_be_served(scene, monkeypatch):
    with pytest.raises(OptionError, match="port is 0"):
        open_viewer(scene, port=0)
    with pytest.raises(OptionError, match="host is"):
        open_viewer(scene, host="203.0.113.7")  # of nobody: kept for documentation
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'placegraph\[view\]'"):
        open_viewer(scene)
