import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from tests.indoor.mapping.parts import cuboid

from placegraph.core.geometry import Camera, rotation_from_quaternion
from placegraph.errors import InputError, OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_learn.scenegraphloc.features import (
    RELATIONS,
    read_attributes,
    relation_row,
)
from placegraph_learn.scenegraphloc.inputs import (
    Views,
    barycentre,
    batch_rooms,
    complete_edges,
    crops,
    object_views,
    quarter_turns,
    rooms_of,
    sample_farthest,
    seen_objects,
    vote_patches,
)
from placegraph_learn.scenegraphloc.train import distort


def _unseen(count, width=4):
    blank = np.zeros((count, width), np.float32)
    return Views(np.arange(count), blank, np.tile(np.eye(4), (count, 1, 1)))


def _boxes(*boxes, **more):
    points, faces = zip(*(cuboid(*box) for box in boxes), strict=True)
    faces = [f + 8 * k for k, f in enumerate(faces)]
    owner = np.repeat(np.arange(len(boxes)), 12)
    mesh = Mesh.plain(np.concatenate(points), np.concatenate(faces), owner)
    names = [chr(ord("a") + k) for k in range(len(boxes))]
    return SceneMap.create(mesh, names, more.pop("labels", names), floor=0.0, **more)


THREE = (((0, 0, 0), (1, 1, 1)), ((2, 0, 0), (3, 2, 4)), ((0, 5, 0), (4, 5.5, 2)))


@pytest.fixture
def scene():
    relations = [(1, "standing on", 0), (2, "next to", 0), (1, "above", 2), (0, "same room", 1)]
    said = [{"color": "red, White", "state": "open"}, {}, {"shape": "red"}]
    return _boxes(*THREE, relations=relations, attributes=said)


def _room(scene, **more):
    (rows, room), = rooms_of(
        scene, _unseen(len(scene)), rng=np.random.default_rng(1), **more
    )  # fmt: skip
    assert rows.tolist() == list(range(len(scene)))
    return room


def test_points_lie_on_the_surface_less_the_rooms_mean(scene, monkeypatch):
    room = _room(scene)
    assert room.points.shape == (3, 512, 3)
    # every point lies on a face of its box, whose size is known
    shifted = room.points - room.points.min(axis=1, keepdims=True)
    sides = np.array([np.subtract(high, low) for low, high in THREE])[:, None]
    near = np.minimum(np.abs(shifted), np.abs(shifted - sides)).min(axis=2)
    assert near.max() < 0.02
    areas = np.array([6.0, 2 * (2 + 4 + 8), 2 * (2 + 8 + 1)])
    middles = room.points.mean(axis=1)
    assert np.abs(np.average(middles, axis=0, weights=areas)).max() < 0.05
    # vertices are taken as they are where asked
    points = _room(scene, source="vertices").points[1] + scene.mesh.vertices.mean(axis=0)
    corners = {tuple(p) for p in np.round(points, 3).tolist()}
    assert corners == {(x, y, z) for x in (2, 3) for y in (0, 2) for z in (0, 4)}
    with pytest.raises(OptionError, match="'surface' or 'vertices'"):
        _room(scene, source="edges")
    monkeypatch.setattr("placegraph_learn.scenegraphloc.inputs._MOST", 2)
    with pytest.raises(OptionError, match="a room has 3 objects"):
        _room(scene)


def test_relations_are_counted_by_3dssgs_words(scene):
    room = _room(scene)
    word = {name: k for k, name in enumerate(RELATIONS)}
    assert room.edges[:3].tolist() == [[1, 0], [2, 0], [1, 2]]
    assert {tuple(e) for e in room.edges.tolist()} == {
        (a, b) for a in range(3) for b in range(3) if a != b
    }
    assert room.relations.shape == (3, 41)
    assert room.relations.sum(axis=1).tolist() == [2, 2, 2]
    assert room.relations[1, [word["standing on"], word["higher than"]]].tolist() == [1, 1]
    assert room.relations[2, [word["close by"], word["none"]]].tolist() == [1, 1]
    assert room.relations[0, word["none"]] == 2
    middles = np.array([np.add(low, high) / 2 for low, high in THREE])
    # next to, above, standing on: each object is in two pairs, the first wins
    assert np.allclose(room.offsets, middles[0] - middles, atol=1e-3)
    # where a pair has two relations, the k-th edge has the word of the k-th triple, as published
    edges, words = complete_edges(3, [(0, 5, 1), (0, 6, 1), (2, 7, 1)])
    assert edges[:2].tolist() == [[0, 1], [2, 1]]
    assert words.tolist() == [5, 6, 7, 0, 0, 0]
    assert len(edges) == 6
    bare, alone = _room(_boxes(*THREE)), _room(_boxes(THREE[0]))
    assert bare.relations[:, 0].tolist() == [2, 2, 2]
    assert not bare.offsets[0].any()
    assert alone.edges.shape == (0, 2)
    assert not alone.relations.any()
    objects = batch_rooms([room, room])
    assert objects.sizes == (3, 3)
    assert objects.owner.tolist() == [0, 1, 2, 3, 4, 5]
    assert objects.poses[4].tolist() == [0, 0, 0, 1, 0, 0, 0]
    assert objects.points.dtype == torch.float32


