"""`placegraph scene build` where things go wrong: exit codes, one line, nothing half done."""

import os
import resource

import numpy as np
import pytest

from placegraph.core.mapfile import writing
from placegraph.io.mesh.ply import write_ply

CORNERS = np.array(
    [[0, 0, 0], [4, 0, 0], [4, 3, 0], [0, 3, 0], [1, 1, 0.7], [2, 1, 0.7], [2, 2, 0.7]]
)
HALVES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])


@pytest.fixture
def mesh(tmp_path):
    """Write a floor and a table as PLY: `mesh(factor, ids=)`."""

    def write(factor=1.0, ids=(0, 0, 1)):
        return write_ply(
            tmp_path / "room.ply", CORNERS * factor, HALVES, objects=np.array(ids, np.int32)
        )

    return write


def fails(result, code, *words):
    assert (result.code, result.out) == (code, "")
    (line,) = result.err.strip().splitlines()
    assert line.startswith("placegraph: ")
    for word in words:
        assert str(word) in line


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
    fails(build("--frames", "0:10"), 7, "room.ply is no capture: frames can only")
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
    with writing(tmp_path / "a.scene"):
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
