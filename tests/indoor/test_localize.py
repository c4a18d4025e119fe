"""A capture finds its pose in a scene map, and says so only if it has."""

import hashlib
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from tests.indoor.conftest import measure_error, rebuild, rebuild_frame

import placegraph as pg
from placegraph.core.estimate import Status
from placegraph.core.geometry import (
    level_from_camera,
    pose_matrix,
    split_pose,
    vector_from_rotation,
)
from placegraph.core.threads import limit_threads
from placegraph.errors import InputError, OptionError
from placegraph.indoor.encode import Patches
from placegraph.indoor.encode.labels import ClassesOfInstances
from placegraph.indoor.likelihood.visibility import VisibilityTable
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.options import FilterOptions, Likelihood, PoseSearchOptions
from placegraph.indoor.pose.prior import Prior
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import open_capture

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = PoseSearchOptions()
TWO = slice(0, 2)
FIVE = slice(0, 5)


def right(estimate, truth, metres=0.25, degrees=5.0):
    """The best mode is where the camera was."""
    distance, turn = measure_error(estimate.best.map_from_camera, truth)
    assert distance < metres, f"{distance:.2f} m off: {estimate.reason}"
    assert turn < degrees, f"{turn:.1f} degrees off: {estimate.reason}"


def honest(estimate, truth=None):
    """`OK` is said only of what lies within 0.5 m and 10 degrees; of another place, never."""
    if estimate.status is Status.OK:
        assert truth is not None, estimate.reason
        right(estimate, truth, 0.5, 10.0)


def same(a, b):
    """Two estimates in every number, but for the last digits of linear algebra."""
    assert a.status is b.status
    assert a.reason == b.reason
    np.testing.assert_allclose(a.trajectory, b.trajectory, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(a.frames, b.frames)
    assert len(a.modes) == len(b.modes)
    for one, other in zip(a.modes, b.modes, strict=True):
        np.testing.assert_allclose(one.map_from_camera, other.map_from_camera, rtol=0, atol=1e-12)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=0, atol=1e-12)
        assert one.probability == other.probability


@pytest.mark.parametrize(
    "cues",
    [
        {"semantic": True},
        {"depth": True},
        {"semantic": True, "colour": True},
        {"depth": True, "colour": True},
    ],
    ids="+".join,
)
def test_each_cue_finds_the_pose(cues, room, walk, truth):
    estimate = room.localize(walk, options=OPTIONS.only(**cues))
    right(estimate, truth(walk)[-1], 0.5, 10.0)
    if "depth" in cues:
        right(estimate, truth(walk)[-1], 0.1, 2.0)
        assert estimate.status is Status.OK, estimate.reason


def test_labels_of_classes(room_world, room, render, truth):
    capture = render(room_world, "classes", 2, through="123", labels="labels", frames=6)
    assert capture.label_kind == "labels"
    right(room.localize(capture), truth(capture)[-1], 0.1, 2.0)
    honest(room.localize(capture, options=OPTIONS.only(semantic=True)), truth(capture)[-1])


def test_an_encoder_of_ones_own(room, walk, truth):
    asked = []

    class Spy(ClassesOfInstances):
        def encode(self, frame):
            asked.append(frame.index)
            return super().encode(frame)

    estimate = room.localize(walk, frames=[2, 3, 5], encoder=Spy(room))
    assert asked == [2, 3, 5]  # each frame once
    right(estimate, truth(walk)[5])
    asked.clear()
    room.localize(walk, frames=TWO, encoder=Spy(room), options=OPTIONS.only(depth=True))
    assert not asked


def test_an_encoder_that_says_nothing_does_no_harm(room, walk, truth):
    class Mute:
        def encode(self, frame):
            rows = np.full(4, -1, np.int32)
            return Patches(frame.camera, (2, 2), rows, np.ones((1, len(room)), np.float32))

    right(room.localize(walk, frames=[1, 3, 4], encoder=Mute()), truth(walk)[4])


def test_frames_of_depth_alone_take_part(room, walk, truth):
    frames = [
        f if i % 2 else rebuild_frame(f, rgb=None, labels=None, label_camera=None)
        for i, f in enumerate(walk[:5])
    ]
    answer = room.localize(frames, seed=1)
    right(answer, truth(walk)[4], 0.1, 2.0)
    assert answer.status is Status.OK


RECORDED = FilterOptions(record=True)


