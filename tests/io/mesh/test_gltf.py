"""glTF binaries: nodes, labels, transforms, colours; and what cannot be read says why."""

import base64
import io
import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tests.io.damage import DAMAGE, any_json, damaged, refusing

from placegraph.errors import InputError
from placegraph.indoor.build import build_scene
from placegraph.io.mesh.gltf import read_glb
from placegraph.io.mesh.model import Texture

TRIANGLE = [[0, 0, 0], [1, 0, 0], [0, 2, 0]]
QUAD = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


def png(array=((1, 2, 3),), mode="RGB"):
    file = io.BytesIO()
    Image.fromarray(np.array([array], np.uint8), mode=None).convert(mode).save(file, "PNG")
    return file.getvalue()


def things(model):
    return [(t.id, t.label, t.name) for t in model.objects]


def test_a_node_is_an_object_turned_to_z_up(glb):
    glb.node(
        glb.primitive(TRIANGLE, [0, 1, 2]), name="Chair_1",
        extras={"label": "chair", "id": 7, "colour": "red", "weight": 2.5, "box": [1, 2]},
    )  # fmt: skip
    model = read_glb(glb.write())
    assert things(model) == [("7", "chair", "Chair_1")]
    assert model.objects[0].attributes == {"colour": "red", "weight": "2.5"}
    np.testing.assert_array_equal(model.vertices, [[0, 0, 0], [1, 0, 0], [0, 0, 2]])
    np.testing.assert_array_equal(model.triangles, [[0, 1, 2]])
    assert (model.colours == 255).all()
    assert model.pictures == (Texture(None),)
    upright = read_glb(glb.path, up="z")
    np.testing.assert_array_equal(upright.vertices, TRIANGLE)
    glb.node(glb.primitive([[0, 0, 5], [1, 0, 5], [0, 2, 5]]))
    np.testing.assert_array_equal(read_glb(glb.write()).vertices[3:, 1], [-5, -5, -5])


def test_ids_and_labels_without_extras(glb):
    for entry in (
        {"name": "sofa.001"}, {"name": "table", "extras": {"id": 0}}, {},
        {"name": "lamp", "extras": {"id": "b"}}, {"name": "rug", "extras": {"id": 3.0}},
    ):  # fmt: skip
        glb.node(glb.primitive(TRIANGLE), **entry)
    assert things(read_glb(glb.write())) == [
        ("1", "sofa", "sofa.001"), ("0", "table", "table"), ("2", "unknown", ""),
        ("b", "lamp", "lamp"), ("3", "rug", "rug"),
    ]  # fmt: skip


def test_parts_belong_to_the_labelled_node_above(glb):
    seat, leg = (glb.node(glb.primitive(TRIANGLE), name=n) for n in ("seat", "leg"))
    lamp = glb.node(glb.primitive(TRIANGLE), name="lamp", extras={"label": "lamp"})
    chair = glb.node(children=[seat, leg, lamp], name="c", extras={"label": "chair"})
    root = glb.node(children=[chair], name="room")
    glb.json["scenes"] = [{"nodes": [root]}]
    model = read_glb(glb.write())
    assert things(model) == [("0", "chair", "c"), ("1", "lamp", "lamp")]
    assert model.object_of.tolist() == [0, 0, 1]


def test_nodes_of_one_id_are_one_object(glb):
    for _ in range(2):
        glb.node(glb.primitive(TRIANGLE), name="n", extras={"id": 4, "label": "chair"})
    model = read_glb(glb.write())
    assert len(model.objects) == 1
    assert model.object_of.tolist() == [0, 0]
    glb.node(glb.primitive(TRIANGLE), name="m", extras={"id": 4, "label": "table"})
    with pytest.raises(InputError, match=r"'n' and 'm' share extras.id '4'"):
        read_glb(glb.write())


def test_only_the_scene_is_read(glb):
    for name in ("in", "out"):
        glb.node(glb.primitive(TRIANGLE), name=name)
    glb.json["scenes"] = [{"nodes": [1]}, {"nodes": [0]}]
    glb.json["scene"] = 1
    assert things(read_glb(glb.write())) == [("0", "in", "in")]


