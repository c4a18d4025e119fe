"""Scene maps: what is built is what is opened; damaged and forged files are refused."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

import placegraph as pg
from placegraph.core.geo import Anchor
from placegraph.core.mapfile import pack_strings, read_header, write_map
from placegraph.errors import MapError, OptionError, PlacegraphError
from placegraph.indoor.build import scene_of_model
from placegraph.indoor.map import textures
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.scene_file import pack_scene
from placegraph.indoor.scene_map import SceneMap

ROOM = {
    "floor": ((0, 0, -0.1), (5, 4, 0)),
    "table": ((1, 1, 0), (2, 2, 0.7)),
    "cup": ((1.2, 1.2, 0.7), (1.3, 1.3, 0.8)),
}
MESH = ("vertices", "triangles", "object_of", "colours", "uv", "texture_of")


@pytest.fixture(scope="module")
def scene(boxes):
    model = boxes(ROOM)
    things = tuple(replace(t, attributes={"material": "wood"}) for t in model.objects)
    return scene_of_model(replace(model, objects=things))


@pytest.fixture
def file(scene, tmp_path):
    scene.save(tmp_path / "a.scene")
    return tmp_path / "a.scene"


def same(a, b):
    assert a.graph == b.graph
    for name in MESH:
        np.testing.assert_array_equal(getattr(a.mesh, name), getattr(b.mesh, name))
    assert len(a.mesh.textures) == len(b.mesh.textures)
    for one, other in zip(a.mesh.textures, b.mesh.textures, strict=True):
        np.testing.assert_array_equal(one, other)
    for name in ("attributes", "scenes", "source", "encoded"):
        assert getattr(a, name) == getattr(b, name)
    for name in ("floors", "scene_of", "scene_from_map", "bounds"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_what_is_saved_is_opened_and_saved_again(scene, file, tmp_path):
    opened = pg.open_map(file)
    same(scene, opened)
    assert opened.graph.labels == ("floor", "table", "cup")
    assert opened.attributes[1] == {"material": "wood", "room": "1"}
    opened.save(tmp_path / "b.scene")
    assert (tmp_path / "b.scene").read_bytes() == file.read_bytes()
    header = read_header(file)
    assert (header.kind, header.version, header.meta["floors"]) == ("scene", 2, [0.0])


def test_what_a_map_knows(scene):
    np.testing.assert_allclose(scene.bounds, [[0, 0, -0.1], [5, 4, 0.8]], atol=5e-4)
    np.testing.assert_array_equal(scene.scene_bounds, scene.bounds[None])
    np.testing.assert_allclose(scene.graph.positions[1], [1.5, 1.5, 0.35], atol=1e-3)
    np.testing.assert_allclose(scene.graph.extents[1], [1, 1, 0.7], atol=1e-3)
    assert ("table", "standing on", "floor") in scene.graph.triples()
    assert scene.floors.tolist() == [0.0]
    assert scene.scenes == ("drawn",)
    assert scene.row_of("2") == 2
    with pytest.raises(OptionError, match=r"'7' is not an object of drawn.glb"):
        scene.row_of("7")
    np.testing.assert_allclose(scene.mesh.textures[0], [[[127.5, 255, 0]]], atol=0.5)


def test_columns_of_an_open_map_cannot_be_written(file):
    opened = pg.open_map(file)
    for array in (opened.floors, opened.scene_of, opened.bounds, opened.scene_bounds,
                  opened.mesh.vertices, opened.mesh.textures[0], opened.graph.positions):  # fmt: skip
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


def test_embeddings_survive(scene, tmp_path, rng):
    vectors = rng.normal(size=(3, 8)).astype(np.float32)
    embedded = scene.with_embeddings(vectors)
    embedded.save(tmp_path / "e.scene")
    opened = pg.open_map(tmp_path / "e.scene")
    np.testing.assert_array_equal(opened.graph.embeddings, embedded.graph.embeddings)
    again = opened.with_embeddings(opened.graph.embeddings)
    np.testing.assert_array_equal(again.graph.embeddings, opened.graph.embeddings)
    step = np.abs(vectors).max(axis=1, keepdims=True) / 127
    assert (np.abs(opened.graph.embeddings - vectors) <= 0.51 * step).all(), "8 bits"
    with pytest.raises(OptionError, match="embeddings"):
        scene.with_embeddings(vectors[:2])


def test_textures_survive(tmp_path, rng):
    noise = rng.integers(0, 256, (40, 30, 1)).astype(np.uint8).repeat(3, 2)
    smooth = np.repeat(np.arange(0, 200, 5, np.uint8)[:, None, None], 30, 1).repeat(3, 2)
    mesh = Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]] * 2)
    mesh = replace(mesh, texture_of=np.array([0, 1], np.int32), textures=(noise, smooth))
    scene = SceneMap.create(mesh, ["a"], ["floor"], floor=0.0)
    scene.save(tmp_path / "t.scene")
    same(scene, pg.open_map(tmp_path / "t.scene"))
    assert np.abs(scene.mesh.textures[1].astype(int) - smooth).max() <= 4
    assert np.abs(scene.mesh.textures[0].astype(int) - noise).mean() < 8


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"floor": np.nan}, "floor is nan"),
        ({"ids": [], "labels": []}, "ids: there is no object; give at least one"),
        ({"ids": ["a", "b"], "labels": ["x", "y"]}, "'b' has no triangle"),
        ({"ids": ["a"], "labels": ["x", "y"]}, "labels"),
        ({"attributes": [{}, {}]}, "attributes"),
        ({"relations": [(0, "next to", 5)]}, "targets"),
        ({"encoded": ()}, "textures"),
    ],
)
def test_what_does_not_fit_is_refused(change, says):
    mesh = Mesh.plain([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    options = {"ids": ["a"], "labels": ["x"], "floor": 0.0} | change
    with pytest.raises(OptionError, match=says):
        SceneMap.create(mesh, options.pop("ids"), options.pop("labels"), **options)


@pytest.fixture
def forge(scene, tmp_path):
    """Write the map's own columns, some of them replaced, with good checksums."""

    def forged(meta=(), **arrays):
        own_meta, own = pack_scene(scene)
        merged = {k: v for k, v in (own | arrays).items() if v is not None}
        write_map(tmp_path / "f.scene", "scene", 1, own_meta | dict(meta), merged)
        return tmp_path / "f.scene"

    return forged


