"""Building scene maps: from files, from models, and from what is not sound."""

import io
import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from tests.indoor.conftest import damage

import placegraph as pg
from placegraph.errors import InputError, OptionError, PlacegraphError
from placegraph.indoor.build import build_scene, scene_of_model
from placegraph.indoor.map.textures import Detail
from placegraph.indoor.mapping.from_capture import FromCapture
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.tum import read_tum
from placegraph.io.mesh.model import Z_UP, Texture

ROOM = {"floor": ((0, 0, -0.1), (5, 4, 0)), "table": ((1, 1, 0), (2, 2, 0.7))}

PLY = """ply
format ascii 1.0
element vertex 7
property float x
property float y
property float z
property int objectId
element face 3
property list uchar int vertex_indices
end_header
0 0 1 1
4 0 1 1
4 4 1 1
0 4 1 1
1 1 2 2
2 1 2 2
2 2 2 5
4 0 1 2 3
3 4 5 6
3 4 6 5
"""


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "room.ply"
    path.write_text(PLY)
    return path


def test_a_ply_becomes_a_map(ply, tmp_path):
    table = tmp_path / "labels.json"
    table.write_text(
        json.dumps([{"id": 1, "label": "floor"}, {"id": 2, "label": "table", "name": "T"}])
    )
    out = tmp_path / "room.scene"
    scene = pg.build_scene(ply, out, labels=table)
    assert scene.graph.ids == ("1", "2")
    assert scene.graph.labels == ("floor", "table")
    assert scene.graph.names == ("", "T")
    assert scene.floors.tolist() == [1.0]
    assert (scene.source, scene.scenes) == ("room.ply", ("room",))
    opened = pg.open_map(out)
    assert opened.graph == scene.graph
    np.testing.assert_array_equal(opened.mesh.vertices, scene.mesh.vertices)
    # What is written is what is built without a file.
    unwritten = build_scene(ply, None, labels={"1": "floor", "2": "table"})
    np.testing.assert_array_equal(unwritten.mesh.triangles, scene.mesh.triangles)


def test_labels_may_name_some(ply, tmp_path):
    scene = build_scene(ply, None, labels={2: "table"})
    assert scene.graph.ids == ("unknown", "2")
    assert scene.graph.labels == ("unknown", "table")
    with pytest.raises(InputError, match=r"no\.json does not exist"):
        build_scene(ply, None, labels=tmp_path / "no.json")


def test_options(ply):
    assert build_scene(ply, None, floor=0.25).floors.tolist() == [0.25]
    assert build_scene(ply, None, floor=-3).floors.tolist() == [-3.0]
    small = build_scene(ply, None, scale=0.5)
    np.testing.assert_allclose(small.bounds, [[0, 0, 0.5], [2, 2, 1]])
    turned = build_scene(ply, None, up="y", floor=0.0)
    np.testing.assert_allclose(turned.bounds, [[0, -2, 0], [4, -1, 4]])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"up": "x"}, "up is 'x'"), ({"scale": 0}, "scale is 0"), ({"scale": np.nan}, "scale is nan"),
        ({"detail": "huge"}, "detail is 'huge'.*full, fine, default"),
        ({"floor": np.inf}, "floor is inf"),
    ],
)  # fmt: skip
def test_bad_options(options, says, ply, tmp_path):
    with pytest.raises(OptionError, match=says):
        build_scene(ply, tmp_path / "a.scene", **options)
    assert not (tmp_path / "a.scene").exists()


def test_no_triangle(boxes, ply):
    with pytest.raises(InputError, match="is empty; a scene map needs a mesh"):
        scene_of_model(boxes({}))
    ply.write_text(PLY.replace("element face 3", "element face 0").split("4 0 1 2 3")[0])
    with pytest.raises(InputError, match="contains points, but no triangles"):
        build_scene(ply, None)


def test_texture_coordinates_that_are_no_numbers(boxes):
    model = boxes(ROOM, uv=np.full((16, 2), np.nan))
    with pytest.raises(InputError, match="texture coordinates are not finite"):
        scene_of_model(model)