def test_transforms_are_multiplied_down_the_tree(glb):
    half = np.sqrt(0.5)
    child = glb.node(
        glb.primitive(TRIANGLE), translation=[1, 0, 0], rotation=[0, 0, half, half], scale=[2, 1, 1]
    )
    parent = glb.node(children=[child], matrix=np.array(
        [[1, 0, 0, 10], [0, 1, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]]).T.ravel().tolist())  # fmt: skip
    glb.json["scenes"] = [{"nodes": [parent]}]
    model = read_glb(glb.write(), up="z")
    # (1, 0, 0) is scaled to (2, 0, 0), turned about z to (0, 2, 0), then shifted.
    np.testing.assert_allclose(
        model.vertices, [[11, 20, 30], [11, 22, 30], [9, 20, 30]], atol=1e-12
    )
    np.testing.assert_array_equal(model.triangles, [[0, 1, 2]])


def test_mirrored_parts_keep_their_outside(glb):
    glb.node(glb.primitive(TRIANGLE), scale=[-1, 1, 1])
    model = read_glb(glb.write(), up="z")
    a, b, c = model.vertices[model.triangles[0]]
    assert np.cross(b - a, c - a)[2] > 0


@pytest.mark.parametrize(
    ("mode", "indices", "expected"),
    [
        (4, None, [[0, 1, 2]]), (4, [0, 1, 2, 2, 3, 0], [[0, 1, 2], [2, 3, 0]]),
        (5, [0, 1, 3, 2], [[0, 1, 3], [1, 2, 3]]), (5, None, [[0, 1, 2], [1, 3, 2]]),
        (6, [0, 1, 2, 3], [[0, 1, 2], [0, 2, 3]]), (5, [0, 1], []),
    ],
)  # fmt: skip
@pytest.mark.parametrize("dtype", ["<u1", "<u2", "<u4"])
def test_triangles_strips_and_fans(mode, indices, expected, dtype, glb):
    glb.node(glb.primitive(QUAD, indices, dtype, mode=mode))
    assert read_glb(glb.write()).triangles.tolist() == expected


def test_points_and_lines_are_left_out(glb):
    glb.node(glb.primitive(TRIANGLE, mode=1), glb.primitive(TRIANGLE))
    model = read_glb(glb.write())
    assert len(model.triangles) == 1
    assert model.left_out == {"primitives that are not triangles": 1}


def test_primitives_are_put_behind_each_other(glb):
    red, blue = (glb.material([*c, 1.0]) for c in ([1, 0, 0], [0, 0, 1]))
    glb.node(*(glb.primitive(TRIANGLE, [2, 1, 0], material=m) for m in (red, blue, red)))
    model = read_glb(glb.write())
    assert model.triangles.tolist() == [[2, 1, 0], [5, 4, 3], [8, 7, 6]]
    assert model.picture_of.tolist() == [0, 1, 0]
    assert [p.factor for p in model.pictures] == [(1, 0, 0), (0, 0, 1)]


def test_quantised_and_interleaved_attributes(glb):
    rows = np.zeros(3, [("p", "<i2", 3), ("_", "<i2"), ("t", "<u2", 2)])
    rows["p"] = TRIANGLE
    rows["t"] = [[0, 65535], [65535, 0], [32768, 0]]
    view = glb.view(rows.tobytes(), byteStride=12)
    entry = {"bufferView": view, "count": 3}
    attributes = {
        "POSITION": glb.add("accessors", {**entry, "componentType": 5122, "type": "VEC3"}),
        "TEXCOORD_0": glb.add("accessors", {
            **entry, "componentType": 5123, "type": "VEC2", "byteOffset": 8, "normalized": True}),
    }  # fmt: skip
    glb.node({"attributes": attributes})
    glb.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    model = read_glb(glb.write(), up="z")
    np.testing.assert_array_equal(model.vertices, TRIANGLE)
    np.testing.assert_allclose(model.uv, [[0, 1], [1, 0], [0.5, 0]], atol=1e-5)


