import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import any_json, damaged

from placegraph.core.geometry import rotation_z
from placegraph.errors import InputError
from placegraph.io.mesh.model import Model, ModelObject, Texture
from placegraph_io.graphs import spark_dsg
from placegraph_io.graphs.spark_dsg import is_spark_dsg, node_name, read_spark_dsg
from placegraph_io.graphs.spark_dsg_write import encode_spark_dsg, node_id

IDENTITY = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
NO_BOX = {
    "type": "INVALID", "dimensions": [0.0] * 3, "world_P_center": [0.0] * 3,
    "world_R_center": IDENTITY,
}  # fmt: skip
POINTS = [
    [0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 0], [6, 5, 0], [5, 6, 0], [9, 9, 9], [8, 9, 9], [9, 8, 9],
]  # fmt: skip
FACES = [[0, 1, 2], [3, 4, 5], [6, 7, 8]]


def header(*numbers):
    names = ("major", "minor", "patch")
    return {"project_name": "main", "version": dict(zip(names, numbers, strict=True))}


def box(centre, lengths, kind="AABB", turn=IDENTITY):
    return {
        "type": kind, "dimensions": lengths, "world_P_center": centre, "world_R_center": turn,
    }  # fmt: skip


def thing(row, label, name="", bounds=NO_BOX, **more):
    attributes = {
        "type": "ObjectNodeAttributes", "position": [0.0] * 3, "last_update_time_ns": 0,
        "is_active": False, "is_predicted": False, "metadata": {}, "name": name,
        "color": {"r": 1, "g": 2, "b": 3, "a": 255}, "bounding_box": bounds,
        "semantic_label": label, "semantic_feature": {"rows": 0, "cols": 0, "data": None},
        "mesh_connections": [], "registered": False, "world_R_object": IDENTITY,
    }  # fmt: skip
    node = {"id": node_id("O", row), "layer": 2, "partition": 0}
    return node | {"attributes": attributes | more}


def other(letter, layer, name=""):
    attributes = {"type": "RoomNodeAttributes", "name": name, "bounding_box": NO_BOX}
    return {
        "id": node_id(letter, 0), "layer": layer, "partition": 0, "attributes": attributes,
    }  # fmt: skip


def edge(source, target, **metadata):
    info = {"type": "EdgeAttributes", "weighted": False, "weight": 1.0, "metadata": metadata}
    return {"source": node_id(*source), "target": node_id(*target), "info": info}


def mesh(labels):
    return {
        "header": header(1, 1, 3), "has_colors": True, "has_labels": True, "has_timestamps": False,
        "has_first_seen_stamps": False, "points": POINTS, "faces": FACES, "labels": labels,
        "colors": [{"r": 10 * i, "g": 0, "b": 0, "a": 255} for i in range(9)],
    }  # fmt: skip


def graph(nodes, edges=(), **more):
    return {
        "SPARK_DSG_header": header(1, 1, 3), "directed": False, "multigraph": False,
        "layer_keys": [{"layer": k, "partition": 0} for k in (2, 3, 4, 5)],
        "layer_names": {"OBJECTS": {"layer": 2, "partition": 0}, "ROOMS": {"layer": 4, "partition": 0}},
        "metadata": {"labelspaces": {"_l2p0": [[3, "chair"], [4, "cup"], [7, "floor"]]}},
        "nodes": list(nodes), "edges": list(edges),
    } | more  # fmt: skip


@pytest.fixture
def read(tmp_path):
    def from_content(content):
        path = tmp_path / "dsg.json"
        path.write_text(json.dumps(content))
        assert is_spark_dsg(path)
        return read_spark_dsg(path)

    return from_content


def corners_of(model, row):
    return model.vertices[model.triangles[model.object_of == row]].reshape(-1, 3)


def test_objects_own_the_vertices_they_are_connected_with(read):
    nodes = [thing(0, 3, mesh_connections=[3, 4, 5]), thing(1, 4, mesh_connections=[6, 7, 8])]
    model = read(graph(nodes, mesh=mesh([7] * 9)))
    found = [(t.id, t.label) for t in model.objects]
    assert found == [("O0", "chair"), ("O1", "cup"), ("mesh 7", "floor")]
    for row, first in ((0, 3), (1, 6), (2, 0)):
        assert corners_of(model, row).tolist() == POINTS[first : first + 3]
    assert model.colours[model.triangles[model.object_of == 1], 0].tolist() == [[60, 70, 80]]
    assert not model.left_out