@pytest.fixture(scope="module")
def answer(room, walk):
    """Estimate of six frames, and the progress reported on the way."""
    told = []
    estimate = room.localize(
        walk, frames=slice(0, 6), options=RECORDED, seed=3, progress=lambda *step: told.append(step)
    )
    return estimate, told


def test_the_answer_is_whole(answer, room, walk, truth):
    (answer, _), true = answer, truth(walk)
    right(answer, true[5], 0.1, 2.0)
    assert answer.status is Status.OK
    best = answer.best
    np.testing.assert_array_equal(answer.trajectory[-1], best.map_from_camera)
    pose, level = split_pose(best.map_from_camera)
    np.testing.assert_allclose(best.pose, pose, atol=1e-12)
    # gravity is a prior of the refinement: the tilt may differ from it by a fraction of a degree
    assert np.abs(level - level_from_camera(walk[5].gravity)).max() < 0.01
    matrix = pose_matrix(best.pose, level)
    np.testing.assert_allclose(best.map_from_camera, matrix, atol=1e-12)
    assert answer.frames.tolist() == list(range(6))
    shares = [m.probability for m in answer.modes]
    assert shares == sorted(shares, reverse=True)
    assert sum(shares) == pytest.approx(1)
    for mode in answer.modes:
        assert np.linalg.eigvalsh(mode.covariance).min() > 0
        assert mode.scene == room.scenes[0]
        np.testing.assert_allclose(mode.scene_from_camera, mode.map_from_camera, atol=1e-12)
    for i, matrix in enumerate(answer.trajectory):
        delta = np.linalg.inv(true[i]) @ matrix
        assert np.linalg.norm(delta[:3, 3]) < 0.12
    # the true pose lies within what the covariance allows
    turn = vector_from_rotation(true[5][:3, :3] @ best.map_from_camera[:3, :3].T)
    error = np.concatenate([true[5][:3, 3] - best.map_from_camera[:3, 3], turn])
    assert error @ np.linalg.solve(best.covariance, error) < 40


def test_the_answer_as_json(answer, room):
    plain = json.loads(json.dumps(answer[0].to_dict(), allow_nan=False))
    assert plain["status"] == "OK"
    assert plain["frames"] == list(range(6))
    evidence = plain["modes"][0]["evidence"]
    assert {e["verdict"] for e in evidence} <= {"for", "against", "silent"}
    assert set() < {o["id"] for e in evidence for o in e["objects"]} <= set(room.graph.ids)
    assert {"seconds", "particles", "rays"} <= set(plain["stats"])


def test_history_and_progress(answer):
    answer, progress = answer
    total = len(answer.history) * 6
    filtering = [(done, of) for what, done, of in progress if what == "filtering"]
    assert filtering == [(i + 1, total) for i in range(total)]
    passes = RECORDED.passes
    assert [p.stride for p in answer.history] == [p.stride for p in passes]
    for record, spec, counts in zip(answer.history, passes, answer.stats["particles"], strict=True):
        assert [frame for frame, _, _ in record.steps] == list(range(6))
        for (_, poses, weights), count in zip(record.steps, counts, strict=True):
            assert poses.shape == (count, 4)
            assert count <= max(spec.particles, 24)
            assert weights.sum() == pytest.approx(1)


def test_the_same_seed_gives_the_same_answer(room, walk, answer):
    answer, _ = answer
    again = room.localize(walk, frames=slice(0, 6), options=RECORDED, seed=3)
    same(answer, again)
    for a, b in zip(answer.history, again.history, strict=True):
        for (_, poses, weights), (_, others, their) in zip(a.steps, b.steps, strict=True):
            np.testing.assert_array_equal(poses, others)
            np.testing.assert_array_equal(weights, their)
    other = room.localize(walk, frames=slice(0, 6), seed=4)
    assert (other.best.pose != answer.best.pose).any()
    right(other, answer.best.map_from_camera, 0.1, 2.0)


def test_the_number_of_threads_does_not_matter(room, walk):
    alone = room.localize(walk, frames=TWO)
    with limit_threads(2):
        same(alone, room.localize(walk, frames=TWO))


def copied(capture, folder, leave=()):
    """Capture copied to another folder, without some of its files."""
    shutil.copytree(capture.path, folder, ignore=shutil.ignore_patterns(*leave))
    return open_capture(folder)


