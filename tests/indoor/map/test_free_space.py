import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.estimate import PoseEstimate, PoseMode, Status
from placegraph.core.geo import Anchor
from placegraph.core.geometry import split_pose
from placegraph.core.mapfile import write_map
from placegraph.errors import MapError
from placegraph.indoor.build import scene_of_model
from placegraph.indoor.likelihood.visibility import build_table
from placegraph.indoor.map import free_space as free
from placegraph.indoor.map.floor import find_storeys
from placegraph.indoor.map.free_space import SEARCH_MARGIN, find_nearest_scene
from placegraph.indoor.map.scene import DESCRIPTOR_SIZE, MAX_LANDMARKS
from placegraph.indoor.map.scene_file import MAX_VIEWPOINTS, is_near_box, pack_scene, save_scene
from placegraph.indoor.mapping.from_capture import thin_points
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.options import FilterOptions
from placegraph.indoor.pose.estimate import add_earth_poses
from placegraph.indoor.scene_map import SceneMap

pytestmark = pytest.mark.usefixtures("one_thread")
STAGE = {
    "floor": ((0, 0, -0.1), (5, 4, 0)), "ceiling": ((0, 0, 2.6), (5, 4, 2.7)),
    "wall west": ((-0.2, 0, 0), (0, 4, 2.6)), "wall south": ((0, -0.2, 0), (5, 0, 2.6)),
    "wall north": ((0, 4, 0), (5, 4.2, 2.6)), "table": ((1, 1, 0.7), (3, 3, 0.75)),
}  # fmt: skip
CLOSED = {"wall east": ((5, 0, 0), (5.2, 4, 2.6))}
SHIFT = np.array([0.4, -0.3, 3.0])
TOO_MANY = {
    "landmark_points": np.zeros((MAX_LANDMARKS + 1, 3), np.int32),
    "landmark_vectors": np.zeros((MAX_LANDMARKS + 1, DESCRIPTOR_SIZE), np.int8),
}


@pytest.fixture(scope="module")
def stacked(room, flat):
    both = merge_scenes({"down": room, "up": flat})
    shifts = np.stack([np.zeros(3), SHIFT]) + both.scene_from_map[:, :3, 3]
    part = np.zeros(len(both.mesh.vertices), np.int64)
    part[both.mesh.triangles] = both.scene_of[both.mesh.object_of][:, None]
    return replace(
        room,
        graph=replace(both.graph, positions=both.graph.positions + shifts[both.scene_of]),
        mesh=replace(both.mesh, vertices=both.mesh.vertices + shifts[part]),
        attributes=both.attributes,
        scene_of=np.zeros(len(both), np.int32),
        encoded=both.encoded,
    )


def test_storeys_are_floors_with_rooms_above(room, flat, stacked, boxes):
    below, above = find_storeys(stacked, 0)
    assert below == room.floors[0]
    assert above == pytest.approx(flat.floors[0] + SHIFT[2], abs=0.02)
    assert len(find_storeys(room, 0)) == 1, "a roof is no storey"
    vertices = stacked.mesh.vertices.copy()
    vertices[-200:, 2] += 1e9  # heights that are none take no memory by them
    tracemalloc.start()
    find_storeys(replace(stacked, mesh=replace(stacked.mesh, vertices=vertices)), 0)
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
    shelves = {f"shelf {i}": ((0, i, 2.2), (5, i + 0.3, 2.25)) for i in range(3)}
    assert len(find_storeys(scene_of_model(boxes(STAGE | shelves)), 0)) == 1


def test_a_camera_upstairs_is_a_level_up_and_in_a_room_there(stacked, flat):
    sofa = flat.graph.positions[flat.graph.labels.index("sofa")]
    for up, at, level, room in (
        (0, (1.0, 1.0, 1.6), "2", "study"),
        (1, sofa + SHIFT, "3", flat.attributes[flat.graph.labels.index("sofa")]["room"]),
    ):
        pose = np.eye(4)
        pose[:3, 3] = at
        mode = PoseMode(pose, np.zeros(4), np.eye(6), 1.0, stacked.scenes[0], pose)
        for said, told in (("2", level), ("mezzanine", "mezzanine")):
            anchored = stacked.anchored(Anchor(7.4, 43.7, 50.0, 0.3, level=said))
            (earth,) = add_earth_poses(anchored, PoseEstimate(Status.OK, (mode,), "")).best.earth
            assert (earth.level, earth.room) == (told, room), up


@pytest.mark.all
def test_either_storey_is_found(stacked, walk, flat_walk, truth):
    for capture, shift in ((walk, np.zeros(3)), (flat_walk, SHIFT)):
        found = stacked.localize(capture, options=FilterOptions().only(depth=True, colour=True))
        true = split_pose(truth(capture)[-1])[0]
        assert found.best.pose[:3] == pytest.approx(true[:3] + shift, abs=0.1)


@pytest.mark.parametrize("closed", [False, True])
def test_places_beside_an_open_side_look_in(closed, boxes, monkeypatch):
    scene = scene_of_model(boxes(STAGE | (CLOSED if closed else {})))
    at = scene.visibility(FilterOptions()).positions
    beside = at[at[:, 0] > 5.3]
    assert bool(len(beside)) is not closed
    assert (at[:, 0] < 5.2 + SEARCH_MARGIN).all()
    assert not ((np.abs(at[:, 1] - 2.0) > 2.2) & (at[:, 0] < 4.0)).any()
    assert at[:, 0].min() > 0
    low = at[at[:, 2] < 0.5]
    under = (low[:, :2] > [1, 1]) & (low[:, :2] < [3, 3])
    assert under.all(axis=1).any(), "under the table"
    monkeypatch.setattr(free, "_PAIRS", 1000)  # they are found in blocks
    np.testing.assert_array_equal(build_table(scene, FilterOptions()).positions, at)


