import io
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tests.io.damage import DAMAGE, any_json, damaged, refusing
from tests.io.writers import ply

from placegraph.errors import InputError, OptionError
from placegraph_io.dataset.scan3r import is_scan3r, read_rooms, read_scan3r

REFERENCE = "0cac7578-8d6f-2d13-8c2d-bfa7a04f8af3"
RESCAN = "ddc73793-765b-241a-9f9e-e1d7f4d1c1fe"
HIDDEN = "6bde60cb-9162-246f-8cf5-d04f7426e56f"
LABELLED = dict.fromkeys("xyz", "float") | dict.fromkeys(("red", "green", "blue"), "uchar")
LABELLED |= dict.fromkeys(("objectId", "globalId"), "ushort")
LABELLED |= dict.fromkeys(("NYU40", "Eigen13", "RIO27"), "uchar")
# a floor of 4 x 4 m, a box of 0.5 m on it, and a lamp at its side that nobody named
PATCHES = {
    1: [(0, 0, 0), (4, 0, 0), (4, 4, 0), (0, 4, 0)],
    2: [(1, 1, 0.5), (1.5, 1, 0.5), (1.5, 1.5, 0.5), (1, 1.5, 0.5)],
    9: [(3, 3, 1), (3.1, 3, 1), (3.1, 3.1, 1), (3, 3.1, 1)],
}
MOVED = np.array([[0, -1, 0, 2.0], [1, 0, 0, 0.5], [0, 0, 1, 0], [0, 0, 0, 1]])
ALIGN = np.array([[0, 1, 0, -1.5], [-1, 0, 0, 3.25], [0, 0, 1, 0.125], [0, 0, 0, 1]])


def columns(matrix):
    return np.asarray(matrix, float).T.ravel().tolist()


def rooms_content():
    move = {"instance_reference": 2, "instance_rescan": 2, "symmetry": 1}
    rescan = {
        "reference": RESCAN, "transform": columns(ALIGN), "nonrigid": [5], "removed": [7, 8],
        "rigid": [move | {"transform": columns(MOVED)}],
    }  # fmt: skip
    return [
        {"reference": REFERENCE, "type": "validation", "ambiguity": [], "scans": [rescan]},
        {"reference": "other", "type": "test", "scans": [{"reference": HIDDEN}]},
    ]


class ScanFolder:
    def __init__(self, root, scan=RESCAN):
        self.root = root
        self.path = root / scan
        self.path.mkdir(parents=True, exist_ok=True)
        self.points = np.array([p for patch in PATCHES.values() for p in patch], float)
        self.faces = [
            [4 * i + a, 4 * i + b, 4 * i + c]
            for i in range(3)
            for a, b, c in ((0, 1, 2), (0, 2, 3))
        ]
        self.ids = np.repeat(list(PATCHES), 4)
        self.scan = scan

    def write(self):
        self.write_mesh()
        self.write_labels()
        groups = [
            {"id": i, "objectId": i, "label": label, "segments": [10 * i], "obb": {}}
            for i, label in ((1, "floor"), (2, "box"))
        ]
        content = {"scan_id": self.scan, "segGroups": groups}
        self.write_json(self.path / "semseg.v2.json", content)
        floor = {"global_id": "6", "label": "floor", "ply_color": "#aec7e8", "id": "1"}
        seen = {"color": ["dark", "gray"], "shape": ["square"], "state": []}
        crate = {"label": "crate", "id": "2", "attributes": seen}
        crate["affordances"] = ["placing items on"]
        self.annotate("objects", [floor | {"attributes": {}}, crate])
        on = [2, 1, 14, "standing on"]
        self.annotate("relationships", [on, [2, 1, 0, "none"]], [[2, 77, 4, "left"], on])
        self.write_json(self.root / "3RScan.json", rooms_content())
        return self.path

    def annotate(self, name, *parts):
        other = {"scan": "another process", "objects": [], "relationships": []}
        scans = [other, *({name: part, "scan": self.scan} for part in parts)]
        self.write_json(self.root / "3DSSG" / f"{name}.json", {"scans": scans})

    def write_mesh(self, points=None, name="mesh.refined.v2.obj"):
        points = self.points if points is None else points
        lines = ["mtllib mesh.refined.mtl"]
        lines += [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in points]
        lines += [f"vt {x / 4:.6f} {y / 4:.6f}" for x, y, _ in points]
        lines.append("usemtl mesh.refined_0")
        lines += ["f " + " ".join(f"{i + 1}/{i + 1}/{i + 1}" for i in face) for face in self.faces]
        (self.path / name).write_text("\n".join(lines) + "\n")
        (self.path / "mesh.refined.mtl").write_text(
            "newmtl mesh.refined_0\nKd 1.0 1.0 1.0\nmap_Kd mesh.refined_0.png\n"
        )
        file = io.BytesIO()
        Image.new("RGB", (4, 4), (200, 100, 50)).save(file, "PNG")
        (self.path / "mesh.refined_0.png").write_bytes(file.getvalue())

    def write_labels(self, order=None, name="labels.instances.annotated.v2.ply"):
        order = range(len(self.points)) if order is None else order
        rows = [(*self.points[i], 174, 199, 232, self.ids[i], 6, 2, 5, 4) for i in order]
        faces = ("face", {"vertex_indices": "uchar int"}, [(face,) for face in self.faces])
        (self.path / name).write_bytes(ply("ascii", ("vertex", LABELLED, rows), faces))

    @staticmethod
    def write_json(path, content):
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(content))


