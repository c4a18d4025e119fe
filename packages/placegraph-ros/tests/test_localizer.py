import shutil
from dataclasses import replace
from pathlib import Path
from struct import pack, unpack_from

import numpy as np
import pytest

from placegraph.core.geometry import rotation_from_quaternion
from placegraph_io.ros.decode import typestore
from placegraph_io.ros.stream import Fault, bag_packets
from placegraph_lab.worlds.bags import BASE_FROM_CAMERA
from placegraph_ros.localizer import Localizer, run
from placegraph_ros.options import LiveOptions
from placegraph_ros.pose_messages import UPRIGHT_BASE
from placegraph_ros.sources import WaitPolicy, bag_source, open_source
from ros_world import FRAMES, START, off, write_bag

ONE_BY_ONE = LiveOptions(background=False)


class Sink:
    def __init__(self):
        self.messages = []

    def write(self, message):
        self.messages.append(message)

    def __getitem__(self, topic):
        return [m for m in self.messages if m.topic == topic]


def matrix(pose):
    out = np.eye(4)
    out[:3, 3] = [pose["position"][a] for a in "xyz"]
    out[:3, :3] = rotation_from_quaternion([pose["orientation"][a] for a in "xyzw"])
    return out


def followed(source, room, options=ONE_BY_ONE, **given):
    heard = Sink()
    localizer = Localizer(room.scene, options, plan=source.plan, **given)
    return run(source.events, localizer, [heard]), heard


def test_a_bag(room):
    summary, heard = followed(bag_source(room.bag), room)
    assert summary.frames == FRAMES
    assert summary.to_dict()["share_ok"] > 0.7, summary
    assert not summary.left_out
    poses = heard["localization/pose"]
    assert len(poses) >= 0.7 * FRAMES
    assert all(m.latched for m in poses)
    for message in poses:
        pose = matrix(message.fields["pose"]["pose"]) @ BASE_FROM_CAMERA
        near, turned = off(pose, truth_at(room, message))
        assert near < 0.15
        assert turned < 0.05
    assert len(heard["localization/odometry"]) >= 5 * (len(poses) - 1)
    edges = [t for m in heard["tf"] for t in m.fields["transforms"]]
    names = {(t["header"]["frame_id"], t["child_frame_id"]) for t in edges}
    assert names == {("map", "odom"), ("odom", "base_link")}
    assert len(heard["localization/map"]) == len(heard["tf_static"]) == 1
    assert len(heard["localization/image"]) == FRAMES


def seconds(stamped):
    return stamped["header"]["stamp"]["sec"], stamped["header"]["stamp"]["nanosec"]


@pytest.mark.parametrize("samples", [5, 1])
def test_pose_and_transforms_of_one_stamp_are_one_answer(room, tmp_path, samples):
    bag = write_bag(tmp_path / "bag.mcap", room.clip, samples)  # 1: odometry at the images' stamps
    _, heard = followed(bag_source(bag), room)
    edges = {}
    for t in (t for m in heard["tf"] for t in m.fields["transforms"]):
        key = t["child_frame_id"], seconds(t)
        assert key not in edges, "a stamp has one transform"
        moved = t["transform"]
        edges[key] = matrix({"position": moved["translation"], "orientation": moved["rotation"]})
    assert len(heard["localization/pose"]) > 0.7 * FRAMES
    rows = [*heard["localization/pose"], *heard["localization/odometry"]]
    for fields in (message.fields for message in rows):
        led = edges["odom", seconds(fields)] @ edges["base_link", seconds(fields)]
        np.testing.assert_allclose(matrix(fields["pose"]["pose"]), led, atol=1e-9)


def test_a_correction_is_sent_at_once(room):
    plan, first, _ = halves(room)
    localizer = Localizer(room.scene, replace(ONE_BY_ONE, background=True), plan=plan)
    before = taken(localizer, first)
    stamps = [seconds(t) for m in before if m.topic == "tf" for t in m.fields["transforms"]]
    localizer.tracker.wait()
    (now,) = [m.fields["transforms"][0] for m in localizer.take(None) if m.topic == "tf"]
    assert now["child_frame_id"] == "odom"
    assert seconds(now) > max(stamps), "without odometry in between"
    localizer.close()


def truth_at(room, message):
    return room.truth[int(np.argmin(np.abs(room.clip.stamps + START - message.stamp)))]


