import io
import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import placegraph as pg
from placegraph.core.geometry import quaternion_from_rotation, rotation_from_vector
from placegraph.errors import InputError
from placegraph.io.capture.frame import Frame
from placegraph_io.ros.containers import open_bag
from placegraph_io.ros.poses import TransformTree
from placegraph_io.ros.stream import (
    SILENT,
    Fault,
    FrameAssembly,
    OdometryPose,
    StreamDiscovery,
    bag_packets,
    mcap_packets,
)
from placegraph_io.ros.topics import TopicChoice, plan_capture
from placegraph_lab.worlds.bags import BASE_FROM_CAMERA, OPTICAL, BagWriter, Layout, write_capture
from placegraph_ros.message import pose
from placegraph_ros.pose_messages import base_pose

START = Layout().start


def assembled(assembly, packets):
    taken = [assembly.take(packet) for packet in packets if not isinstance(packet, Fault)]
    return [*itertools.chain(*taken), *assembly.finish()]


def frames_of(assembly, packets):
    return [f for f in assembled(assembly, packets) if isinstance(f, Frame)]


def of_bag(path):
    assembly = FrameAssembly(plan_capture(open_bag(path), TopicChoice()))
    return assembly, list(bag_packets(assembly.plan.bag, assembly.topics))


def bytes_of(path):
    return io.BytesIO(next(path.glob("*.mcap")).read_bytes()).read


def same(frames, capture):
    assert len(frames) == len(capture)
    for got, wanted in zip(frames, capture, strict=True):
        assert got.stamp == pytest.approx(wanted.stamp, abs=1e-6)
        assert (got.camera, got.depth_camera) == (wanted.camera, wanted.depth_camera)
        np.testing.assert_allclose(got.odometry, wanted.odometry, atol=1e-6)
        np.testing.assert_allclose(got.gravity, wanted.gravity, atol=1e-6)
        np.testing.assert_array_equal(got.rgb(), wanted.rgb())
        if wanted.depth_camera is not None:
            np.testing.assert_array_equal(got.depth(), wanted.depth())


@pytest.mark.parametrize(
    "layout", [Layout(), Layout(images="packed", poses="odometry", depth=False)]
)
@pytest.mark.parametrize("container", ["mcap", "rosbag1"])
def test_frames_of_a_stream_are_those_of_its_capture(container, layout, bag):
    path = bag(container, layout)
    assembly, packets = of_bag(path)
    same(frames_of(assembly, packets), pg.open_capture(path))
    assert (assembly.odometry, assembly.base, assembly.camera) == ("odom", "base_link", OPTICAL)
    np.testing.assert_allclose(assembly.base_from_camera(), BASE_FROM_CAMERA, atol=1e-9)
    assert not assembly.left_out


@pytest.mark.parametrize("container", ["mcap", "rosbag1"])
def test_a_lens_that_refocuses(container, tmp_path, clip):
    path = tmp_path / ("walk.bag" if container == "rosbag1" else "walk")
    wanted = [replace(f.camera, fx=(1 + 0.01 * i) * f.camera.fx) for i, f in enumerate(clip)]
    frames = [replace(f, camera=c) for f, c in zip(clip.frames, wanted, strict=True)]
    with BagWriter(path, container) as writer:
        write_capture(writer, replace(clip, frames=tuple(frames)))
    assert [f.camera for f in pg.open_capture(path)] == wanted
    same(frames_of(*of_bag(path)), pg.open_capture(path))


def test_a_pipe_is_heard_until_it_is_known_what_comes(bag):
    path = bag()
    data = next(path.glob("*.mcap")).read_bytes()
    listening = StreamDiscovery(Path("stdin"), TopicChoice())
    packets = list(mcap_packets(io.BytesIO(data).read, "stdin"))
    assert not any(isinstance(p, Fault) for p in packets)
    coming = iter(packets)
    plan = next(filter(None, map(listening.take, coming)), None) or listening.find_plan()
    same(frames_of(FrameAssembly(plan), [*listening.packets(), *coming]), pg.open_capture(path))


