"""GLB: what is written is sound by the standard, and read back it is the same."""

import io
import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from placegraph.errors import OptionError
from placegraph.io.mesh import gltf_write as glb_write
from placegraph.io.mesh.gltf import read_glb
from placegraph.io.mesh.gltf_write import Material, Part, Surface, encode_glb

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)], np.float32)
FACES = np.array([(0, 2, 1), (0, 1, 3)])
PNG = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108020000009077"
    "53de0000000c49444154789c63f8cfc000000301010018dd8db00000000049454e44ae426082"
)


def content_of(data):
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert (kind, size % 4) == (b"JSON", 0)
    return json.loads(data[20 : 20 + size])


@pytest.fixture
def read(tmp_path):
    def back(*arguments, **options):
        path = tmp_path / "a.glb"
        path.write_bytes(encode_glb(*arguments, **options))
        return read_glb(path)

    return back


def test_parts_are_nodes_and_things(read):
    surface = Surface(CORNERS, FACES, 0)
    parts = [
        Part("Stuhl Nr. 1", [surface], {"label": "chair", "id": "7", "room": "Küche"}),
        Part("nothing", [], {"label": "ghost", "id": "8"}),
        Part("table", [surface, surface], {"label": "table", "id": "x"}),
    ]
    model = read(parts, [Material()])
    found = [(t.id, t.label, t.name) for t in model.objects]
    assert found == [("7", "chair", "Stuhl Nr. 1"), ("x", "table", "table")]
    assert model.objects[0].attributes == {"room": "Küche"}
    assert model.object_of.tolist() == [0, 0, 1, 1, 1, 1]
    assert model.vertices[:4] == pytest.approx(CORNERS)
    assert model.triangles[:2].tolist() == FACES.tolist()
    assert (model.colours == 255).all()


def test_images_are_written_as_they_are_and_once_and_read_back(read):
    uv = np.zeros((4, 2))
    parts = [Part(str(k), [Surface(CORNERS, FACES, k, uv)]) for k in range(3)]
    data = encode_glb(parts, [Material(PNG), Material(PNG, (0.5, 1.0, 0.0)), Material()])
    content = content_of(data)
    assert data.count(PNG) == 1
    assert [image["mimeType"] for image in content["images"]] == ["image/png"]
    factors = [m["pbrMetallicRoughness"].get("baseColorFactor") for m in content["materials"]]
    assert factors == [None, [0.5, 1.0, 0.0, 1.0], None]
    parts = [Part("a", [Surface(CORNERS, FACES, k, CORNERS[:, :2]) for k in range(2)])]
    model = read(parts, [Material(PNG), Material(factor=(0.25, 0.5, 1.0))])
    assert [p.data for p in model.pictures] == [PNG, None]
    assert model.pictures[1].factor == (0.25, 0.5, 1.0)
    assert model.uv[:4] == pytest.approx(CORNERS[:, :2])


def test_webp_says_so(read):
    file = io.BytesIO()
    Image.new("RGB", (4, 4), (200, 10, 10)).save(file, "WEBP")
    parts = [Part("a", [Surface(CORNERS, FACES, 0, CORNERS[:, :2])])]
    content = content_of(encode_glb(parts, [Material(file.getvalue())]))
    assert content["extensionsUsed"] == content["extensionsRequired"] == ["EXT_texture_webp"]
    assert content["images"][0]["mimeType"] == "image/webp"
    assert read(parts, [Material(file.getvalue())]).pictures[0].data == file.getvalue()


@given(hnp.arrays(np.uint8, (4, 3)))
def test_vertex_colours_survive(tmp_path_factory, colours):
    path = tmp_path_factory.mktemp("glb") / "a.glb"
    path.write_bytes(
        encode_glb([Part("a", [Surface(CORNERS, FACES, 0, None, colours)])], [Material()])
    )
    assert (read_glb(path).colours == colours).all()


@given(hnp.arrays(np.float32, (5, 3), elements=st.floats(-1e4, 1e4, width=32)), st.booleans())
def test_positions_are_exact_in_either_frame(tmp_path_factory, points, turned):
    path = tmp_path_factory.mktemp("glb") / "a.glb"
    surface = Surface(points, np.array([(0, 1, 2), (2, 3, 4)]), 0)
    path.write_bytes(encode_glb([Part("a", [surface])], [Material()], turned=turned))
    model = read_glb(path, up="y" if turned else "z")
    assert (model.vertices == points).all()
    accessor = content_of(path.read_bytes())["accessors"][0]
    assert np.all(np.array(accessor["min"]) <= np.array(accessor["max"]))


def test_lines_are_drawn_but_are_no_things(read):
    parts = [Part("walk", lines=np.zeros((3, 2, 3))), Part("a", [Surface(CORNERS, FACES, 0)])]
    model = read(parts, [Material()])
    assert model.left_out == {"primitives that are not triangles": 1}
    assert len(model.triangles) == 2


def test_an_empty_file_is_sound_and_a_huge_one_is_refused(read, monkeypatch):
    content = content_of(encode_glb([], []))
    assert "buffers" not in content
    assert read([], []).objects == ()
    monkeypatch.setattr(glb_write, "_LARGEST", 500)
    with pytest.raises(OptionError, match="4 GiB"):
        encode_glb([Part("a", [Surface(CORNERS, FACES, 0)])], [Material()])


def test_the_scene_tells_relations_and_floor(read):
    parts = [Part(i, [Surface(CORNERS, FACES, 0)], {"id": i, "label": "box"}) for i in "abc"]
    rows = [["a", "on", "b"], ["c", "near", "gone"], ["a", 3, "b"], "nonsense", ["a", "b"]]
    extras = {"relations": rows, "scenes": [{"name": "s", "floor": -0.5}]}
    model = read(parts, [Material()], extras=extras)
    assert model.relations == ((0, "on", 1),)
    assert model.floor == -0.5
    model = read(parts, [Material()], extras={"relations": 3, "scenes": [{"floor": "low"}]})
    assert (model.relations, model.floor) == ((), None)
    two = [{"name": "s", "floor": 0}, {"name": "t", "floor": 1}]
    assert read(parts, [Material()], extras={"scenes": two}).floor is None