def test_attributes_are_counted_by_the_words_given(scene):
    assert not _room(scene, count=164).attributes.any()
    assert _room(scene, count=164).attributes.shape == (3, 164)
    room = _room(scene, attributes=("white", "red", "open", "closed"))
    assert room.attributes.tolist() == [[1, 1, 1, 0], [0, 0, 0, 0], [0, 1, 0, 0]]


def test_merged_scenes_are_rooms_of_their_own(scene):
    other = _boxes(*THREE[:2], scene="other", source="other")
    merged = merge_scenes({"first": scene, "second": other})
    views = _unseen(len(merged))
    found = rooms_of(merged, views, rng=np.random.default_rng(1))
    assert [len(room) for _, room in found] == [3, 2]
    alone = _room(scene)
    merged_room = found[0][1]
    assert np.allclose(merged_room.points, alone.points, atol=2e-3)
    assert np.allclose(merged_room.offsets, alone.offsets, atol=2e-3)
    assert np.array_equal(merged_room.relations, alone.relations)


@settings(max_examples=15)
@given(arrays(np.int64, (9, 3), elements=st.integers(-5, 5)))
def test_a_barycentre_is_that_of_the_hulls_corners(points):
    found = barycentre(points)
    assert (found >= points.min(axis=0) - 1e-9).all()
    assert (found <= points.max(axis=0) + 1e-9).all()
    assert np.allclose(found, barycentre(np.concatenate([points[::-1], points])))
    box = np.array([[x, y, z] for x in (0, 2) for y in (0, 3) for z in (0, 1)], float)
    inside = (1, 1.5, 0.5) + points * (0.19, 0.29, 0.09)
    assert np.allclose(barycentre(np.concatenate([box, box[:2], inside])), (1, 1.5, 0.5))
    assert np.allclose(barycentre(box[:4]), box[:4].mean(axis=0))  # a plane
    assert np.allclose(barycentre(box[:1]), box[0])


def test_the_farthest_points_cover_a_line(rng):
    line = np.zeros((2000, 3), np.float32)
    line[:, 0] = np.linspace(0, 1, 2000)
    chosen = np.sort(sample_farthest(line, 17, rng)[:, 0])
    assert np.diff(chosen).min() > 0.02
    few = sample_farthest(line[:3], 8, rng)
    assert set(few[:, 0].tolist()) <= set(line[:3, 0].astype(float).tolist())


def test_distortion_is_smooth_and_of_its_size(rng):
    points = rng.uniform(0, (4, 3, 2.5), (3000, 3)).astype(np.float32)
    near = points + np.float32(0.004)
    both = np.concatenate([points, near])
    moved = [distort(both, np.random.default_rng(k)) - both for k in range(5)]
    sizes = [float(np.abs(m).mean()) for m in moved]
    assert 0.02 < np.median(sizes) < 0.5
    pulls = np.array(moved)
    apart = np.abs(pulls[:, :3000] - pulls[:, 3000:]).mean()
    assert apart < 0.1 * np.abs(pulls).mean()
    cloud = points[:7]  # some clouds are left as they are, and any shape is taken
    same = [np.array_equal(distort(cloud, np.random.default_rng(k)), cloud) for k in range(24)]
    assert 0 < sum(same) < 8
    for odd in (np.zeros((5, 3), np.float32), np.float32([[0, 0, 0], [900, 900, 900]])):
        assert np.isfinite(distort(odd, np.random.default_rng(0))).all()