def test_a_folder_and_a_pipe_say_the_same(room):
    heard = {}
    for name in ("walk", "bag"):
        with room.bag.open("rb") as pipe:
            path = room.walk if name == "walk" else Path("-")
            summary, heard[name] = followed(open_source(path, WaitPolicy(0.0), pipe), room)
        assert summary.frames == FRAMES
    assert not summary.lacks
    for message in heard["walk"]["localization/pose"]:
        assert message.fields["header"]["frame_id"] == "map"
        truth = room.truth[int(np.argmin(np.abs(room.clip.stamps - message.stamp)))]
        assert off(matrix(message.fields["pose"]["pose"]) @ UPRIGHT_BASE, truth)[0] < 0.15
    told = [[m.fields["message"] for m in heard[n]["localization/status"]] for n in heard]
    assert len(told[0]) >= 3
    assert told[0][-1][:3] == told[1][-1][:3] == "OK:"


def test_a_folder_that_fills(room, tmp_path):
    walk = tmp_path / "walk"
    shutil.copytree(room.walk, walk)
    rows = (walk / "odometry.tum").read_text().splitlines()
    images = {kind: sorted((room.walk / kind).iterdir()) for kind in ("rgb", "depth")}
    for files in images.values():
        for file in files[4:]:
            (walk / file.parent.name / file.name).unlink()
    (walk / "odometry.tum").write_text("\n".join(rows[:4]))
    waits = []

    def pause(_seconds):
        waits.append(None)
        if len(waits) == 1:
            (walk / "odometry.tum").write_text("\n".join(rows))
        elif len(waits) == 2:
            for files in images.values():
                for file in files[4:]:
                    shutil.copy(file, walk / file.parent.name)
        else:
            policy.over.set()

    policy = WaitPolicy(np.inf, pause)
    frames = []
    for frame in open_source(walk, policy).events:
        if frame is None:
            assert frames, "what an image has told is asked for while nothing comes"
        else:
            frames.append(frame)
    assert [f.stamp for f in frames] == pytest.approx(room.clip.stamps)
    assert len(waits) == 3


