import io
import json

import numpy as np
import pytest
from PIL import Image

from placegraph.errors import InputError
from placegraph.io.capture.capture import open_capture
from placegraph_lab.worlds.bags import BagWriter
from placegraph_ros.message import pose

pytest.importorskip("rosbags", reason="needs rosbags")
Y_UP_FROM_MAP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


def write(path, world):
    with BagWriter(path, "rosbag1") as writer:
        for i in range(len(world)):
            stamp, stream = float(world.stamps[i]), io.BytesIO()
            Image.fromarray(world.rgb[i]).save(stream, "JPEG", quality=97)
            writer.imu("/imu", stamp, np.array([0.0, 0.0, 1.0]), "imu_frame")
            told = pose(Y_UP_FROM_MAP @ world.poses[i])
            writer.send("/odometry", "nav_msgs/msg/Odometry", stamp, "odom_frame",
                        child_frame_id="base_link", pose={"pose": told})  # fmt: skip
            writer.send_compressed(
                "/camera/rgb/compressed", stamp, stream.getvalue(), "jpg", "camera_rgb_frame"
            )
            metres = np.where(world.sure[i] == 0, 0, world.units(i)).astype(np.uint16)
            writer.image("/camera/depth", stamp, metres, "mono16", "camera_depth_frame")
    return path


def sidecar(world):
    still = {"xyz": [0, 0, 0], "xyzw": [0, 0, 0, 1]}
    half = np.sqrt(0.5)
    return {
        "camera": world.cameras[0].to_dict(),
        "depth_camera": world.depth_cameras[0].to_dict(),
        "frame": "upright",
        "imu": None,
        "transforms": [
            {"parent": "upright", "child": "odom_frame"} | still | {"xyzw": [half, 0, 0, half]},
            {"parent": "base_link", "child": "camera_rgb_frame"} | still,
            {"parent": "base_link", "child": "camera_depth_frame"} | still,
        ],
    }


@pytest.mark.parametrize("turns", [0, 1])
def test_points_and_colours(turns, recorded, tmp_path):
    world = recorded(turns=turns, shrink=1)
    path = write(tmp_path / "walk.bag", world)
    (tmp_path / "walk.bag.json").write_text(json.dumps(sidecar(world)))
    capture = open_capture(path)
    np.testing.assert_allclose(capture.stamps, world.stamps)
    world.check(capture)


def test_what_is_missing_is_named(recorded, tmp_path):
    world = recorded(shrink=1)
    path = write(tmp_path / "walk.bag", world)
    with pytest.raises(InputError, match=r"CameraInfo|intrinsics|camera"):
        open_capture(path)
    beside = sidecar(world)
    del beside["transforms"], beside["frame"]
    (tmp_path / "walk.bag.json").write_text(json.dumps(beside))
    with pytest.raises(InputError, match="camera_rgb_frame"):
        open_capture(path)
