import json
import pickle
import shutil
from dataclasses import replace

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader

import placegraph as pg
from placegraph.core.geometry import (
    Camera,
    pose_matrix,
    quaternion_from_rotation,
    rotation_from_vector,
)
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.tum import write_tum
from placegraph_io.ros.decode import Registration
from placegraph_io.ros.poses import MAX_GAP, TransformTree
from placegraph_lab.worlds.bags import BASE_FROM_CAMERA, OPTICAL, BagWriter, Layout, write_capture

START = Layout().start
CONTAINERS = ("mcap", "sqlite3", "rosbag1")


def same(capture, clip):
    assert len(capture) == len(clip)
    assert (capture.camera, capture.depth_camera) == (clip.camera, clip.depth_camera)
    np.testing.assert_allclose(capture.stamps - START, clip.stamps, atol=1e-6)
    np.testing.assert_allclose(capture.odometry, clip.odometry, atol=1e-9)
    np.testing.assert_allclose(capture.gravity, clip.gravity, atol=1e-9)
    for got, wanted in zip(capture, clip, strict=True):
        np.testing.assert_array_equal(got.rgb(), wanted.rgb())
        np.testing.assert_allclose(got.depth(), wanted.depth(), atol=0.0006)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("container", CONTAINERS)
def test_containers(container, packed, bag, clip):
    same(pg.open_capture(bag(container, packed=packed)), clip)
    layout = Layout(images="packed", poses="odometry")
    same(pg.open_capture(bag(container, layout, packed=packed, name="other")), clip)


def test_a_file_alone_and_what_was_chosen(bag, clip, recorded, tmp_path):
    for container, ending in (("mcap", "mcap"), ("sqlite3", "db3")):
        folder = bag(container, name=f"in_{ending}")
        file = tmp_path / f"walk.{ending}"
        shutil.copy(next(folder.glob(f"*.{ending}")), file)
        same(capture := pg.open_capture(file), clip)
        (folder / "metadata.yaml").unlink()
        same(pg.open_capture(folder), clip)
    recorded().check(capture, near=0.008)
    said = " ".join(capture.notes)
    assert "Colour is /camera/color/image_raw (sensor_msgs/Image, rgb8, 96 x 72" in said
    assert "/camera/aligned_depth_to_color/image_raw" in said
    assert "camera_optical_frame in odom, from /tf" in said


