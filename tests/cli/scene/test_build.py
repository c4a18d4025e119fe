"""`placegraph scene build` and `info`: one sentence for people, JSON for machines, nothing half done."""

import resource

import numpy as np
import pytest
from tests.cli.failing import fails

from placegraph.core.mapfile import map_writer
from placegraph.io.mesh.ply import write_ply

CORNERS = np.array(
    [[0, 0, 1], [4, 0, 1], [4, 4, 1], [0, 4, 1], [1, 1, 2], [2, 1, 2], [2, 2, 2]], float
)
FACES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 4, 5]])


@pytest.fixture
def ply(tmp_path):
    return write_ply(tmp_path / "room.ply", CORNERS, FACES, objects=np.array([1, 1, 2, 2]))


def test_build_and_info(run, ply, tmp_path):
    out, labels = tmp_path / "room.scene", tmp_path / "labels.json"
    labels.write_text('{"1": "floor", "2": "table [/b]"}')
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

    def build_json(*options):
        return run("scene", "build", ply, "-o", out, "--json", *options).json

    assert build_json("--floor", "-2.5")["floor_m"] == [-2.5]
    assert build_json("--scale", "0.5")["high_m"] == [2, 2, 1]
    assert build_json("--up", "y", "--floor", "0")["low_m"] == [0, -2, 0]


@pytest.mark.parametrize(
    ("options", "code", "words"),
    [
        (["--object-property", "part"], 3, ["'part'", "room.ply"]),
        (["-o", "no/a"], 4, ["No such file"]),
        (["--up", "x"], 7, ["up is 'x'"]),
        (["--detail", "huge"], 7, ["detail is 'huge'", "tiny"]),
        (["--error", "-1"], 7, ["error is -1.0"]), (["--texel", "nan"], 7, ["texel is nan"]),
        (["--frames", "one"], 7, ["--frames", "10:20"]),
        (["--frames", "::0"], 7, ["--frames", "1 or more"]),
        *((option, 7, ["room.ply is not a capture"])
          for option in (["--frames", "1:2"], ["--voxel", "0.1"], ["--poses", "odometry"])),
        (["--landmarks"], 7, ["room.ply is not a capture, but landmarks applies only to captures"]),
        (["--reader", "x"], 7, ["--reader", "name=value"]),
        (["--reader", "x=1"], 7, ["x: not an option of .ply"]), (["--floor", "nan"], 7, ["floor"]),
    ],
)  # fmt: skip
def test_build_refuses(options, code, words, run, ply, tmp_path):
    fails(run("scene", "build", ply, "-o", tmp_path / "a.scene", *options), code, *words)
    assert not (tmp_path / "a.scene").exists()


def test_a_map_that_is_being_written_is_locked(run, ply, tmp_path):
    with map_writer(tmp_path / "a.scene"):
        fails(run("scene", "build", ply, "-o", tmp_path / "a.scene"), 5, "a.scene")


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


def test_a_disk_that_is_full(run, ply, tmp_path):
    source, out = ply, tmp_path / "a.scene"
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
    x, y = np.meshgrid(np.linspace(0, 9, 500), np.linspace(0, 9, 500))  # takes seconds to simplify
    corner = np.arange(500 * 499).reshape(499, 500)[:, :-1].ravel()[:, None]
    faces = np.vstack([corner + np.array(c) for c in ((0, 1, 500), (1, 501, 500))])
    corners = np.stack([x, y, 1 + 0.1 * np.sin(9 * x) * np.cos(7 * y)], axis=-1).reshape(-1, 3)
    write_ply(source, corners, faces, objects=np.ones(len(faces), int))
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
        np.vstack([FACES, [[1, 2, 0]]]),
        objects=np.array([0, 0, 1, 1, 0]),
    )
    result = run("scene", "build", source, "-o", out)
    assert (result.code, result.err) == (0, "")
    assert "9,004 m from its origin" in result.out
    assert "1 triangles without area, 1 triangles twice in one place" in result.out
    told = run("scene", "build", source, "-o", out, "--json").json
    assert told["left_out"] == {"triangles without area": 1, "triangles twice in one place": 1}
    assert "subtract an offset" in told["notes"][0]
