"""`placegraph bag info`, and bags wherever a capture is taken."""

import json
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

import placegraph as pg
from placegraph_lab.worlds.bags import BagWriter, Layout, write_capture


@pytest.fixture(scope="module")
def world(room, tmp_path_factory):
    """Map file, capture folder without labels, and the same as a bag."""
    folder = tmp_path_factory.mktemp("bags")
    left_out = shutil.ignore_patterns("gravity.txt", "trajectory.tum", "instances", "labels")
    shutil.copytree(room.walk, folder / "walk", ignore=left_out)
    clip = pg.open_capture(folder / "walk")
    with BagWriter(folder / "bag") as writer:
        write_capture(writer, clip)
    return SimpleNamespace(
        map=room.map, walk=folder / "walk", bag=folder / "bag/bag.mcap", clip=clip
    )


def test_a_bag_is_localized_like_its_folder(run, world):
    poses = []
    for capture in (world.walk, world.bag):
        result = run("scene", "localize", world.map, capture, "--json", "--quiet", "--seed", "1")
        assert result.code == 0, result.err
        poses.append(result.json)
    assert poses[0]["status"] == poses[1]["status"] == "OK"
    best = [np.array(p["modes"][0]["map_from_camera"]) for p in poses]
    np.testing.assert_allclose(best[0], best[1], atol=1e-4)


def test_what_lies_in_it(run, world):
    told = run("bag", "info", world.bag, "--json").json
    assert (told["frames"], told["poses_in"]) == (6, "odom")
    assert told["uses"] == {"localize": [], "refine": [], "build": [], "track": []}
    assert told["chosen"]["colour"] == "/camera/color/image_raw"
    assert told["chosen"]["camera"] == "/camera/color/camera_info"
    (tf,) = (t for t in told["topics"] if t["topic"] == "/tf")
    assert (tf["messages"], tf["type"], tf["used"]) == (6, "tf2_msgs/TFMessage", ["transforms"])
    assert {"parent": "odom", "child": "base_link", "fixed": False} in told["transforms"]
    words = run("bag", "info", world.bag).out
    assert "sensor_msgs/Image, rgb8 160 x 90" in words
    assert "localize, refine, build, track: yes, 6 frames" in words


@pytest.mark.parametrize(
    ("layout", "lacks"),
    [
        (Layout(depth=False), {"build": "contains no depth, which a map needs; record"}),
        (Layout(poses="none"), {"localize": "no transform leads", "track": "no transform leads"}),
        (Layout(infos=False), {"localize": "no CameraInfo of", "build": "no CameraInfo of"}),
        (Layout(images="none"), {"localize": "contains no colour images", "refine": "no colour"}),
    ],
)
def test_what_it_lacks_for_what(layout, lacks, run, world, tmp_path):
    with BagWriter(tmp_path / "walk") as writer:
        write_capture(writer, world.clip, layout)
    result = run("bag", "info", tmp_path / "walk")
    assert result.code == 0
    uses = run("bag", "info", tmp_path / "walk", "--json").json["uses"]
    for use, words in lacks.items():
        assert any(words in sentence for sentence in uses[use])
        assert re.search(rf"^(\w+, )*{use}(, \w+)*: no\. ", result.out, re.MULTILINE)
    if layout == Layout(depth=False):
        assert uses["localize"] == []


def test_files_that_are_no_bag_are_named(run, tmp_path):
    (tmp_path / "flat.glb").write_bytes(b"glTF" + bytes(range(256)))
    (tmp_path / "empty").mkdir()
    for name, words in (
        ("flat.glb", "is not a bag; give"),
        ("empty", "contains no .mcap or .db3 file"),
    ):
        result = run("bag", "info", tmp_path / name)
        assert result.code == 3
        assert words in result.err


def test_what_is_not_read_is_said(run, world, tmp_path):
    with BagWriter(tmp_path / "walk") as writer:
        writer.send_compressed("/cam/video/compressed", 1.7e9, b"h264", "h264")
        writer.write_bytes("/battery", "sensor_msgs/msg/BatteryState", 1.7e9, b"\0\1\0\0")
        for frame in world.clip:
            pose = frame.odometry
            writer.transform("map", "camera_optical_frame", pose, 1.7e9 + frame.stamp)
            writer.info("/camera/color/camera_info", 1.7e9 + frame.stamp, frame.camera)
            writer.image("/camera/color/image_raw", 1.7e9 + frame.stamp, frame.rgb(), "rgb8")
    out = run("bag", "info", tmp_path / "walk").out
    assert "/battery" in out
    assert "Not read:" in out
    assert "track: no. " in out
    assert "the result of a localization" in out
    (tmp_path / "walk.json").write_text(json.dumps({"colour": "/battery"}))
    assert (
        "/battery is sensor_msgs/BatteryState with 1 messages"
        in run("bag", "info", tmp_path / "walk").out
    )
    (tmp_path / "walk.json").write_text("{")
    result = run("bag", "info", tmp_path / "walk")
    assert result.code == 3
    assert "walk.json is not JSON" in result.err
