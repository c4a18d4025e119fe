from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import level_from_camera, pose_matrix
from placegraph.core.graph import SceneGraph
from placegraph.indoor.language import Kind, read
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor.windows import Window
from placegraph_lab.tables.scene import sentences as spoken_poses
from placegraph_lab.tables.scene.sentences import (
    RankedSentence,
    Scene,
    ask,
    describe_pose,
    figures,
    recall,
    report,
)
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.home.home import scene_of


def scene(name, *labels, room="", edges=()):
    graph = SceneGraph(
        ids=tuple(map(str, range(len(labels)))),
        labels=labels,
        positions=np.zeros((len(labels), 3)),
        sources=np.array([s for s, _, _ in edges], np.int64),
        relations=tuple(r for _, r, _ in edges),
        targets=np.array([t for _, _, t in edges], np.int64),
    )
    return Scene(name, graph, (room,) * len(labels))


SCENES = [
    scene("a", "stove", "fridge", "chair", "chair", "wall", room="kitchen", edges=[(1, "next to", 0)]),
    scene("b", "bed", "lamp", "nightstand", "floor", room="bedroom", edges=[(1, "standing on", 2)]),
    scene("c", "toilet", "bathtub", "mirror", room="1"),
]  # fmt: skip


def test_ranks_are_counted():
    twins = [scene(str(i), "sofa", "lamp", room="1") for i in range(9)]
    asked = ask([*twins, SCENES[0]], np.random.default_rng(0), facts=2, wrong=0.0, each=1)
    assert {a.candidates for a in asked} == {10}
    assert asked[-1].rank == 1
    assert asked[0].rank in (5, 6)  # of equals, the middle
    ranked = [RankedSentence("", "", 1, 0.0, 10, r) for r in (1, 2, 4, 9)]
    assert recall(ranked) == [0.25, 0.5, 0.75]
    assert ".10/" in report(asked)
    (row,) = figures(asked)
    assert (row["recall_1"], row["sentences"]) == (0.1, 10)


@pytest.fixture(scope="module")
def flat():
    return scene_of(Flat.load("altbau").furnish(np.random.default_rng(1)))


def test_a_pose_is_described_as_it_is(flat):
    tall = next(i for i, label in enumerate(flat.graph.labels) if label == "fridge")
    at = flat.graph.positions[tall] - [1.6, 0.0, 0.0]
    level = level_from_camera(np.array([0.0, 1.0, 0.0]))
    ways = {0.0: "facing the fridge", np.pi / 2: "the fridge is on my right",
            -np.pi / 2: "the fridge is on my left", np.pi: "the fridge is behind me"}  # fmt: skip
    for yaw, said in ways.items():
        pose = pose_matrix([*at[:2], 1.5, yaw], level)
        text = describe_pose(flat, pose, np.random.default_rng(0), 100)
        assert said in text.split(". ")
        assert all(s.kind in (Kind.NEAR, Kind.TOWARDS) for s in read(text).statements)
    assert describe_pose(flat, pose, np.random.default_rng(0), 0) == ""


def test_every_window_is_asked_without_with_and_against(flat, monkeypatch):
    level = level_from_camera(np.array([0.0, 1.0, 0.0]))
    poses = [pose_matrix([1.6, 5.7, 1.5, 1.0], level), pose_matrix([7.6, 1.2, 1.5, 3.0], level)]
    windows = [Window("seq", (SimpleNamespace(index=i),), pose) for i, pose in enumerate(poses)]
    told = []

    def localize(_scene, _capture, *, description, **_options):
        told.append(description)
        return PoseEstimate(Status.LOST, (), "nothing is looked at")

    monkeypatch.setattr(SceneMap, "localize", localize)
    spoken = spoken_poses.ask_pose(flat, windows, np.random.default_rng(0))
    one, other = told[1], told[4]
    assert one != other
    assert told == [None, one, other, None, other, one] * 2
    by = spoken_poses.pose_figures(spoken)["colour"]
    assert by["wrong"] == pytest.approx(
        {"windows": 2, "recall": 0, "held": 0, "wrong_ok": 0, "seconds": 0}, abs=0.5
    )
    assert spoken_poses.report_poses(spoken).count("true") == len(spoken_poses.TERMS)
