"""Why a pose is believed: which objects agree, how far depth and colours do, where the map ends."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from tests.indoor.conftest import view_frames

from placegraph.core.geometry import (
    Camera,
    between,
    compose,
    level_from_camera,
    pose_matrix,
    split_pose,
)
from placegraph.indoor.build import scene_of_model
from placegraph.indoor.encode import bind_encoder
from placegraph.indoor.encode.labels import InstancesEncoder, LabelsEncoder
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.options import Likelihood, PoseSearchOptions
from placegraph.indoor.pose.agreement import Agreement, agreement, explain
from placegraph.indoor.pose.window import level_poses
from placegraph.io.capture.frame import Frame

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = PoseSearchOptions()
CAMERA = Camera(80, 48, 60.0, 60.0, 40.0, 24.0)
# two chairs before the walls of a hall: one in the west, one in the east
HALL = {
    "floor": ((-5, -5, -0.1), (5, 5, 0)),
    "wall": ((-5.1, -5, 0), (-5, 5, 3)),
    "wall ": ((5, -5, 0), (5.1, 5, 3)),
    "chair": ((-4, -1, 0), (-3, 1, 2)),
    "chair ": ((3, -1, 0), (4, 1, 2)),
}
FLOOR, WEST_WALL, EAST_WALL, WEST, EAST = range(5)
EASTWARD, WESTWARD = np.array([0, 0, 1.2, 0.0]), np.array([0, 0, 1.2, math.pi])


@pytest.fixture(scope="module")
def hall(boxes):
    return scene_of_model(boxes(HALL), detail="full")


def rendered(scene, pose, kind, **change):
    """A frame of boxes as a camera at a pose (4,) sees them, without noise."""
    drawn = scene.render(pose_matrix(pose, level_from_camera((0, 1, 0))), CAMERA, samples=1)
    labels = [label.strip() for label in scene.graph.labels]
    names = dict(enumerate(dict.fromkeys(labels), 1))
    number = {name: i for i, name in names.items()}
    of_object = np.array([number[label] for label in labels] + [-1])
    fields = {
        "depth": np.nan_to_num(drawn.depth), "label_kind": kind, "label_names": names,
        "labels": of_object[drawn.objects] if kind == "labels" else drawn.objects,
    }  # fmt: skip
    return Frame.from_arrays(drawn.colour, CAMERA, gravity=(0, 1, 0), **fields | change)


def judged(scene, frame, pose, kind, likelihood=OPTIONS.likelihood, **wanted):
    options = replace(OPTIONS, likelihood=likelihood)
    options = options.only(**wanted or {"semantic": True, "depth": True})
    grid = (6, 10)
    labels = kind == "labels"
    encoder = bind_encoder(LabelsEncoder(grid), scene) if labels else InstancesEncoder(scene, grid)
    seen = view_frames(scene, [frame], options, encoder, 4.0)
    return agreement(Scorer(scene, options.likelihood), pose, seen, np.zeros((1, 4)))


@pytest.mark.parametrize("kind", ["instances", "labels"])
def test_where_the_camera_is_everything_agrees(hall, kind):
    got = judged(hall, rendered(hall, EASTWARD, kind), EASTWARD, kind)
    assert got.semantic > 0.95
    assert got.depth > 0.98
    assert math.isnan(got.colour)
    assert 0.5 < got.covered < 0.95  # above the wall the hall is open
    assert got.weights[EAST] > 5
    assert got.weights[EAST_WALL] > 5
    assert (got.weights >= 0).all()
    assert got.counts[[WEST, WEST_WALL]].tolist() == [0, 0]


def test_what_fills_many_patches_tells_only_in_part(hall):
    frame = rendered(hall, EASTWARD, "instances")
    whole = judged(hall, frame, EASTWARD, "instances", semantic=True)
    part = judged(hall, frame, EASTWARD, "instances", Likelihood(object_patches=1.0), semantic=True)
    patches = whole.counts[EAST]
    assert patches > 5
    assert part.weights[EAST] == pytest.approx(whole.weights[EAST] / math.sqrt(patches), rel=0.05)
    np.testing.assert_array_equal(part.counts, whole.counts)


def test_labels_speak_for_the_object_seen_not_for_its_like(hall):
    for pose, seen, unseen in ((EASTWARD, EAST, WEST), (WESTWARD, WEST, EAST)):
        got = judged(hall, rendered(hall, pose, "labels"), pose, "labels", semantic=True)
        assert got.weights[seen] > 3
        assert got.counts[unseen] == 0
        first = next(e for e in explain(hall, got) if e.statement.startswith("chair"))
        assert (first.verdict, first.objects[0].id) == ("for", hall.graph.ids[seen])


def test_instances_in_the_wrong_place_speak_against_themselves(hall):
    frame = rendered(hall, EASTWARD, "instances")
    got = judged(hall, frame, WESTWARD, "instances", semantic=True)
    assert got.semantic < 0.4
    assert got.weights[EAST] < -3
    assert got.weights[EAST_WALL] < -3
    assert got.counts[WEST] == 0
    spoken = {e.objects[0].id: e for e in explain(hall, got) if e.objects}
    chair = spoken[hall.graph.ids[EAST]]
    assert chair.verdict == "against"
    assert chair.note


def test_labels_in_the_wrong_place_speak_against_what_stands_there(hall):
    chairs = np.full((48, 80), 3)  # all of the image
    frame = rendered(hall, EASTWARD, "labels", labels=chairs)
    got = judged(hall, frame, EASTWARD, "labels", semantic=True)
    assert got.weights[EAST] > 1
    assert got.weights[EAST_WALL] < -3
    assert got.counts[WEST] == got.counts[WEST_WALL] == 0


def test_depth_counts_readings_within_a_deviation(hall):
    frame = rendered(hall, EASTWARD, "instances")
    deviation = OPTIONS.likelihood.depth_floor + OPTIONS.likelihood.depth_slope * 3
    for off, share in ((0.0, 1.0), (0.5, 1.0), (-0.5, 1.0), (2.0, 0.0), (-2.0, 0.0)):
        moved = np.where(frame.depth() > 0, frame.depth() + off * deviation, 0)
        other = rendered(hall, EASTWARD, "instances", depth=moved)
        got = judged(hall, other, EASTWARD, "instances", depth=True)
        assert got.depth == pytest.approx(share, abs=0.12)
        assert math.isnan(got.semantic)


def test_something_in_the_way_speaks_against_what_is_behind(hall):
    frame = rendered(hall, EASTWARD, "instances")
    depth = frame.depth().copy()
    depth[10:, 20:60] = 1.0
    got = judged(
        hall, rendered(hall, EASTWARD, "instances", depth=depth), EASTWARD, "instances", depth=True
    )
    assert got.weights[EAST] < -1
    assert got.weights[EAST_WALL] > 0


def test_a_camera_that_sees_noobject_of_the_map(hall):
    frame = rendered(hall, EASTWARD, "instances")
    off = np.array([300.0, 0, 1.2, 0.0])
    got = judged(hall, frame, off, "instances")
    assert got.covered == 0
    assert math.isnan(got.semantic)
    assert math.isnan(got.depth)
    assert not got.counts.any()
    (note,) = explain(hall, got)
    assert (note.statement, note.verdict) == ("coverage", "silent")
    assert "100%" in note.note


@pytest.fixture(scope="module")
def walked(room, walk, truth):
    """Scorer, true pose of the last frame, views of ten frames and steps to them."""
    seen = view_frames(room, walk, OPTIONS, InstancesEncoder(room))
    poses = level_poses(walk.odometry, walk.gravity)
    pose, _ = split_pose(truth(walk)[-1])
    return Scorer(room, OPTIONS.likelihood), pose, seen, between(poses[-1], poses)


def test_a_rendered_walk_agrees_with_its_truth(walked, room):
    scorer, pose, seen, steps = walked
    right = agreement(scorer, pose, seen, steps)
    assert right.covered > 0.95
    assert right.semantic > 0.8
    assert right.depth > 0.85
    assert right.colour > 0.2
    assert right.tone > 0.5
    for off in ((1.0, 0, 0, 0), (0, 0, 0, 0.8), (0, 0, 0, np.pi)):
        wrong = agreement(scorer, compose(pose, np.array(off)), seen, steps)
        assert wrong.semantic < right.semantic - 0.05
        assert wrong.depth < right.depth - 0.1
        assert wrong.colour < right.colour / 1.5
        assert wrong.tone < right.tone / 1.5
    evidence = explain(room, right)
    assert [e.verdict for e in evidence[:3]] == ["for"] * 3
    assert {"depth", "colour"} <= {e.statement for e in evidence}
    json.dumps([e.to_dict() for e in evidence], allow_nan=False)


def test_colours_are_told_per_sample_of_the_image(walked):
    scorer, pose, seen, steps = walked
    got = agreement(scorer, pose, seen[-1:], np.zeros((1, 4)))
    inside = (seen[-1].patch >= 0).mean()
    assert inside < 0.8  # 16 x 9 samples in tiles of 4 x 4
    colour, tone = scorer.terms(pose[None], seen[-1])[0, 2:].tolist()
    assert got.covered == 1.0
    assert got.colour == pytest.approx(colour / OPTIONS.likelihood.colour_weight, rel=1e-4)
    assert got.tone == pytest.approx(tone / OPTIONS.likelihood.tone_weight, rel=1e-4)
    bare = seen[-1]._replace(terms=seen[-1].terms & [True, False, True])
    assert math.isnan(agreement(scorer, pose, [bare], np.zeros((1, 4))).tone)
    assert len(steps) == len(seen)


def test_eq_2_can_be_explained_too(room, walk, truth):
    options = PoseSearchOptions(likelihood=Likelihood(kind="gaussian"))
    seen = view_frames(room, walk[-1:], options, InstancesEncoder(room))
    pose, _ = split_pose(truth(walk)[-1])
    got = agreement(Scorer(room, options.likelihood), pose, seen, np.zeros((1, 4)))
    assert got.semantic > 0.8
    assert got.depth > 0.85


def explain_with(hall, **change):
    fields = {
        "covered": 1.0, "semantic": math.nan, "depth": math.nan, "colour": math.nan,
        "weights": np.zeros(5), "counts": np.zeros(5),
    }  # fmt: skip
    return explain(hall, Agreement(**fields | change))


def test_objects_in_the_order_of_what_they_explain_with(hall):
    weights, patches = np.array([2.0, -9.0, 0.3, 5.0, 7.0]), np.array([4.0, 3, 2, 1, 0])
    got = explain_with(hall, weights=weights, counts=patches)
    assert [e.objects[0].id for e in got] == [hall.graph.ids[i] for i in (1, 3, 0, 2)]
    assert [e.verdict for e in got] == ["against", "for", "for", "silent"]
    assert [e.weight for e in got] == [-9.0, 5.0, 2.0, 0.3]
    assert got[0].statement == f"wall {hall.graph.ids[1]}"


def test_only_the_twelve_that_told_most_are_named(room):
    count = len(room)
    assert count > 12
    agreed = Agreement(
        1.0, math.nan, math.nan, math.nan, np.arange(count, dtype=float), np.ones(count)
    )
    got = explain(room, agreed)
    assert [e.weight for e in got] == [float(count - 1 - i) for i in range(12)]


def test_depth_colour_and_coverage_in_words(hall):
    (depth,) = explain_with(hall, depth=0.83)
    assert (depth.statement, depth.verdict) == ("depth", "for")
    assert depth.note.startswith("83% of the readings")
    assert explain_with(hall, depth=0.2)[0].verdict == "against"
    assert explain_with(hall, colour=0.4)[0].verdict == "for"
    assert explain_with(hall, colour=0.0)[0].verdict == "silent"
    assert explain_with(hall, covered=0.5)[0].note == "50% of the view lies outside the map"
    assert explain_with(hall, covered=0.8) == ()
