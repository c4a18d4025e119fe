import contextlib
import copy
import io
import sqlite3
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tests.io.damage import DAMAGE, damaged
from tests.io.writers import rvl

from placegraph.errors import InputError, PlacegraphError
from placegraph.io.capture.capture import open_capture

OPTICAL = np.array([[0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0.3]], "<f4")
"""base_from_camera of most: the base looks along x, with z up."""
SCHEMA = """
CREATE TABLE Node (id INTEGER NOT NULL, map_id INTEGER NOT NULL, weight INTEGER, stamp FLOAT,
    pose BLOB, ground_truth_pose BLOB, velocity BLOB, label TEXT, gps BLOB, env_sensors BLOB,
    time_enter DATE, PRIMARY KEY (id));
CREATE TABLE Data (id INTEGER NOT NULL, image BLOB, depth BLOB, {confidence} calibration BLOB,
    scan BLOB, scan_info BLOB, user_data BLOB, time_enter DATE, PRIMARY KEY (id));
CREATE TABLE Admin (version TEXT, preview_image BLOB, opt_cloud BLOB, opt_ids BLOB, opt_poses BLOB,
    opt_last_localization BLOB, time_enter DATE);
"""


def packed(array):
    kinds = {"uint8": 0, "int32": 4, "float32": 5}
    rows = np.atleast_2d(array)
    return zlib.compress(rows.tobytes()) + struct.pack("<3i", *rows.shape, kinds[rows.dtype.name])


def serialized(camera, *, kind=0, rectified=True, local=OPTICAL):
    k = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1.0]])
    raw = k * np.array([[1.1, 1, 1], [1, 1.1, 1], [1, 1, 1]]) if rectified else k
    p = np.column_stack([k, np.zeros(3)]) if rectified else np.zeros(0)
    distortion = np.full(5, 0.3) if rectified else np.zeros(0)
    turn = np.eye(3) if rectified else np.zeros(0)
    sizes = (9, distortion.size, turn.size, p.size, local.size)
    head = (0, 21, 4, kind, camera.width, camera.height, *sizes)
    doubles = b"".join(a.astype("<f8").tobytes() for a in (raw, distortion, turn, p))
    return struct.pack("<11i", *head) + doubles + local.tobytes()


def floats(camera, size):
    head = [camera.fx, camera.fy, camera.cx - 0.5, camera.cy - 0.5]
    return (
        np.array([*head, *((camera.width, camera.height) if size else ())], "<f4").tobytes()
        + OPTICAL.tobytes()
    )


def encoded(array, kind="PNG"):
    stream = io.BytesIO()
    Image.fromarray(array).save(stream, kind)
    return stream.getvalue()


def depth_bytes(world, i, kind):
    if kind == "float":
        bgra = np.ascontiguousarray(world.metres[i].astype("<f4")).view(np.uint8)
        return encoded(bgra.reshape(*world.metres[i].shape, 4)[..., [2, 1, 0, 3]])
    if kind == "inverse":
        a, b = 100 * 101.0, 1 - 100 * 101.0 / 20.0
        steps = np.zeros(world.metres[i].shape, np.uint16)
        near = world.metres[i] > 0
        steps[near] = np.rint(a / world.metres[i][near] + b)
        return b"DEPTHINV" + struct.pack("<ff", a, b) + b"DEPTHRVL" + rvl(steps)
    return b"DEPTHRVL" + rvl(world.units(i)) if kind == "rvl" else encoded(world.units(i))


def write(
    path, world, *, version="0.23.0", depth="rvl", optimized=True, sessions=(0,), confidence=None
):
    new = version >= "0.23" if confidence is None else confidence
    base = sqlite3.connect(path)
    base.executescript(SCHEMA.format(confidence="depth_confidence BLOB," if new else ""))
    drift = np.eye(4)
    drift[:3, 3] = 5.0, -3.0, 0.0
    camera_from_base = np.linalg.inv(np.vstack([OPTICAL, (0, 0, 0, 1)]).astype(float))
    right = []
    for i in range(len(world)):
        pose = world.poses[i] @ camera_from_base
        right.append(pose[:3].astype("<f4"))
        wrong = (drift @ pose)[:3].astype("<f4") if optimized else right[-1]
        row = (i + 1, sessions[i % len(sessions)], float(world.stamps[i]), wrong.tobytes())
        base.execute("INSERT INTO Node (id, map_id, stamp, pose) VALUES (?, ?, ?, ?)", row)
        camera = world.cameras[i]
        old = floats(camera, version >= "0.11.2")
        calibration = serialized(camera) if version >= "0.18" else old
        row = (i + 1, encoded(world.rgb[i]), depth_bytes(world, i, depth), calibration)
        base.execute("INSERT INTO Data (id, image, depth, calibration) VALUES (?, ?, ?, ?)", row)
        if new:
            sure = packed(world.sure[i] * np.uint8(50))
            base.execute("UPDATE Data SET depth_confidence = ? WHERE id = ?", (sure, i + 1))
    ids = packed(np.arange(1, len(world) + 1, dtype=np.int32)) if optimized else None
    poses = packed(np.concatenate(right).reshape(1, -1)) if optimized else None
    base.execute(
        "INSERT INTO Admin (version, opt_ids, opt_poses) VALUES (?, ?, ?)", (version, ids, poses)
    )
    base.commit()
    base.close()
    return path


def change(path, *commands):
    base = sqlite3.connect(path)
    for command, *values in commands:
        base.execute(command, values)
    base.commit()
    base.close()


