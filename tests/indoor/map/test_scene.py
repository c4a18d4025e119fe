from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.mapfile import pack_strings, write_map
from placegraph.errors import MapError, OptionError
from placegraph.indoor.map.scene import DESCRIPTOR_SIZE, LANDMARK_GRAIN, Landmarks
from placegraph.indoor.map.scene_file import measure_parts, open_scene, pack_scene, save_scene
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.scene_map import SceneMap


@pytest.fixture
def some(rng):
    vectors = rng.normal(size=(50, DESCRIPTOR_SIZE))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    points = rng.uniform(-3, 3, (50, 3))
    return points, vectors, Landmarks.of(points, vectors)


def test_they_keep_their_points_and_looks(some):
    points, vectors, landmarks = some
    apart = np.linalg.norm(landmarks.points[:, None] - points, axis=2)
    row = apart.argmin(axis=1)
    assert sorted(row) == list(range(50))
    assert apart.min(axis=1).max() < LANDMARK_GRAIN
    assert np.einsum("ld,ld->l", landmarks.unit_vectors, vectors[row]).min() > 0.999


def test_a_file_holds_them_and_one_without_opens(room, some, tmp_path):
    landmarks = some[2]
    save_scene(replace(room, landmarks=landmarks), tmp_path / "a.scene")
    again = open_scene(tmp_path / "a.scene", SceneMap).landmarks
    assert np.array_equal(again.points, landmarks.points)
    assert np.array_equal(again.vectors, landmarks.vectors)
    assert measure_parts(tmp_path / "a.scene")["landmarks"] > 0
    merged = merge_scenes({"a": replace(room, landmarks=landmarks), "b": room})
    shift = np.linalg.inv(merged.scene_from_map[0])[:3, 3]
    assert np.allclose(merged.landmarks.points, landmarks.points + shift, atol=1e-5)
    assert merge_scenes({"a": room, "b": room}).landmarks is None
    save_scene(room, tmp_path / "b.scene")
    assert open_scene(tmp_path / "b.scene", SceneMap).landmarks is None


def test_damaged_columns_are_refused(room, some, tmp_path):
    meta, arrays = pack_scene(replace(room, landmarks=some[2]))
    arrays["landmark_vectors"] = arrays["landmark_vectors"][:-1]
    write_map(tmp_path / "a.scene", "scene", 2, meta, arrays)
    with pytest.raises(MapError, match="landmarks"):
        open_scene(tmp_path / "a.scene", SceneMap)
    with pytest.raises(OptionError, match="landmarks"):
        Landmarks(np.full((1, 3), np.nan, np.float32), np.zeros((1, DESCRIPTOR_SIZE), np.int8))


def test_an_attribute_that_holds_several_is_refused(room, tmp_path):
    meta, arrays = pack_scene(room)
    texts = ['{"floor": "1"}, {}', *[""] * (len(room.graph.labels) - 1)]
    write_map(tmp_path / "a.scene", "scene", 2, meta, arrays | {"attributes": pack_strings(texts)})
    with pytest.raises(MapError, match="attributes"):
        open_scene(tmp_path / "a.scene", SceneMap)