def test_vertices_that_nothing_uses_do_no_harm(boxes):
    model = boxes(ROOM)
    points = np.concatenate([model.vertices, [[np.nan] * 3, [1e30] * 3]])
    scene = scene_of_model(
        replace(model, vertices=points, uv=np.zeros((18, 2)), colours=np.zeros((18, 3), np.uint8))
    )
    assert len(scene.mesh.vertices) == 16


def test_no_floor_needs_a_height(boxes):
    walls = {"wall": ((0, 0, 0), (0.1, 4, 2.7)), "wall ": ((0, 3.9, 0), (5, 4, 2.7))}
    with pytest.raises(InputError, match=r"drawn.glb: no floor was found.*floor=0.0, or --floor 0"):
        scene_of_model(boxes(walls))
    assert scene_of_model(boxes(walls), floor=0.0).floors.tolist() == [0.0]


@pytest.mark.parametrize("turned", [True, False])
def test_a_floor_that_stands_is_laid_down(boxes, turned):
    model = boxes(ROOM)
    lying = replace(model, vertices=model.vertices @ (Z_UP if turned else Z_UP.T))
    notes = []
    scene = scene_of_model(lying, up="auto", notes=notes)
    np.testing.assert_allclose(scene.bounds, scene_of_model(model).bounds, atol=2e-3)
    assert "y point up" in notes[0]
    one_s_way = scene_of_model(lying, up="z", floor=0.0)
    assert np.ptp(one_s_way.bounds[:, 2]) > 3.0
    standing = boxes({"floor": ((0, 0, 0), (4, 0.01, 3))})
    with pytest.raises(InputError, match=r"labelled floor is not level.*--up"):
        scene_of_model(standing, up="z")


def test_one_giant_object_is_told(boxes):
    notes = []
    assert len(scene_of_model(_hills(boxes), notes=notes, detail="full")) == 1
    assert "100 % of the surface" in notes[0]
    assert "--segment" in notes[0]


@pytest.mark.parametrize("empty", ["triangle", "object"])
def test_what_has_no_surface_is_left_out(boxes, empty):
    model, left_out = boxes(ROOM), Counter()
    if empty == "triangle":
        triangles = np.concatenate([model.triangles, [[0, 0, 1], [0, 1, 1]]])
        objects = np.append(model.object_of, [1, 1])
    else:
        triangles, objects = model.triangles[:12], model.object_of[:12]
    pictures = np.zeros(len(triangles), int)
    model = replace(model, triangles=triangles, object_of=objects, picture_of=pictures)
    scene = scene_of_model(model, left_out=left_out)
    if empty == "triangle":
        assert (len(scene.mesh), left_out) == (24, {"triangles without area": 2})
    else:
        assert (scene.graph.labels, left_out) == (("floor",), {"objects without a triangle": 1})


def test_objects_in_any_order_and_sharing_vertices(boxes, rng):
    model = boxes(ROOM)
    order = rng.permutation(24)
    mixed = replace(model, triangles=model.triangles[order], object_of=model.object_of[order])
    scene = scene_of_model(mixed)
    assert scene.mesh.object_of.tolist() == [0] * 12 + [1] * 12
    assert scene.graph == scene_of_model(model).graph


def _hills(boxes, n=60):
    x, y = np.meshgrid(np.arange(n) * 0.02, np.arange(n) * 0.02, indexing="ij")
    points = np.stack([x, y, np.sin(x) * np.cos(y) * 0.02], axis=2).reshape(-1, 3)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    triangles = corner[:, None] + [[0, n, 1, n, n + 1, 1]]
    count = 2 * len(corner)
    return replace(
        boxes({"floor": ((0, 0, 0), (1, 1, 1))}), vertices=points, triangles=triangles.reshape(-1, 3),
        object_of=np.zeros(count, int), picture_of=np.zeros(count, int),
        colours=np.full((len(points), 3), 200, np.uint8), uv=np.zeros((len(points), 2)),
    )  # fmt: skip