def test_the_truth_is_not_looked_at(room, walk, tmp_path):
    blind = copied(walk, tmp_path / "blind", ["trajectory.tum"])
    assert not (blind.path / "trajectory.tum").exists()
    expected = room.localize(walk, frames=TWO)
    same(expected, room.localize(blind, frames=TWO))
    (blind.path / "trajectory.tum").write_text("not a trajectory\n", encoding="utf-8")
    same(expected, room.localize(open_capture(blind.path), frames=TWO))


def test_the_odometrys_frame_does_not_matter(room, walk, truth):
    slant = np.eye(4)
    slant[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]  # the map's up is the odometry's y
    slant[:3, 3] = (30, -20, 5)
    frames = [replace(f, odometry=slant @ f.odometry) for f in walk[:5]]
    right(room.localize(frames), truth(walk)[4], 0.1, 2.0)


def test_the_map_is_only_read(room_world, walk):
    path = room_world.folder / "flat.scene"
    before = hashlib.sha256(path.read_bytes()).digest()
    scene = pg.open_map(path)
    columns = [scene.mesh.vertices, scene.mesh.triangles, *scene.mesh.textures]
    digests = [hashlib.sha256(c.tobytes()).digest() for c in columns]
    assert scene.localize(walk, frames=TWO).best
    assert hashlib.sha256(path.read_bytes()).digest() == before
    assert [hashlib.sha256(c.tobytes()).digest() for c in columns] == digests


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        *(({"frames": rows}, "frames") for rows in ([], slice(40, 50), [0, -11], [3, 2], "3")),
        ({"seed": -1}, "seed"),
        ({"device": "tpu"}, "device"),
        ({"device": "cuda"}, "device"),
        ({"options": PoseSearchOptions(heights=(300.0,))}, "heights"),
        ({"encoder": "labels"}, "object ids without names"),
    ],
    ids=str,
)
def test_questions_that_are_refused(wrong, says, room, walk):
    with pytest.raises(OptionError, match=says):
        room.localize(walk, **{"frames": TWO} | wrong)


def test_one_frame(room, walk, truth):
    estimate = room.localize(walk, frames=[6])
    assert estimate.trajectory.shape == (1, 4, 4)
    right(estimate, truth(walk)[6], 0.3)


def test_a_prior_saves_the_search(room, walk, truth):
    pose, _ = split_pose(truth(walk)[0])
    known = Prior(*pose[:2], yaw=float(pose[3]), spread=0.3, turn=0.2)
    right(room.localize(walk, frames=FIVE, prior=known), truth(walk)[4])
    # of the height and the heading nothing need be known
    right(room.localize(walk, frames=FIVE, prior=Prior(*pose[:2], spread=0.5)), truth(walk)[4])


def test_a_prior_wider_than_the_map_changes_nothing(flat, flat_walk, truth):
    pose, _ = split_pose(truth(flat_walk)[0])
    wide = Prior(pose[0] + 40.0, pose[1] - 30.0, yaw=float(pose[3]) + 0.5, spread=170.0, turn=1.0)
    right(flat.localize(flat_walk, frames=FIVE, prior=wide), truth(flat_walk)[4])


def test_a_prior_that_is_wrong_is_not_believed(flat, flat_walk, truth):
    pose, _ = split_pose(truth(flat_walk)[0])
    far = max(flat.visibility(OPTIONS).positions, key=lambda p: np.linalg.norm(p[:2] - pose[:2]))
    estimate = flat.localize(flat_walk, frames=FIVE, prior=Prior(*far[:2], spread=0.3))
    honest(estimate, truth(flat_walk)[4])


@pytest.mark.parametrize(
    "cues",
    [
        {"semantic": True, "depth": True, "colour": True},
        {"semantic": True},
        pytest.param({"depth": True, "colour": True}, marks=pytest.mark.all),
        pytest.param({"depth": True}, marks=pytest.mark.all),
        {"colour": True},
    ],
    ids="+".join,
)
def test_a_capture_of_another_place_is_not_ok(cues, room, flat, walk):
    options = OPTIONS.only(**cues)
    # objects of another map have no ids in this one, but labels
    encoder = Classes(room, flat)
    honest(flat.localize(walk, frames=slice(0, 10, 2), encoder=encoder, options=options))


