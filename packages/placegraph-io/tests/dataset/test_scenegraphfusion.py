import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE, damaged, refusing
from tests.io.writers import ply

from placegraph.errors import InputError
from placegraph_io.dataset.scenegraphfusion import GRID, is_scenegraphfusion, read_scenegraphfusion

BEFORE = dict.fromkeys("xyz", "float") | {"label": "ushort"}
EXTRA = dict.fromkeys(("semantic", "instance"), "ushort")
AFTER = dict.fromkeys(("nx", "ny", "nz", "curvature"), "float")
AFTER |= dict.fromkeys(("red", "green", "blue", "alpha"), "uchar")
AFTER |= dict.fromkeys(("quality", "radius"), "float")


def patch(x, y, z, normal=(0, 0, 1), side=1.0, step=0.02):
    across = np.arange(0, side, step) + step / 2
    a, b = (v.ravel() for v in np.meshgrid(across, across))
    zero = np.zeros_like(a)
    local = np.stack([a, b, zero] if normal[2] else [zero, a, b], axis=1)
    return local + (x, y, z)  # noqa: RUF005


SEGMENTS = {
    3: (patch(0, 0, 0), (0, 0, 1), (90, 60, 30)),
    7: (patch(1, 0, 0), (0, 0, 1), (90, 60, 30)),
    5: (patch(0, 0, 0.1, normal=(1, 0, 0)), (1, 0, 0), (200, 200, 200)),
    8: (patch(0.4, 0.4, 0.5, side=0.2), (0, 0, 1), (0, 0, 255)),
    9: (patch(1.5, 0.5, 0.3, side=0.06), (0, 0, 1), (9, 9, 9)),  # too small for a prediction
}


def logs(**shares):
    return {k: math.log(p) if p else 0 for k, p in shares.items()}


def graph():
    return {
        "nodes": {
            "3": logs(floor=0.9, wall=0.1, chair=0),
            "7": logs(floor=0.7, wall=0.2, chair=0.1),
            "5": {"floor": 0, "wall": 0, "chair": 0} | logs(wall=0.999),
            "8": {"floor": -30.0, "wall": -30.0, "chair": 0},  # a probability of 1 is 0, too
        },
        "edges": {
            "3_7": {"same part": -0.1, "none": -2.35, "standing on": 0},
            "5_3": {"same part": -0.1, "none": -2.35, "standing on": 0},  # of another label: no
            "5_7": {"same part": -5.0, "none": -3.0, "attached to": -0.06},
            "8_7": {"standing on": -0.2, "none": -1.7, "same part": 0},
            "7_8": {"standing on": -3, "none": -0.05, "same part": 0},
        },
        "kfs": {},
    }


class Output:
    def __init__(self, root, every=1):
        self.path = root / "scene0000_00" / "scene_graph_fusion"
        self.path.mkdir(parents=True, exist_ok=True)
        self.write_surfels(every=every)
        self.write_graph({"scene0000_00": graph()})

    def write_graph(self, content, name="predictions.json"):
        (self.path / name).write_text(json.dumps(content))

    def write_surfels(self, name="inseg.ply", binary=False, every=1):
        extra = {} if name == "inseg.ply" else EXTRA
        rows = [
            (*point, segment, *(0 for _ in extra), *normal, 0.0, *colour, 0, 0.0, 0.0)
            for segment, (dense, normal, colour) in SEGMENTS.items()
            for point in dense[::every].tolist()
        ]
        form = "binary_little_endian" if binary else "ascii"
        (self.path / name).write_bytes(ply(form, ("vertex", BEFORE | extra | AFTER, rows)))


@pytest.fixture
def output(tmp_path):
    return Output(tmp_path)


def things(model):
    return {t.id: t for t in model.objects}


@pytest.mark.parametrize("binary", [False, True])
def test_segments_become_things(output, binary):
    output.write_surfels(binary=binary)
    assert is_scenegraphfusion(output.path)
    model = read_scenegraphfusion(output.path)
    found = things(model)
    assert {i: t.label for i, t in found.items()} == {
        "3": "floor", "5": "wall", "8": "chair", "unknown": "unknown",
    }  # fmt: skip
    assert found["3"].attributes == {"probability": "0.800"}
    assert found["5"].attributes == {"probability": "0.999"}
    assert found["8"].attributes == {"probability": "1.000"}
    row = {t.id: i for i, t in enumerate(model.objects)}
    assert set(model.relations) == {
        (row["8"], "standing on", row["3"]),
        (row["5"], "attached to", row["3"]),
    }


def test_squares_lie_on_the_surface(output):
    model = read_scenegraphfusion(output.path)
    row = {t.id: i for i, t in enumerate(model.objects)}
    corners = model.vertices[model.triangles]
    floor, wall = (corners[model.object_of == row[i]] for i in "35")
    assert np.allclose(floor[..., 2], 0)
    assert np.allclose(wall[..., 0], 0)
    low, high = floor.min(axis=(0, 1)), floor.max(axis=(0, 1))
    assert np.allclose(low[:2], 0, atol=GRID)
    assert np.allclose(high[:2], (2, 1), atol=GRID)
    normals = np.cross(floor[:, 1] - floor[:, 0], floor[:, 2] - floor[:, 0])
    assert (normals[:, 2] > 0).all()
    area = np.linalg.norm(normals, axis=1).sum() / 2
    assert 2.0 < area < 3.2  # they overlap a little, so that there are no holes
    chair = model.triangles[model.object_of == row["8"]]
    assert (model.colours[chair] == (0, 0, 255)).all()


