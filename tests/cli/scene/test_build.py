"""`placegraph scene build` and `info`: one sentence for people, JSON for machines, nothing half done."""

import json
import os
import resource

import numpy as np
import pytest
from tests.cli.failing import fails

from placegraph.core.mapfile import map_writer
from placegraph.io.mesh.ply import write_ply

PLY = """ply
format ascii 1.0
element vertex 7
property float x
property float y
property float z
property int objectId
element face 3
property list uchar int vertex_indices
end_header
0 0 1 1
4 0 1 1
4 4 1 1
0 4 1 1
1 1 2 2
2 1 2 2
2 2 2 5
4 0 1 2 3
3 4 5 6
3 4 4 5
"""


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "room.ply"
    path.write_text(PLY)
    return path


@pytest.fixture
def labels(tmp_path):
    path = tmp_path / "labels.json"
    path.write_text('{"1": "floor", "2": "table [/b]"}')
    return path


def test_build_and_info(run, ply, labels, tmp_path):
    out = tmp_path / "room.scene"
    result = run("scene", "build", ply, "-o", out, "--labels", labels)
    assert (result.code, result.err) == (0, "")
    assert result.out.startswith(f"{out}: 2 objects, 3 triangles, floor at 1.00 m, ")
    assert "Left out: 1 triangles without area." in result.out
    shown = run("scene", "info", out)
    assert shown.code == 0
    for word in ("room.ply", "table [/b] 1", "triangles", "floor"):
        assert word in shown.out
    told = run("scene", "info", out, "--json").json
    assert told["objects"] == 2
    assert told["labels"] == {"floor": 1, "table [/b]": 1}
    assert told["floor_m"] == [1.0]
    assert (told["low_m"], told["high_m"]) == ([0, 0, 1], [4, 4, 2])
    assert told["bytes"] == out.stat().st_size
    assert told["relations"] == {}


def test_build_as_json_and_in_silence(run, ply, tmp_path):
    out = tmp_path / "a.scene"
    told = run("scene", "build", ply, "-o", out, "--json")
    assert told.err == ""
    assert told.json["objects"] == 2
    assert told.json["left_out"] == {"triangles without area": 1}
    assert told.json["bytes"] == out.stat().st_size
    quiet = run("scene", "build", ply, "-o", out, "--quiet")
    assert (quiet.code, quiet.out, quiet.err) == (0, "", "")


def test_build_options(run, ply, tmp_path):
    out = tmp_path / "a.scene"

    def told(*options):
        return run("scene", "build", ply, "-o", out, "--json", *options).json

    assert told("--floor", "-2.5")["floor_m"] == [-2.5]
    assert told("--scale", "0.5")["high_m"] == [2, 2, 1]
    assert told("--up", "y", "--floor", "0")["low_m"] == [0, -2, 0]
    assert told("--object-property", "OBJECTID")["objects"] == 2
    fails(
        run("scene", "build", ply, "-o", out, "--object-property", "part"), 3, "'part'", "room.ply"
    )
    fails(run("scene", "build", ply, "-o", out, "--up", "x"), 7, "up is 'x'")
    fails(run("scene", "build", ply, "-o", out, "--detail", "huge"), 7, "detail is 'huge'", "tiny")
    fails(run("scene", "build", ply, "-o", out, "--error", "-1"), 7, "error is -1.0")
    fails(run("scene", "build", ply, "-o", out, "--texel", "nan"), 7, "texel is nan")
    fails(run("scene", "build", ply, "-o", out, "--frames", "one"), 7, "--frames", "10:20")
    fails(run("scene", "build", ply, "-o", out, "--frames", "::0"), 7, "--frames", "1 or more")
    for option in (("--frames", "1:2"), ("--voxel", "0.1"), ("--poses", "odometry")):
        fails(run("scene", "build", ply, "-o", out, *option), 7, "room.ply is no capture")
    fails(run("scene", "build", ply, "-o", out, "--reader", "x"), 7, "--reader", "name=value")
    fails(run("scene", "build", ply, "-o", out, "--reader", "x=1"), 7, "x: no option of .ply")
    fails(run("scene", "build", ply, "-o", out, "--floor", "nan"), 7, "floor")


def test_build_refuses(run, ply, tmp_path):
    out = tmp_path / "a.scene"
    fails(run("scene", "build", tmp_path / "no.glb", "-o", out), 3, "no.glb", "does not exist")
    (tmp_path / "a.xyz").touch()
    fails(run("scene", "build", tmp_path / "a.xyz", "-o", out), 3, "unknown ending")
    fails(run("scene", "build", ply, "-o", out, "--labels", tmp_path / "no.json"), 3, "no.json")
    ply.write_text(PLY.replace("4 4 1 1\n", "4 4 nan 1\n"))
    fails(run("scene", "build", ply, "-o", out), 3, "room.ply", "not numbers")
    ply.write_text(PLY.replace("3 4 5 6", "3 4 5 9"))
    fails(run("scene", "build", ply, "-o", out), 3, "room.ply", "outside 0 to 6")
    assert not out.exists()


def test_no_floor_is_mended_by_an_option(run, ply, tmp_path):
    ply.write_text(PLY.replace("4 0 1 2 3", "4 0 0 0 0"))
    out = tmp_path / "a.scene"
    fails(run("scene", "build", ply, "-o", out, "--up", "y"), 3, "shows no floor", "--floor 0")
    assert run("scene", "build", ply, "-o", out, "--up", "y", "--floor", "0").code == 0