class Classes(ClassesOfInstances):
    """Instances of one map as labels on another."""

    def __init__(self, scene, other):
        super().__init__(scene)
        words = [label.casefold() for label in other.graph.labels]
        classes = list(dict.fromkeys(words))
        self.table = np.full((len(classes), len(other)), -1.0, np.float32)
        self.table[[classes.index(word) for word in words], np.arange(len(other))] = 1.0
        self.row_of = {
            id_: classes.index(label.casefold()) if label.casefold() in classes else -1
            for id_, label in zip(scene.graph.ids, scene.graph.labels, strict=True)
        }


def test_a_capture_of_a_larger_place_is_not_ok(room, flat_walk):
    for cues in ({"semantic": True, "depth": True}, {"depth": True}):
        honest(room.localize(flat_walk, frames=FIVE, options=OPTIONS.only(**cues)))


@pytest.mark.parametrize("height", [0.3, 2.2])
def test_a_camera_at_any_height(height, room, room_world, render, truth):
    walk = render(room_world, f"at {height}", 3, through="123", frames=6, height=height)
    right(room.localize(walk), truth(walk)[-1], 0.1, 2.0)


@pytest.mark.all
def test_a_height_that_frames_leave_open(room, room_world, render, truth):
    walk = render(room_world, "at 0.9", 3, through="123", frames=6, height=0.9)
    found = [room.localize(walk, seed=seed) for seed in range(4)]
    for estimate in found:
        honest(estimate, truth(walk)[-1])
    assert any(
        measure_error(estimate.best.map_from_camera, truth(walk)[-1])[0] < 0.1 for estimate in found
    )


def test_a_map_of_one_giant_triangle(walk):
    vertices = [[-500, -500, 0], [500, -500, 0], [0, 700, 0]]
    scene = SceneMap.create(Mesh.plain(vertices, [[0, 1, 2]]), ["0"], ["floor"], floor=0.0)
    estimate = scene.localize(walk, frames=TWO, options=PoseSearchOptions(spacing=30.0))
    assert estimate.status is not Status.OK
    json.dumps(estimate.to_dict(), allow_nan=False)


def test_depth_of_zeros_is_no_depth(room, walk, truth):
    zeros = rebuild(walk[:4], depth=lambda f: np.zeros_like(f.depth()))
    estimate = room.localize(zeros)
    right(estimate, truth(walk)[3], 0.5, 10.0)
    without = rebuild(walk[:4], depth=lambda _: None, depth_camera=lambda _: None)
    same(estimate, room.localize(without))
    assert "depth" not in {e.statement for e in estimate.evidence}


def test_some_frames_may_lack_depth_or_labels(room, walk, truth):
    torn = rebuild(
        walk[:6],
        depth=lambda f: f.depth() * (np.nan if f.index % 2 else 1),
        labels=lambda f: np.full_like(f.labels(), -1) if f.index == 5 else f.labels(),
    )
    right(room.localize(torn), truth(walk)[5])


def test_a_map_without_colours_asks_for_other_cues(room, walk, truth):
    mesh = room.mesh
    white = SceneMap.create(
        Mesh.plain(mesh.vertices, mesh.triangles, mesh.object_of), room.graph.ids,
        room.graph.labels, floor=float(room.floors[0]),
    )  # fmt: skip
    right(white.localize(walk, frames=slice(0, 10, 3)), truth(walk)[9])
    # near frames of one wall leave the height open
    honest(white.localize(walk, frames=FIVE), truth(walk)[4])
    with pytest.raises(OptionError):
        white.localize(walk, frames=FIVE, options=OPTIONS.only(colour=True))


def test_nothing_to_compare(room, walk):
    bare = rebuild(
        walk[:2], depth=lambda _: None, depth_camera=lambda _: None,
        labels=lambda _: None, label_camera=lambda _: None, label_kind=lambda _: "labels",
    )  # fmt: skip
    for cues in ({"depth": True}, {"semantic": True}, {"semantic": True, "depth": True}):
        with pytest.raises(OptionError, match="cannot be compared"):
            room.localize(bare, options=OPTIONS.only(**cues))
    assert room.localize(bare).modes  # colours are left


def test_a_torn_image_is_named(room, walk, tmp_path):
    torn = copied(walk, tmp_path / "torn")
    file = sorted((torn.path / "rgb").iterdir())[2]
    file.write_bytes(file.read_bytes()[:300])
    with pytest.raises(InputError, match=file.name):
        room.localize(open_capture(torn.path), frames=FIVE)
    # who does not look at colours does not mind
    options = OPTIONS.only(semantic=True, depth=True)
    room.localize(open_capture(torn.path), frames=FIVE, options=options)