@pytest.mark.parametrize(
    ("values", "dtype", "entry"),
    [
        ([[0.2140411, 0, 1]] * 3, "<f4", {}),
        ([[0.2140411, 0, 1, 0.5]] * 3, "<f4", {}),
        ([[55, 0, 255, 255]] * 3, "<u1", {"normalized": True}),
        ([[14027, 0, 65535, 0]] * 3, "<u2", {"normalized": True}),
        ([[55, 0, 255, 255]] * 3, "<u1", {}),
    ],
)
def test_vertex_colours_are_linear(values, dtype, entry, glb):
    primitive = glb.primitive(TRIANGLE)
    primitive["attributes"]["COLOR_0"] = glb.accessor(values, dtype, **entry)
    glb.node(primitive)
    np.testing.assert_allclose(read_glb(glb.write()).colours, [[128, 0, 255]] * 3, atol=1)
    if dtype == "<u1":  # some exporters write sRGB
        glb.json["asset"]["generator"] = "https://github.com/mikedh/trimesh"
        assert read_glb(glb.write()).colours[0].tolist() == [55, 0, 255]


def textured(glb, uv, sampler=None, factor=None, **info):
    material = glb.material(factor, glb.texture(png(), sampler), **info)
    primitive = glb.primitive(TRIANGLE, material=material)
    primitive["attributes"]["TEXCOORD_0"] = glb.accessor(uv)
    glb.node(primitive)
    return read_glb(glb.write())


def test_textures_keep_their_bytes_and_coordinates(glb):
    uv = [[0, 0], [2.5, -1], [0.25, 0.75]]
    model = textured(glb, uv, {"wrapS": 10497}, factor=[0.5, 1, 0.25, 1])
    assert model.pictures[0].data == png()
    assert model.pictures[0].factor == (0.5, 1.0, 0.25)
    np.testing.assert_array_equal(model.uv, uv)
    assert "a.glb: images[0]" in model.pictures[0].name


def test_clamped_and_mirrored_textures(glb, new_glb):
    uv = [[0, 0], [1, 1], [1.5, 0.5]]
    clamped = textured(glb, uv, {"wrapS": 33071, "wrapT": 33071})
    assert clamped.uv.min() > 0
    assert clamped.uv.max() < 1
    np.testing.assert_allclose(clamped.uv, [[0, 0], [1, 1], [1, 0.5]], atol=1e-3)
    mirrored = textured(new_glb(), uv, {"wrapS": 33648})
    np.testing.assert_allclose(mirrored.uv, [[0, 0], [0.5, 1], [0.75, 0.5]])
    assert mirrored.pictures[0].mirrored == (True, False)


def test_texture_transform(glb):
    moved = {"offset": [0.5, 0.0], "rotation": np.pi / 2, "scale": [2, 4]}
    uv = [[0, 0], [1, 0], [0, 1]]
    model = textured(glb, uv, extensions={"KHR_texture_transform": moved})
    # u to the right and v down: a quarter turn counter-clockwise leads from u to -v, and v to u.
    np.testing.assert_allclose(model.uv, [[0.5, 0], [0.5, -2], [4.5, 0]], atol=1e-12)


def test_second_coordinates_and_webp(glb):
    texture = glb.texture(png())
    image = io.BytesIO()
    Image.new("RGB", (2, 2)).save(image, "WEBP")
    source = glb.add("images", {"bufferView": glb.view(image.getvalue())})
    glb.json["textures"][texture]["extensions"] = {"EXT_texture_webp": {"source": source}}
    primitive = glb.primitive(TRIANGLE, material=glb.material(None, texture, texCoord=1))
    primitive["attributes"]["TEXCOORD_1"] = glb.accessor([[0.5, 0.5]] * 3)
    glb.node(primitive)
    model = read_glb(glb.write())
    assert model.pictures[0].data == image.getvalue()
    assert (model.uv == 0.5).all()


def test_images_as_data_uri(glb):
    material = glb.material(None, glb.texture(b""))
    glb.json["images"] = [{"uri": "data:image/png;base64," + base64.b64encode(png()).decode()}]
    glb.node(glb.primitive(TRIANGLE, material=material))
    assert read_glb(glb.write()).pictures[0].data == png()
    glb.json["images"] = [{"uri": "data:image/png;base64,%%%"}]
    with pytest.raises(InputError, match=r"images\[0\] is not base64"):
        read_glb(glb.write())