def test_relations_have_their_rows():
    assert len(RELATIONS) == len(set(RELATIONS)) == 41
    assert relation_row("Standing On ") == 15
    assert relation_row("next to") == RELATIONS.index("close by")
    assert relation_row("same room") is None
    assert RELATIONS[26] == "hanging in"
    assert RELATIONS[40] == "more comfortable than"


@pytest.mark.parametrize("content", [b"", b"red\nred\n", b'["red", 3]', b'["red"', b"\xff\xfe\x00"])
def test_wrong_lists_of_attributes_are_refused(tmp_path, content):
    (tmp_path / "a.txt").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.txt"):
        read_attributes(tmp_path / "a.txt")
    with pytest.raises(InputError):
        read_attributes(tmp_path / "none.txt")
    (tmp_path / "b.txt").write_text("Red\n\nwhite \nopen\n", encoding="utf-8")
    (tmp_path / "b.json").write_text(json.dumps(["red", "white", "open"]), encoding="utf-8")
    for name in ("b.txt", "b.json"):
        assert read_attributes(tmp_path / name) == ("red", "white", "open")


CAMERA = Camera(80, 60, 40.0, 40.0, 40.0, 30.0)
LOOKING_EAST = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


class Middle:
    key, dimension = "mean", 3

    def grid(self, image):
        return image.astype(np.float32).mean(axis=(0, 1))[None, None]

    def crop(self, image):
        return np.float32([*image.shape[:2], image[..., 0].mean()])


def _wall(x, low, high):
    corners = [[x, y, z] for y in (low[0], high[0]) for z in (low[1], high[1])]
    return np.array(corners), np.array([[0, 1, 2], [1, 3, 2]])


@pytest.fixture(scope="module")
def scene_views():
    parts = [
        _wall(4, (-9, -9), (9, 9)),
        _wall(2, (0.0, 1.5), (1.0, 2.0)),
        _wall(-3, (0, 0), (1, 1)),
    ]
    mesh = Mesh.plain(
        np.concatenate([v for v, _ in parts]),
        np.concatenate([t + 4 * i for i, (_, t) in enumerate(parts)]),
        np.repeat(np.arange(3), 2),
    )
    return SceneMap.create(mesh, ["w", "b", "p"], ["wall", "board", "picture"], floor=0.0)


def _frame(pose=LOOKING_EAST, value=100, camera=CAMERA, stamp=0.0):
    image = np.full((camera.height, camera.width, 3), value, np.uint8)
    return Frame.from_arrays(image, camera, odometry=pose, stamp=stamp)


def test_an_object_has_its_views_and_what_was_never_seen_a_blank_one(scene_views):
    capture = Capture.from_frames([_frame(), _frame(value=200, stamp=1.0)])
    views = object_views(scene_views, [capture], Middle(), rotate=False)
    assert views.owner.tolist() == [0, 0, 1, 1, 2]
    assert not views.features[4].any()
    board = views.features[2]
    # three crops: 10 x 20, 14 x 28 and 18 x 36 px; of equal frames the first comes first
    assert board.tolist() == [14.0, 28.0, 100.0]
    assert views.features[3][2] == 200.0
    poses = views.poses(np.eye(4))
    assert poses[4].tolist() == [0, 0, 0, 1, 0, 0, 0]
    assert np.allclose(rotation_from_quaternion(poses[0, :4]), LOOKING_EAST[:3, :3], atol=1e-6)
    assert np.allclose(poses[0, 4:], [0, 0, 1.5])
    some = views.of(np.array([2, 1]))  # views of some objects are renumbered
    assert some.owner.tolist() == [0, 1, 1]
    assert np.array_equal(some.features, views.features[[4, 2, 3]])
    assert (np.take_along_axis(poses, np.abs(poses[:, :4]).argmax(axis=1)[:, None], 1) > 0).all()


def test_ten_views_with_the_most_pixels_are_kept(scene_views):
    def nearer(metres):
        pose = LOOKING_EAST.copy()
        pose[0, 3] = metres
        return pose

    steps = np.linspace(0.0, 0.7, 14)[np.random.default_rng(2).permutation(14)]
    frames = [_frame(nearer(x), stamp=float(i)) for i, x in enumerate(steps)]
    pixels = np.array([(seen_objects(scene_views, frame) == 1).sum() for frame in frames])
    assert len(np.unique(pixels)) < 14  # some show as much as others
    views = object_views(scene_views, [Capture.from_frames(frames)], Middle(), rotate=False)
    own = views.owner == 1
    assert own.sum() == 10
    kept = views.map_from_camera[own, 0, 3]
    assert np.array_equal(kept, steps[np.argsort(-pixels, kind="stable")[:10]])


