import contextlib
import json
from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.indoor.mapping.parts import cuboid, subdivided
from tests.io.damage import DAMAGE, any_json

from placegraph.core.geometry import rotation_z
from placegraph.errors import InputError, PlacegraphError
from placegraph.indoor.build import build_scene
from placegraph.io.mesh.ply import write_ply
from placegraph.maps import open_map, open_scene
from placegraph_io.graphs.conceptgraphs import is_conceptgraphs, read_conceptgraphs

SIZES = {"table": (1.6, 0.8, 0.7), "shelf": (0.4, 1.2, 1.9), "stool": (0.4, 0.4, 0.5)}
PLACES = {
    "table": (2.0, 1.5, 0.35, 0.5),
    "shelf": (4.5, 3.0, 0.95, 1.2),
    "stool": (1.0, 3.5, 0.25, 0.0),
}
"""x, y, z [m] of the middle, yaw."""


def grid(size):
    points, triangles = cuboid(np.full(3, -0.5), np.full(3, 0.5))
    for _ in range(4):
        points, triangles = subdivided(points, triangles)
    return points * size, triangles


def write(folder, *, turned=True, mesh=True):
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(0)
    objects, parts, of = {}, [], []
    for i, (label, size) in enumerate(SIZES.items()):
        x, y, z, yaw = PLACES[label]
        yaw = yaw if turned else 0.0
        points, faces = grid(np.array(size))
        parts.append((points @ rotation_z(yaw).T + (x, y, z), faces))
        of.append(np.full(len(faces), i))
        extent = rng.permutation(size) if turned else np.array(size)
        objects[f"object_{i + 1}"] = {
            "id": 7 * i, "object_tag": label, "object_caption": f"A wooden {label}." if i else None,
            "bbox_extent": extent.round(2).tolist(), "bbox_center": [x, y, round(z, 2)],
            "bbox_volume": round(float(np.prod(size)), 2),
        }  # fmt: skip
    floor, faces = grid(np.array([6.0, 5.0, 0.02]))
    parts.append((floor + np.array([3.0, 2.5, -0.01]), faces))
    of.append(np.full(len(faces), len(SIZES)))
    edges = {
        "edge_0": {"edge_id": 0, "edge_description": "stool next to table", "num_detections": 3,
                   "object_1_id": 14, "object_1_tag": "stool", "object_2_id": 0, "object_2_tag": "table",
                   "relationship": "next to"},
        "edge_1": {"edge_id": 1, "object_1_id": 99, "object_2_id": 0, "relationship": "on"},
    }  # fmt: skip
    (folder / "obj_json_run1.json").write_text(json.dumps(objects))
    (folder / "edge_json_run1.json").write_text(json.dumps(edges))
    (folder / "pcd_run1.pkl.gz").write_bytes(b"a pickle")
    kind = "overlap" if turned else "iou"
    (folder / "config_params.json").write_text(json.dumps({"spatial_sim_type": kind}))
    if mesh:
        starts = np.cumsum([0, *(len(p) for p, _ in parts)])
        vertices = np.concatenate([p for p, _ in parts])
        triangles = np.concatenate([f + s for (_, f), s in zip(parts, starts, strict=False)])
        write_ply(
            folder / "mesh.ply", vertices, triangles, np.full((len(vertices), 3), 200, np.uint8)
        )
    return np.concatenate(of)


@pytest.mark.parametrize("turned", [True, False])
def test_a_mesh_lends_objects_their_shape(turned, tmp_path):
    of = write(tmp_path / "run", turned=turned)
    model = read_conceptgraphs(tmp_path / "run", mesh=tmp_path / "run/mesh.ply")
    assert [t.label for t in model.objects] == ["table", "shelf", "stool", "unknown"]
    assert [t.id for t in model.objects] == ["0", "7", "14", "mesh"]
    assert model.objects[1].attributes == {"caption": "A wooden shelf."}
    assert model.relations == ((2, "next to", 0),)
    assert model.left_out == {"edges without two objects and a relationship": 1}
    for row in range(3):
        assert (model.object_of[of == row] == row).mean() > 0.93, row
    floor = model.object_of[of == 3]
    assert (floor == 3).mean() > 0.9, "what stands on it takes little of the floor"


