import json

import numpy as np
import pytest

from placegraph.core import files as locks
from placegraph.errors import MapError, MapLockedError, OptionError
from placegraph.indoor.build import build_scene, scene_of_model
from placegraph.indoor.map.mesh import GRAIN, Mesh
from placegraph.indoor.mapping.export import MARK, export, list_losses, paint_vertices
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.scene_map import SceneMap
from placegraph_io.graphs.spark_dsg import read_spark_dsg


@pytest.fixture
def way():
    poses = np.stack([np.eye(4)] * 5)
    poses[:, 0, 3] = np.linspace(0, 2, 5)
    return poses


def same(one, other, *, names=True):
    assert one.graph.ids == other.graph.ids
    assert one.graph.labels == other.graph.labels
    assert not names or one.graph.names == other.graph.names
    assert one.attributes == other.attributes
    assert one.floors == pytest.approx(other.floors, abs=GRAIN)
    assert len(one.mesh) == len(other.mesh)
    for row in range(len(one)):
        corners = [
            np.sort(m.vertices[m.triangles[m.object_of == row]].reshape(-1, 3), axis=0)
            for m in (one.mesh, other.mesh)
        ]
        assert np.abs(corners[0] - corners[1]).max() <= GRAIN


def test_glb_there_and_back(room, tmp_path, way):
    path = tmp_path / "room.glb"
    assert export(room, path, camera_paths={"walk": way}) == (path,)
    back = build_scene(path, None, detail="full")
    same(back, room)
    third = np.full(len(room.mesh), 1 / 3, np.float32)
    rows = np.arange(len(room.mesh), dtype=np.int32)
    ours, theirs = (m.colour_at(rows, third, third).astype(int) for m in (room.mesh, back.mesh))
    assert np.abs(ours - theirs).mean() < 4
    assert b"EXT_texture_webp" not in path.read_bytes()  # which some programs do not know


def test_ply_and_its_labels_there_and_back(room, tmp_path):
    path = tmp_path / "room.ply"
    files = export(room, path)
    assert [f.name for f in files] == ["room.ply", "room.labels.json"]
    same(build_scene(path, None, labels=files[1], detail="full"), room)


def test_spark_dsg_there_and_back(room, tmp_path, way):
    path = tmp_path / "room.json"
    export(room, path, camera_paths={"walk": way, "again": way})
    model = read_spark_dsg(path)
    assert not model.left_out
    assert len(model.relations) == len(room.graph.relations)
    same(scene_of_model(model, detail="full"), room)
    nodes = json.loads(path.read_text())["nodes"]
    assert [n["attributes"]["name"] for n in nodes if n["layer"] == 4] == ["study"]
    assert sum(n["partition"] != 0 for n in nodes) == 10


def plain_map(ids=("0", "1"), colours=None, relation="on", **more):
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 1)]
    mesh = Mesh.plain(corners, [(0, 1, 2), (0, 2, 3)], [0, 1], colours)
    relations = [(1, relation, 0)]
    return SceneMap.create(mesh, ids, ["floor", "ramp"], floor=0.0, relations=relations, **more)


def test_vertex_colours_without_textures_are_exact(tmp_path):
    colours = np.arange(12).reshape(4, 3) * 20
    scene = plain_map(colours=colours)
    for ending in ("glb", "ply", "json"):
        path = tmp_path / f"a.{ending}"
        export(scene, path)
        if ending == "json":
            back = read_spark_dsg(path)
        else:
            back = build_scene(path, None, floor=0.0, detail="full").mesh
        owner = back.object_of
        for row, corners in enumerate(([0, 1, 2], [0, 2, 3])):
            (triangle,) = back.triangles[owner == row]
            assert (back.colours[triangle] == colours[corners]).all()


TAKEN = {"label": "of a shop", "id": "EAN 4", "placegraph": "mine", "name": "n", "map id": "5"}


def odd_map(ids):
    names, attributes = ["", "ramp"], [TAKEN, {}]
    return plain_map(ids, relation="leads to", names=names, attributes=attributes)


@pytest.mark.parametrize("ending", ["glb", "ply", "json"])
def test_attributes_of_any_name_come_back(ending, tmp_path):
    scene = odd_map(("7", "8"))
    files = export(scene, tmp_path / f"a.{ending}")
    if ending == "json":
        back = scene_of_model(read_spark_dsg(files[0]), detail="full")
    else:
        labels = files[1] if ending == "ply" else None
        back = build_scene(files[0], None, labels=labels, floor=0.0, detail="full")
    same(back, scene)
    assert ("leads to" in back.graph.relations) == (ending != "ply")
    assert any("Relations (1)" in said for said in list_losses(scene, files[0])) == (
        ending == "ply"
    )
    if ending == "ply":  # an id that becomes a number takes no attribute's place
        files = export(odd_map(("sofa/1", "8")), tmp_path / "b.ply")
        back = build_scene(files[0], None, labels=files[1], floor=0.0)
        assert back.attributes[back.graph.ids.index("9")] == TAKEN | {"map map id": "sofa/1"}
        export(plain_map(("7", "sofa/1")), tmp_path / "c.ply")
        told = json.loads((tmp_path / "c.labels.json").read_text())
        assert told["written by"] == MARK
        assert [entry["id"] for entry in told["objects"]] == [7, 8]
        assert told["objects"][1]["attributes"] == {"id": "sofa/1"}