def test_turned_images_turn_boxes_too(scene_views):
    camera = Camera(60, 80, 40.0, 40.0, 30.0, 40.0)
    image = np.random.default_rng(1).integers(0, 256, (80, 60, 3), np.uint8)
    upright = Frame.from_arrays(image, camera, odometry=LOOKING_EAST)
    # the same view by a camera that lies on its side: turned clockwise its image stands upright
    upright_from_lying = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    lying = Frame.from_arrays(np.rot90(image), CAMERA, odometry=LOOKING_EAST @ upright_from_lying)
    assert quarter_turns(upright, None) == 0
    assert quarter_turns(lying, None) == 1
    straight = object_views(scene_views, [Capture.from_frames([upright])], Middle())
    for rotate in (None, True):
        turned = object_views(scene_views, [Capture.from_frames([lying])], Middle(), rotate=rotate)
        assert np.allclose(straight.features, turned.features)
    wrong = object_views(scene_views, [Capture.from_frames([lying])], Middle(), rotate=False)
    assert not np.allclose(straight.features, wrong.features)


@pytest.mark.parametrize(
    ("gravity", "turns"), [((0, 1, 0), 0), ((1, 0, 0), 1), ((0, -1, 0.2), 2), ((-1, 0.3, 0), 3)]
)
def test_an_image_stands_upright_after_its_turns(gravity, turns):
    frame = replace(_frame(), gravity=np.array(gravity, float))
    assert quarter_turns(frame, None) == turns
    assert quarter_turns(frame, True) == 1
    assert quarter_turns(frame, False) == 0
    # the half of the image that lies down the gravity comes to lie below
    image = np.zeros((6, 8))
    x, y = np.sign(np.round(gravity[:2])).astype(int)
    image[{0: slice(None), 1: slice(3, 6), -1: slice(0, 3)}[y],
          {0: slice(None), 1: slice(4, 8), -1: slice(0, 4)}[x]] = 1  # fmt: skip
    upright = np.rot90(image, -turns)
    half = upright.shape[0] // 2
    assert upright[half:].all()
    assert not upright[:half].any()


@given(st.integers(1, 60), st.integers(1, 60), st.data())
def test_crops_hold_the_box_and_grow_within_the_image(width, height, data):
    left = data.draw(st.integers(0, width - 1))
    right = data.draw(st.integers(left + 1, width))
    top = data.draw(st.integers(0, height - 1))
    bottom = data.draw(st.integers(top + 1, height))
    image = np.arange(width * height).reshape(height, width, 1)
    parts = crops(image, (left, top, right, bottom))
    assert np.array_equal(parts[0], image[top:bottom, left:right])
    for before, after in pairwise(parts):
        assert np.isin(before, after).all()
    assert parts[2].shape[1] == min(width, right + 2 * int(0.2 * (right - left))) - max(
        0, left - 2 * int(0.2 * (right - left))
    )


def test_a_patch_shows_what_most_of_its_pixels_do():
    objects = np.full((60, 120), -1, np.int32)
    objects[:, :60] = 3
    objects[:20, 60:] = 5  # a third of its patch: none is more frequent
    objects[30:, 60:] = 7
    assert vote_patches(objects, (1, 2)).tolist() == [[3, 7]]
    objects[30:, 60:] = -1
    assert vote_patches(objects, (1, 2)).tolist() == [[3, -1]]
    # six things in equal parts: none covers more than a fifth
    mixed = np.repeat(np.arange(6, dtype=np.int32), 10)[None].repeat(60, axis=0)
    assert vote_patches(mixed, (1, 1)).tolist() == [[-1]]


def test_rays_see_the_things_that_a_rendered_walk_shows(room, survey):
    same = []
    for frame in survey:
        rows = seen_objects(room, frame, longest=frame.label_camera.width)
        ids = np.array([*room.graph.ids, "-1"])[rows]
        same.append((ids == frame.labels().astype(str)).mean())
    assert min(same) > 0.95