@pytest.mark.parametrize("side", [120, pytest.param(708, marks=pytest.mark.all)])
def test_a_million_small_triangles(boxes, side):
    model = _hills(boxes, side)
    scene = scene_of_model(model, detail="full")
    assert len(scene.mesh) == len(model.triangles) == 2 * (side - 1) ** 2
    assert scene.floors[0] == pytest.approx(0.0, abs=0.02)
    fewer = scene_of_model(model)
    assert 10 < len(fewer.mesh) < 1000
    np.testing.assert_allclose(fewer.bounds, scene.bounds, atol=0.01)


def encoded(array, form="PNG", **options):
    file = io.BytesIO()
    Image.fromarray(np.asarray(array, np.uint8)).save(file, form, **options)
    return file.getvalue()


def look(boxes, picture, **options):
    scene = scene_of_model(boxes(ROOM, pictures=(picture,)), **options)
    return scene.mesh.textures[0], scene.encoded[0]


def test_a_flat_colour_is_one_texel(boxes):
    texture, _ = look(boxes, Texture(None, (0.2140411, 1.0, 0.0)))
    np.testing.assert_allclose(texture, [[[127.5, 255, 0]]], atol=0.5)


def test_a_jpeg_of_the_right_size_is_cached_in_full_detail(boxes, rng):
    data = encoded(rng.integers(0, 256, (64, 64, 3)), "JPEG")
    texture, blob = look(boxes, Texture(data), detail="full")
    assert blob == data
    assert texture.shape == (64, 64, 3)
    _, small = look(boxes, Texture(data))
    assert len(small) < len(data)


def test_large_textures_become_small(boxes):
    gradient = np.repeat(np.linspace(0, 255, 600)[:, None, None], 300, 1).repeat(3, 2)
    for form in ("PNG", "JPEG"):
        texture, _ = look(boxes, Texture(encoded(gradient, form)), detail=Detail(max_texture=100))
        assert texture.shape == (100, 50, 3)
        np.testing.assert_allclose(texture[:, 25, 0], np.linspace(1, 254, 100), atol=4)


def test_the_base_colour_is_folded_in_as_light(boxes):
    gray = np.full((4, 4, 3), 188)  # half of the light
    texture, _ = look(boxes, Texture(encoded(gray), (0.5, 1.0, 0.0)))
    np.testing.assert_allclose(texture, np.broadcast_to([137, 188, 0], (4, 4, 3)), atol=1)


def test_mirrored_textures_are_laid_out_to_be_repeated(boxes):
    picture = encoded([[[255, 0, 0], [0, 0, 255]]])
    texture, _ = look(boxes, Texture(picture, mirrored=(True, False)))
    assert texture[0, :, 0].tolist() == [255, 0, 0, 255]
    assert look(boxes, Texture(picture, mirrored=(True, True)))[0].shape == (2, 4, 3)


@pytest.mark.parametrize("mode", ["L", "P", "RGBA", "LA", "1", "CMYK", "I;16"])
def test_pictures_of_any_mode(mode, boxes):
    deep = Image.fromarray(np.full((3, 3), 60_000, np.uint16))
    image = deep if mode == "I;16" else Image.new(mode, (3, 3))
    file = io.BytesIO()
    image.save(file, "TIFF" if mode == "CMYK" else "PNG")
    assert look(boxes, Texture(file.getvalue()))[0].shape == (3, 3, 3)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=40)
@given(data=st.data())
def test_broken_pictures_give_one_kind_of_error(data, boxes):
    form = data.draw(st.sampled_from(["PNG", "JPEG", "WEBP"]))
    damaged = damage(data, encoded(np.arange(192).reshape(8, 8, 3), form))
    try:
        look(boxes, Texture(damaged, name="house.glb: images[3]"))
    except PlacegraphError as error:
        assert isinstance(error, InputError)  # noqa: PT017  # either is right
        assert "house.glb: images[3]" in str(error)  # noqa: PT017


