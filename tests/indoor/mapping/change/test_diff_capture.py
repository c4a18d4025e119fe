from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Camera, level_from_camera, pose_matrix, rotation_z
from placegraph.errors import InputError, OptionError
from placegraph.indoor.build import build_scene
from placegraph.indoor.mapping.change.align import transform_points
from placegraph.indoor.mapping.change.changes import DiffOptions
from placegraph.indoor.mapping.change.diff_capture import diff_capture
from placegraph.io.capture.capture import Capture, open_capture
from placegraph_lab.worlds.flat.walks import Walk, write_walk

CAMERA = Camera(256, 144, 150.0, 150.0, 128.0, 72.0)


def gaze(world, name, seed, interior=None, pitch=0.45):
    turn = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
    level = level_from_camera([0.0, np.cos(pitch), np.sin(pitch)])
    x, y = 3.2 + 0.25 * np.cos(turn), 2.0 + 0.25 * np.sin(turn)
    poses = pose_matrix(np.stack([x, y, np.full(16, 1.6), turn], axis=1), level)
    folder = world.folder / name
    rng = np.random.default_rng(seed)
    walk = Walk(0.2 * np.arange(16), poses)
    write_walk(interior or world.interior, walk, folder, rng, camera=CAMERA)
    return SimpleNamespace(walk=open_capture(folder), poses=poses)


@pytest.fixture(scope="module")
def before(room_world):
    return gaze(room_world, "diff-before", 5)


@pytest.fixture(scope="module")
def after(room_world):
    changed = room_world.interior.move_object("side table", (0.1, -0.6)).without("lamp")
    return gaze(room_world, "diff-after", 6, changed)


def test_where_nothing_changed_nothing_is_found(room, before):
    found = diff_capture(room, before.walk, before.poses)
    assert len(found) == 0
    assert found.same
    frames = [replace(frame, images=frame.images, index=i) for i, frame in enumerate(before.walk)]
    again = diff_capture(room, Capture.from_frames(frames), before.poses)
    assert again.to_dict() == found.to_dict()
    off = np.array(before.poses)
    off[:, :3, :3] = rotation_z(0.01) @ off[:, :3, :3]
    off[:, :3, 3] += 0.02
    assert len(diff_capture(room, before.walk, off)) == 0


def test_what_moved_and_vanished_is_found_from_the_poses_of_localizing(room, after):
    found = diff_capture(room, after.walk, room.localize(after.walk, seed=0))
    assert {(c.kind, c.name) for c in found} == {("moved", "side table"), ("vanished", "lamp")}
    (table,) = found.of("moved")
    at = transform_points(table.after_from_before, table.centre[None])[0]
    np.testing.assert_allclose(at - table.centre, (0.1, -0.6, 0.0), atol=0.06)
    assert all(0.5 < c.confidence < 1.0 for c in found)


def test_what_is_new_appears_with_a_surface(room_world, tmp_path_factory, before):
    folder = tmp_path_factory.mktemp("less")
    room_world.interior.without("side table").write_glb(folder / "less.glb")
    less = build_scene(folder / "less.glb", None)
    found = diff_capture(less, before.walk, before.poses)
    assert [c.kind for c in found] == ["appeared"]
    (table,) = found
    low, high = room_world.interior.find_object("side table").bounds
    assert np.all(table.box[0] > low - 0.1)
    assert np.all(table.box[1] < high + 0.1)
    assert np.ptp(table.box, axis=0)[:2].max() > 0.5 * (high - low)[:2].max()
    assert len(table.piece.triangles) >= 12


def test_what_no_frame_shows_is_unseen(room, after):
    back = after.walk[:1]
    found = diff_capture(room, back, after.poses[:1], options=DiffOptions(least_frames=1))
    assert found.unseen
    told = {c.id for c in found} | set(found.same)
    assert not told & set(found.unseen)
    assert told | set(found.unseen) >= set(room.graph.ids)


def test_depth_does_not_tell_a_picture_from_its_wall_colours_do(room_world, room):
    changed = room_world.interior.without("picture 2")
    later = gaze(room_world, "diff-picture", 7, changed)
    found = diff_capture(room, later.walk, later.poses, options=DiffOptions(depth=False))
    assert [(c.kind, c.name) for c in found] == [("vanished", "picture 2")]
    found = diff_capture(room, later.walk, later.poses)
    assert [(c.kind, c.name) for c in found] == [("vanished", "picture 2")]
    unseen = diff_capture(room, later.walk, later.poses, options=DiffOptions(colour=False))
    assert len(unseen) == 0
    assert room.graph.ids[room.graph.names.index("picture 2")] in unseen.unseen


def test_a_picture_that_hangs_elsewhere_is_found_by_its_colours(room_world, room):
    changed = room_world.interior.move_object("picture 2", (-0.5, 0.0))
    later = gaze(room_world, "diff-slid", 8, changed, pitch=0.1)
    (picture,) = diff_capture(room, later.walk, later.poses)
    assert (picture.kind, picture.name) == ("moved", "picture 2")
    np.testing.assert_allclose(picture.after_from_before[:3, 3], (-0.5, 0.0, 0.0), atol=0.05)


def test_poses_have_to_be_poses(room, before):
    with pytest.raises(OptionError, match=r"shape is \(3, 4, 4\), expected \(T, 4, 4\),"):
        diff_capture(room, before.walk, before.poses[:3])
    with pytest.raises(OptionError, match="rigid"):
        diff_capture(room, before.walk, 2.0 * before.poses)
    with pytest.raises(OptionError, match="poses"):
        diff_capture(room, [], np.zeros((0, 4, 4)))
    lost = PoseEstimate(Status.LOST, (), "Nothing fits.")
    with pytest.raises(
        InputError, match=r"Nothing fits\.\), so nothing can be compared\. Give its"
    ):
        diff_capture(room, before.walk, lost, name="walk")
    with pytest.raises(OptionError, match="leave one on"):
        DiffOptions(depth=False, colour=False)
    elsewhere = np.array(before.poses)
    elsewhere[:, :3, :3] = rotation_z(1.2) @ elsewhere[:, :3, :3]
    elsewhere[:, 0, 3] -= 1.3
    with pytest.raises(InputError, match=r"walk: only .* of its depth readings"):
        diff_capture(room, before.walk, elsewhere, name="walk")
