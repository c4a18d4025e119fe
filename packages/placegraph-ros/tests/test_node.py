import threading
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from ruamel.yaml import YAML

from fake_rclpy import World
from placegraph_io.ros.decode import typestore
from placegraph_io.ros.stream import Packet, bag_packets
from placegraph_ros import node as ros_node
from placegraph_ros.localizer import Localizer
from placegraph_ros.node import NEWEST, Inbox, LocalizerNode, RosModules, main
from placegraph_ros.options import PARAMETERS
from placegraph_ros.sources import bag_source
from ros_world import FRAMES

PACKAGE = Path(__file__).resolve().parents[1] / "ament"
REMAPPINGS = {
    "rgb/image": "/camera/color/image_raw", "rgb/camera_info": "/camera/color/camera_info",
    "depth/image": "/camera/aligned_depth_to_color/image_raw",
    "depth/camera_info": "/camera/aligned_depth_to_color/camera_info",
}  # fmt: skip


@pytest.fixture
def recorded(room):
    source = bag_source(room.bag)
    topics = {t.name: (t.type,) for t in source.plan.bag.topics.values()}
    packets = list(bag_packets(source.plan.bag, topics))
    return packets, topics | {"/battery": ("sensor_msgs/msg/BatteryState",)}


@pytest.fixture
def robot(room, recorded, monkeypatch):
    nodes = []

    def started(lacks=(), namespace="/", remappings=REMAPPINGS, **parameters):
        parameters = {"map": str(room.map)} | parameters
        world = World(parameters, recorded[1], lacks, namespace, remappings)
        world.install(monkeypatch)
        world.init()
        shell = LocalizerNode(RosModules.load())
        nodes.append(shell)
        shell.start()
        return world, shell

    yield started
    for shell in nodes:
        shell.close()


def settled(shell):
    done = threading.Event()

    def asked(localizer):
        localizer.tracker.wait()
        messages = localizer.take(None)
        done.set()
        return messages

    shell.inbox.ask(asked)
    assert done.wait(120)
    after = threading.Event()  # and until what that said was published
    shell.inbox.ask(lambda _: after.set() or [])
    assert after.wait(120)


def sent(world, shell, packets):
    world.tick()
    for packet in packets:
        world.send(packet)
        settled(shell)
    world.tick()


def test_it_listens_chooses_and_tells_the_pose(robot, recorded):
    packets, _ = recorded
    world, shell = robot()
    world.tick()
    names = {s.topic for s in world.node.subscriptions}
    assert "/battery" not in names
    assert {"/camera/color/image_raw", "/camera/color/camera_info", "/odom", "/tf_static"} < names
    sent(world, shell, packets)
    assert {s.topic for s in world.node.subscriptions if s.raw} == {
        "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw", "/odom", "/tf_static",
        "/camera/color/camera_info", "/camera/aligned_depth_to_color/camera_info",
    }  # fmt: skip
    told = world.node.told
    assert len(told["/localization/pose"]) > 0.4 * FRAMES
    assert told["/localization/odometry"][-1].child_frame_id == "base_link"
    (edge,) = told["/tf"][-1].transforms
    assert (edge.header.frame_id, edge.child_frame_id) == ("map", "odom")
    ahead = edge.header.stamp.sec + edge.header.stamp.nanosec * 1e-9
    assert ahead - packets[-1].stamp == pytest.approx(1.0, abs=0.11), "as AMCL"
    assert told["/localization/particle_cloud"][-1].particles
    assert told["/localization/status"][-1].message.startswith("OK")
    assert told["/diagnostics"][-1].status[0].message.startswith("OK")
    assert "/localization/image" not in told, "the robot has its images"
    assert any(said.startswith("OK") for level, said in world.logger.said if level == "info")
    kept = {p.topic_name: p.qos_profile for p in world.node.publishers}
    assert kept["/localization/pose"].durability == "transient_local"
    assert kept["/localization/status"].durability == "transient_local"
    assert kept["/localization/particle_cloud"].reliability == "best_effort"
    qos = {s.topic: s.qos_profile for s in world.node.subscriptions}
    assert qos["/camera/color/image_raw"].reliability == "best_effort"
    assert qos["/tf_static"].durability == "transient_local"