def test_without_connections_label_and_box_decide(read):
    near = box([5.5, 5.5, 0], [1, 1, 0.1])
    nodes = [thing(0, 3, bounds=near), thing(1, 4, bounds=near)]
    model = read(graph(nodes, mesh=mesh([3] * 6 + [4] * 3)))
    assert corners_of(model, 0).tolist() == POINTS[3:6]
    # of the cup's label there is nothing within its box: the box stands for it
    assert len(corners_of(model, 1)) == 36
    assert model.left_out == {"objects without a mesh, shown as boxes": 1}
    assert [t.id for t in model.objects[2:]] == ["mesh 3", "mesh 4"]


@pytest.mark.parametrize("kind", ["AABB", "RAABB", "OBB"])
def test_boxes_are_closed_and_seen_from_outside(read, kind):
    turn = {"w": np.cos(0.3), "x": 0.0, "y": 0.0, "z": np.sin(0.3)}
    model = read(graph([thing(0, 3, bounds=box([1, 2, 3], [2, 4, 6], kind, turn))]))
    a, b, c = np.moveaxis(model.vertices[model.triangles], 1, 0)
    assert np.einsum("ti,ti->", a, np.cross(b, c)) / 6 == pytest.approx(48)  # its volume
    turned = np.eye(3) if kind == "AABB" else rotation_z(0.6)
    assert np.abs((model.vertices - [1, 2, 3]) @ turned) == pytest.approx(
        np.broadcast_to([1, 2, 3], (8, 3))
    )


def test_an_object_of_khronos_has_its_own_mesh_in_its_box(read):
    turn = {"w": np.sqrt(0.5), "x": 0.0, "y": 0.0, "z": np.sqrt(0.5)}
    nodes = [
        thing(0, 3, bounds=box([1, 0, 0], [1, 1, 1], "RAABB", turn), mesh=mesh([7] * 9)),
        thing(1, 3, bounds=box([1, 0, 0], [1, 1, 1]), mesh={"has_colors": True}),
    ]
    model = read(graph(nodes))
    assert corners_of(model, 0)[:2] == pytest.approx(np.array([(1, 0, 0), (1, 1, 0)]), abs=1e-12)
    assert len(corners_of(model, 1)) == 36


def test_labels_names_rooms_and_relations(read):
    some = box([0, 0, 0], [1, 1, 1])
    nodes = [
        thing(0, 3, "my chair", some, metadata={"colour": "red", "weight": 3, "list": []}),
        thing(1, 99, "O(1)", some),
        thing(2, (1 << 32) - 1, "thing from afar", some),
        other("p", 3),
        other("R", 4, "kitchen"),
        other("B", 5, "house"),
    ]
    edges = [
        edge(("R", 0), ("p", 0)),
        edge(("O", 1), ("p", 0)),
        edge(("R", 0), ("O", 0)),
        edge(("B", 0), ("R", 0)),
        edge(("O", 0), ("O", 1), relation="next to"),
        edge(("O", 1), ("O", 2)),
    ]
    model = read(graph(nodes, edges))
    first, second, third = model.objects
    assert (first.label, first.name) == ("chair", "my chair")
    assert first.attributes == {"room": "kitchen", "colour": "red", "weight": "3"}
    assert (second.label, second.attributes) == ("label 99", {"room": "kitchen"})
    assert (third.label, third.attributes) == ("thing from afar", {})
    assert model.relations == ((0, "next to", 1),)
    assert model.left_out["edges between objects without a relation's name"] == 1
    assert model.left_out["labels without a name"] == 1


def test_agents_and_dynamic_layers_are_no_objects(read):
    agent = {"type": "AgentNodeAttributes", "position": [0.0] * 3, "world_R_body": IDENTITY}
    node = {"id": node_id("a", 0), "layer": 2, "partition": 97, "attributes": agent}
    model = read(graph([node, thing(0, 3, bounds=box([0, 0, 0], [1, 1, 1]))]))
    assert [t.id for t in model.objects] == ["O0"]