@pytest.mark.parametrize("name", [
    "ids", "labels", "names", "attributes", "scene_of", "positions", "extents", "sources", "targets",
    "relation_of", "relations", "vertices", "triangles", "object_of", "texture_of", "uv", "colours",
    "textures", "texture_bytes",
])  # fmt: skip
def test_missing_and_strange_columns(name, forge):
    with pytest.raises(MapError, match=rf"column '{name}' is missing"):
        pg.open_map(forge(**{name: None}))
    with pytest.raises(MapError, match=r"f\.scene"):
        pg.open_map(forge(**{name: np.zeros((2, 2, 2), np.int8)}))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("triangles", 24), ("triangles", -1), ("object_of", 3), ("object_of", -1),
        ("texture_of", 1), ("texture_of", -1), ("scene_of", 1), ("scene_of", -1), ("sources", 3),
        ("targets", -1), ("relation_of", 9), ("relation_of", -1), ("positions", np.nan),
        ("extents", -1.0), ("texture_bytes", 5), ("texture_bytes", -1),
    ],
)  # fmt: skip
def test_rows_that_point_nowhere(name, value, forge, scene):
    column = pack_scene(scene)[1][name].copy()
    column.flat[0] = value
    with pytest.raises(MapError, match=r"f\.scene.*Build"):
        pg.open_map(forge(**{name: column}))


@pytest.mark.parametrize(
    "meta",
    [
        {"floors": []}, {"floors": [None]}, {"floors": ["low"]}, {"floors": [0.0, 0.0]}, {"scenes": []},
        {"scenes": ["a", "b"]}, {"scene_from_map": []}, {"scene_from_map": [[1.0]]}, {"grain": 0},
        {"grain": "fine"}, {"grain": 1e9}, {"uv_grain": -1}, {"source": None, "scenes": None},
    ],
)  # fmt: skip
def test_metadata_that_makes_no_sense(meta, forge):
    with pytest.raises(MapError, match=r"f\.scene"):
        pg.open_map(forge(meta))