def test_a_node_that_was_renamed_has_its_new_name(tmp_path):
    export(odd_map(("7", "8")), tmp_path / "a.glb")
    data = (tmp_path / "a.glb").read_bytes()
    for other, name in ((b'{"name":"floo2"', "floo2"), (b'{"name":"floor"', "")):
        (tmp_path / "b.glb").write_bytes(data.replace(b'{"name":"floor"', other))
        assert build_scene(tmp_path / "b.glb", None, floor=0.0).graph.names[0] == name


def test_merged_scenes_become_rooms(tmp_path):
    scene = merge_scenes({"one": plain_map(), "two": plain_map()})
    export(scene, tmp_path / "a.json")
    content = json.loads((tmp_path / "a.json").read_text())
    rooms = [n["attributes"]["name"] for n in content["nodes"] if n["layer"] == 4]
    assert rooms == list(scene.scenes)
    assert read_spark_dsg(tmp_path / "a.json").floor is None
    export(scene, tmp_path / "a.glb")
    back = build_scene(tmp_path / "a.glb", None, floor=0.0)
    assert back.graph.ids == scene.graph.ids


def test_what_it_did_not_write_stays(tmp_path):
    scene = plain_map()
    for name in ("a.glb", "a.ply", "a.json"):
        path = tmp_path / name
        path.write_text("a work of years")
        with pytest.raises(OptionError, match=f"{name} exists"):
            export(scene, path)
        assert path.read_text() == "a work of years"
        export(scene, path, overwrite=True)
        again = export(scene, path)  # now it is its own
        assert all(MARK.encode() in f.read_bytes()[:4096] for f in again)
    (tmp_path / "a.labels.json").write_text("[]")
    with pytest.raises(OptionError, match=r"a\.labels\.json exists"):
        export(scene, tmp_path / "a.ply")
    assert not list(tmp_path.glob(".*"))


def test_where_it_cannot_be_written(tmp_path):
    scene = plain_map()
    with pytest.raises(OptionError, match=r"unknown ending; choose \.glb, \.ply, \.json"):
        export(scene, tmp_path / "a.obj")
    with pytest.raises(MapError, match="cannot be written"):
        export(scene, tmp_path / "no" / "a.glb")
    (tmp_path / "b.glb").mkdir()
    with pytest.raises(MapError, match="not a regular file"):
        export(scene, tmp_path / "b.glb")
    with locks.lock_file(tmp_path / "a.glb"), pytest.raises(MapLockedError):
        export(scene, tmp_path / "a.glb")


def test_camera_paths_that_do_not_fit(tmp_path, way):
    scene = plain_map()
    with pytest.raises(OptionError, match="cannot store them"):
        export(scene, tmp_path / "a.ply", camera_paths={"walk": way})
    for poses in (way[0], way[:0], way * np.nan, [[1]]):
        with pytest.raises(OptionError, match="walk"):
            export(scene, tmp_path / "a.glb", camera_paths={"walk": poses})
    with pytest.raises(OptionError, match="27"):
        export(scene, tmp_path / "a.json", camera_paths={str(k): way for k in range(27)})
    assert not list(tmp_path.iterdir())


def quad(texture, colours=255):
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    mesh = Mesh(
        vertices=np.column_stack([corners, np.zeros(4)]).astype(np.float32),
        triangles=np.array([(0, 1, 2), (0, 2, 3)], np.int32),
        object_of=np.zeros(2, np.int32),
        colours=np.full((4, 3), colours, np.uint8),
        uv=(corners * 0.999).astype(np.float32),
        texture_of=np.zeros(2, np.int32),
        textures=(np.asarray(texture, np.uint8),),
    )
    return SceneMap.create(mesh, ["0"], ["floor"], floor=0.0)


def test_a_vertex_has_the_colours_around_it_times_its_own():
    model = paint_vertices(quad(np.full((8, 8, 3), (10, 100, 200)), colours=51))
    assert (model.colours == [2, 20, 40]).all()
    halves = np.zeros((64, 64, 3))
    halves[:, 32:] = 200  # bright where x is large
    model = paint_vertices(quad(halves))
    bright = model.colours[:, 0].astype(int)
    left = model.vertices[:, 0] < 0.5
    assert bright[left].max() < 80
    assert bright[~left].min() > 120
