import os
import pickle
import sqlite3
import struct
import sys
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE, damaged

import placegraph as pg
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, MissingExtraError, PlacegraphError
from placegraph.io.capture.frame import Capture, Frame
from placegraph_lab.worlds.bags import BASE_FROM_CAMERA, OPTICAL, BagWriter, Layout, write_capture
from placegraph_ros.message import Message, header

START = Layout().start
COLOUR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"


def fails(path, match, **options):
    with pytest.raises(InputError, match=match) as caught:
        read(path, **options)
    assert str(path) in str(caught.value)


def read(path, **options):
    for frame in pg.open_capture(path, **options):
        frame.rgb()
        frame.depth()


@pytest.mark.parametrize("packed", [False, True])
def test_an_mcap_that_was_cut_is_read_as_far_as_it_goes(packed, bag, clip, tmp_path):
    (file,) = bag(packed=packed).glob("*.mcap")
    data = file.read_bytes()
    for name, part in (("no_end", data[:-40]), ("half", data[: len(data) * 3 // 5])):
        cut = tmp_path / f"{name}.mcap"
        cut.write_bytes(part)
        if packed and name == "half":  # one chunk, and that is not whole
            fails(cut, "contains no message")
            continue
        capture = pg.open_capture(cut)
        assert any("truncated" in note for note in capture.notes)
        assert 2 <= len(capture) <= len(clip)
        for got, wanted in zip(capture, clip, strict=False):
            np.testing.assert_array_equal(got.rgb(), wanted.rgb())
            np.testing.assert_allclose(got.depth(), wanted.depth(), atol=0.0006)


def test_messages_outside_of_chunks(bag, clip, tmp_path):
    (file,) = bag().glob("*.mcap")
    data = file.read_bytes()
    at = 8
    head = 9 + struct.unpack_from("<Q", data, at + 1)[0]
    (length,) = struct.unpack_from("<Q", data, at + head + 1)  # the only chunk
    records = data[at + head + 49 : at + head + 9 + length]
    footer = b"\x02" + struct.pack("<QQQI", 20, 0, 0, 0)
    loose = tmp_path / "loose.mcap"
    loose.write_bytes(data[: at + head] + records + footer + data[:8])
    capture = pg.open_capture(loose)
    assert len(capture) == len(clip)
    assert "without an index" in capture.notes[0]
    np.testing.assert_array_equal(capture[3].rgb(), clip[3].rgb())


@pytest.mark.parametrize("container", ["mcap", "sqlite3", "rosbag1"])
def test_files_that_are_no_bag(container, bag, tmp_path):
    path = bag(container)
    file = path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")
    data = file.read_bytes()
    for number, part in enumerate((b"", b"not a bag at all" * 100, data[:100])):
        bad = tmp_path / f"bad{number}{file.suffix}"
        bad.write_bytes(part)
        fails(
            bad,
            "contains no message|not begin as an MCAP|not a rosbag2 database|is a damaged ROS 1 bag",
        )
    if container == "rosbag1":
        (tmp_path / "half.bag").write_bytes(data[: len(data) // 2])
        fails(tmp_path / "half.bag", "rosbag reindex")
    os.mkfifo(tmp_path / f"pipe{file.suffix}")  # reading it would wait for a writer
    fails(tmp_path / f"pipe{file.suffix}", "not a regular file")


def test_a_folder_that_is_not_whole(bag):
    path = bag("sqlite3")
    (file,) = path.glob("*.db3")
    moved = file.rename(path / "renamed.db3")
    fails(path, "db3 does not exist, but metadata.yaml lists it")
    told = path / "metadata.yaml"
    told.write_text(told.read_text().replace(file.name, 300 * "a" + file.name))
    fails(path, "db3 does not exist, but metadata.yaml lists it")
    moved.rename(f"{file}.zstd")
    (path / "metadata.yaml").unlink()
    fails(path, "unpack it: `zstd -d")
    (path / "metadata.yaml").write_text("rosbag2_bagfile_information: [")
    fails(path, "run `ros2 bag reindex`")


def test_a_database_without_definitions_or_with_a_lost_row(bag, clip):
    path = bag("sqlite3")
    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as rows:
        rows.execute("DROP TABLE message_definitions")
    rows.close()
    capture = pg.open_capture(path)
    assert len(capture) == len(clip)
    with sqlite3.connect(file) as rows:
        rows.execute("DELETE FROM messages")
    rows.close()
    with pytest.raises(InputError, match=r"message \d+ cannot be read.*recover"):
        pickle.loads(pickle.dumps(capture[0])).rgb()  # noqa: S301  # opened anew


@DAMAGE
@given(data=st.data())
def test_flipped_bytes_raise_nothing_else(data, tmp_path_factory):
    folder = tmp_path_factory.getbasetemp() / "flipped"
    folder.mkdir(exist_ok=True)
    whole = _small(folder, data.draw(st.sampled_from(["mcap", "sqlite3", "rosbag1"])))
    bad = folder / f"bad{whole.suffix}"
    bad.write_bytes(data.draw(damaged(whole.read_bytes())))
    with suppress(PlacegraphError):
        read(bad)


def _small(folder, container):
    path = folder / f"{container}{'.bag' if container == 'rosbag1' else ''}"
    if not path.exists():
        clip = Capture.from_frames(
            Frame.from_arrays(
                np.zeros((3, 4, 3), np.uint8), Camera(4, 3, 4, 4, 2, 1.5), depth=np.ones((3, 4)), stamp=i / 10
            )
            for i in range(2)
        )  # fmt: skip
        with BagWriter(path, container) as writer:
            write_capture(writer, clip)
            writer.transform("odom", "base_link", np.diag([-1.0, -1, 1, 1]), START + 0.3)
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix != ".yaml")


def test_gaps_and_two_parents(bag, clip):
    stamps = START + clip.stamps

    def two(writer):
        for i, stamp in enumerate(stamps):
            if i < 2:
                writer.transform("odom", "base_link", clip.odometry[i], stamp - 0.01)
            writer.transform("map", "base_link", np.eye(4), stamp + 0.001)

    path = bag(layout=Layout(poses="none"), more=two)
    capture = pg.open_capture(path)
    assert len(capture) == 2
    assert capture.left_out == {f"no transform from {OPTICAL} to odom": 2}
    assert any("base_link has several parents (map, odom)" in note for note in capture.notes)
    whole = pg.open_capture(path, topics={"frame": "map"})
    np.testing.assert_allclose(whole.odometry, [BASE_FROM_CAMERA] * 4, atol=1e-9)


def test_a_joint_is_no_odometry(bag, clip):
    def joint(writer):
        for frame in clip:
            stamp = START + frame.stamp
            writer.transform("world", "base_footprint", np.linalg.inv(frame.odometry), stamp)
            writer.transform("base_footprint", "pan", frame.odometry, stamp)
            writer.transform("pan", "base_link", np.linalg.inv(BASE_FROM_CAMERA), stamp)

    capture = pg.open_capture(bag(layout=Layout(poses="none"), more=joint))
    np.testing.assert_allclose(capture.odometry, [np.eye(4)] * 4, atol=1e-9)
    assert any("world is a frame of localization or SLAM" in n for n in capture.notes)


def test_odometry_that_leads_nowhere(bag):
    def wheels(writer):
        writer.odometry("/odom", START + 100.0, np.eye(4), child="wheels")

    path = bag(layout=Layout(poses="none"), more=wheels)
    fails(
        path,
        r"/odom moves .wheels., which no transform connects.*missing ones as \"transforms\" in",
    )
    fails(path, "/wheels has no nav_msgs/Odometry", topics={"odometry": "/wheels"})
    join = {"parent": "wheels", "child": "base_link", "xyz": [0, 0, 0], "xyzw": [0, 0, 0, 1]}
    assert len(pg.open_capture(path, topics={"transforms": [join]})) == 4, "it stands still"
    far = join | {"xyz": [10**400, 0, 0]}
    with pytest.raises(PlacegraphError, match="transforms"):
        pg.open_capture(path, topics={"transforms": [far]})
    named = bag(
        layout=Layout(poses="none"), name="nameless",
        more=lambda w: w.odometry("/odom", START, np.eye(4), child=""),
    )  # fmt: skip
    fails(named, "child_frame_id is empty")


def test_depth_that_nothing_joins(bag, clip):
    def aside(writer):
        writer.info("/other/camera_info", START, clip.depth_camera, "aside")
        for frame in clip:
            units = np.full((36, 48), 900, np.uint16)
            writer.image("/other/image_raw", START + frame.stamp, units, "16UC1", "aside")

    path = bag(layout=Layout(depth=False), more=aside)
    fails(
        path,
        "no transform connects the colour camera 'camera_optical_frame'.*'aside'.*\"depth\": null",
    )
    assert pg.open_capture(path, topics={"depth": None}).depth_camera is None


def test_clocks_that_jump(bag, clip, tmp_path):
    with BagWriter(tmp_path / "back") as writer:
        write_capture(writer, clip[1:])
        late = Layout(start=START + 1000.0)
        for frame in clip[:1]:  # recorded later, stamped earlier
            image = {
                "header": header(START + frame.stamp - 50, OPTICAL), "height": 72, "width": 96,
                "step": 288, "encoding": "rgb8", "data": frame.rgb(),
            }  # fmt: skip
            writer.write(Message(COLOUR, "sensor_msgs/msg/Image", late.start, image))
    capture = pg.open_capture(tmp_path / "back")
    assert (len(capture), capture.left_out) == (3, {"the clock jumped back": 1})
    assert any("jumps back 1 times" in note for note in capture.notes)

    def other_clock(writer):
        for frame in clip:
            base = frame.odometry @ np.linalg.inv(BASE_FROM_CAMERA)
            at = START + frame.stamp
            writer.transform("odom", "base_link", base, 7.0 + frame.stamp, recorded=at)

    capture = pg.open_capture(bag(layout=Layout(poses="none"), more=other_clock))
    np.testing.assert_allclose(capture.odometry, clip.odometry, atol=1e-6)
    assert any("different clocks, so the times of recording" in note for note in capture.notes)

    def again(writer):
        writer.image(COLOUR, START + clip.stamps[0], np.zeros((72, 96, 3), np.uint8), "rgb8")

    capture = pg.open_capture(bag(more=again, name="twice"))
    assert (len(capture), capture.left_out) == (4, {"a repeated stamp": 1})


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"width": 96, "height": 96}, '96 x 96 pixels, but the images have 96 x 72.*"camera"'),
        ({"k": np.zeros(9)}, "K is all zeros, so the camera was not calibrated"),
        ({"distortion_model": "double_sphere"}, "distortion_model is 'double_sphere'"),
        ({"d": np.arange(12.0)}, "D has 12 coefficients"),
        ({"k": np.full(9, np.nan)}, "camera_info"),
    ],
)  # fmt: skip
def test_intrinsics_that_cannot_be(fields, match, bag, clip):
    def info(writer):
        writer.info("/camera/color/camera_info", START, clip.camera, **fields)

    fails(bag(layout=Layout(infos=False), before=info), match)