@pytest.mark.parametrize(
    ("version", "depth", "turns"),
    [
        ("0.23.0", "rvl", 0), ("0.23.0", "inverse", 3), ("0.20.0", "float", 1),
        ("0.16.1", "png", 0), ("0.10.0", "png", 0),
    ],
)  # fmt: skip
def test_points_and_colours(version, depth, turns, recorded, tmp_path):
    world = recorded(turns=turns, refocus=0.01)
    capture = open_capture(write(tmp_path / "walk.db", world, version=version, depth=depth))
    world.check(capture, sure=version == "0.23.0")
    np.testing.assert_allclose(capture.stamps, world.stamps)
    assert "RTAB-Map optimized" in capture.notes[0]
    again = copy.deepcopy(capture[0])  # as processes hand frames on
    np.testing.assert_array_equal(again.rgb(), capture[0].rgb())


def test_odometry_where_nothing_was_optimized(recorded, tmp_path):
    world = recorded()
    path = write(tmp_path / "walk.db", world, optimized=False, sessions=(0, 1, 1, 1))
    capture = open_capture(path)
    world.check(capture, [1, 2, 3])
    assert capture.left_out == {"no pose": 1}
    assert "is used, because" in capture.notes[1]


def test_nodes_that_lack_something(recorded, tmp_path):
    world = recorded()
    path = write(tmp_path / "walk.db", world)
    change(path, ("UPDATE Data SET image = NULL WHERE id = 1",),
           ("UPDATE Data SET depth = NULL WHERE id = 2",),
           ("UPDATE Node SET stamp = 'now' WHERE id = 3",))  # fmt: skip
    capture = open_capture(path)
    assert capture.left_out == {"no colour image": 1, "no stamp": 1}
    assert len(capture) == 2
    assert capture[0].depth() is None
    world.check(capture[1:], [3])


def test_of_several_cameras_the_first(recorded, tmp_path):
    world = recorded()
    path = write(tmp_path / "walk.db", world, confidence=False)
    for i in range(len(world)):
        pair = np.hstack([world.rgb[i], world.rgb[0] // 2])
        depths = np.hstack([world.units(i), np.zeros_like(world.units(i))])
        change(path, ("UPDATE Data SET image = ?, depth = ?, calibration = ? WHERE id = ?",
                      encoded(pair), encoded(depths), 2 * serialized(world.cameras[i]), i + 1))  # fmt: skip
    world.check(open_capture(path), sure=False)


@pytest.mark.parametrize(
    ("command", "values", "says"),
    [
        ("UPDATE Admin SET version = '0.8.5'", (), "before version 0.10"),
        ("UPDATE Admin SET version = 'new'", (), "has no version"),
        ("UPDATE Admin SET opt_poses = ?", (b"x" * 40,), "Admin.opt_poses declares"),
        ("UPDATE Admin SET opt_ids = ?", (packed(np.arange(3, dtype=np.int32)),), "twelve numbers"),
        ("UPDATE Admin SET opt_ids = ?", (struct.pack("<3i", 1 << 30, 1 << 30, 4) * 2,), "opt_ids declares"),
        ("UPDATE Data SET calibration = ?", (b"12345",), "calibration is not an RTAB-Map calibration"),
        ("UPDATE Data SET calibration = ?", (struct.pack("<11i", 0, 21, 4, 1, *[0] * 7),), "stereo"),
        ("DROP TABLE Data", (), "is not an RTAB-Map database"),
        ("DELETE FROM Node", (), "contains no usable frame"),
    ],
)  # fmt: skip
def test_wrong_databases(command, values, says, recorded, tmp_path):
    path = write(tmp_path / "walk.db", recorded())
    change(path, (command, *values))
    with pytest.raises(InputError, match=says) as caught:
        open_capture(path)
    assert "walk.db" in str(caught.value)


def test_a_view_is_not_run(recorded, tmp_path):
    path = write(tmp_path / "walk.db", recorded())
    forever = (
        "CREATE VIEW Node AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id FROM n) "
        "SELECT id, 0 AS map_id, 0.0 AS stamp, x'' AS pose FROM n"
    )
    change(path, ("DROP TABLE Node",), (forever,))
    with pytest.raises(InputError, match="no table Node"):
        open_capture(path)


@pytest.mark.parametrize(
    ("column", "data", "says"),
    [
        ("image", b"\xff\xd8\xff", "image of node 2 cannot be read as an image"),
        ("depth", encoded(np.zeros((9, 9), np.uint16)), "9 x 9 pixels, but its camera has 48 x 36"),
        ("depth", encoded(np.zeros((36, 48, 3), np.uint8)), "mode 'RGB',.* not depth"),
        ("depth", b"DEPTHRVL" + struct.pack("<II", 1 << 31, 1 << 31), "2147483648 x 2147483648"),
        ("depth", b"DEPTHRVL" + struct.pack("<III", 48, 36, 0x10000000), "ends before"),
        ("depth_confidence", packed(np.zeros((3, 3), np.uint8)), "3 x 3 numbers, but the depth image has"),
    ],
)  # fmt: skip
def test_wrong_images(column, data, says, recorded, tmp_path):
    path = write(tmp_path / "walk.db", recorded(), confidence="confidence" in column)
    change(path, (f"UPDATE Data SET {column} = ? WHERE id = 2", data))  # noqa: S608
    frame = open_capture(path)[1]
    with pytest.raises(InputError, match=says):
        frame.rgb() if column == "image" else frame.depth()


@DAMAGE
@given(data=st.data())
def test_mutated_bytes(data, recorded, tmp_path):
    good, bad = tmp_path / "good.db", tmp_path / "bad.db"
    if not good.exists():
        write(good, recorded())
    bad.write_bytes(data.draw(damaged(good.read_bytes())))
    with contextlib.suppress(PlacegraphError):
        for frame in open_capture(bad):
            frame.rgb(), frame.depth()