def test_where_it_stands_is_saved_and_old_files_stand_nowhere(scene, file, tmp_path):
    assert pg.open_map(file).anchors == ()
    assert "anchors" not in read_header(file).meta
    likely = Anchor(7.42, 43.73, 50, 1.5, np.diag([1, 2, 3, 0.01]), "Library", "way/7", "1", 0.75)
    other = replace(likely, heading=1.5 + np.pi, probability=0.25, residuals=(0.1, 0.3))
    scene.anchored(other, likely).save(tmp_path / "b.scene")
    found = pg.open_map(tmp_path / "b.scene").anchors
    assert [a.to_dict() for a in found] == [likely.to_dict(), other.to_dict()]
    with pytest.raises(OptionError, match=r"'drawn'.* add up to 1\.50"):
        scene.anchored(likely, likely)


PLACE = {"longitude": 7.42, "latitude": 43.73, "height": 50, "heading": 1.5}


@pytest.mark.parametrize(
    "anchors",
    [
        3, "here", [3], ["here"], [{}], None, [PLACE | {"latitude": 91}], [PLACE | {"height": None}],
        [PLACE | {"covariance": [[1]]}], [PLACE | {"building": 7}], [PLACE, PLACE],
        [PLACE | {"scene": "attic"}], [PLACE | {"residuals": "many"}], [PLACE | {"heading": "north"}],
    ],
)  # fmt: skip
def test_anchors_that_make_no_sense(anchors, forge):
    with pytest.raises(MapError, match=r"f\.scene"):
        pg.open_map(forge({"anchors": anchors}))


def test_attributes_and_textures_that_make_no_sense(forge, tmp_path):
    for texts in (["[1]", "", ""], ["{", "", ""], ["5", "", ""], ["{}"]):
        with pytest.raises(MapError, match=r"f\.scene"):
            pg.open_map(forge(attributes=pack_strings(texts)))
    Image.new("RGB", (2, 2)).save(tmp_path / "a.gif")
    for data, says in (
        (b"not an image", r"texture 0.*Build the map again"),
        ((tmp_path / "a.gif").read_bytes(), "not a WebP, PNG or JPEG"),
    ):
        columns = {
            "textures": np.frombuffer(data, np.uint8),
            "texture_bytes": np.array([len(data)]),
        }
        opened = pg.open_map(forge(**columns))
        with pytest.raises(MapError, match=says):
            opened.mesh.textures[0]


def test_textures_that_would_fill_memory_are_not_decoded(file, monkeypatch):
    opened = pg.open_map(file)
    monkeypatch.setattr(textures, "FREE_PIXELS", 0)
    monkeypatch.setattr(textures, "PIXELS_A_BYTE", 0)
    with pytest.raises(MapError, match=r"more texels than .* can encode; .*Build the map again"):
        opened.mesh.textures[0]


def test_a_newer_version_and_another_kind(file, scene):
    write_map(file, "scene", 3, *pack_scene(scene))
    with pytest.raises(MapError, match=r"version 3.*reads up to 2"):
        pg.open_map(file)
    write_map(file, "city", 1, {}, {})
    with pytest.raises(MapError, match="is a city map, not a scene map"):
        SceneMap.open(file)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(data=st.data())
def test_damaged_files_are_refused(data, file):
    path, damaged = file.with_name("b.scene"), bytearray(file.read_bytes())
    length = data.draw(st.integers(0, len(damaged)))
    if length == len(damaged):
        damaged[data.draw(st.integers(0, length - 1))] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(bytes(damaged[:length]))
    with pytest.raises(PlacegraphError, match=r"b\.scene"):
        pg.open_map(path)


def test_opening_is_light(file):
    code = "import sys, placegraph; placegraph.open_map(sys.argv[1]); print(*sys.modules)"
    done = subprocess.run(  # noqa: S603  # our own interpreter and code
        [sys.executable, "-c", code, str(file)], capture_output=True, text=True, check=True
    )
    assert not {"numba", "osmium", "typer", "placegraph.outdoor"} & set(done.stdout.split())