def test_boxes_where_there_is_no_mesh(tmp_path):
    write(tmp_path / "run", turned=False)
    model = read_conceptgraphs(tmp_path / "run/obj_json_run1.json")
    assert len(model.triangles) == 3 * 12
    corners = model.vertices[model.triangles[model.object_of == 1]].reshape(-1, 3)
    x, y, z, _ = PLACES["shelf"]
    np.testing.assert_allclose(
        (corners.min(axis=0) + corners.max(axis=0)) / 2, (x, y, z), atol=0.01
    )
    np.testing.assert_allclose(np.ptp(corners, axis=0), SIZES["shelf"], atol=0.01)
    assert "rotations of boxes" not in " ".join(model.left_out)
    write(tmp_path / "run")
    assert "rotations of boxes" in " ".join(read_conceptgraphs(tmp_path / "run").left_out)


def test_maps_of_it(tmp_path):
    write(tmp_path / "run")
    assert is_conceptgraphs(tmp_path / "run")
    left_out = Counter()
    mesh = tmp_path / "run/mesh.ply"
    room = build_scene(tmp_path / "run", None, reader={"mesh": mesh}, left_out=left_out)
    assert room.graph.labels == ("table", "shelf", "stool", "unknown")
    assert abs(room.floors[0]) < 0.03
    for rough in (open_map(tmp_path / "run"), open_scene(tmp_path / "run/obj_json_run1.json")):
        assert rough.graph.labels == ("table", "shelf", "stool")
        assert abs(rough.floors[0]) < 0.1


def test_a_world_with_y_up(tmp_path):
    write(tmp_path / "run", turned=False)
    file = tmp_path / "run/obj_json_run1.json"
    content = json.loads(file.read_text())
    for entry in content.values():
        x, y, z = entry["bbox_center"]
        entry["bbox_center"] = [x, z, -y]
        a, b, c = entry["bbox_extent"]
        entry["bbox_extent"] = [a, c, b]
    upright = read_conceptgraphs(tmp_path / "run")
    file.write_text(json.dumps(content))
    turned = read_conceptgraphs(tmp_path / "run", up="y")
    for row in range(3):
        ends = [np.sort(m.vertices[m.triangles[m.object_of == row]].reshape(-1, 3), axis=0)[[0, -1]]
                for m in (upright, turned)]  # fmt: skip
        np.testing.assert_allclose(*ends, atol=1e-9)


def test_pickles_are_never_opened(tmp_path):
    write(tmp_path / "run", mesh=False)
    (tmp_path / "run/obj_json_run1.json").unlink()
    assert is_conceptgraphs(tmp_path / "run")
    with pytest.raises(InputError, match=r"which are never opened.*save_obj_json"):
        open_scene(tmp_path / "run")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"bbox_center": [1, 2]}, "object_1: bbox_center is not a list of 3"),
        ({"bbox_extent": "wide"}, "bbox_extent is not"), ({"id": 7}, "id 7 occurs twice"),
    ],
)  # fmt: skip
def test_wrong_objects(change, says, tmp_path):
    write(tmp_path / "run", mesh=False)
    file = tmp_path / "run/obj_json_run1.json"
    content = json.loads(file.read_text())
    content["object_1"] |= change
    file.write_text(json.dumps(content))
    with pytest.raises(InputError, match=says):
        read_conceptgraphs(tmp_path / "run")
    file.write_text('{"object_1": 3}')
    with pytest.raises(InputError, match="must be a JSON object with id"):
        read_conceptgraphs(tmp_path / "run")


def test_a_mesh_of_elsewhere(tmp_path):
    write(tmp_path / "run")
    points, faces = grid(np.ones(3))
    write_ply(tmp_path / "far.ply", points + 50.0, faces, np.full((len(points), 3), 200, np.uint8))
    with pytest.raises(InputError, match=r"far\.ply has no triangle in any box"):
        read_conceptgraphs(tmp_path / "run", mesh=tmp_path / "far.ply")


FILES = ("obj_json_run1.json", "edge_json_run1.json", "config_params.json")
FIELDS = (
    "id", "object_tag", "object_caption", "bbox_extent", "bbox_center", "object_1_id", "relationship",
)  # fmt: skip


@DAMAGE
@given(
    name=st.sampled_from(FILES),
    field=st.sampled_from(FIELDS),
    value=any_json(),
    whole=st.booleans(),
)
def test_whatever_stands_in_it(tmp_path, name, field, value, whole):
    write(tmp_path / "run", mesh=False)
    file = tmp_path / "run" / name
    content = json.loads(file.read_text())
    first = next(iter(content.values()))
    if whole or not isinstance(first, dict):
        content = value
    else:
        first[field] = value
    file.write_text(json.dumps(content))
    with contextlib.suppress(PlacegraphError):
        read_conceptgraphs(tmp_path / "run")