def test_what_is_no_scene(run, ply, tmp_path):
    fails(
        run("scene", "info", tmp_path / "no.scene"), 3, "does not exist", "`placegraph scene build`"
    )
    fails(run("scene", "info", ply), 4, "not a placegraph map", "`placegraph scene build`")
    out = tmp_path / "a.scene"
    run("scene", "build", ply, "-o", out)
    fails(run("city", "info", out), 4, "is a scene map, not a city map")
    out.write_bytes(out.read_bytes()[:-50])
    fails(run("scene", "info", out), 4, "a.scene", "damaged")


def test_the_shared_house(run, shared, tmp_path):
    source = shared / "data" / "house" / "map"
    out = tmp_path / "house.scene"
    told = run(
        "scene",
        "build",
        source / "house.glb",
        "-o",
        out,
        "--labels",
        source / "objects.json",
        "--json",
    ).json
    assert told["objects"] == 86
    assert told["textures"] == 66
    assert told["floor_m"] == [0.0]
    assert told["bytes"] < (source / "house.glb").stat().st_size
    assert told["labels"]["Chair"] == sum(
        thing["label"] == "Chair" for thing in json.loads((source / "objects.json").read_text())
    )


# --- where things go wrong ---

CORNERS = np.array(
    [[0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0], [1, 1, 0.7], [2, 1, 0.7], [2, 2, 0.7]]
)
HALVES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])


@pytest.fixture
def mesh(tmp_path):
    def write(factor=1.0, ids=(0, 0, 1)):
        return write_ply(
            tmp_path / "room.ply", CORNERS * factor, HALVES, objects=np.array(ids, np.int32)
        )

    return write


def test_every_refusal_names_file_and_mend(run, mesh, tmp_path):
    out = tmp_path / "a.scene"

    def build(*options):
        return run("scene", "build", tmp_path / "room.ply", "-o", out, *options)

    mesh(1000.0)
    fails(build(), 3, "room.ply", "looks like millimetres", "--scale 0.001")
    mesh(0.001)
    fails(build(), 3, "room.ply", "--scale 1000")
    assert build("--scale", "1000", "--quiet").code == 0
    mesh()
    (tmp_path / "labels.json").write_text('{"7": "lamp"}')
    fails(build("--labels", tmp_path / "labels.json"), 3, "labels", "room.ply (0, 1)")
    (tmp_path / "labels.json").write_text('{"7": ')
    fails(build("--labels", tmp_path / "labels.json"), 3, "labels.json", "not JSON")
    fails(build("--landmarks"), 7, "room.ply is no capture: landmarks can only be used")
    (tmp_path / "room.ply").write_bytes(b"")
    fails(build(), 3, "room.ply is empty")
    (tmp_path / "room.ply").write_bytes(mesh().read_bytes()[:-5])
    fails(build(), 3, "room.ply", "truncated")


def test_outputs_that_cannot_be(run, mesh, tmp_path):
    source = mesh()
    table = tmp_path / "labels.json"
    table.write_text('{"0": "floor"}')
    before = source.read_bytes(), table.read_bytes()
    fails(run("scene", "build", source, "-o", source), 7, "would be overwritten")
    fails(
        run("scene", "build", source, "-o", table, "--labels", table),
        7,
        "labels.json",
        "overwritten",
    )
    fails(run("scene", "build", source, "-o", tmp_path), 4, "not a plain file")
    fails(run("scene", "build", source, "-o", tmp_path / "no" / "a"), 4, "No such file")
    fails(run("scene", "build", source, "-o", tmp_path / ("x" * 300)), 4, "File name too long")
    with map_writer(tmp_path / "a.scene"):
        fails(run("scene", "build", source, "-o", tmp_path / "a.scene"), 5, "a.scene")
    assert (source.read_bytes(), table.read_bytes()) == before


def test_a_disk_that_is_full(run, mesh, tmp_path):
    source, out = mesh(), tmp_path / "a.scene"
    assert run("scene", "build", source, "-o", out).code == 0
    before = out.read_bytes()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (len(before) // 2, limits[1]))
    try:
        result = run("scene", "build", source, "-o", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    fails(result, 4, "a.scene cannot be written", "Choose another place")
    assert out.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.scene", "room.ply"]


def test_ctrl_c_leaves_the_old_map_and_no_lock(tmp_path, interrupted):
    source, out, lock = (tmp_path / n for n in ("room.ply", "a.scene", ".a.scene.lock"))
    os.mkfifo(source)  # reading waits for who writes: nobody
    out.write_bytes(b"old")
    ended = interrupted("scene", "build", source, "-o", out, once=lock.exists)
    assert (ended.code, ended.out, ended.err) == (130, "", "")
    assert out.read_bytes() == b"old"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.scene", "room.ply"]


def test_notes_and_counts_reach_the_summary(run, tmp_path):
    out = tmp_path / "a.scene"
    source = write_ply(
        tmp_path / "far.ply",
        CORNERS + np.array([9000, 0, 0]),
        np.vstack([HALVES, [[0, 0, 1], [1, 2, 0]]]),
        objects=np.array([0, 0, 1, 1, 0]),
    )
    result = run("scene", "build", source, "-o", out)
    assert (result.code, result.err) == (0, "")
    assert "9,004 m from its origin" in result.out
    assert "1 triangles without area, 1 triangles twice in one place" in result.out
    told = run("scene", "build", source, "-o", out, "--json").json
    assert told["left_out"] == {"triangles without area": 1, "triangles twice in one place": 1}
    assert "subtract a corner" in told["notes"][0]