def test_what_it_is_asked(robot, recorded, room, scene, tmp_path):
    packets, _ = recorded
    world, shell = robot(publish_tf=False, transform_tolerance=1)
    sent(world, shell, packets[: len(packets) // 2])
    assert "/tf" not in world.node.told
    world.node.call("reinitialize_global_localization")
    settled(shell)
    assert "reset on request" in world.node.told["/localization/status"][-1].message
    world.node.call("request_nomotion_update")
    assert world.node.call("load_map", map_url="/nowhere.scene").result == 1
    assert world.node.call("load_map", map_url=str(room.bag)).result == 2
    assert world.node.services["load_map"].group is not None
    scene.save(tmp_path / "other map.scene")
    url = (tmp_path / "other map.scene").as_uri()
    assert world.node.call("load_map", map_url=url).result == 0
    settled(shell)
    assert len(shell.localizer.tracker.maps) == len(scene)


def initial(frame="map", length=1.0):
    store = typestore("cdr")

    def made(kind, **fields):
        return store.types[kind](**fields)

    stamp = made("builtin_interfaces/msg/Time", sec=0, nanosec=0)
    header = made("std_msgs/msg/Header", stamp=stamp, frame_id=frame)
    at = made("geometry_msgs/msg/Point", x=1.0, y=2.0, z=0.0)
    turn = made("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=length)
    pose = made("geometry_msgs/msg/Pose", position=at, orientation=turn)
    covariance = np.diag([0.25, 0.25, 0, 0, 0, 0.07]).ravel()
    told = made("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    message = made(kind, header=header, pose=told)
    return message, bytes(store.serialize_cdr(message, kind)), kind


def test_initial_poses(robot, recorded):
    packets, _ = recorded
    world, shell = robot()
    sent(world, shell, packets[: len(packets) // 2])
    _, data, kind = initial()
    world.send(Packet("/initialpose", kind, packets[0].time, data))
    settled(shell)
    assert "pose was given" in world.node.told["/localization/status"][-1].message
    message, *_ = initial("odom")
    world.node.call("set_initial_pose", pose=message)
    message, *_ = initial(length=0.0)
    world.node.call("set_initial_pose", pose=message)
    errors = [said for level, said in world.logger.said if level == "error"]
    assert "send it in 'map'" in errors[0]
    assert "the quaternion has length 0" in errors[1]


def test_without_nav2(robot, recorded):
    packets, _ = recorded
    world, shell = robot(lacks=("nav2_msgs", "foxglove_msgs"))
    sent(world, shell, packets)
    assert world.node.told["/localization/pose"]
    assert "/localization/particle_cloud" not in world.node.told
    assert set(world.node.services) == {
        "reinitialize_global_localization", "request_nomotion_update",
    }  # fmt: skip
    warned = [said for level, said in world.logger.said if level == "warning"]
    assert len(warned) == 3
    assert "apt install ros-$ROS_DISTRO-nav2-msgs" in warned[0]


def test_images_wait_in_no_queue():
    inbox, kind = Inbox(), "sensor_msgs/msg/CompressedImage"
    for i in range(3 * NEWEST):
        inbox.put(Packet("/a", kind, float(i), b""))
        inbox.put(Packet("/tf", "tf2_msgs/msg/TFMessage", float(i), b""))
    inbox.ask(len)
    events = iter(inbox)
    held = [next(events) for _ in range(4 * NEWEST + 1)]
    assert [p.time for p in held[:-1] if p.topic == "/a"] == [8.0, 9.0, 10.0, 11.0]
    assert held[-1] is len
    assert inbox.dropped == 2 * NEWEST
    assert next(events) is None, "time has gone by"
    inbox.close()
    assert list(events) == []


def test_main(room, recorded, monkeypatch, capsys):
    assert main() == 8
    assert "source /opt/ros/jazzy/setup.bash" in capsys.readouterr().err

    def interrupted():
        raise KeyboardInterrupt

    world = World({"map": str(room.map), "autostart_node": True}, recorded[1])
    world.install(monkeypatch)
    world.spin = interrupted
    assert main() == 0
    assert world.node.destroyed
    assert not world.running
    assert world.logger.said[-1] == ("info", "0 frames, 0 dropped; none left out")
    for parameters, code, words in (
        ({}, 7, "no map is given"),
        ({"map": "nowhere.scene"}, 3, "nowhere.scene"),
        ({"map": str(room.map), "mode": "twice"}, 7, "mode is 'twice'"),
        ({"map": str(room.map), "transform_tolerance": "soon"}, 7, "transform_tolerance is 'soon'"),
    ):
        world = World(parameters | {"autostart_node": True}, recorded[1])
        world.install(monkeypatch)
        assert main() == code
        assert words in world.logger.said[-1][1]


def beats(world, topic="/bond"):
    return [(b.id, b.active) for b in world.node.told.get(topic, [])]


def test_a_lifecycle_with_bond_as_nav2_wants_it(robot, recorded):
    packets, _ = recorded
    world, shell = robot(namespace="/robot1", remappings=REMAPPINGS | {"odom": "/odom"})
    sent(world, shell, packets)
    node, bond = world.node, world.node.told["/robot1/bond"][-1]
    assert (bond.id, bond.active, bond.heartbeat_timeout) == ("placegraph_localizer", True, 4.0)
    assert {t.clock for t in node.timers} == {"steady"}
    assert 0.1 in {t.period for t in node.timers}
    assert len(node.told["/robot1/localization/pose"]) > 3
    node.trigger_deactivate()
    assert beats(world, "/robot1/bond")[-1] == ("placegraph_localizer", False)
    assert not [*node.timers, *node.subscriptions, *node.services, *node.publishers]
    node.trigger_activate()  # as the manager resumes it
    told = len(node.told["/robot1/localization/pose"])
    sent(world, shell, packets)
    assert len(node.told["/robot1/localization/pose"]) > told + 3
    node.trigger_deactivate()
    node.trigger_cleanup()
    shell.given["map"] = "nowhere.scene"
    node.trigger_configure()
    assert node.state == "unconfigured"
    assert "nowhere.scene" in world.logger.said[-1][1]


def test_the_manager_lets_go(robot):
    world, _ = robot()
    world.tick()
    (mine,) = world.node.told["/bond"]
    kind, store = "bond/msg/Status", typestore("cdr")
    for active in (True, False):
        mine.instance_id, mine.active = "the manager's", active
        world.send(Packet("/bond", kind, 1.0, bytes(store.serialize_cdr(mine, kind))))
        world.tick()
    assert beats(world)[1:] == [("placegraph_localizer", True), ("placegraph_localizer", False)]


def test_robot1_never_takes_the_camera_of_robot2(robot, recorded):
    _, topics = recorded
    world, _ = robot(namespace="/robot1", remappings={"/tf_static": "/robot1/tf_static"})
    both = {f"/{r}{name}": kinds for name, kinds in topics.items() for r in ("robot1", "robot2")}
    names = {
        "/robot1/rgb/image": "sensor_msgs/msg/Image", "/robot2/rgb/image": "sensor_msgs/msg/Image",
        "/robot1/tf_static": "tf2_msgs/msg/TFMessage",
    }  # fmt: skip
    world.topics |= both | {name: (kind,) for name, kind in names.items()}
    world.tick()
    heard = {s.topic for s in world.node.subscriptions if s.raw}
    assert heard == {"/robot1/rgb/image", "/robot1/odom", "/robot1/tf_static"}
    for _ in range(10):
        world.tick()
    (warned,) = [said for level, said in world.logger.said if level == "warning"]
    assert "published on /robot1/rgb/camera_info; remap" in warned


def test_discovery_on_request_wakes_no_lazy_publisher(robot, recorded):
    packets, _ = recorded
    world, shell = robot(discover=True, remappings={})
    lazy = {"/lazy/image": ("sensor_msgs/msg/Image",)}
    world.topics |= lazy
    sent(world, shell, packets)
    assert not any(s.topic in lazy for s in world.node.subscriptions)
    assert len(world.node.told["/localization/pose"]) > 3


def test_parameters_are_described_and_honoured(robot, recorded):
    packets, _ = recorded
    world, shell = robot()
    described = world.node.described
    assert all(d.description.endswith((".", "[s].")) for d in described.values())
    assert described["map"].read_only
    (limits,) = described["transform_tolerance"].floating_point_range
    assert (limits.from_value, limits.to_value) == (0.0, 60.0)
    sent(world, shell, packets)
    assert not world.node.set_parameter("map", "other.scene").successful
    refused = world.node.set_parameter("mode", "twice")
    assert not refused.successful
    assert "choose 'continuous' or 'once'" in refused.reason
    assert world.node.set_parameter("transform_tolerance", 3.0).successful
    settled(shell)
    assert shell.localizer.options.tolerance == 3.0
    count = len(world.node.told["/tf"])
    assert world.node.set_parameter("publish_tf", False).successful
    shell.inbox.put(next(p for p in packets if p.topic == "/odom")._replace(time=2e9))
    settled(shell)
    assert len(world.node.told["/tf"]) == count


def test_a_worker_that_dies_ends_the_node(robot):
    world, shell = robot()
    shell.inbox.ask(lambda _: 1 / 0)
    shell._worker.join(60)
    assert not world.running
    with pytest.raises(ZeroDivisionError):
        shell.close()
    shell._error = None


def test_ctrl_c_in_the_middle(robot, recorded):
    world, shell = robot()
    sent(world, shell, recorded[0][: len(recorded[0]) // 2])
    told = len(world.node.told["/localization/status"])
    world.try_shutdown()
    shell.inbox.ask(Localizer.relocalize)
    shell.inbox.ask(lambda _: shell.inbox.close() or [])
    shell._worker.join(60)
    shell.close()
    assert len(world.node.told["/localization/status"]) == told


def test_the_package():
    described = ET.parse(PACKAGE / "package.xml").getroot()  # noqa: S314  # our own
    assert described.findtext("name") == "placegraph_ros"
    assert "rclpy" in {e.text for e in described.findall("exec_depend")}
    setup = (PACKAGE / "setup.py").read_text("utf-8")
    assert f"localizer = {ros_node.__name__}:main" in setup
    assert (PACKAGE / "resource" / "placegraph_ros").is_file()
    written = YAML(typ="safe").load((PACKAGE / "config" / "localizer.yaml").read_text("utf-8"))
    # whatever namespace and name the node is given
    defaults = {name: value for name, (value, _) in PARAMETERS.items()}
    assert written["/**"]["ros__parameters"] == defaults


def test_the_launch_file(monkeypatch):
    made = SimpleNamespace(nodes=[])

    def module(name, **content):
        monkeypatch.setitem(__import__("sys").modules, name, SimpleNamespace(**content))

    module("launch", LaunchDescription=list)
    module("launch.actions", DeclareLaunchArgument=lambda name, **_: name)
    module("launch.substitutions", LaunchConfiguration=lambda name: f"${name}")
    module("launch_ros.actions", Node=lambda **given: made.nodes.append(given) or given)
    module("launch_ros")
    module("ament_index_python")
    module("ament_index_python.packages", get_package_share_directory=lambda name: f"/share/{name}")
    content = {}
    file = PACKAGE / "launch" / "localizer.launch.py"
    exec(compile(file.read_text("utf-8"), str(file), "exec"), content)  # noqa: S102  # our own
    content["generate_launch_description"]()
    (node,) = made.nodes
    assert (node["package"], node["executable"]) == ("placegraph_ros", "localizer")
    assert ("localization/pose", "amcl_pose") in node["remappings"]
    assert node["parameters"][0] == "$params"
    assert node["parameters"][1]["use_sim_time"] == "$use_sim_time"
    assert node["namespace"] == "$namespace"
    assert {("/tf", "tf"), ("rgb/image", "$image")} < set(node["remappings"])