def test_version_1_0_as_hydra_saved_it(read):
    old = thing(0, 3, "chair")
    old["attributes"]["bounding_box"] = {
        "type": "AABB", "min": [0, 0, 0], "max": [2, 2, 2], "world_P_center": [0, 0, 0],
        "world_R_center": IDENTITY,
    }  # fmt: skip
    old["attributes"]["color"] = [1, 2, 3]
    vertices = [dict(zip("xyzrgb", (*p, 1, 2, 3), strict=True)) for p in POINTS]
    linked = [{"source": node_id("O", 0), "target": row} for row in (3, 4, 5)]
    content = graph(
        [old],
        layer_ids=[2, 3, 4, 5],
        mesh={"vertices": vertices, "faces": FACES},
        mesh_edges=linked,
    )
    for key in ("SPARK_DSG_header", "layer_keys", "layer_names", "metadata"):
        del content[key]
    model = read(content)
    assert [(t.label, t.name) for t in model.objects] == [("chair", "chair"), ("unknown", "")]
    assert corners_of(model, 0).tolist() == POINTS[3:6]
    del content["mesh"]
    assert corners_of(read(content), 0).min(axis=0).tolist() == [0, 0, 0]
    assert corners_of(read(content), 0).max(axis=0).tolist() == [2, 2, 2]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"SPARK_DSG_header": header(2, 0, 0)}, "2.0.0 of Spark-DSG, but only 1.x"),
        ({"SPARK_DSG_header": {}}, "is damaged"), ({"nodes": {}}, "no nodes"),
        ({"nodes": [3]}, "is damaged"), ({"nodes": [{"id": 1, "layer": 2}]}, "is damaged"),
        ({"edges": [{"source": 1}]}, "is damaged"),
        ({"metadata": {"labelspaces": {"_l2p0": [3]}}}, "is damaged"),
        ({"mesh": mesh([7] * 9) | {"faces": [[0, 1, 9]]}}, "outside 0 to 8"),
        ({"mesh": mesh([7] * 9) | {"points": [[1, 2]]}}, "is damaged"),
    ],
)  # fmt: skip
def test_nonsense_is_refused(read, change, sentence):
    nodes = [thing(0, 3, bounds=box([0, 0, 0], [1, 1, 1]))]
    with pytest.raises(InputError, match=sentence):
        read(graph(nodes) | change)


def test_boxes_that_are_none(read):
    zero = dict.fromkeys("wxyz", 0.0)
    boxes = [
        box([0, 0, 0], [0, 0, 0]),
        box([0, 0, 0], [1, -1, 1]),
        box([None, 0, 0], [1, 1, 1]),
        box([0, 0, 0], [1, 1, 1], "OBB", zero),
        box([0, 0, 0], [1, 1, 1], None),
    ]
    model = read(graph([thing(i, 3, bounds=b) for i, b in enumerate(boxes)]))
    assert model.left_out["objects without a mesh or box"] == len(boxes)


def test_other_json_is_no_scene_graph(tmp_path):
    path = tmp_path / "a.json"
    for text in ('{"nodes": []}', '[{"id": 3}]', "", '{"objects": "EdgeAttributes of none"}'):
        path.write_text(text)
        assert not is_spark_dsg(path)
    assert not is_spark_dsg(tmp_path)
    assert not is_spark_dsg(tmp_path / "no.json")
    assert not is_spark_dsg("a\0.json")
    with pytest.raises(InputError, match="does not exist"):
        read_spark_dsg(tmp_path / "no.json")


def test_a_huge_file_is_refused_before_it_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(spark_dsg, "LARGEST", 10)
    path = tmp_path / "a.json"
    path.write_text(json.dumps(graph([])))
    with pytest.raises(InputError, match="include_mesh=False"):
        read_spark_dsg(path)


def drawn(objects=3):
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
    vertices = np.concatenate([points[:1], *(points[1:] + k for k in range(objects))])
    faces = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)])
    return Model(
        path=Path("drawn"),
        objects=tuple(
            ModelObject(
                f"id {k}", ("chair", "table")[k % 2], f"näme {k}", {"room": "hall", "n": str(k)}
            )
            for k in range(objects)
        ),
        vertices=vertices,
        triangles=np.concatenate([np.where(faces == 0, 0, faces + 3 * k) for k in range(objects)]),
        object_of=np.repeat(np.arange(objects), 4),
        colours=np.arange(3 * len(vertices)).reshape(-1, 3).astype(np.uint8),
        uv=np.zeros((len(vertices), 2)),
        picture_of=np.zeros(4 * objects, np.int64),
        pictures=(Texture(None),),
        relations=((0, "on", 1), (1, "below", 0), (1, "next to", 2)),
        floor=-0.25,
    )


def test_there_and_back(tmp_path):
    model = drawn()
    path = tmp_path / "ours.json"
    path.write_bytes(encode_spark_dsg(model, ["hall"] * 3, note={"floor": -0.25}))
    assert is_spark_dsg(path)
    back = read_spark_dsg(path)
    assert back.objects == model.objects
    assert sorted(back.relations) == sorted(model.relations)
    assert back.floor == -0.25
    assert not back.left_out
    for row in range(3):
        assert corners_of(back, row) == pytest.approx(corners_of(model, row), abs=1e-6)
        ours, theirs = (m.colours[m.triangles[m.object_of == row]] for m in (model, back))
        assert (ours == theirs).all()


