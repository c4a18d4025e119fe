"""What images show of objects: boxes, crops, the frames that show most, poses, patches."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import Camera, rotation_from_quaternion
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_learn.scenegraphloc.views import (
    Views,
    crops,
    object_views,
    quarter_turns,
    seen_objects,
    shown,
)

CAMERA = Camera(80, 60, 40.0, 40.0, 40.0, 30.0)
LOOKING_EAST = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])


class Middle:
    """Features that are the mean colour of what they are given: easily known."""

    key, dimension = "mean", 3

    def grid(self, image):
        return image.astype(np.float32).mean(axis=(0, 1))[None, None]

    def crop(self, image):
        return np.float32([*image.shape[:2], image[..., 0].mean()])


def _wall(x, low, high):
    """Corners and triangles of a wall at x, from y z `low` to `high`."""
    corners = [[x, y, z] for y in (low[0], high[0]) for z in (low[1], high[1])]
    return np.array(corners), np.array([[0, 1, 2], [1, 3, 2]])


@pytest.fixture(scope="module")
def scene():
    """A large wall to the east, a small board before it, and something behind the camera."""
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


def _board(objects):
    rows, columns = np.nonzero(objects == 1)
    return columns.min(), rows.min(), columns.max() + 1, rows.max() + 1


def test_rays_see_what_the_camera_would(scene):
    objects = seen_objects(scene, _frame())
    assert set(np.unique(objects)) == {0, 1}
    # 1 m wide and 0.5 m high at 2 m, from the optical axis to the left and up
    assert _board(objects) == (20, 20, 40, 30)
    assert (objects[20:30, 20:40] == 1).all()
    small = seen_objects(scene, _frame(), longest=40)
    assert small.shape == (30, 40)
    assert _board(small) == (10, 10, 20, 15)


def test_an_object_has_its_views_and_what_was_never_seen_a_blank_one(scene):
    capture = Capture.from_frames([_frame(), _frame(value=200, stamp=1.0)])
    views = object_views(scene, [capture], Middle(), rotate=False)
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
    assert (np.take_along_axis(poses, np.abs(poses[:, :4]).argmax(axis=1)[:, None], 1) > 0).all()


def test_ten_views_with_the_most_pixels_are_kept(scene):
    def nearer(metres):
        pose = LOOKING_EAST.copy()
        pose[0, 3] = metres
        return pose

    steps = np.linspace(0.0, 0.7, 14)[np.random.default_rng(2).permutation(14)]
    frames = [_frame(nearer(x), stamp=float(i)) for i, x in enumerate(steps)]
    pixels = np.array([(seen_objects(scene, frame) == 1).sum() for frame in frames])
    assert len(np.unique(pixels)) < 14  # some show as much as others
    views = object_views(scene, [Capture.from_frames(frames)], Middle(), rotate=False)
    own = views.owner == 1
    assert own.sum() == 10
    kept = views.map_from_camera[own, 0, 3]
    assert np.array_equal(kept, steps[np.argsort(-pixels, kind="stable")[:10]])


def test_turned_images_turn_boxes_too(scene):
    camera = Camera(60, 80, 40.0, 40.0, 30.0, 40.0)
    image = np.random.default_rng(1).integers(0, 256, (80, 60, 3), np.uint8)
    upright = Frame.from_arrays(image, camera, odometry=LOOKING_EAST)
    # the same view by a camera that lies on its side: turned clockwise its image stands upright
    upright_from_lying = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    lying = Frame.from_arrays(np.rot90(image), CAMERA, odometry=LOOKING_EAST @ upright_from_lying)
    assert quarter_turns(upright, None) == 0
    assert quarter_turns(lying, None) == 1
    straight = object_views(scene, [Capture.from_frames([upright])], Middle())
    for rotate in (None, True):
        turned = object_views(scene, [Capture.from_frames([lying])], Middle(), rotate=rotate)
        assert np.allclose(straight.features, turned.features)
    wrong = object_views(scene, [Capture.from_frames([lying])], Middle(), rotate=False)
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
    assert shown(objects, (1, 2)).tolist() == [[3, 7]]
    objects[30:, 60:] = -1
    assert shown(objects, (1, 2)).tolist() == [[3, -1]]
    # six things in equal parts: none covers more than a fifth
    mixed = np.repeat(np.arange(6, dtype=np.int32), 10)[None].repeat(60, axis=0)
    assert shown(mixed, (1, 1)).tolist() == [[-1]]


def test_views_of_some_objects_are_renumbered():
    views = Views(np.array([0, 1, 1, 2]), np.eye(4, 3, dtype=np.float32), np.stack([np.eye(4)] * 4))
    some = views.of(np.array([2, 1]))
    assert some.owner.tolist() == [0, 1, 1]
    assert np.array_equal(some.features, views.features[[3, 1, 2]])


def test_rays_see_the_things_that_a_rendered_walk_shows(room, survey):
    same = []
    for frame in survey:
        rows = seen_objects(room, frame, longest=frame.label_camera.width)
        ids = np.array([*room.graph.ids, "-1"])[rows]
        same.append((ids == frame.labels().astype(str)).mean())
    assert min(same) > 0.95