def test_older_materials(glb):
    older = {"diffuseFactor": [0.5, 0.25, 1, 1]}
    glb.add("materials", {"extensions": {"KHR_materials_pbrSpecularGlossiness": older}})
    glb.node(glb.primitive(TRIANGLE, material=0))
    assert read_glb(glb.write()).pictures[0].factor == (0.5, 0.25, 1.0)


def spoil(glb, change):
    glb.node(glb.primitive(TRIANGLE, [0, 1, 2], material=glb.material([1, 1, 1, 1])))
    change(glb.json)
    return glb.write()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda j: j.update(extensionsRequired=["KHR_draco_mesh_compression"]), "without Draco"),
        (lambda j: j["meshes"][0]["primitives"][0].update(
            extensions={"KHR_draco_mesh_compression": {}}), "without Draco"),
        (lambda j: j["bufferViews"][0].update(extensions={"EXT_meshopt_compression": {}}), "meshopt"),
        (lambda j: j.update(extensionsRequired=["KHR_texture_basisu"]), "JPEG or PNG"),
        (lambda j: j.update(extensionsRequired=["ACME_new"]), "'ACME_new', unknown"),
        (lambda j: j["accessors"][0].update(sparse={}), "sparse"),
        (lambda j: j["accessors"][0].pop("bufferView"), "sparse"),
        (lambda j: j["buffers"][0].update(uri="no.bin"), r"'no.bin', which is missing"),
        (lambda j: j["bufferViews"][0].update(buffer=1), "missing"),
        (lambda j: j["accessors"][0].update(count=4), "beyond its data"),
        (lambda j: j["accessors"][0].update(count=1e9), "beyond its data"),
        (lambda j: j["accessors"][0].update(count=-1), "count is '-1'"),
        (lambda j: j["accessors"][0].update(componentType=1), "unknown type"),
        (lambda j: j["accessors"][0].update(type="MAT4"), "unknown type"),
        (lambda j: j["accessors"][0].update(type="VEC2"), "three coordinates"),
        (lambda j: j["bufferViews"][0].update(byteLength=10**6), "beyond the file"),
        (lambda j: j["accessors"][1].update(count=0), None),
        (lambda j: j["nodes"][0].update(mesh=5), r"meshes\[5\]"),
        (lambda j: j["nodes"][0].update(mesh=-1), r"meshes\[-1\]"),
        (lambda j: j["nodes"][0].update(children=[0]), "parent"),
        (lambda j: j["nodes"][0].update(matrix=[1, 2]), "must be 16 numbers"),
        (lambda j: j["nodes"][0].update(translation=["a", 0, 0]), "must be 3 numbers"),
        (lambda j: j["nodes"][0].update(children=5), "not a list"),
        (lambda j: j["meshes"][0]["primitives"][0].update(material=9), r"materials\[9\]"),
        (lambda j: j["materials"][0].update(pbrMetallicRoughness=[]), "not an object"),
        (lambda j: j.update(scenes=[{"nodes": [3]}]), r"nodes\[3\]"),
        (lambda j: j.update(nodes={}), "not a list"),
        (lambda j: j.update(extensionsRequired=[[]]), "unknown here"),
        (lambda j: j["meshes"][0]["primitives"].append(3), "not valid glTF"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_says_why(change, says, glb):
    path = spoil(glb, change)
    if says is None:
        assert len(read_glb(path).triangles) == 0
        return
    if says == "parent":  # a node that is its own child: no root, or two parents
        glb.json["scenes"] = [{"nodes": [0]}]
        glb.write()
    with pytest.raises(InputError, match=says) as caught:
        read_glb(path)
    assert str(path) in str(caught.value)


def test_what_is_no_glb(glb, tmp_path):
    glb.node(glb.primitive(TRIANGLE))
    data = glb.write().read_bytes()
    for content, says in (
        (b"", "is empty"), (b'{"asset": {"version": "2.0"}}', "in JSON form; rename it to .gltf"),
        (b"solid stl of some kind", "not glTF 2.0 binary"), (data[:-8], "truncated"),
        (struct.pack("<4sII", b"glTF", 1, len(data)) + data[12:], "glTF 1"),
        (data[:12] + struct.pack("<I", 10**6) + data[16:], "ends within a chunk"),
        (data[:20] + b"x" + data[21:], "no JSON"),
        (struct.pack("<4sIIII", b"glTF", 2, 24, 4, 0x4E4F534A) + b"[]  ", "not an object"),
    ):  # fmt: skip
        path = tmp_path / "b.glb"
        path.write_bytes(content)
        with pytest.raises(InputError, match=says):
            read_glb(path)
    with pytest.raises(InputError, match="does not exist"):
        read_glb(tmp_path / "no.glb")
    with pytest.raises(InputError, match="cannot be read"):
        read_glb(tmp_path)
    glb.node(glb.primitive(TRIANGLE, [0, 1, 3]))
    with pytest.raises(InputError, match="an index is 3 of 3 vertices"):
        read_glb(glb.write())


@DAMAGE
@given(data=st.data())
def test_damaged_files_give_one_kind_of_error(data, new_glb):
    glb = new_glb()
    primitive = glb.primitive(QUAD, [0, 1, 2, 2, 3, 0], mode=4)
    primitive["attributes"]["TEXCOORD_0"] = glb.accessor([[0.5, 0.5]] * 4)
    primitive["attributes"]["COLOR_0"] = glb.accessor([[0.5, 0.5, 1]] * 4)
    primitive["material"] = glb.material([1, 0.5, 1, 1], glb.texture(png(), {"wrapS": 33648}))
    child = glb.node(
        primitive, name="seat", extras={"id": 3}, translation=[1, 2, 3], rotation=[0, 0, 0, 1]
    )
    glb.json["scenes"] = [{"nodes": [glb.node(children=[child])]}]
    path = as_text(glb) if data.draw(st.booleans()) else glb.write()
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    with refusing("" if path.suffix == ".gltf" else path):
        model = read_glb(path)
        assert model.triangles.max(initial=-1) < len(model.vertices)


@DAMAGE
@given(data=st.data())
def test_nonsense_in_the_json_gives_one_kind_of_error(data, new_glb):
    glb = new_glb()
    primitive = glb.primitive(QUAD, [0, 1, 2, 2, 3, 0], mode=4)
    primitive["attributes"]["COLOR_0"] = glb.accessor([[0.5, 0.5, 1]] * 4)
    texture = glb.texture(png(), {"wrapS": 33648})
    moved = {"KHR_texture_transform": {"offset": [0, 0], "rotation": 1.0}}
    primitive["material"] = glb.material([1, 0.5, 1, 1], texture, extensions=moved)
    glb.node(primitive, name="seat", extras={"id": 3, "label": "chair"}, scale=[1, 2, 3])
    glb.json["scenes"] = [{"nodes": [0]}]
    place = glb.json
    while True:  # walk down to a random place and put nonsense there
        key = data.draw(
            st.sampled_from(sorted(place) if isinstance(place, dict) else range(len(place)))
        )
        inner = place[key]
        if not isinstance(inner, dict | list) or not inner or data.draw(st.integers(0, 4)) == 0:
            break
        place = inner
    place[key] = data.draw(any_json())
    with refusing(glb.path):
        model = read_glb(glb.write())
        assert model.triangles.max(initial=-1) < len(model.vertices)


def test_the_shared_house(shared):
    model = read_glb(shared / "data" / "house" / "map" / "house.glb")
    told = json.loads((shared / "data" / "house" / "map" / "objects.json").read_text())
    assert things(model) == [(str(o["id"]), o["label"], o["name"]) for o in told]
    assert len(model.triangles) == 145_841
    for row, thing in enumerate(told):
        corners = model.vertices[model.triangles[model.object_of == row].ravel()]
        np.testing.assert_allclose(corners.min(axis=0), thing["bbox_min"], atol=2e-4)
        np.testing.assert_allclose(corners.max(axis=0), thing["bbox_max"], atol=2e-4)
    assert sum(p.data is not None for p in model.pictures) == 64


BASE64 = "data:application/octet-stream;base64,"


def filled(glb):
    """A textured chair and a table, written as .glb."""
    material = glb.material([0.5, 1, 1, 1], glb.texture(png()))
    glb.node(glb.primitive(QUAD, [0, 1, 2, 2, 3, 0], material=material),
             name="c", extras={"label": "chair", "id": 7})  # fmt: skip
    glb.node(glb.primitive(QUAD, [0, 1, 2]), name="t", extras={"label": "table"})
    return glb.write()


def as_text(glb, buffer="parts/a%20b.bin", image="t.png"):
    """The same as .gltf; what has no data URI lies beside it."""
    content = json.loads(json.dumps(glb.json))
    content["asset"] = {"version": "2.0"}
    content["buffers"] = [{"byteLength": len(glb.bytes), "uri": buffer}]
    content["images"] = [{"uri": image}]
    path = glb.path.with_name("a.gltf")
    path.write_text(json.dumps(content))
    (path.parent / "parts").mkdir(exist_ok=True)
    (path.parent / "parts" / "a b.bin").write_bytes(glb.bytes)
    (path.parent / "t.png").write_bytes(png())
    return path


def same(one, other):
    assert one.objects == other.objects
    for name in ("vertices", "triangles", "object_of", "uv", "picture_of", "colours"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    pictures = [[(p.data, p.factor) for p in model.pictures] for model in (one, other)]
    assert pictures[0] == pictures[1]


def test_files_beside_it_and_inside(glb):
    model = read_glb(filled(glb))
    same(read_glb(as_text(glb)), model)
    inside = [BASE64 + base64.b64encode(data).decode() for data in (bytes(glb.bytes), png())]
    same(read_glb(as_text(glb, *inside)), model)
    upright = read_glb(as_text(glb), up="z")
    np.testing.assert_array_equal(upright.vertices[:3, :2], np.array(QUAD)[:3, :2])
    scene = build_scene(as_text(glb), None, floor=0.0)
    assert scene.graph.labels == ("chair", "table")
    assert scene.mesh.vertices[:, 2].max() == pytest.approx(1.0, abs=1e-3)
    glb.json["images"] = [{"uri": "t.png"}]
    assert read_glb(glb.write()).pictures[0].data == png()


@pytest.mark.parametrize(
    "uri",
    ["../a.bin", "%2e%2e/a.bin", "parts/../../a.bin", "/etc/hostname", "file:///etc/hostname",
     "https://x.org/a.bin", "link/a.bin", "C:/a.bin", "a%00b", "\ud800"],
)  # fmt: skip
def test_nothing_outside_its_folder_is_read(glb, uri, tmp_path):
    filled(glb)
    (tmp_path.parent / "a.bin").write_bytes(glb.bytes)
    (tmp_path / "link").symlink_to(tmp_path.parent)
    for where in ("buffer", "image"):
        path = as_text(glb, **{where: uri})
        with pytest.raises(InputError, match="lies outside its folder") as caught:
            read_glb(path)
        assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"buffer": "no.bin"}, r"buffers\[0\] lies in 'no.bin', which is missing"),
        ({"image": "no.png"}, r"images\[0\] lies in 'no.png', which is missing"),
        ({"buffer": "parts"}, "missing"), ({"buffer": ""}, "missing"),
        ({"buffer": "x" * 5000}, "lies outside|is missing"), ({"buffer": "t.png"}, "ends beyond"),
        ({"buffer": BASE64 + "%%"}, "not base64"), ({"buffer": "data:text/plain,abc"}, "not base64"),
        ({"image": "data:image/png"}, "not base64"),
    ],
)  # fmt: skip
def test_what_is_missing_says_so(glb, given, says):
    filled(glb)
    with pytest.raises(InputError, match=says):
        read_glb(as_text(glb, **given))


def test_other_text(glb):
    filled(glb)
    path = as_text(glb)
    for text, says in (
        ("", "no JSON"), ("[]", "not an object"), ("{}", "glTF None"),
        ('{"asset": {"version": "1.0"}}', "glTF 1.0"), ('{"asset": []}', "not an object"),
        (('{"asset": {"version": "2.0"}, "bufferViews": [{"byteLength": 4}], "buffers": [{}],'
         ' "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}], "nodes": [{"mesh": 0}],'
         ' "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 1}]}'),
         r"buffers\[0\] is not in the file"),
    ):  # fmt: skip
        path.write_text(text)
        with pytest.raises(InputError, match=says):
            read_glb(path)
    path.write_bytes(glb.path.read_bytes())  # a binary file of the wrong name
    assert len(read_glb(path).objects) == 2