@pytest.fixture
def scan(tmp_path):
    folder = ScanFolder(tmp_path / "data")
    folder.write()
    return folder


def labels_of(model):
    return [model.objects[i].label for i in model.object_of.tolist()]


def test_labels_texture_attributes_relations(scan):
    assert is_scan3r(scan.path)
    model = read_scan3r(scan.path)
    assert labels_of(model) == ["floor"] * 2 + ["box"] * 2 + ["unknown"] * 2
    assert [t.id for t in model.objects] == ["1", "2", "unknown"]
    box = model.objects[1]
    seen = {"color": "dark, gray", "shape": "square", "affordances": "placing items on"}
    assert box.attributes == seen
    assert model.relations == ((1, "standing on", 0),)
    assert Image.open(io.BytesIO(model.pictures[model.picture_of[0]].data)).size == (4, 4)
    corner = model.triangles[2, 1]  # (1.5, 1) of the box
    assert model.uv[corner] == pytest.approx((0.375, 0.75))
    assert (model.colours == 255).all()  # the colours of labels are none
    assert model.left_out == {"relations of missing objects": 1}
    assert np.allclose(model.vertices, scan.points)


def test_another_order_takes_the_nearest_labels(scan):
    order = np.random.default_rng(0).permutation(12)
    scan.write_labels(order=[*order, *order])
    model = read_scan3r(scan.path)
    assert labels_of(model) == ["floor"] * 2 + ["box"] * 2 + ["unknown"] * 2
    assert (
        model.left_out["vertices labelled like their nearest neighbour, because the meshes differ"]
        == 12
    )


def test_the_same_order_tells_coincident_vertices_apart(scan):
    scan.points[4:8] = scan.points[0:4]
    scan.write()
    assert labels_of(read_scan3r(scan.path))[:4] == ["floor"] * 2 + ["box"] * 2


def test_what_no_label_is_near_is_unknown_and_all_of_it_refused(scan):
    points = scan.points.copy()
    points[4:8, 2] += 0.2
    scan.write_mesh(points)
    model = read_scan3r(scan.path)
    assert labels_of(model)[2:4] == ["unknown"] * 2
    assert model.left_out["vertices without a label within 0.05 m"] == 4
    scan.write_mesh(scan.points + np.array([0, 0, 1]))
    with pytest.raises(InputError, match="do not coincide: 100%"):
        read_scan3r(scan.path)


def test_segments_in_place_of_the_annotated_mesh(scan):
    (scan.path / "labels.instances.annotated.v2.ply").unlink()
    segments = scan.path / "mesh.refined.0.010000.segs.v2.json"
    scan.write_json(segments, {"segIndices": (10 * scan.ids).tolist()})
    assert labels_of(read_scan3r(scan.path)) == ["floor"] * 2 + ["box"] * 2 + ["unknown"] * 2
    scan.write_json(segments, {"segIndices": (10 * scan.ids).tolist()[1:]})
    with pytest.raises(InputError, match=r"labels 11 vertices, but .* has 12"):
        read_scan3r(scan.path)
    segments.unlink()
    with pytest.raises(InputError, match="has a mesh, but no labels"):
        read_scan3r(scan.path)


def test_labels_without_the_textured_mesh(scan):
    (scan.path / "mesh.refined.v2.obj").unlink()
    model = read_scan3r(scan.path)
    assert labels_of(model) == ["floor"] * 2 + ["box"] * 2 + ["unknown"] * 2
    assert (model.colours == 255).all()
    assert model.left_out["colours; add mesh.refined.v2.obj to have them"] == 1
    (scan.path / "labels.instances.annotated.v2.ply").unlink()
    with pytest.raises(InputError, match=r"has no mesh; download mesh\.refined"):
        read_scan3r(scan.path)
    assert not is_scan3r(scan.path)


def test_names_of_objects_from_either_file(scan):
    (scan.root / "3DSSG" / "objects.json").rename(scan.root / "objects.json")
    (scan.path / "semseg.v2.json").unlink()
    assert labels_of(read_scan3r(scan.path))[2] == "crate"
    (scan.root / "objects.json").unlink()
    with pytest.raises(InputError, match=r"semseg.v2.json.*lists the objects of the scan ddc73793"):
        read_scan3r(scan.path)


def test_braces_in_names_mislead_nobody(scan):
    path = scan.root / "3DSSG" / "objects.json"
    content = json.loads(path.read_text())
    content["scans"][1]["objects"][1]["affordances"] = ["}}{", "{"]
    scan.write_json(path, content)
    assert read_scan3r(scan.path).objects[1].attributes["affordances"] == "}}{, {"
    path.write_text(path.read_text()[:-2])
    with pytest.raises(InputError, match=r"objects\.json is not JSON"):
        read_scan3r(scan.path)
    scan.write()
    scan.annotate("relationships", 3)
    with pytest.raises(InputError, match=r"`relationships` of .* is not a list"):
        read_scan3r(scan.path)