def test_a_bag_that_is_being_recorded(room, tmp_path):
    data, path = room.bag.read_bytes(), tmp_path / "walk.mcap"
    path.write_bytes(data[: len(data) // 2])

    def pause(_seconds):
        if path.stat().st_size < len(data):
            path.write_bytes(data)
        else:
            policy.over.set()

    policy = WaitPolicy(np.inf, pause)
    grown = [p for p in open_source(path, policy).events if "/camera/color/" in p.topic]
    assert len(grown) == 2 * FRAMES, "images, and intrinsics"


def halves(room):
    source = bag_source(room.bag)
    packets = list(source.events)
    half = START + room.clip.stamps[FRAMES // 2]
    first, second = ([p for p in packets if (p.time < half) == early] for early in (True, False))
    return source.plan, first, second


def taken(localizer, packets):
    return [m for packet in packets for m in localizer.take(packet)]


def statuses(messages):
    return [m.fields["message"] for m in messages if m.topic == "localization/status"]


def test_once(room):
    plan, first, second = halves(room)
    localizer = Localizer(room.scene, replace(ONE_BY_ONE, mode="once"), plan=plan)
    taken(localizer, first)
    looked = sum(localizer.summary.told.values())
    assert localizer.summary.told["OK"] == 1
    assert looked < FRAMES // 2 - 1
    assert statuses(localizer.relocalize())[0] == "LOST: The pose was reset on request."
    after = taken(localizer, second)
    assert sum(localizer.summary.told.values()) > looked
    assert any(m.topic == "localization/odometry" for m in after), "odometry carries the pose on"
    localizer.close()


def test_a_pose_that_was_told(room):
    plan, first, second = halves(room)
    localizer = Localizer(room.scene, ONE_BY_ONE, plan=plan)
    here = room.truth[0] @ np.linalg.inv(BASE_FROM_CAMERA)
    here[:3, 3] += (0.2, -0.2, 0.0)
    covariance = np.diag([0.25, 0.25, 0.0, 0.0, 0.0, 0.07])  # as RViz says it
    localizer.place(here, covariance)
    messages = taken(localizer, first)
    assert any("pose was given" in s for s in statuses(messages)) or statuses(messages)
    assert localizer.summary.told["OK"] >= 2
    covariance[0, 0] = np.nan
    assert "is not used" in statuses(localizer.place(here, covariance))[0]
    covariance[0, 0] = 0.25
    assert "is not used" in statuses(localizer.place(np.zeros((4, 4)), covariance))[0]
    taken(localizer, second)
    assert localizer.summary.told["OK"] >= 4
    localizer.close()


def test_another_map(room, scene):
    plan, first, second = halves(room)
    localizer = Localizer(room.scene, ONE_BY_ONE, plan=plan)
    taken(localizer, first)
    localizer.load(scene)
    messages = taken(localizer, second)
    assert sum(m.topic == "localization/map" for m in messages) == 1
    assert not any(m.topic == "localization/pose" for m in messages)
    localizer.close()


def test_what_is_broken_is_counted_and_the_rest_goes_on(room):
    plan, first, second = halves(room)
    localizer = Localizer(room.scene, ONE_BY_ONE, plan=plan)
    image = next(p for p in first if p.type.endswith("/Image") and "aligned" not in p.topic)
    odom = next(p for p in first if p.topic == "/odom")
    taken(localizer, first)
    taken(localizer, [
        Fault("/odom", "a chunk is damaged."), odom._replace(data=odom.data[:40]),
        image._replace(data=image.data[:4]), image._replace(topic="/elsewhere"),
    ])  # fmt: skip
    told = sum(localizer.summary.told.values())
    assert sum(localizer.summary.left_out.values()) == 3
    assert any("record that topic again" in why for why in localizer.summary.left_out)
    taken(localizer, second)
    localizer.finish()
    assert sum(localizer.summary.told.values()) > told
    assert localizer.summary.frames == FRAMES
    localizer.close()


def test_a_stream_without_intrinsics_says_so_and_goes_on_when_they_come(room):
    source = bag_source(room.bag)
    every = source.plan.bag.topics
    packets = list(bag_packets(source.plan.bag, every))
    localizer = Localizer(room.scene, ONE_BY_ONE, name="robot")
    without = [p for p in packets if "camera_info" not in p.topic]
    said = statuses(taken(localizer, without))
    assert len(said) == 1, "it is said once"
    assert said[0].startswith("LOST: robot contains no CameraInfo of /camera/color/image_raw")
    assert localizer.summary.lacks
    later = [p._replace(time=p.time + 10.0) for p in packets]
    taken(localizer, later)
    assert localizer.topics == {
        "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw", "/odom", "/tf_static",
        "/camera/color/camera_info", "/camera/aligned_depth_to_color/camera_info",
    }  # fmt: skip
    assert not localizer.summary.lacks
    localizer.close()


def test_odometry_that_falls_silent_is_the_status(room):
    source = bag_source(room.bag)
    packets = list(source.events)
    localizer = Localizer(room.scene, ONE_BY_ONE, plan=source.plan)
    last = START + room.clip.stamps[4] + 0.01
    said = statuses(taken(localizer, [p for p in packets if p.topic != "/odom" or p.time <= last]))
    assert any(s.startswith("OK") for s in said)
    assert said[-1].startswith("AMBIGUOUS: There was no odometry for")
    localizer.close()
    localizer = Localizer(room.scene, ONE_BY_ONE, plan=source.plan)
    far = [p if p.topic != "/odom" else p._replace(data=shifted(p.data)) for p in packets]
    said = statuses(taken(localizer, far))
    assert said[-1].startswith("LOST: No image could be used yet: no transform from camera_optical")
    localizer.close()


@pytest.mark.parametrize(
    "variance", [0.0, np.nan, *(pytest.param(v, marks=pytest.mark.all) for v in (9.0, -1.0))]
)
def test_what_odometry_says_of_its_errors(variance, room):
    source, store = bag_source(room.bag), typestore("cdr")
    localizer = Localizer(room.scene, ONE_BY_ONE, plan=source.plan)
    for packet in source.events:
        if packet.topic == "/odom" and packet.time > START + room.clip.stamps[6]:
            said = store.deserialize_cdr(packet.data, packet.type)
            said.pose.covariance = variance * np.eye(6).ravel()
            packet = packet._replace(data=bytes(store.serialize_cdr(said, packet.type)))  # noqa: PLW2901
        localizer.take(packet)
    localizer.finish()
    localizer.close()
    notes = [n for n in localizer.summary.notes if "covariance of odometry" in n]
    assert len(notes) == (not variance >= 0.0)
    assert sum(localizer.summary.told.values()) == FRAMES
    assert localizer.summary.told["OK"] > FRAMES / 2


def shifted(data):
    (seconds,) = unpack_from("<i", data, 4)
    return data[:4] + pack("<i", seconds - 3600) + data[8:]


@pytest.mark.parametrize("seconds", [-5, 2**31 - 1])
def test_stamps_that_ros_cannot_say(seconds, room):
    ahead = replace(ONE_BY_ONE, tolerance=1.0)
    localizer = Localizer(room.scene, ahead, plan=bag_source(room.bag).plan)
    packets = [
        p._replace(data=p.data[:4] + pack("<i", seconds) + p.data[8:]) if p.topic != "/tf_static" else p
        for p in bag_source(room.bag).events
    ]  # fmt: skip
    said = [*taken(localizer, packets), *localizer.finish()]
    assert localizer.summary.left_out
    assert statuses(said)[-1]
    localizer.close()


def test_images_that_come_too_fast_are_dropped(room):
    source = bag_source(room.bag)
    options = replace(ONE_BY_ONE, background=True)
    summary, heard = followed(source, room, options)
    assert summary.frames == summary.dropped + sum(summary.told.values()) == FRAMES
    assert not statuses(heard.messages)[-1].startswith("LOST: Nothing is known")
