import numpy as np
import pytest

from placegraph.indoor.build import build_scene
from placegraph.io.mesh.gltf import read_glb
from placegraph.maps import open_map
from placegraph_lab.worlds.flat.flat import Flat


@pytest.fixture(scope="module")
def flat():
    return Flat.load("altbau")


@pytest.fixture(scope="module")
def interior(flat):
    return flat.furnish(np.random.default_rng(1))


@pytest.fixture(scope="module")
def path(interior, tmp_path_factory):
    return interior.write_glb(tmp_path_factory.mktemp("glb") / "flat.glb")


def test_read_back_it_is_the_same_flat(path, interior):
    model = read_glb(path)
    assert not model.left_out
    assert [(t.id, t.label, t.name) for t in model.objects] == [
        (str(t.id), t.label, t.name) for t in interior.objects
    ]
    for row, thing in enumerate(interior.objects):
        points = model.vertices[model.triangles[model.object_of == row]].reshape(-1, 3)
        assert np.stack([points.min(0), points.max(0)]) == pytest.approx(thing.bounds, abs=1e-5)


def test_as_a_scene_map(path, flat, interior, tmp_path):
    built = build_scene(path, tmp_path / "flat.scene", detail="full")
    opened = open_map(tmp_path / "flat.scene")
    for scene in (built, opened):
        assert len(scene.graph) == len(interior.objects)
        assert scene.floors == pytest.approx([0.0], abs=1e-3)
        assert scene.bounds[1, 2] == pytest.approx(flat.height, abs=1e-3)
        assert scene.attributes[interior.find_object("stove").id]["room"] == "kitchen"
        assert len(scene.mesh) == len(interior.mesh())
    lamp = built.graph.positions[interior.find_object("floor lamp").id]
    assert lamp[:2] == pytest.approx(flat.position("L"), abs=0.02)