def test_labels_on_a_mesh(output, tmp_path):
    mesh = tmp_path / "scene0000_00" / "scene0000_00_vh_clean_2.obj"
    mesh.write_text(
        "v 0 0 0.02\nv .9 0 0.02\nv 0 .9 0.02\nv 0 .1 .2\nv 0 .9 .2\nv 0 .5 .9\nv 5 5 5\nv 6 5 5\nv 5 6 5\n"
        "f 1 2 3\nf 4 5 6\nf 7 8 9\n"
    )
    model = read_scenegraphfusion(output.path / "predictions.json", mesh=mesh)
    assert [model.objects[i].label for i in model.object_of] == ["floor", "wall", "unknown"]
    assert len(model.triangles) == 3
    assert model.left_out["vertices of the mesh without a surfel within 0.1 m"] == 3
    assert model.left_out["labels of missing objects"] == 1  # the chair
    (relation,) = model.relations
    assert [model.objects[i].label for i in relation[::2]] == ["wall", "floor"]
    mesh.write_text("v 9 9 9\nv 8 9 9\nv 9 8 9\nf 1 2 3\n")
    with pytest.raises(InputError, match="has no vertex within"):
        read_scenegraphfusion(output.path, mesh=mesh)


def test_names_alone(output):
    output.write_graph({
        "nodes": {"3": "floor", "7": "floor", "8": "chair"},
        "edges": {"3_7": ["same part"], "8_3": ["standing on"]},
        "kfs": {},
    })  # fmt: skip
    model = read_scenegraphfusion(output.path)
    assert sorted(things(model)) == ["3", "8", "unknown"]
    assert [name for _, name, _ in model.relations] == ["standing on"]


def test_colours_of_labels_are_none(output):
    (output.path / "inseg.ply").unlink()
    output.write_surfels("node_semantic.ply")
    model = read_scenegraphfusion(output.path)
    assert (model.colours == 255).all()
    assert model.left_out["colours; add inseg.ply to have them"] == 1


def test_a_likelihood_that_cannot_be_told(output):
    content = graph()
    content["nodes"]["8"] = {"floor": -9.0, "wall": 0, "chair": 0}
    output.write_graph(content)
    assert "8" not in things(read_scenegraphfusion(output.path))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([], "must be a JSON object"),
        ({}, "has no `nodes`"),
        ({"a": {"nodes": {}}, "b": {"nodes": {}}}, "several scans"),
        ({"nodes": []}, "`nodes` must be an object"),
        ({"nodes": {"x": "chair"}}, "'x' is not a segment number"),
        ({"nodes": {"3": {}}}, "must be a name, or an object"),
        ({"nodes": {"3": {"floor": 10**400}}}, "invalid numbers"),
        ({"nodes": {"3": {"a": None}}}, "invalid numbers"),
        ({"nodes": {"3": "a"}, "edges": {"3-4": "b"}}, "not an edge"),
        ({"nodes": {"4": "a"}}, "have no segment in common"),
    ],
)
def test_graphs_that_are_none(output, content, message):
    output.write_graph(content)
    with pytest.raises(InputError, match=message):
        read_scenegraphfusion(output.path)


def test_files_that_are_missing(output):
    (output.path / "inseg.ply").rename(output.path / "other.ply")
    assert not is_scenegraphfusion(output.path)
    with pytest.raises(InputError, match=r"has no inseg\.ply or node_semantic\.ply"):
        read_scenegraphfusion(output.path)
    (output.path / "inseg.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n"
    )
    with pytest.raises(InputError, match="lacks label, nx, ny, nz, y, z"):
        read_scenegraphfusion(output.path)
    with pytest.raises(InputError, match=r"has no predictions\.json"):
        read_scenegraphfusion(output.path.parent)


def test_surfels_in_another_unit(output):
    text = (output.path / "inseg.ply").read_text().splitlines()
    text[-1] = " ".join(["1e15", "-1e15", "1e15", *text[-1].split()[3:]])
    (output.path / "inseg.ply").write_text("\n".join(text))
    with pytest.raises(InputError, match="give it in metres"):
        read_scenegraphfusion(output.path)
    text[-1] = " ".join(["nan", "0", "0", *text[-1].split()[3:]])
    (output.path / "inseg.ply").write_text("\n".join(text))
    assert read_scenegraphfusion(output.path).left_out["surfels that are not numbers"] == 1


@given(
    name=st.sampled_from(["inseg.ply", "predictions.json"]), data=st.data(), binary=st.booleans()
)
@DAMAGE
def test_only_input_errors_of_spoilt_files(tmp_path, name, data, binary):
    output = Output(tmp_path, every=400)
    output.write_surfels(binary=binary, every=400)
    path = output.path / name
    path.write_bytes(data.draw(damaged(path.read_bytes(), within=3000)))
    with refusing():
        model = read_scenegraphfusion(output.path)
        assert len(model.object_of) == len(model.triangles) > 0