def test_the_shared_house(house):
    scene, path, source = house.scene, house.path, house.source
    listed = json.loads(source.with_name("objects.json").read_text())
    for column, key in (("ids", "id"), ("names", "name"), ("labels", "label")):
        assert getattr(scene.graph, column) == tuple(str(o[key]) for o in listed)
    low = scene.graph.positions - scene.graph.extents / 2
    np.testing.assert_allclose(low, [o["bbox_min"] for o in listed], atol=6e-3)
    assert scene.floors.tolist() == [0.0]
    assert path.stat().st_size < source.stat().st_size
    assert len(scene.mesh.textures) == 66
    rows = {r: set() for r in scene.graph.relations}
    edges = (scene.graph.sources, scene.graph.relations, scene.graph.targets)
    for s, r, t in zip(*edges, strict=True):
        rows[r].add((scene.graph.names[s], scene.graph.names[t]))
    assert ("DeskPortraitC_01", "NightStand_01_001") in rows["standing on"]
    assert ("TV_01_001", "HouseWallB_01_001") in rows["attached to"]
    assert ("Handle_01_001", "Door_01_001") in rows["attached to"]


def test_the_house_looks_as_in_its_pictures(house, shared):
    scene, folder = house.scene, shared / "data" / "house" / "seq00"
    frame = open_capture(folder)[0]
    map_from_camera = read_tum(folder / "trajectory.tum").poses[0]
    pixels = np.stack(np.mgrid[2:320:5, 2:180:5], axis=-1).reshape(-1, 2)
    rays = frame.label_camera.directions(pixels + 0.5) @ map_from_camera[:3, :3].T
    hits = scene.caster.cast(np.broadcast_to(map_from_camera[:3, 3], rays.shape), rays)
    assert (hits.triangle >= 0).all()
    seen = scene.mesh.object_of[hits.triangle]
    assert (seen == frame.labels()[pixels[:, 1], pixels[:, 0]]).mean() > 0.98
    depth = frame.depth()[pixels[:, 1], pixels[:, 0]]
    assert np.nanmedian(np.abs(hits.distance - depth)) < 0.03
    mine = scene.mesh.colour_at(hits.triangle, hits.u, hits.v).astype(float)
    theirs = frame.rgb()[pixels[:, 1] * 2, pixels[:, 0] * 2].astype(float)
    for one, other in ((0, 1), (2, 1)):  # red and blue against green: lighting changes little of it
        a, b = (np.log((c[:, one] + 8) / (c[:, other] + 8)) for c in (mine, theirs))
        assert np.corrcoef(a, b)[0, 1] > 0.6


def test_what_is_cut_anew_has_no_relations_of_what_it_was(boxes, tmp_path):
    whole = scene_of_model(boxes({**ROOM, "cup": ((1.4, 1.4, 0.7), (1.5, 1.5, 0.8))}))
    whole.export(tmp_path / "room.glb")
    counts = Counter()
    scene = build_scene(tmp_path / "room.glb", None, segment=True, left_out=counts)
    assert (
        counts["relations of objects that were segmented again"] == len(whole.graph.relations) > 0
    )
    edges = zip(scene.graph.sources, scene.graph.targets, strict=True)
    half = scene.graph.extents / 2
    for a, b in edges:
        gap = np.abs(scene.graph.positions[a] - scene.graph.positions[b]) - half[a] - half[b]
        assert gap.max() < 2.0, "what is related is near"
    unasked = build_scene(tmp_path / "room.glb", None)
    assert unasked.graph.labels == whole.graph.labels


@pytest.mark.parametrize("how", [{"capture": FromCapture()}, {"reader": {"groups": "o"}}])
def test_options_of_other_sources_are_refused(how, ply):
    with pytest.raises(
        OptionError, match=r"room\.ply is not a capture|groups: not an option of \.ply"
    ):
        build_scene(ply, None, **how)
