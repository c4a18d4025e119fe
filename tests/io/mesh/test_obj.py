"""OBJ meshes: objects, groups and materials, polygons, textures, and files that are spoilt."""

import io
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from tests.io.damage import DAMAGE, damaged, refusing

from placegraph.errors import InputError, OptionError
from placegraph.io.capture.json_files import LabelEntry
from placegraph.io.mesh import obj as obj_lines
from placegraph.io.mesh.model import triangulate_fans
from placegraph.io.mesh.obj import is_obj, read_obj

ROOM = """\
# made by hand
mtllib room.mtl
o floor.001
v 0 0 0
v 2 0 0
v 2 2 0
v 0 2 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl wood
f 1/1 2/2 3/3 4/4
o chair
g seat ignored
v 0 0 1 1 0 0
v 1 0 1 0 1 0
v 1 1 1 0 0 1
usemtl red paint
f -3 -2 -1
g back
f 5//1 6//1 7//1
"""
MATERIALS = """\
newmtl wood
Kd 1 1 1
map_Kd -s 1 1 1 -clamp on textures\\wood grain.png
newmtl red paint
Kd 0.5 0 0 # dark
"""


def png(colour=(10, 20, 30)):
    file = io.BytesIO()
    Image.new("RGB", (2, 2), colour).save(file, "PNG")
    return file.getvalue()


@pytest.fixture
def room(tmp_path):
    (tmp_path / "textures").mkdir()
    (tmp_path / "textures" / "wood grain.png").write_bytes(png())
    (tmp_path / "room.mtl").write_text(MATERIALS)
    path = tmp_path / "room.obj"
    path.write_text(ROOM)
    return path


def written(tmp_path, text, name="a.obj"):
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_objects_are_things_that_a_table_names(room):
    model = read_obj(room)
    found = [(t.id, t.label, t.name) for t in model.objects]
    assert found == [("floor.001", "floor", "floor.001"), ("chair", "chair", "chair")]
    assert model.object_of.tolist() == [0, 0, 1, 1]
    corners = model.vertices[model.triangles]
    assert corners[1].tolist() == [[0, 0, 0], [2, 2, 0], [0, 2, 0]]  # the rest of the fan
    assert corners[2].tolist() == corners[3].tolist() == [[0, 0, 1], [1, 0, 1], [1, 1, 1]]
    table = {"chair": LabelEntry("armchair", "mine", {"colour": "red"})}
    chair = read_obj(room, table=table).objects[1]
    assert (chair.id, chair.label, chair.name) == ("chair", "armchair", "mine")
    assert chair.attributes == {"colour": "red"}


def test_textures_and_colours(room):
    model = read_obj(room)
    wood, paint = (model.pictures[i] for i in model.picture_of[[0, 2]])
    assert wood.data == png()
    assert wood.factor == (1, 1, 1)
    assert "wood grain.png" in wood.name
    assert paint.data is None
    assert paint.factor == pytest.approx((0.214, 0, 0), abs=1e-3)  # 0.5 of sRGB, linear
    assert model.uv[model.triangles[0]].tolist() == [[0, 1], [1, 1], [1, 0]]  # v down
    assert model.colours[model.triangles[2]].tolist() == [[255, 0, 0], [0, 255, 0], [0, 0, 255]]
    assert model.colours[model.triangles[0]].tolist() == [[255] * 3] * 3
    assert model.left_out == {
        "textures whose offset or scale was not applied": 1,
        "vertices without the colour that others have": 4,
    }


@pytest.mark.parametrize(
    ("groups", "labels", "of"),
    [
        ("o", ["floor", "chair"], [0, 0, 1, 1]),
        ("g", ["unknown", "seat", "back"], [0, 0, 1, 2]),
        ("usemtl", ["wood", "red paint"], [0, 0, 1, 1]),
    ],
)
def test_what_parts_a_file(room, groups, labels, of):
    model = read_obj(room, groups=groups)
    assert [t.label for t in model.objects] == labels
    assert model.object_of.tolist() == of


def test_auto_takes_the_first_keyword_that_parts(tmp_path):
    head = "v 0 0 0\nv 1 0 0\nv 0 1 0\no all\n"
    parted = read_obj(written(tmp_path, head + "g a\nf 1 2 3\ng b\nf 1 2 3\n"))
    assert [t.id for t in parted.objects] == ["a", "b"]
    whole = read_obj(written(tmp_path, head + "f 1 2 3\n"))
    assert [t.id for t in whole.objects] == ["all"]
    bare = read_obj(written(tmp_path, "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"))
    assert [(t.id, t.label) for t in bare.objects] == [("unknown", "unknown")]
    again = head.replace("o all\n", "o a\nf 1 2 3\no b\nf 1 2 3\no a\nf 1 2 3\n")
    assert read_obj(written(tmp_path, again)).object_of.tolist() == [0, 1, 0]


