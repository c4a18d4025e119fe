from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from tests.indoor.mapping.parts import cuboid

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.mapping.segment import segment
from placegraph.indoor.rays import RayCaster
from placegraph.io.capture.frame import Frame

CAMERA = Camera(160, 120, 110.0, 110.0, 80.0, 60.0)
WORDS = {0: "floor", 1: "chair", 2: "window", 3: "lamp", 4: "rug"}


def fine(vertices, triangles, rounds):
    spots = vertices[triangles]
    for _ in range(rounds):
        a, b, c = np.moveaxis(spots, 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        spots = np.stack([np.stack(p, axis=1) for p in parts], axis=1).reshape(-1, 3, 3)
    return spots


def cube(low, high):
    return fine(*cuboid(low, high), 3)


def wall(y0, y1, z0, z1, x=0.0):
    corners = np.array([[x, y0, z0], [x, y1, z0], [x, y1, z1], [x, y0, z1]], float)
    return fine(corners, np.array([[0, 1, 2], [0, 2, 3]]), 4)


@pytest.fixture(scope="module")
def room():
    ground = np.array([[0, -2, 0], [4, -2, 0], [4, 2, 0], [0, 2, 0]], float)
    parts = [
        fine(ground, np.array([[0, 1, 2], [0, 2, 3]]), 5),
        *(wall(*w) for w in ((-2, 2, 0, 1), (-2, 2, 2, 2.5), (-2, -0.5, 1, 2), (0.5, 2, 1, 2))),
        wall(-0.5, 0.5, 1, 2),
        cube((1.5, -0.6, 0.0), (2.0, -0.005, 0.8)),
        cube((1.5, 0.005, 0.0), (2.0, 0.6, 0.8)),
    ]
    truth = np.repeat([0, 1, 1, 1, 1, 2, 3, 4], [len(p) for p in parts])
    spots = np.concatenate(parts)
    return spots.reshape(-1, 3), np.arange(3 * len(spots)).reshape(-1, 3), truth


def look(eye, at):
    z = np.array(at, float) - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = eye
    return pose


def views(room, meaning, *, noise=0.0, count=12, depth=True, kind="labels", names=WORDS):
    vertices, triangles, truth = room
    caster = RayCaster(vertices, triangles)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.directions(np.stack([u, v], axis=-1).reshape(-1, 2) + 0.5)
    rng = np.random.default_rng(7)
    frames = []
    for i in range(count):
        angle = np.pi * (i + 0.5) / count - np.pi / 2
        pose = look([1.9 + 2 * np.cos(angle), 1.9 * np.sin(angle), 1.5], [0.8, 0.0, 0.8])
        hits = caster.cast(pose[:3, 3], rays @ pose[:3, :3].T)
        part = np.where(hits.triangle >= 0, truth[hits.triangle], -1)
        labels = np.where(part >= 0, np.array(meaning)[part], -1).reshape(v.shape)
        wrong = np.kron(rng.random((12, 16)) < noise, np.ones((10, 10), bool))
        other = np.kron(rng.integers(0, 5, (12, 16)), np.ones((10, 10), int))
        frame = Frame.from_arrays(
            np.zeros((*v.shape, 3), np.uint8), CAMERA, odometry=pose, stamp=float(i),
            depth=hits.distance.reshape(v.shape) if depth else None,
            labels=np.where(wrong & (labels >= 0), other, labels),
            label_kind=kind, label_names=names,
        )  # fmt: skip
        frames.append(frame)
    return frames


def shares(found, truth, part):
    labels = np.array(found.labels)[found.object_of[truth == part]]
    return {label: float(np.mean(labels == label)) for label in set(labels.tolist())}


@pytest.mark.parametrize("depth", [True, False])
def test_labels_with_noise(room, depth):
    vertices, triangles, truth = room
    frames = views(room, [0, -1, 2, 1, 1], noise=0.3, depth=depth)
    found = segment(vertices, triangles, frames=frames)
    assert shares(found, truth, 0)["floor"] > 0.95
    assert shares(found, truth, 2)["window"] > 0.9
    assert shares(found, truth, 1)["wall"] > 0.85
    for chair in (3, 4):
        assert shares(found, truth, chair)["chair"] > 0.75


def test_regions_of_one_label_split_at_gaps(room):
    vertices, triangles, truth = room
    moved = vertices.copy()
    moved[triangles[truth == 4].ravel(), 1] += 0.8
    apart = (moved, triangles, truth)
    found = segment(moved, triangles, frames=views(apart, [0, -1, 2, 1, 1]))
    chairs = [set(found.object_of[truth == part].tolist()) for part in (3, 4)]
    names = [{found.names[i] for i in rows if found.labels[i] == "chair"} for rows in chairs]
    assert [len(n) for n in names] == [1, 1]
    assert names[0] != names[1]


def test_labels_lie_within_the_wall_they_are_flush_with(room):
    vertices, triangles, truth = room
    bare = segment(vertices, triangles)
    assert shares(bare, truth, 2) == {"wall": 1.0}
    found = segment(vertices, triangles, frames=views(room, [-1, -1, 2, -1, -1]))
    assert shares(found, truth, 2)["window"] > 0.95
    assert found.labels.count("window") == 1
    assert shares(found, truth, 1)["wall"] > 0.95
    assert "unknown" in shares(found, truth, 3)  # what no label speaks of stays as geometry has it


def test_instances_keep_their_ids(room):
    vertices, triangles, truth = room
    frames = views(room, [-1, -1, -1, 17, 4], kind="instances", names={})
    found = segment(vertices, triangles, frames=frames)
    ids = np.array(found.ids)[found.object_of]
    assert np.mean(ids[truth == 3] == "17") > 0.75
    assert np.mean(ids[truth == 4] == "4") > 0.75
    assert len(set(found.ids)) == len(found)
    assert found.labels[0] == "floor"


@pytest.mark.parametrize("names", [{}, {5: "unknown", 6: "object"}])
def test_an_instance_that_covers_the_floor_is_the_floor(room, names):
    vertices, triangles, truth = room
    frames = views(room, [5, 6, 6, 17, 4], noise=0.2, kind="instances", names=names)
    found = segment(vertices, triangles, frames=frames)
    assert shares(found, truth, 0)["floor"] > 0.95
    assert shares(found, truth, 1)["wall"] > 0.95
    for id_, word in (("5", "floor"), ("6", "wall")):
        assert found.labels.count(word) == 1
        assert found.ids[found.labels.index(word)] == id_
    assert found.floor == pytest.approx(0.0, abs=1e-6)


def test_an_instance_within_a_wall_is_no_wall(room):
    vertices, triangles, truth = room
    centres = vertices[triangles].mean(axis=1)
    rug = (truth == 0) & (np.abs(centres[:, 0] - 3.0) < 0.6) & (np.abs(centres[:, 1]) < 0.8)
    parts = (vertices, triangles, np.where(rug, 5, truth))
    frames = views(parts, [-1, -1, 9, 17, 4, 8], kind="instances", names={})
    found = segment(vertices, triangles, frames=frames)
    for id_ in ("8", "9"):
        assert found.labels[found.ids.index(id_)] == "unknown"
    assert found.labels.count("floor") == found.labels.count("wall") == 1


def test_labels_that_do_not_name_the_floor(room):
    vertices, triangles, truth = room
    for word in ("object", "floor"):
        frames = views(room, [0, -1, 2, 1, 1], noise=0.2, names=WORDS | {0: word})
        found = segment(vertices, triangles, frames=frames)
        assert shares(found, truth, 0) == {"floor": 1.0}
        assert found.labels.count("floor") == 1
        assert "object" not in found.labels
    frames = views(room, [0, -1, 2, 1, 1], noise=0.2, names=WORDS | {0: "parquet"})
    found = segment(vertices, triangles, frames=frames)
    assert found.labels.count("parquet") == 1
    rows = [i for i, label in enumerate(found.labels) if label == "floor"]  # corners no image shows
    corner = (1.0 / 8.0) ** 2 / 2.0
    assert all((found.object_of == row).sum() * corner > 0.5 for row in rows)


def test_something_before_the_mesh_does_not_vote(room):
    vertices, triangles, _ = room
    frames = views(room, [4, 4, 4, 4, 4])
    near = [
        Frame.from_arrays(
            f.rgb(), CAMERA, depth=0.5 * f.depth(), labels=f.labels(), label_names=WORDS,
            odometry=f.odometry,
        )
        for f in frames
    ]  # fmt: skip
    assert "rug" in segment(vertices, triangles, frames=frames).labels
    assert "rug" not in segment(vertices, triangles, frames=near).labels


def test_poses_stand_in_for_odometry(room):
    vertices, triangles, _ = room
    frames = views(room, [0, -1, 2, 1, 1])
    poses = np.array([f.odometry for f in frames])
    blind = [replace(f, odometry=np.eye(4)) for f in frames]
    one = segment(vertices, triangles, frames=frames)
    two = segment(vertices, triangles, frames=blind, poses=poses)
    np.testing.assert_array_equal(one.object_of, two.object_of)
    lost = poses.copy()
    lost[:, :3, 3] += 100.0
    far = segment(vertices, triangles, frames=frames, poses=lost)
    assert "chair" not in far.labels


def test_order_of_triangles_and_frames_without_labels_do_not_matter(room):
    vertices, triangles, _ = room
    frames = views(room, [0, -1, 2, 1, 1], noise=0.3)
    order = np.random.default_rng(1).permutation(len(triangles))
    one = segment(vertices, triangles, frames=frames)
    two = segment(vertices, triangles[order], frames=frames)
    np.testing.assert_array_equal(one.object_of[order], two.object_of)
    assert one.names == two.names
    blind = [Frame.from_arrays(np.zeros((120, 160, 3), np.uint8), CAMERA)]
    bare, unlabelled = (segment(vertices, triangles, frames=f) for f in ((), blind))
    np.testing.assert_array_equal(bare.object_of, unlabelled.object_of)


def test_what_is_passed_over_is_counted(room):
    vertices, triangles, _ = room
    frames = views(room, [0, -1, 2, 1, 1], names={0: "floor"}, count=2)
    poses = np.array([f.odometry for f in frames])
    poses[1] = np.nan
    left_out = Counter()
    segment(vertices, triangles, frames=frames, poses=poses, left_out=left_out)
    assert left_out["frames without a pose"] == 1
    assert left_out["pixels whose label has no name"] > 0


def test_bad_frames(room):
    vertices, triangles, _ = room
    frames = views(room, [0, -1, 2, 1, 1], count=2)
    mixed = [frames[0], *views(room, [0, -1, 2, 1, 1], count=1, kind="instances")]
    with pytest.raises(OptionError, match="kind"):
        segment(vertices, triangles, frames=mixed)
