"""A video with a trajectory beside it: TUM's rows, or EuRoC's of a body."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE, read_damaged

from placegraph.core.geometry import Camera, quaternion_from_rotation
from placegraph.errors import InputError
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.tum import write_tum

write_video = pytest.importorskip("tests.io.video", reason="needs OpenCV").write_video
LARGE = Camera(192, 144, 160.0, 161.0, 97.5, 71.0)  # a codec's blocks blur small ones
BODY_FROM_CAMERA = np.array([[0, -1, 0, 0.02], [1, 0, 0, 0], [0, 0, 1, -0.01], [0, 0, 0, 1.0]])


def write(path, world, **said):
    write_video(path / "walk.mov", world.rgb, rate=2)
    (path / "camera.json").write_text(json.dumps(world.cameras[0].to_dict() | said))
    return path


def euroc(path, stamps, poses):
    rows = [
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    ]
    for stamp, pose in zip(stamps, poses, strict=True):
        x, y, z, w = quaternion_from_rotation(pose[:3, :3])
        numbers = [*pose[:3, 3], w, x, y, z]
        rows.append(f"{round(stamp * 1e9)}," + ",".join(f"{v:.9f}" for v in numbers))
    path.write_text("\n".join(rows))


@pytest.mark.parametrize("turns", [0, 1])
def test_a_row_a_frame(turns, recorded, tmp_path):
    world = recorded(turns=turns, camera=LARGE, shrink=4)
    write(tmp_path, world)
    write_tum(tmp_path / "odometry.tum", world.stamps, world.poses)
    capture = open_capture(tmp_path)
    world.check_views(capture)
    np.testing.assert_allclose(capture.stamps, world.stamps)


def test_rows_of_another_rate_by_their_stamps(recorded, tmp_path):
    world = recorded(camera=LARGE, shrink=4)
    write(tmp_path, world, start=1000.0)
    moments = 1000.0 + np.arange(len(world)) / 2
    wild = np.broadcast_to(np.eye(4), world.poses.shape)
    stamps = np.concatenate([moments, moments + 0.26])
    poses = np.concatenate([world.poses, wild])
    order = np.argsort(stamps)[:-2]
    write_tum(tmp_path / "odometry.tum", stamps[order], poses[order])
    capture = open_capture(tmp_path)
    assert capture.left_out == {"no pose": 1}
    world.check_views(capture, [0, 1, 2])
    write(tmp_path, world)
    with pytest.raises(InputError, match=r'"start" in camera\.json'):
        open_capture(tmp_path)


def test_euroc_tells_of_a_body(recorded, tmp_path):
    world = recorded(camera=LARGE, shrink=4)
    write(tmp_path, world, body_from_camera=BODY_FROM_CAMERA.tolist())
    euroc(tmp_path / "odometry.csv", world.stamps, world.poses @ np.linalg.inv(BODY_FROM_CAMERA))
    world.check_views(open_capture(tmp_path))


@pytest.mark.parametrize(
    ("said", "rows", "says"),
    [
        ({"start": "now"}, None, "start is not"), ({"body_from_camera": [1, 2]}, None, "has 2 numbers"),
        ({"body_from_camera": "no"}, None, "not 16 numbers"), ({}, "1,2,3", "timestamp"),
        ({}, "2,0,0,0,1,0,0,0\n1,0,0,0,1,0,0,0", "do not ascend"), ({}, "1,0,0,0,2,0,0,0", "length 2"),
        ({"width": 7, "height": 7}, None, "192 x 144 pixels, but its camera has 7 x 7"),
    ],
)  # fmt: skip
def test_wrong_files(said, rows, says, recorded, tmp_path):
    world = recorded(camera=LARGE, shrink=4)
    write(tmp_path, world, **said)
    euroc(tmp_path / "odometry.csv", world.stamps, world.poses)
    if rows:
        (tmp_path / "odometry.csv").write_text(rows)
    with pytest.raises(InputError, match=says):
        open_capture(tmp_path)[0].rgb()


def test_nothing_but_a_video(recorded, tmp_path):
    write(tmp_path, recorded(camera=LARGE, shrink=4))
    with pytest.raises(InputError, match=r"odometry.tum does not exist"):
        open_capture(tmp_path)
    (tmp_path / "again.mp4").write_bytes(b"")
    with pytest.raises(InputError, match=r"again.mp4, walk.mov; leave one"):
        open_capture(tmp_path)


@DAMAGE
@given(data=st.data())
def test_damaged_files(data, recorded, tmp_path):
    world = recorded(camera=LARGE, shrink=4)
    body = np.eye(4).tolist()

    def both(path):
        write(path, world, start=0.5, body_from_camera=body)
        write_tum(path / "odometry.tum", world.stamps, world.poses)

    read_damaged(tmp_path, data, both)