def test_intrinsics_of_another_resolution_and_of_rectified_images(tmp_path, clip):
    twice = clip.camera.resize(192, 144)
    bent = replace(clip.camera, distortion=(0.1, 0.0, 0.0, 0.0, 0.0), fx=70.0)
    p = np.array([80.0, 0, 49.0, 0, 0, 81.0, 34.5, 0, 0, 0, 1, 0])
    for name, camera, more in (("image_raw", twice, {}), ("image_rect_color", bent, {"p": p})):
        with BagWriter(tmp_path / name) as writer:
            write_capture(writer, clip, Layout(infos=False, images="none"))
            for frame in clip:
                writer.image(f"/cam/{name}", START + frame.stamp, frame.rgb(), "rgb8")
            writer.info("/cam/camera_info", START, camera, **more)
        assert pg.open_capture(tmp_path / name).camera == clip.camera


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"height": 60_000}, "96 x 60000 of 'rgb8' with a step of 288 do not fit 20736 bytes"),
        ({"height": 1 << 31}, "width and height are 96 and 2147483648"),
        ({"width": 97}, "97 x 72 of 'rgb8'"),
        ({"step": 3}, "with a step of 3"),
        ({"encoding": "64FC1"}, "encoding '64FC1' is not supported"),
        ({"encoding": "16UC1"}, "is not supported"),
        ({"width": 48, "step": 288}, "has 48 x 72 pixels, but its camera has 96 x 72"),
    ],
)
def test_images_that_are_not_what_they_say(fields, match, tmp_path, clip):
    with BagWriter(tmp_path / "walk") as writer:
        write_capture(writer, clip[:2])
        given = {"height": 72, "width": 96, "step": 288, "encoding": "rgb8",
                 "data": clip[0].rgb().reshape(-1)} | fields  # fmt: skip
        stamp = START + clip.stamps[1] + 0.005
        writer.transform("odom", "base_link", np.eye(4), stamp)
        writer.send(COLOUR, "sensor_msgs/msg/Image", stamp, OPTICAL, **given)
    capture = pg.open_capture(tmp_path / "walk")
    with pytest.raises(InputError, match=f"walk.mcap, {COLOUR}.*{match}"):
        capture[2].rgb()