def test_without_3dssg_and_in_the_reference_frame(scan, tmp_path):
    model = read_scan3r(scan.path, annotations=tmp_path)
    assert labels_of(model)[2] == "box"
    assert not model.relations
    assert len(model.left_out) == 2
    expected = scan.points @ ALIGN[:3, :3].T + ALIGN[:3, 3]
    assert np.allclose(read_scan3r(scan.path, reference_frame=True).vertices, expected)


def test_the_first_version(tmp_path):
    folder = ScanFolder(tmp_path / "data")
    folder.write_mesh(name="mesh.refined.obj")
    folder.write_labels(name="labels.instances.annotated.ply")
    groups = [{"objectId": 1, "id": 1, "label": "floor", "segments": []}]
    folder.write_json(folder.path / "semseg.json", {"segGroups": groups})
    assert labels_of(read_scan3r(folder.path)) == ["floor"] * 2 + ["unknown"] * 4


def test_moves_undone(scan):
    scan.faces[0][0] = scan.faces[1][0] = 4  # a corner of the box is one of the floor, too
    scan.write()
    model = read_scan3r(
        scan.path, reference_frame=True, undo_moves=True, rooms=scan.root / "3RScan.json"
    )
    aligned = scan.points @ ALIGN[:3, :3].T + ALIGN[:3, 3]
    back = np.linalg.inv(MOVED)
    box = scan.points[4:8] @ back[:3, :3].T + back[:3, 3]
    corners = model.vertices[model.triangles]
    assert np.allclose(corners[2], box[:3])
    assert np.allclose(corners[0], aligned[scan.faces[0]])
    assert model.uv[model.triangles[2, 1]] == pytest.approx((0.375, 0.75))
    with pytest.raises(OptionError, match="undo_moves"):
        read_scan3r(scan.path, undo_moves=True)


def test_rooms(scan):
    rooms = read_rooms(scan.root / "3RScan.json")
    room = rooms.room_of(RESCAN)
    assert (room.reference, room.kind) == (REFERENCE, "validation")
    assert [s.id for s in room.scans] == [REFERENCE, RESCAN]
    assert np.array_equal(rooms.reference_from(REFERENCE), np.eye(4))
    rescan = rooms.scan(RESCAN)
    assert (rescan.nonrigid, rescan.removed) == (("5",), ("7", "8"))
    (move,) = rescan.moves
    assert (move.reference_id, move.scan_id, move.symmetry) == ("2", "2", 1)
    assert np.allclose(move.scan_from_reference, MOVED)
    with pytest.raises(InputError, match="has no transform for the rescan 6bde60cb"):
        rooms.reference_from(HIDDEN)
    with pytest.raises(InputError, match="has no scan 'x'"):
        rooms.room_of("x")


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (ALIGN.T, "not rigid"), (ALIGN + np.eye(4, k=3) * 2000, "in millimetres"),
        (np.full((4, 4), np.inf), "not rigid"), (ALIGN[:3], "not 16 numbers"),
    ],
)  # fmt: skip
def test_matrices_that_cannot_be(scan, matrix, message):
    content = rooms_content()
    content[0]["scans"][0]["transform"] = columns(matrix)
    scan.write_json(scan.root / "3RScan.json", content)
    with pytest.raises(InputError, match=message):
        read_scan3r(scan.path, reference_frame=True)


def test_rooms_are_looked_for(scan):
    (scan.root / "3RScan.json").unlink()
    with pytest.raises(InputError, match=r"no 3RScan.json nearby"):
        read_scan3r(scan.path, reference_frame=True)
    with pytest.raises(InputError, match="is not the folder"):
        read_scan3r(scan.root / "none")
    assert not is_scan3r(scan.root)


FILES = (
    "labels.instances.annotated.v2.ply", "semseg.v2.json", "mesh.refined.v2.obj", "mesh.refined.mtl",
    "../3DSSG/objects.json", "../3DSSG/relationships.json", "../3RScan.json",
)  # fmt: skip


@given(name=st.sampled_from(FILES), data=st.data())
@DAMAGE
def test_only_input_errors_of_spoilt_files(tmp_path, name, data):
    folder = ScanFolder(tmp_path / "data")
    folder.write()
    path = folder.path / name
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    with refusing():
        model = read_scan3r(folder.path, reference_frame=True, undo_moves=True)
        assert len(model.object_of) == len(model.triangles)


@given(any_json("reference", "scans", "transform", "rigid", "type", "removed", "symmetry"))
@DAMAGE
def test_rooms_of_any_json(tmp_path, content):
    path = tmp_path / "3RScan.json"
    path.write_text(json.dumps(content))
    with refusing():
        assert all(room.scans[0].id == room.reference for room in read_rooms(path).rooms)