def test_cameras_are_looked_for_where_the_maps_own_were(room, tmp_path):
    seen = np.array([[3.0, 3.0, 0.61], [3.5, 3.0, 0.63]]) + np.array([0, 0, room.floors[0]])
    scene = replace(room, viewpoints=seen)
    table = scene.visibility(FilterOptions())
    own = table.positions[table.is_common]
    assert 0 < len(own) < 40
    assert (np.abs(own[:, :2] - seen[0, :2]).max(axis=1) < 1.5).all()
    np.testing.assert_allclose(own[:, 2] - room.floors[0], 0.62, atol=0.011)
    assert (table.layer[table.is_common] == 0).all()
    save_scene(scene, tmp_path / "it.scene")
    np.testing.assert_allclose(SceneMap.open(tmp_path / "it.scene").viewpoints, seen, atol=0.0051)
    assert "viewpoints" not in pack_scene(room)[1], "a mesh has none; nor have older files"
    moved = merge_scenes({"a": room, "b": scene})
    shift = np.linalg.inv(moved.scene_from_map[1])[:3, 3]
    np.testing.assert_allclose(moved.viewpoints, seen + shift)


def test_beside_a_walked_scene_cameras_are_held_as_usual(room):
    seen = np.array([[3.0, 3.0, 0.61 + room.floors[0]]])
    both = merge_scenes({"mesh": room, "walked": replace(room, viewpoints=seen)})
    table = both.visibility(FilterOptions())
    within = find_nearest_scene(both, table.positions[:, :2])[0]
    above = table.positions[:, 2] - table.ground
    assert (table.layer[table.is_common & (within == 1)] == 0).all()
    mesh = within == 0
    assert (table.is_common & mesh).any()
    assert (table.is_common[mesh] == ((above > 1.05) & (above < 1.85))[mesh]).all()


def test_a_place_where_a_camera_stood_is_kept(boxes):
    seen = np.array([[0.4, -2.6, 1.2], [1.1, -2.4, 1.2], [2.0, 0.6, 0.5]])
    board = {"board": ((0, 0, 0.6), (1.5, 0.1, 1.8)), "floor": ((0, -0.6, -0.1), (1.5, 0, 0))}
    shut = {"crate": ((1.8, 0.4, 0.3), (2.2, 0.8, 0.7))}  # around the third
    bare = scene_of_model(boxes(board | shut))
    scene = replace(bare, viewpoints=seen)
    table = scene.visibility(FilterOptions())
    shares = (table.panoramas.ranges != 255).mean(axis=(1, 2))
    away = np.linalg.norm(table.positions[:, None] - seen, axis=2)
    for camera in range(3):
        assert away[:, camera].min() < table.spacing, camera
        assert table.is_common[away[:, camera].argmin()]
    assert shares[away[:, :2].min(axis=1) < 0.5].min() < 0.1, "a narrow sweep"
    assert shares.min() < 0.5 * shares[away[:, 0].argmin()] + 0.01, "elsewhere half of it will do"
    assert len(bare.visibility(FilterOptions())) < len(table)


def test_cameras_of_two_storeys_have_their_layers(stacked, room):
    seen = np.array([[3.0, 3.0, 0.9], [3.0, 3.0, 0.8 + SHIFT[2]]])
    seen[:, 2] += room.floors[0]
    table = replace(stacked, viewpoints=seen).visibility(FilterOptions())
    own = table.positions[table.is_common]
    assert {round(z, 2) for z in own[:, 2] - room.floors[0]} == {0.9, round(0.8 + SHIFT[2], 2)}


@pytest.mark.parametrize(
    ("forged", "says"),
    [
        ({"viewpoints": np.full((1, 3), np.iinfo(np.int32).max, np.int32)}, "outside the mesh"),
        ({"viewpoints": np.full((MAX_VIEWPOINTS + 1, 3), 100, np.int32)}, "at most 300"),
        ({"landmark_points": np.zeros((1, 3), np.int32)}, "landmark_vectors"),
        ({"landmark_vectors": np.zeros((1, DESCRIPTOR_SIZE), np.int8)}, "landmark_points"),
        (TOO_MANY, "at most 20,000"),
    ],
)
def test_absurd_viewpoints_and_landmarks_are_refused(forged, says, room, tmp_path):
    meta, arrays = pack_scene(room)
    write_map(tmp_path / "it.scene", "scene", 2, meta, arrays | forged)
    with pytest.raises(MapError, match=says):
        SceneMap.open(tmp_path / "it.scene")


def test_viewpoints_are_few_and_everywhere(rng):
    points = rng.uniform(0, 10, (5000, 3))
    got = thin_points(points)
    assert MAX_VIEWPOINTS / 3 < len(got) <= MAX_VIEWPOINTS
    nearest = np.linalg.norm(points[:, None] - got[None], axis=2).min(axis=1)
    assert nearest.max() < 4.0
    points_near = np.array([[0.5, 0.5, 0.5], [10.9, 0, 0], [11.1, 0, 0], [0, 0, -10.1]])
    box = np.array([[0.0] * 3, [1.0] * 3])
    assert is_near_box(points_near, box).tolist() == [True, True, False, False]
    np.testing.assert_allclose(thin_points(points[:1].repeat(9, axis=0)), points[:1], atol=0.005)