def test_the_layout_is_the_one_of_1_1_3():
    poses = np.stack([np.eye(4)] * 2)
    content = json.loads(
        encode_spark_dsg(drawn(), ["a", "b", "a"], camera_paths={"walk": poses, "run": poses})
    )
    assert next(iter(content)) == "SPARK_DSG_header"
    kinds = [n["attributes"]["type"] for n in content["nodes"]]
    assert (
        kinds
        == ["ObjectNodeAttributes"] * 3 + ["RoomNodeAttributes"] * 2 + ["AgentNodeAttributes"] * 4
    )
    saved = thing(0, 3)["attributes"].keys()
    assert content["nodes"][0]["attributes"].keys() == saved
    names = [node_name(n["id"]) for n in content["nodes"]]
    assert names == ["O0", "O1", "O2", "R0", "R1", "a0", "a1", "b0", "b1"]
    links = [(node_name(e["source"]), node_name(e["target"])) for e in content["edges"]]
    assert links == [
        ("O0", "O1"), ("O1", "O2"),  # one edge a pair
        ("R0", "O0"), ("R0", "O2"), ("R1", "O1"), ("a0", "a1"), ("b0", "b1"),
    ]  # fmt: skip
    keys = [(k["layer"], k["partition"]) for k in content["layer_keys"]]
    assert keys == [(2, 0), (2, 97), (2, 98), (3, 0), (4, 0), (5, 0)]
    owned = [n["attributes"]["mesh_connections"] for n in content["nodes"][:3]]
    assert sorted(v for own in owned for v in own) == list(range(len(content["mesh"]["points"])))
    space = dict(content["metadata"]["labelspaces"]["_l2p0"])
    for node, own in zip(content["nodes"], owned, strict=False):
        label = node["attributes"]["semantic_label"]
        assert space[label] in {"chair", "table"}
        assert {content["mesh"]["labels"][v] for v in own} == {label}


def test_a_thing_without_triangles_is_written_without_a_box(tmp_path):
    model = drawn()
    model = replace(model, objects=(*model.objects, ModelObject("bare", "ghost")))
    path = tmp_path / "ours.json"
    path.write_bytes(encode_spark_dsg(model, ["hall"] * 4))
    back = read_spark_dsg(path)
    assert back.objects == model.objects
    assert back.left_out == {"objects without a mesh or box": 1}


@given(st.integers(0, 4000), st.data())
def test_truncated_and_damaged_files_end_in_an_input_error(tmp_path_factory, at, data):
    whole = encode_spark_dsg(drawn(), ["hall"] * 3)
    path = tmp_path_factory.mktemp("dsg") / "a.json"
    path.write_bytes(whole[: min(at, len(whole) - 1)])
    with pytest.raises(InputError, match=r"a\.json"):
        read_spark_dsg(path)
    path.write_bytes(data.draw(damaged(whole)))
    with suppress(InputError):
        read_spark_dsg(path)


@given(any_json(
    "nodes", "edges", "id", "layer", "attributes", "bounding_box", "mesh", "faces", "points",
    "metadata", "source", "target", "info", "type", "semantic_label",
))  # fmt: skip
def test_any_json_ends_in_a_model_or_an_input_error(tmp_path_factory, value):
    path = tmp_path_factory.mktemp("dsg") / "a.json"
    for content in (value, {"nodes": [value]}, {"nodes": [], "edges": [value], "mesh": value}):
        path.write_text(json.dumps(content))
        with suppress(InputError):
            read_spark_dsg(path)


def test_the_folder_that_hydra_logged_to(tmp_path):
    nodes = [thing(0, 3, mesh_connections=[3, 4, 5], bounds=box([0, 0, 0], [1, 1, 1]))]
    (tmp_path / "backend").mkdir()
    (tmp_path / "backend/dsg.json").write_text(json.dumps(graph(nodes)))
    assert is_spark_dsg(tmp_path)
    assert len(read_spark_dsg(tmp_path).triangles) == 12
    (tmp_path / "backend/dsg_with_mesh.json").write_text(
        json.dumps(graph(nodes, mesh=mesh([7] * 9)))
    )
    assert len(read_spark_dsg(tmp_path).triangles) == 3
    assert not is_spark_dsg(tmp_path / "backend/nothing")
