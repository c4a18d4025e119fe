"""PLY meshes and label tables: text and binary alike, ids by vertex or face."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from tests.io.damage import DAMAGE, damaged, refusing
from tests.io.writers import ply

from placegraph.errors import InputError, MapError, OptionError
from placegraph.io.capture.json_files import LabelEntry as Entry
from placegraph.io.capture.json_files import read_label_table
from placegraph.io.mesh.ply import read_ply, write_ply

FORMS = ("ascii", "binary_little_endian", "binary_big_endian")
SQUARE = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]


def vertices(points=SQUARE, **columns):
    """Vertex element with further columns, each as a type and values."""
    properties = {"x": "float", "y": "double", "z": "float"}
    properties |= {name: kind for name, (kind, _) in columns.items()}
    extra = [values for _, values in columns.values()]
    return "vertex", properties, [(*p, *e) for p, *e in zip(points, *extra, strict=True)]


def faces(*rows, name="vertex_indices", **columns):
    properties = {name: "uchar int"} | {key: kind for key, (kind, _) in columns.items()}
    extra = [values for _, values in columns.values()]
    return "face", properties, [(r, *e) for r, *e in zip(rows, *extra, strict=True)]


@pytest.fixture
def write(tmp_path):
    def written(*elements, form="ascii", name="a.ply"):
        path = tmp_path / name
        path.write_bytes(ply(form, *elements))
        return path

    return written


def ids(model):
    return [t.id for t in model.objects]


@pytest.mark.parametrize("form", FORMS)
def test_the_same_mesh_in_every_form(form, write):
    model = read_ply(
        write(
            vertices(red=("uchar", [1, 2, 3, 4]), green=("uchar", [5] * 4), blue=("uchar", [255] * 4),
                     objectId=("short", [7, 7, 7, 9])),
            faces([0, 1, 2], [0, 2, 3]),
            form=form,
        )
    )  # fmt: skip
    np.testing.assert_array_equal(model.vertices, SQUARE)
    assert model.triangles.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert model.colours.tolist() == [[1, 5, 255], [2, 5, 255], [3, 5, 255], [4, 5, 255]]
    assert ids(model) == ["7"]
    assert model.object_of.tolist() == [0, 0]
    assert [t.label for t in model.objects] == ["unknown"]


@pytest.mark.parametrize("form", FORMS)
def test_polygons_become_fans(form, write):
    hexagon = [(np.cos(a), np.sin(a), 0.0) for a in np.arange(6)]
    mixed = faces([0, 1, 2, 3], [0, 1], [], [5, 4, 3], [0, 1, 2, 3, 4], id=("int", [1, 2, 3, 4, 5]))
    path = write(vertices(hexagon), mixed, ("other", {"a": "uchar"}, [(3,)]), form=form)
    model = read_ply(path, object_property="ID")
    assert model.triangles.tolist() == [
        [0, 1, 2], [0, 2, 3], [5, 4, 3], [0, 1, 2], [0, 2, 3], [0, 3, 4],
    ]  # fmt: skip
    assert [ids(model)[i] for i in model.object_of] == ["1", "1", "4", "5", "5", "5"]


@pytest.mark.parametrize("name", ["objectId", "object_id", "OBJECT_ID", "label", "instance"])
def test_known_names_of_ids(name, write):
    model = read_ply(write(vertices(**{name: ("int", [3] * 4)}), faces([0, 1, 2])))
    assert ids(model) == ["3"]


def test_faces_know_better_than_vertices(write):
    path = write(
        vertices(objectId=("int", [3] * 4)),
        faces([0, 1, 2], [0, 2, 3], object_id=("int", [1, 2]), name="vertex_index"),
    )
    model = read_ply(path)
    assert ids(model) == ["1", "2"]
    assert model.object_of.tolist() == [0, 1]
    assert ids(read_ply(path, object_property="objectId")) == ["3"]
    with pytest.raises(
        InputError, match=r"no property 'segment'; it has objectId, object_id, x, y"
    ):
        read_ply(path, object_property="segment")


def test_the_majority_of_the_corners_decides(write):
    path = write(
        vertices(objectId=("int", [1, 2, 2, 3])), faces([0, 1, 2], [1, 2, 3], [0, 1, 3], [1, 3, 2])
    )
    model = read_ply(path)
    assert [ids(model)[i] for i in model.object_of] == ["2", "2", "1", "2"]


@pytest.mark.parametrize(
    ("kind", "nothing"),
    [("int", -1), ("ushort", 65535), ("uchar", 255), ("float", "nan"), ("int", -9)],
)
def test_faces_without_an_object_are_one_unknown_object(kind, nothing, write):
    ids_of = {"object_id": (kind, [nothing, 4, nothing])}
    model = read_ply(write(vertices(), faces([0, 1, 2], [0, 2, 3], [0, 1, 3], **ids_of)))
    assert {(t.id, t.label) for t in model.objects} == {("unknown", "unknown"), ("4", "unknown")}
    assert [ids(model)[i] for i in model.object_of] == ["unknown", "4", "unknown"]


def test_a_table_names_objects_and_leaves_the_rest_unknown(write):
    path = write(vertices(), faces([0, 1, 2], [0, 2, 3], [0, 1, 3], object_id=("int", [0, 4, 9])))
    table = {"4": Entry("chair", "Stool", {"colour": "red"}), "77": Entry("lamp")}
    model = read_ply(path, table=table)
    assert [(t.id, t.label, t.name) for t in model.objects] == [
        ("unknown", "unknown", ""), ("4", "chair", "Stool"),
    ]  # fmt: skip
    assert model.objects[1].attributes == {"colour": "red"}
    assert model.object_of.tolist() == [0, 1, 0]
    assert model.left_out == {"labels of missing objects": 1}


def test_meshes_without_ids_points_alone_and_other_axes(write, tmp_path):
    assert [t.label for t in read_ply(write(vertices(), faces([0, 1, 2]))).objects] == ["unknown"]
    assert len(read_ply(write(vertices())).triangles) == 0
    assert len(read_ply(write(vertices([]), faces())).vertices) == 0
    model = read_ply(write(vertices([(1, 2, 3)] * 3), faces([0, 1, 2])), up="y")
    np.testing.assert_array_equal(model.vertices, [[1, -3, 2]] * 3)
    assert ids(model) == ["0"]
    (tmp_path / "a.ply").write_bytes((tmp_path / "a.ply").read_bytes().replace(b"\n", b"\r\n"))
    assert read_ply(tmp_path / "a.ply").triangles.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("float", [0.0, 0.2, 1.0, 0.5], [0, 51, 255, 128]),
        ("float", [0, 20, 255, 128], [0, 20, 255, 128]),
        ("ushort", [0, 256, 65535, 32896], [0, 1, 255, 128]),
    ],
)
def test_colours_of_other_types(kind, values, expected, write):
    columns = dict.fromkeys(("diffuse_red", "diffuse_green", "diffuse_blue"), (kind, values))
    model = read_ply(write(vertices(**columns), faces([0, 1, 2])))
    assert model.colours[:, 0].tolist() == expected


def test_colours_of_faces_belong_to_their_corners(write):
    columns = {c: ("uchar", [10, 20]) for c in ("red", "green", "blue")}
    model = read_ply(write(vertices(), faces([0, 1, 2], [0, 2, 3], **columns)))
    assert model.triangles.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert model.colours[:, 1].tolist() == [10] * 3 + [20] * 3
    np.testing.assert_array_equal(model.vertices[3:], np.array(SQUARE)[[0, 2, 3]])


def test_many_vertices_come_back_exactly(tmp_path, rng):
    points = rng.normal(size=(5000, 3)).astype(np.float32)
    rows = rng.integers(0, 5000, (8000, 3))
    triples = [tuple(float(v) for v in p) for p in points]
    for form in FORMS:
        path = tmp_path / f"{form}.ply"
        path.write_bytes(ply(form, vertices(triples), faces(*rows.tolist())))
        model = read_ply(path)
        np.testing.assert_array_equal(model.vertices, points)
        np.testing.assert_array_equal(model.triangles, rows)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "is empty"), (b"obj", "not a PLY file"), (b"ply\nformat ascii 1.0\n", "not a PLY file"),
        (b"ply\nelement vertex 1\nend_header\n", "header cannot be parsed"),
        (b"ply\nformat zip 1.0\nend_header\n", "header cannot be parsed"),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "header cannot be parsed"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "header cannot be parsed"),
        (b"ply\nformat ascii 1.0\nelement vertex 9999999999\nend_header\n", "cannot be parsed"),
        (b"ply\nformat ascii 1.0\nproperty int x\nend_header\n", "header cannot be parsed"),
        (b"ply\nformat ascii 1.0\nelement v 1\nproperty complex x\nend_header\n", "cannot be parsed"),
        (b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "no vertices with x, y, z"),
        (ply("ascii", ("vertex", {"x": "float"}, [(1,)])), "no vertices with x, y, z"),
        (ply("ascii", vertices(), faces([0, 1, 4])), "vertex outside 0 to 3"),
        (ply("ascii", vertices(), faces([0, 1, -1])), "vertex outside 0 to 3"),
        (ply("ascii", vertices()).replace(b"vertex 4", b"vertex 5"), "4|5 vertex"),
        (ply("ascii", vertices()) + b"zero", "contains a value"),
        (ply("ascii", vertices())[:-3] + b"zero", "contains a value"),
        (ply("ascii", vertices())[:-3] + b"z" * 100, "contains a value"),
        (ply("ascii", vertices(objectId=("uchar", [999] * 4))), "damaged in"),
        (ply("ascii", vertices(), faces([0, 1, 2])).replace(b"3 0 1 2", b"1e999 0 1 2"), "damaged in"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_says_why(content, says, tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(InputError, match=says) as caught:
        read_ply(path)
    assert str(path) in str(caught.value)


def test_missing_files(tmp_path):
    for path, says in ((tmp_path / "no.ply", "does not exist"), (tmp_path, "cannot be read")):
        with pytest.raises(InputError, match=says):
            read_ply(path)


@pytest.mark.parametrize("form", FORMS)
def test_every_truncation_is_noticed(form, tmp_path):
    whole = ply(form, vertices(), faces([0, 1, 2], [0, 1, 2, 3]))
    whole = whole.rstrip(b"\n") if form == "ascii" else whole
    path = tmp_path / "a.ply"
    last = len(whole) - (2 if form == "ascii" else 1)
    for length in range(last):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"a\.ply"):
            read_ply(path)


@DAMAGE
@given(data=st.data())
def test_damaged_files_give_one_kind_of_error(data, tmp_path):
    columns = {"objectId": ("int", [1, 2, 2, 5]), "red": ("float", [0.5] * 4)}
    columns |= {"green": ("float", [0.5] * 4), "blue": ("float", [0.5] * 4)}
    form = data.draw(st.sampled_from(FORMS))
    path = tmp_path / "a.ply"
    whole = ply(form, vertices(**columns), faces([0, 1, 2], [0, 1, 2, 3]))
    path.write_bytes(data.draw(damaged(whole)))
    with refusing(path):
        model = read_ply(path)
        assert model.triangles.max(initial=-1) < len(model.vertices)
        assert model.object_of.max(initial=-1) < len(model.objects)


TABLE = [{"id": "3", "label": "chair"}, {"id": "4", "label": "table"}]


@pytest.mark.parametrize(
    "content",
    [
        {"3": "chair", "4": "table"},
        [{"id": 3, "label": "chair"}, {"id": "4", "label": "table", "extra": 1}],
        {"objects": [{"objectId": 3, "label": "chair"}, {"object_id": 4, "class": "table"}]},
        {"segGroups": [{"objectId": 3, "label": "chair"}, {"objectId": 4, "label": "table"}]},
        {"scans": [{"scan": "x", "objects": TABLE}]},
    ],
)
def test_tables_in_every_shape(content, tmp_path):
    path = tmp_path / "labels.json"
    path.write_text(json.dumps(content))
    for given_ in (path, str(path)):
        assert read_label_table(given_) == {"3": Entry("chair"), "4": Entry("table")}


def test_tables_in_memory_with_attributes_and_of_several_scans(tmp_path):
    assert read_label_table({3: "chair"}) == {"3": Entry("chair")}
    path = tmp_path / "objects.json"
    entry = {"id": 1, "label": "sofa", "name": "S"}
    path.write_text(json.dumps([entry | {"attributes": {"color": ["red", "blue"], "n": 2}}]))
    assert read_label_table(path)["1"] == Entry("sofa", "S", {"color": "red, blue", "n": "2"})
    scans = [{"scan": s, "objects": [{"id": 1, "label": s}]} for s in ("a", "b")]
    path.write_text(json.dumps({"scans": scans}))
    assert read_label_table(path, scan="b")["1"].label == "b"
    with pytest.raises(InputError, match="but not 'c'"):
        read_label_table(path, scan="c")


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "not JSON"), ("5", "not a label table"), ('{"3": 4}', "label of '3' is '4'"),
        ('{"3": ""}', "not text"), ("[3]", "entry 0 is not an object"),
        ('[{"id": 3}]', "entry 0 lacks"), ('[{"id": true, "label": "a"}]', "entry 0 lacks"),
        ('[{"label": "a"}]', "entry 0 lacks"), ('{"scans": 3}', "several scans"),
        ('{"objects": {}}', "not a label table"),
    ],
)  # fmt: skip
def test_wrong_tables(text, says, tmp_path):
    path = tmp_path / "labels.json"
    path.write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        read_label_table(path)
    assert str(path) in str(caught.value)
    with pytest.raises(InputError, match="does not exist"):
        read_label_table(tmp_path / "no.json")


FACES = np.array([(0, 2, 1), (0, 1, 3), (3, 2, 1)])


@given(
    hnp.arrays(np.float32, (4, 3), elements=st.floats(-1e6, 1e6, width=32)),
    hnp.arrays(np.uint8, (4, 3)),
    hnp.arrays(np.int64, 3, elements=st.integers(0, 2**31 - 1)),
)
def test_read_back_it_is_the_same(tmp_path_factory, points, colours, objects):
    path = write_ply(
        tmp_path_factory.mktemp("ply") / "a.ply", points, FACES, colours, objects=objects
    )
    model = read_ply(path)
    assert (model.vertices == points).all()
    assert (model.triangles == FACES).all()
    assert (model.colours == colours).all()
    assert [model.objects[row].id for row in model.object_of] == [str(n) for n in objects]


def test_colours_and_objects_may_be_missing(tmp_path):
    path = write_ply(tmp_path / "a.ply", np.zeros((4, 3)), FACES, comments=("made by a test",))
    model = read_ply(path)
    assert (model.colours == 255).all()
    assert [t.id for t in model.objects] == ["0"]
    assert b"\ncomment made by a test\n" in path.read_bytes()
    empty = write_ply(tmp_path / "b.ply", np.zeros((0, 3)), np.zeros((0, 3), int))
    assert len(read_ply(empty).triangles) == 0


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"vertices": np.zeros((4, 2))}, "vertices"),
        ({"triangles": np.zeros((4, 4), int)}, "triangles"),
        ({"colours": np.zeros((3, 3), np.uint8)}, "colours"),
        ({"objects": np.zeros(4, int)}, "objects"),
        ({"comments": ("two\nlines",)}, "comments"),
        ({"comments": ("é",)}, "comments"),
    ],
)
def test_columns_that_do_not_fit(tmp_path, change, name):
    columns = {"vertices": np.zeros((4, 3)), "triangles": FACES}
    with pytest.raises(OptionError, match=name):
        write_ply(tmp_path / "a.ply", **(columns | change))
    assert not list(tmp_path.iterdir())
    with pytest.raises(MapError, match="cannot be written"):
        write_ply(tmp_path / "no" / "a.ply", np.zeros((4, 3)), FACES)