def test_a_vertex_of_two_texture_coordinates_is_two(tmp_path):
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt .5 .25\nf 1/1 2/1 3/1\nf 1/2 3 2/1\n"
    model = read_obj(written(tmp_path, text))
    assert len(model.vertices) == 5  # the first is there for 1/1 and 1/2, the third for 3/1 and 3
    assert model.uv[model.triangles[1]].tolist() == [[0.5, 0.75], [0, 0], [0, 1]]
    assert model.vertices[model.triangles[1]].tolist() == [[0, 0, 0], [0, 1, 0], [1, 0, 0]]


def test_odd_but_sound_text(tmp_path):
    sized = "v 1 2 3 255 0 7\nv 1 0 0 1 2 3\nv 0 1 0 4 5 6\nf 1 2 3\n"
    model = read_obj(written(tmp_path, sized), up="y")
    assert model.vertices[0].tolist() == [1, -3, 2]
    assert model.colours[0].tolist() == [255, 0, 7]
    text = b"\xef\xbb\xbfv 0 0 0 # origin\r\n  \tv\t1e0 0 0 1.0\r\nv 0 1\\\r\n 0\r\n"
    text += b"l 1 2\r\nf 1 2 \\\r\n3"
    model = read_obj(written(tmp_path, text))
    assert model.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert model.triangles.tolist() == [[0, 1, 2]]
    assert model.left_out == {"lines and points, which have no surface": 1}


def test_what_is_missing_is_counted(tmp_path):
    text = "mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\nf 1 2\n"
    model = read_obj(written(tmp_path, text))
    assert model.left_out == {
        "material files that are missing": 1,
        "materials missing in the material files": 1,
        "faces of fewer than three corners": 1,
    }
    assert model.pictures[0].data is None
    (tmp_path / "gone.mtl").write_text("newmtl a\nKd .2 .2 .2\nmap_Kd C:\\pics\\gone.jpg\n")
    model = read_obj(tmp_path / "a.obj")
    assert model.left_out["textures that are missing"] == 1
    assert model.pictures[0].factor != (1, 1, 1)


def test_black_beside_a_texture_means_nothing(room):
    (room.parent / "room.mtl").write_text("newmtl wood\nKd 0 0 0\nmap_Kd textures/wood grain.png\n")
    model = read_obj(room)
    assert model.pictures[model.picture_of[0]].factor == (1, 1, 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "contains no vertex"), ("v 0 0 0\nv 1 0\n", "line 2: it is cut off"),
        ("v 0 0 0\nv 1 nonsense 0\n", r"a.obj, line 2: 'nonsense' is not a number"),
        ("v 0 0 0\nvt\nvt 1x\n", "line 3: '1x' is not a number"),
        ("v 0 0 0\nf 1 2 3\n", "vertices 3 of 1"), ("v 0 0 0\nf 1/2 1 1\n", "uv 2 of 0"),
        ("v 0 0 0\nf 1 1 -2\n", "line 2: a face refers to a missing vertex"),
        ("v 0 0 0\nf 1/ 1 1\n", "line 2"), ("v 0 0 0\nf 0 1 1\n", "line 2"),
        ("v 0 0 0\nf 1.5 1 1\n", "line 2: '1.5' is not a number"),
    ],
)  # fmt: skip
def test_nonsense_is_named(tmp_path, text, message):
    with pytest.raises(InputError, match=message):
        read_obj(written(tmp_path, text))


def test_missing_and_foreign(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_obj(tmp_path / "none.obj")
    with pytest.raises(InputError, match="cannot be read"):
        read_obj(tmp_path)
    with pytest.raises(OptionError, match="groups"):
        read_obj(written(tmp_path, ROOM), groups="s")
    (tmp_path / "room.mtl").write_text("newmtl wood\nKd a b c\n")
    with pytest.raises(InputError, match=r"room.mtl, line 2: Kd is 'a b c'"):
        read_obj(tmp_path / "a.obj")
    assert is_obj(tmp_path / "a.obj")
    assert not is_obj(tmp_path)


@given(size=st.integers(1, 300))
@settings(max_examples=20, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_blocks_change_nothing(room, size):
    whole = read_obj(room)
    with patch.object(obj_lines, "BLOCK", size):
        parts = read_obj(room)
    for name in ("vertices", "triangles", "object_of", "colours", "uv", "picture_of"):
        assert np.array_equal(getattr(whole, name), getattr(parts, name))
    assert whole.objects == parts.objects


@given(text=damaged(ROOM.encode()) | st.binary(max_size=200).map(b"v 0 0 0\nf ".__add__))
@DAMAGE
def test_only_input_errors_of_spoilt_files(tmp_path, text):
    with refusing():
        model = read_obj(written(tmp_path, text))
        assert model.triangles.max(initial=0) < len(model.vertices)
        assert len(model.object_of) == len(model.picture_of) == len(model.triangles)


@given(st.lists(st.integers(0, 7), max_size=20))
def test_fans_cover_polygons(lengths):
    corner, face = triangulate_fans(np.array(lengths, np.int64))
    starts = np.cumsum([0, *lengths])
    expected = [
        [starts[f], starts[f] + i, starts[f] + i + 1]
        for f, n in enumerate(lengths)
        for i in range(1, n - 1)
    ]
    assert corner.tolist() == [list(map(int, row)) for row in expected]
    assert face.tolist() == [f for f, n in enumerate(lengths) for _ in range(n - 2)]