@pytest.mark.parametrize("level", [0, 255])
def test_black_and_white_images_are_survived(level, room, walk, truth):
    # frames apart: without colours, one view of a wall leaves the height open
    blank = rebuild(walk[::3], rgb=lambda f: np.full_like(f.rgb(), level))
    right(room.localize(blank), truth(walk)[9])
    assert room.localize(blank, options=OPTIONS.only(colour=True)).status is not Status.OK


@pytest.mark.parametrize(
    "options",
    [
        FilterOptions(kld=False),
        FilterOptions(start="uniform", spacing=0.3),
        FilterOptions(answer="mle"),
    ],
    ids=["without KLD", "uniform start", "without polish"],
)
def test_variants(options, room, walk, truth):
    estimate = room.localize(walk, frames=FIVE, options=options)
    right(estimate, truth(walk)[4], 0.3, 8.0)


@pytest.mark.parametrize("name", ["paper", "published", "coarse"])
def test_the_papers_recipes(name, room, walk, truth):
    """Eq. 2, a uniform start, 2,500 particles: slower, but they find their way in a room."""
    options = FilterOptions.preset(name)
    estimate = room.localize(walk, frames=slice(0, 3), options=options, refine=False)
    right(estimate, truth(walk)[2], 0.3, 8.0)
    counts = estimate.stats["particles"]
    assert [len(c) for c in counts] == [3] * len(options.passes)
    assert min(map(min, counts)) >= 2490  # shares of modes are rounded
    assert 0 < sum(mode.probability for mode in estimate.modes) <= 1 + 1e-9
    assert len(estimate.modes) <= options.modes


def test_the_last_pass_at_full_resolution(room, walk, truth):
    """Table 7, "max. resolution": stride 1."""
    first, second, third = FilterOptions.paper().passes
    passes = (first, replace(second, particles=300), replace(third, stride=1.0, particles=200))
    options = replace(FilterOptions.paper(), passes=passes, min_particles=200)
    estimate = room.localize(walk, frames=TWO, options=options, refine=False)
    right(estimate, truth(walk)[1], 0.4, 10.0)


def test_the_recipes_do_not_ask_the_table(room, walk, monkeypatch):
    monkeypatch.setattr(VisibilityTable, "ranks", None)
    options = replace(FilterOptions.published(), spacing=0.4, per_cell=1, inject_every=2)
    options = replace(options, min_particles=100, passes=options.passes[:1])
    assert room.localize(walk, frames=FIVE, options=options, refine=False).modes


def test_labels_alone_are_judged_by_ratios(room, walk, truth):
    """Scores of Eq. 2 are never above 0, and no log-likelihood ratio of a place that fits."""
    options = replace(
        PoseSearchOptions().only(semantic=True), likelihood=Likelihood(kind="gaussian")
    )
    estimate = room.localize(walk, frames=FIVE, options=options, refine=False)
    assert estimate.status is not Status.LOST, estimate.reason
    right(estimate, truth(walk)[4], 0.8, 10.0)  # of any height


@pytest.fixture(scope="module")
def building(room, flat):
    return merge_scenes({"office": room, "home": flat})


@pytest.mark.parametrize("name", ["office", "home"])
def test_the_right_scene_of_many(name, building, walk, flat_walk, truth):
    capture = walk if name == "office" else flat_walk
    estimate = building.localize(capture, frames=slice(0, 10, 2))
    assert estimate.status is Status.OK, estimate.reason
    best = estimate.best
    assert best.scene == name
    delta = np.linalg.inv(truth(capture)[8]) @ best.scene_from_camera
    assert np.linalg.norm(delta[:3, 3]) < 0.1
    into = building.scene_from_map[building.scenes.index(name)]
    np.testing.assert_allclose(into @ best.map_from_camera, best.scene_from_camera, atol=1e-9)


def test_the_shared_house(house, shared, truth):
    capture = open_capture(shared / "data/house/seq00")
    estimate = house.scene.localize(capture, frames=slice(5, 10))
    assert estimate.status is Status.OK, estimate.reason
    right(estimate, truth(capture)[9], 0.1, 1.0)
    assert estimate.frames.tolist() == [5, 6, 7, 8, 9]


@pytest.mark.all
def test_the_shared_office_is_not_in_the_house(house, shared):
    office = open_capture(shared / "data/office")
    honest(house.scene.localize(office, frames=slice(0, 10, 3)))