@pytest.mark.parametrize("packed", [False, True])
def test_a_pipe_that_is_cut_off_is_read_as_far_as_it_goes(packed, bag):
    path = bag(packed=packed)
    data = next(path.glob("*.mcap")).read_bytes()
    whole = list(mcap_packets(io.BytesIO(data).read, "stdin"))
    for cut in (9, len(data) // 3, len(data) // 2):
        *packets, fault = mcap_packets(io.BytesIO(data[:cut]).read, "stdin")
        assert isinstance(fault, Fault)
        assert "stdin has no end" in fault.reason
        assert packets == whole[: len(packets)]
        assert packets or packed or cut == 9, "of a chunk that is cut off what is there"
    with pytest.raises(InputError, match="stdin does not begin like an MCAP"):
        list(mcap_packets(io.BytesIO(b"{}").read, "stdin"))


def test_a_damaged_chunk_of_a_pipe_is_named(bag):
    data = bytearray(next(bag(packed=True).glob("*.mcap")).read_bytes())
    chunk = data.index(b"\x04\x00\x00\x00zstd")
    data[chunk + 40 : chunk + 60] = bytes(20)
    packets = mcap_packets(io.BytesIO(bytes(data)).read, "stdin")
    assert "stdin, a chunk" in next(p for p in packets if isinstance(p, Fault)).reason


@pytest.mark.parametrize(
    ("layout", "words"),
    [
        (Layout(infos=False), "contains no CameraInfo of /camera/color/image_raw"),
        (Layout(poses="none"), "no transform leads"),
        (Layout(images="none"), "contains no colour images"),
    ],
)
def test_what_lacks_is_named_until_it_comes(layout, words, bag):
    lacking = list(mcap_packets(bytes_of(bag("mcap", layout)), "robot"))
    listening = StreamDiscovery(Path("robot"), TopicChoice())
    assert not any(listening.take(p) for p in lacking)
    assert listening.find_plan() is None
    assert words in listening.missing[0]
    for packet in mcap_packets(bytes_of(bag(name="whole")), "robot"):
        listening.take(packet)
    assert listening.find_plan() is not None
    assert not listening.missing


def test_odometry_between_images_is_told(tmp_path, clip):
    stamps = np.linspace(-0.05, clip.stamps[-1] - clip.stamps[0] + 0.05, 200)
    camera_from_base = np.linalg.inv(BASE_FROM_CAMERA)

    def turning(writer):
        first = START + clip.frames[0].stamp
        writer.transform("base_link", OPTICAL, BASE_FROM_CAMERA, first, "/tf_static")
        for t in stamps:
            pose = clip.frames[0].odometry.copy()
            pose[0, 3] += t
            writer.odometry("/odom", first + t, pose @ camera_from_base)

    with BagWriter(tmp_path / "more") as writer:
        turning(writer)
        write_capture(writer, clip, Layout(poses="none"))
    assembly, packets = of_bag(tmp_path / "more")
    said = assembled(assembly, packets)
    moves = [m for m in said if isinstance(m, OdometryPose)]
    assert isinstance(said[0], OdometryPose), "odometry is told before the first frame"
    assert len(moves) > 150
    assert all(b.stamp > a.stamp for a, b in itertools.pairwise(moves))
    along = moves[-1].odometry_from_camera[0, 3] - clip.frames[0].odometry[0, 3]
    assert along == pytest.approx(stamps[-1], abs=1e-6)
    same([f for f in said if isinstance(f, Frame)], pg.open_capture(tmp_path / "more"))


def test_what_odometry_says_of_its_errors_is_the_cameras(bag, clip, rng):
    root = rng.normal(size=(6, 6))
    told = root @ root.T
    poses = [frame.odometry @ np.linalg.inv(BASE_FROM_CAMERA) for frame in clip]

    def wheels(writer):
        writer.transform("base_link", OPTICAL, BASE_FROM_CAMERA, START, "/tf_static")
        for frame, matrix in zip(clip, poses, strict=True):
            writer.send(
                "/odom", "nav_msgs/msg/Odometry", START + frame.stamp, "odom",
                child_frame_id="base_link", pose={"pose": pose(matrix), "covariance": told.ravel()},
            )  # fmt: skip

    assembly, packets = of_bag(bag(layout=Layout(poses="none"), more=wheels))
    moves = [m for m in assembled(assembly, packets) if isinstance(m, OdometryPose)]
    assert moves
    for move in moves:
        _, spread = base_pose(move.odometry_from_camera, move.covariance, BASE_FROM_CAMERA)
        np.testing.assert_allclose(spread, told, atol=1e-9)


def test_clocks_that_jump_and_gaps(clip, bag):
    last = START + clip.stamps[-1]

    def alone(writer):
        for stamp in (last + 90.0, last + 91.0):
            writer.image("/camera/color/image_raw", stamp, clip[0].rgb(), "rgb8")

    assembly, packets = of_bag(bag(more=alone))
    _, again = of_bag(bag("mcap", Layout(start=START - 100.0), name="again"))
    later = [p._replace(time=p.time + 300.0) for p in again]
    assert len(frames_of(assembly, [*packets, *later])) == 2 * len(clip)
    assert assembly.jumps == 1
    assert dict(assembly.left_out) == {f"no transform from {OPTICAL} to odom": 2}


def test_where_depth_falls_silent_colours_go_on(clip, bag):
    def more(writer):
        for i in range(1, 31):
            stamp = START + clip.stamps[-1] + 0.1 * i
            writer.transform("odom", "base_link", np.eye(4), stamp)
            writer.image("/camera/color/image_raw", stamp, clip[0].rgb(), "rgb8")

    assembly, packets = of_bag(bag(more=more))
    frames = frames_of(assembly, packets)
    assert [f.depth() is not None for f in frames[: len(clip)]] == [True] * len(clip)
    late = [f.stamp - START - clip.stamps[-1] for f in frames[len(clip) :]]
    assert min(late) == pytest.approx(SILENT, abs=0.11)
    assert all(f.depth() is None for f in frames[len(clip) :])
    assert assembly.left_out == {"no depth within 20 ms": 30 - len(late)}


def test_transforms_of_a_stream_are_those_of_all_their_samples(rng):
    key, count = ("odom", "base_link"), 200
    turns = np.cumsum(rng.normal(size=(count, 3)) * 0.1, axis=0)
    xyzw = np.array([quaternion_from_rotation(rotation_from_vector(t)) for t in turns])
    xyzw *= np.where(rng.random(count) < 0.5, -1.0, 1.0)[:, None]  # both mean the same turn
    rows = np.c_[np.arange(count) * 0.02, rng.normal(size=(count, 3)), xyzw]
    whole, live = TransformTree(), TransformTree()
    whole.add({key: [rows]})
    order = np.arange(count)
    order[50:52] = 51, 50  # late
    for i in order:
        live.extend(key, rows[i : i + 1], keep=2.0)
        live.extend(key, np.full((1, 8), np.nan), keep=2.0)
    stamps = np.linspace(2.0, 3.9, 77)
    np.testing.assert_allclose(live.lookup(*key, stamps), whole.lookup(*key, stamps), atol=1e-12)
    assert np.isnan(live.lookup(*key, np.array([1.0]))).any(), "forgotten"
    assert live.invalid == count
    live.extend(key, rows[:1] - [10.0, *[0.0] * 7], keep=2.0)
    assert len(live.edges[key].stamps) == 1
    assert np.isfinite(live.lookup(*key, np.array([-10.0]))).all()
    assert np.isnan(live.lookup(*key, np.array([-9.0]))).any()