@pytest.mark.parametrize("packing", ["NONE", "LZ4", "ZSTD"])
@pytest.mark.parametrize("container", ["mcap", "rosbag1"])
def test_what_the_library_mcap_writes(container, packing, bag, clip, tmp_path):
    ros1 = container == "rosbag1"
    with AnyReader([bag(container)]) as reader, (tmp_path / "other.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=30_000, compression=CompressionType[packing])
        writer.start("ros1" if ros1 else "ros2", "tests")
        channels = {}
        for c in reader.connections:
            name = c.msgtype.replace("/msg/", "/") if ros1 else c.msgtype
            schema = writer.register_schema(name, "ros1msg" if ros1 else "ros2msg", b"")
            channels[c.id] = writer.register_channel(c.topic, "ros1" if ros1 else "cdr", schema)
        for c, time, data in reader.messages():
            writer.add_message(channels[c.id], time, data, time)
        writer.finish()
    same(pg.open_capture(tmp_path / "other.mcap"), clip)


def test_frames_are_read_elsewhere(bag, clip):
    capture = pg.open_capture(bag(packed=True))
    frame = pickle.loads(pickle.dumps(capture[2]))  # noqa: S301  # our own
    np.testing.assert_array_equal(frame.rgb(), clip[2].rgb())
    assert len(pickle.dumps(capture[2])) < 10_000, "an index of the bag does not come along"


def test_splits_are_one_bag(tmp_path, clip):
    (tmp_path / "walk").mkdir()
    for i, part in enumerate((clip[:2], clip[2:])):
        with BagWriter(tmp_path / f"part{i}") as writer:
            write_capture(writer, part)
        shutil.copy(tmp_path / f"part{i}/part{i}.mcap", tmp_path / f"walk/walk_{i}.mcap")
    same(pg.open_capture(tmp_path / "walk"), clip)
    shutil.copy(tmp_path / "walk/walk_0.mcap", tmp_path / "walk/other.mcap")
    with pytest.raises(InputError, match=r"contains several bags \(other, walk\)"):
        pg.open_capture(tmp_path / "walk")


def test_depth_of_another_camera(tmp_path, clip, recorded):
    world = recorded()
    aside = np.eye(4)
    aside[:3, :3], aside[:3, 3] = rotation_from_vector([0.01, -0.02, 0.03]), (0.015, 0.002, -0.004)
    camera = Camera(120, 100, 90.0, 92.0, 61.0, 49.0)
    wall = 2.0  # every depth camera sees a plane before the colour camera
    with BagWriter(tmp_path / "walk") as writer:
        write_capture(writer, clip, replace(Layout(), depth=False))
        writer.transform(OPTICAL, "depth_frame", aside, START + 100, "/tf_static")
        v, u = np.mgrid[:100, :120] + 0.5
        rays = camera.directions(np.stack([u, v], axis=-1)) @ aside[:3, :3].T
        depth = (wall - aside[2, 3]) / rays[..., 2]
        for stamp in world.stamps:
            writer.info("/depth/camera_info", START + stamp, camera, "depth_frame")
            writer.image(
                "/depth/image_raw", START + stamp, depth.astype("f4"), "32FC1", "depth_frame"
            )
    capture = pg.open_capture(tmp_path / "walk")
    assert any("registered from depth_frame" in note for note in capture.notes)
    got = capture[1].depth()
    assert got.shape == (capture.depth_camera.height, capture.depth_camera.width)
    inner = got[6:-6, 6:-6]
    assert np.isfinite(inner).mean() > 0.8
    np.testing.assert_allclose(inner[np.isfinite(inner)], wall, atol=0.004)
    assert capture.depth_camera.fx / capture.camera.fx == pytest.approx(
        capture.depth_camera.width / capture.camera.width, rel=0.02
    )


def test_the_nearer_surface_hides_the_other():
    camera = Camera(40, 30, 40.0, 40.0, 20.0, 15.0)
    depth = np.full((30, 40), 4.0, np.float32)
    depth[:, 20:] = 1.0
    aside = np.eye(4)
    aside[0, 3] = -0.2  # the colour camera stands to the right: the near half moves left by 8 - 2
    got = Registration(camera, camera)(depth, aside)
    assert (got[:, 13:30][np.isfinite(got[:, 13:30])] == 1.0).all()
    assert (got[:, :11][np.isfinite(got[:, :11])] == 4.0).all()


def test_what_the_file_beside_it_says(bag, clip, tmp_path):
    path = bag(layout=Layout(infos=False))
    with pytest.raises(InputError, match=r'no CameraInfo of /camera/color/image_raw.*"camera"'):
        pg.open_capture(path)
    numbers = {k: getattr(clip.camera, k) for k in ("fx", "fy", "cx", "cy")}
    beside = tmp_path / "walk.json"
    said = {"camera": numbers, "depth_camera": clip.depth_camera.to_dict()}
    beside.write_text(json.dumps(said))
    same(pg.open_capture(path), clip)
    assert pg.open_capture(path, topics={"depth": None}).depth_camera is None
    twice = pg.open_capture(path, topics={"depth_scale": 500})
    np.testing.assert_allclose(twice[0].depth(), 2 * clip[0].depth(), atol=0.0012)
    for wrong, words in (({"color": "/a"}, "'color' is unknown"), ({"frame": 3}, "frame is '3'"),
                         ({"transforms": [{}]}, "transforms is .*parent")):  # fmt: skip
        with pytest.raises(OptionError, match=words):
            pg.open_capture(path, topics=wrong)
        beside.write_text(json.dumps(said | wrong))
        with pytest.raises(InputError, match=f"{beside}.*{words}"):
            pg.open_capture(path)
        beside.write_text(json.dumps(said))
    (tmp_path / "plain/rgb").mkdir(parents=True)
    with pytest.raises(OptionError, match="topics: not an option of capture folder"):
        pg.open_capture(tmp_path / "plain", topics={"frame": "odom"})


def test_poses_of_a_file(bag, clip, tmp_path):
    path = bag(layout=Layout(poses="none"))
    with pytest.raises(InputError, match=r"no transform leads.*Record /tf, /tf_static or nav_msgs"):
        pg.open_capture(path)
    write_tum(tmp_path / "own.tum", clip.stamps[1:] + START, clip.odometry[1:])
    capture = pg.open_capture(path, poses=tmp_path / "own.tum")
    np.testing.assert_allclose(capture.odometry, clip.odometry[1:], atol=1e-6)
    assert capture.left_out == {"no pose in own.tum": 1}


def test_an_imu_stands_a_leaning_odometry_upright(tmp_path, clip):
    lean = np.eye(4)
    lean[:3, :3] = rotation_from_vector([0.2, -0.1, 0.0])
    tilted = type(clip).from_frames(replace(f, odometry=lean @ f.odometry) for f in clip)
    for name, how in (("leaning", True), ("level", False)):
        with BagWriter(tmp_path / name) as writer:
            write_capture(writer, tilted if how else clip)
            for frame in clip:
                up = np.linalg.inv(BASE_FROM_CAMERA[:3, :3].T)[..., :] @ -frame.gravity
                writer.imu("/imu", START + frame.stamp, up)
        capture = pg.open_capture(tmp_path / name)
        np.testing.assert_allclose(capture.gravity, clip.gravity, atol=1e-6)
        assert any("tilted by 12." in note for note in capture.notes) is how


def test_transforms_are_found_between_any_two_frames(rng):
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3] = pose_matrix(rng.normal(size=(4, 4)), np.eye(3))[:, :3]
    turn = pose_matrix([0, 0, 0, 0.2], np.eye(3))
    tree = TransformTree()
    tree.add({("odom", "base"): [rows((0.0, poses[0]), (0.2, poses[0] @ turn), (2.0, poses[1]))]})
    tree.add({("base", side): [rows((0, poses[i]))] for side, i in (("left", 2), ("right", 3))},
             static=True)  # fmt: skip
    at = np.array([0.0, 0.1, 0.2, 0.7, 2.0, 2.3])
    got = tree.lookup("right", "odom", at)
    half = pose_matrix([0, 0, 0, 0.1], np.eye(3))
    wanted = [poses[0], poses[0] @ half, poses[0] @ turn, None, poses[1], None]
    assert MAX_GAP < 1.8
    for pose, base in zip(got, wanted, strict=True):
        if base is None:
            assert np.isnan(pose[:3]).any()
        else:
            np.testing.assert_allclose(pose, np.linalg.inv(base @ poses[3]), atol=1e-9)
    np.testing.assert_allclose(
        tree.lookup("left", "right", at[:1])[0], np.linalg.inv(poses[2]) @ poses[3], atol=1e-9
    )
    assert tree.lookup("odom", "nowhere", at) is None
    assert tree.ancestors("left") == {"base": False, "odom": True}


def rows(*samples):
    return np.array(
        [(t, *pose[:3, 3], *quaternion_from_rotation(pose[:3, :3])) for t, pose in samples]
    )