def test_topics_of_another_type(bag):
    def more(writer):
        writer.imu(COLOUR, START + 101.0, np.array([0, 0, 1.0]))
        writer.write_bytes(
            "/junk", "sensor_msgs/msg/Image", START + 101.0, b"\0\1\0\0" + b"\xff" * 30
        )

    path = bag(more=more)
    capture = pg.open_capture(path)
    assert len(capture) == 4
    assert any("has messages of sensor_msgs/msg/Image and" in note for note in capture.notes)
    fails(path, "/junk: a message does not match the ROS definition of", topics={"colour": "/junk"})
    fails(path, "/tf is tf2_msgs/TFMessage with 4 messages; image", topics={"colour": "/tf"})
    fails(path, "/no is not in the bag", topics={"depth": "/no"})
    fails(path, "shows depth", topics={"colour": DEPTH})


def test_a_bag_without_images(tmp_path):
    with BagWriter(tmp_path / "walk") as writer:
        writer.transform("odom", "base_link", np.eye(4), START)
        writer.send_compressed("/cam/compressed", START, b"h264", "h264")
    fails(
        tmp_path / "walk", r"contains no colour images.*'h264'.*cannot be read.*Record the camera"
    )


def test_poses_that_are_no_numbers(bag, clip):
    def broken(writer):
        nowhere = np.full((4, 4), np.nan)
        nowhere[:3, :3] = np.eye(3)
        writer.odometry("/odom", START + clip.stamps[1] + 0.01, nowhere)

    capture = pg.open_capture(bag(layout=Layout(poses="odometry"), more=broken))
    np.testing.assert_allclose(capture.odometry, clip.odometry, atol=1e-9)
    assert any(
        "1 transforms with NaN or without a unit quaternion" in note for note in capture.notes
    )


def test_the_extra_is_named(bag, monkeypatch):
    path = bag()
    monkeypatch.setitem(sys.modules, "rosbags", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[ros\]"):
        pg.open_capture(path)
