"""glTF as text: the same model as the binary file, its buffers and images inside or beside it."""

import base64
import io
import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

from placegraph.errors import InputError
from placegraph.indoor.build import build_scene
from placegraph.io.mesh.gltf import read_glb

QUAD = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
BASE64 = "data:application/octet-stream;base64,"


def png():
    file = io.BytesIO()
    Image.fromarray(np.full((4, 4, 3), 200, np.uint8)).save(file, "PNG")
    return file.getvalue()


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
    assert one.things == other.things
    for name in ("vertices", "triangles", "thing_of", "uv", "picture_of", "colours"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert [(p.data, p.factor) for p in one.pictures] == [
        (p.data, p.factor) for p in other.pictures
    ]


def test_files_beside_it_and_inside(glb):
    model = read_glb(filled(glb))
    same(read_glb(as_text(glb)), model)
    inside = [BASE64 + base64.b64encode(data).decode() for data in (bytes(glb.bytes), png())]
    same(read_glb(as_text(glb, *inside)), model)
    np.testing.assert_array_equal(
        read_glb(as_text(glb), up="z").vertices[:3, :2], np.array(QUAD)[:3, :2]
    )


def test_a_map_is_built_of_it(glb):
    filled(glb)
    scene = build_scene(as_text(glb), None, floor=0.0)
    assert scene.graph.labels == ("chair", "table")
    assert scene.mesh.vertices[:, 2].max() == pytest.approx(1.0, abs=1e-3)


def test_a_binary_file_may_have_files_beside_it_too(glb):
    filled(glb)
    as_text(glb)
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
        with pytest.raises(InputError, match="leads out of its folder") as caught:
            read_glb(path)
        assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"buffer": "no.bin"}, r"buffers\[0\] lies in 'no.bin', which is not there"),
        ({"image": "no.png"}, r"images\[0\] lies in 'no.png', which is not there"),
        ({"buffer": "parts"}, "not there"),
        ({"buffer": ""}, "not there"),
        ({"buffer": "x" * 5000}, "leads out|not there"),
        ({"buffer": "t.png"}, "ends beyond"),
        ({"buffer": BASE64 + "%%"}, "not base64"),
        ({"buffer": "data:text/plain,abc"}, "not base64"),
        ({"image": "data:image/png"}, "not base64"),
    ],
)
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
    assert len(read_glb(path).things) == 2


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damaged_text(new_glb, data):
    glb = new_glb()
    filled(glb)
    path = as_text(glb)
    text = path.read_bytes()
    at = data.draw(st.integers(0, len(text) - 1))
    change = data.draw(st.one_of(st.just(b""), st.binary(min_size=1, max_size=3)))
    path.write_bytes(text[:at] + change + (text[at + len(change) :] if change else b""))
    try:
        read_glb(path)
    except InputError:
        return
