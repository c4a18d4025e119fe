import numpy as np
import pytest

import placegraph as pg
from placegraph.core.geo import Anchor
from placegraph.errors import OptionError
from placegraph.indoor.build import scene_of_model
from placegraph.indoor.mapping.merge import GAP, merge_scenes

FLAT = {"floor": ((2, 3, 0.9), (6, 6, 1.0)), "table": ((3, 4, 1.0), (4, 5, 1.7))}
SHED = {"floor": ((-1, -1, -0.1), (1, 1, 0)), "cup": ((0, 0, 0), (0.1, 0.1, 0.1))}


@pytest.fixture(scope="module")
def scenes(boxes):
    return {"flat": scene_of_model(boxes(FLAT)), "shed": scene_of_model(boxes(SHED))}


def test_scenes_stand_in_a_row_on_one_floor(scenes):
    merged = merge_scenes(scenes)
    assert merged.scenes == ("flat", "shed")
    assert merged.graph.ids == ("flat/0", "flat/1", "shed/0", "shed/1")
    assert merged.graph.labels == ("floor", "table", "floor", "cup")
    assert merged.scene_of.tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose(merged.floors, [0, 0], atol=1e-12)
    flat, shed = merged.scene_bounds
    assert shed[0, 0] - flat[1, 0] == pytest.approx(GAP, abs=0.1)
    np.testing.assert_allclose(
        np.diff(flat, axis=0), np.diff(scenes["flat"].bounds, axis=0), atol=1e-3
    )
    assert merged.graph.relations == ("standing on", "standing on")
    ends = merged.scene_of[merged.graph.sources], merged.scene_of[merged.graph.targets]
    np.testing.assert_array_equal(*ends)
    assert repr(merged) == "SceneMap('flat, shed', 4 objects, 48 triangles, 2 scenes)"


def test_the_way_back_into_each_scene(scenes):
    merged = merge_scenes(scenes)
    for row, scene in enumerate(scenes.values()):
        own = merged.scene_of == row
        points = np.concatenate([merged.graph.positions[own], np.ones((own.sum(), 1))], axis=1)
        back = points @ merged.scene_from_map[row].T
        np.testing.assert_allclose(back[:, :3], scene.graph.positions, atol=1e-9)
        rotation = merged.scene_from_map[row, :3, :3]
        np.testing.assert_array_equal(rotation, np.eye(3))


def test_meshes_keep_shape_objects_and_colours(scenes):
    merged = merge_scenes(scenes)
    mesh, shed = merged.mesh, scenes["shed"].mesh
    own = mesh.object_of >= 2
    corners = mesh.vertices[mesh.triangles[own]].astype(float)
    shift = -merged.scene_from_map[1, :3, 3]
    np.testing.assert_allclose(corners, shed.vertices[shed.triangles] + shift, atol=1e-4)
    assert (mesh.object_of[own] == shed.object_of + 2).all()
    assert len(mesh.textures) == 2
    assert set(mesh.texture_of[own].tolist()) == {1}


def test_scenes_stay_where_they_stand_on_earth(scenes):
    here = Anchor(7.42, 43.73, 50, 0.7, np.diag([0.01, 0.02, 0.03, 1e-4]))
    there = Anchor(-0.1, 51.5, 20, 2.0)
    anchored = {"flat": scenes["flat"].anchored(here), "shed": scenes["shed"].anchored(there)}
    merged = merge_scenes({"house": merge_scenes(anchored), "bare": scenes["shed"]})
    points = np.array([[2.5, 3.5, 1.2], [5.0, 4.0, 2.0]])
    for row, anchor in ((0, here), (1, there)):
        name = merged.scenes[row]
        (moved,) = merged.anchors_of(name)
        shifted = points - merged.scene_from_map[row, :3, 3]
        np.testing.assert_allclose(moved.to_earth(shifted), anchor.to_earth(points), atol=1e-4)
    pose = np.eye(4)
    pose[:3, 3] = points[0]
    before = here.pose(pose)
    pose[:3, 3] -= merged.scene_from_map[0, :3, 3]
    np.testing.assert_allclose(
        merged.anchors_of("house/flat")[0].pose(pose).covariance, before.covariance, atol=1e-7
    )
    assert merged.anchors_of("bare") == ()


def test_merged_maps_are_written_and_opened(scenes, tmp_path):
    merged = merge_scenes(scenes, tmp_path / "m.scene")
    opened = pg.open_map(tmp_path / "m.scene")
    assert opened.graph == merged.graph
    assert opened.scenes == merged.scenes
    np.testing.assert_array_equal(opened.mesh.vertices, merged.mesh.vertices)
    np.testing.assert_array_equal(opened.scene_from_map, merged.scene_from_map)
    np.testing.assert_array_equal(opened.floors, merged.floors)


def test_one_scene_twice_and_merged_again(scenes):
    twice = merge_scenes({"a": scenes["flat"], "b": scenes["flat"]})
    assert twice.graph.ids[:2] == ("a/0", "a/1")
    nested = merge_scenes({"street": twice, "shed": scenes["shed"]})
    assert nested.scenes == ("street/a", "street/b", "shed")
    assert nested.graph.ids[2] == "street/b/0"
    assert nested.scene_of.tolist() == [0, 0, 1, 1, 2, 2]
    np.testing.assert_allclose(nested.floors, [0, 0, 0], atol=1e-12)
    for row in (0, 1):
        point = np.append(nested.graph.positions[2 * row], 1.0)
        np.testing.assert_allclose(
            (nested.scene_from_map[row] @ point)[:3], scenes["flat"].graph.positions[0], atol=1e-9
        )


def test_embeddings_are_joined_or_refused(scenes, rng):
    vectors = {name: rng.normal(size=(2, 5)).astype(np.float32) for name in scenes}
    embedded = {name: m.with_embeddings(vectors[name]) for name, m in scenes.items()}
    merged = merge_scenes(embedded)
    np.testing.assert_allclose(
        merged.graph.embeddings, np.concatenate(list(vectors.values())), atol=0.02
    )
    with pytest.raises(OptionError, match="use the same encoder for all scenes"):
        merge_scenes({"a": embedded["flat"], "b": scenes["shed"]})
    with pytest.raises(OptionError, match="use the same encoder for all scenes"):
        merge_scenes({"a": embedded["flat"], "b": scenes["shed"].with_embeddings(np.ones((2, 3)))})


@pytest.mark.parametrize("names", [[], [""], ["a/b"]])
def test_what_cannot_be_merged(names, scenes):
    with pytest.raises(OptionError, match="scenes: "):
        merge_scenes(dict.fromkeys(names, scenes["flat"]))
