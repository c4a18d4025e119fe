"""The localizer as a node of ROS 2: a shell that carries messages, and leaves the rest to `Localizer`.

Callbacks put bytes into an inbox and return; a thread of its own takes them out. Messages are neither
decoded nor made by rclpy: what comes is decoded where it is used, what goes are the bytes of `encode`.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Thread
from typing import Any

from placegraph.errors import MissingExtraError, OptionError, PlacegraphError
from placegraph.maps import open_rooms
from placegraph_io.ros.poses import is_static
from placegraph_io.ros.stream import WANTED, Packet
from placegraph_io.ros.topics import Wishes, wishes_of
from placegraph_ros.encode import cdr
from placegraph_ros.localizer import Localizer
from placegraph_ros.loop import run
from placegraph_ros.message import Message
from placegraph_ros.node_services import Inbox, Services
from placegraph_ros.options import LiveOptions, mode_of
from placegraph_ros.telling import STATUS

NAME = "placegraph_localizer"
_LOOK = 1.0  # seconds between two looks at which topics there are
_GLOBAL = ("tf", "tf_static", "diagnostics")  # topics that stand in no namespace


@dataclass(frozen=True, slots=True)
class Ros:
    """What is used of ROS 2."""

    rclpy: Any
    qos: Any
    executors: Any
    groups: Any
    message: Any
    """Class of a message by its name."""
    service: Any

    @classmethod
    def imported(cls) -> Ros:
        """Import it; `MissingExtraError` where it is not installed."""
        try:
            import rclpy
            from rclpy import callback_groups, executors, qos
            from rosidl_runtime_py.utilities import get_message, get_service
        except ImportError as error:
            raise MissingExtraError(
                f"The node needs rclpy, which comes with ROS 2 ({error}): source its setup.bash "
                '(source /opt/ros/jazzy/setup.bash), or install RoboStack, and pip install "placegraph'
                '[ros]" into the Python that has it. Bags and `placegraph live` need no ROS.'
            ) from error
        return cls(rclpy, qos, executors, callback_groups, get_message, get_service)


class LocalizerNode:
    """Subscribes to what frames are made of, tells the pose, and offers the services of a localizer.

    Raises
    ------
    OptionError
        A parameter is out of its range.
    InputError, MapError
        The map cannot be opened.

    """

    def __init__(self, ros: Ros) -> None:
        self.ros = ros
        self.node = ros.rclpy.create_node(NAME)
        given = {
            name: self.node.declare_parameter(name, value, self._descriptor(value)).value
            for name, value in PARAMETERS.items()
        }
        if not given["map"]:
            raise OptionError(
                "map: no map is given; set the parameter map to a .scene or a library."
            )
        self.publish_tf = bool(given["publish_tf"])
        self.inbox = Inbox()
        self.localizer = Localizer(
            open_rooms(given["map"]), options_of(given), name=str(beside(given, NAME)),
            wishes=wishes_of_parameters(given, NAME), device=given["device"],
        )  # fmt: skip
        self._subscribed: dict[tuple[str, str], Any] = {}
        self._publishers: dict[str, Any] = {}
        self._unknown: set[str] = set()
        self._status = ""
        self.services = Services(ros, self.node, self.inbox, self.localizer.options.map_frame)
        self.node.create_timer(_LOOK, self.look)
        self._error: BaseException | None = None
        self._worker = Thread(target=self._work, name="placegraph", daemon=True)
        self._worker.start()

    def _descriptor(self, value: object) -> Any:  # noqa: ANN401  # of rcl_interfaces
        """What may be set: where it is seconds, whole ones (`1`), too."""
        descriptor = self.ros.message("rcl_interfaces/msg/ParameterDescriptor")()
        descriptor.dynamic_typing = isinstance(value, float)
        return descriptor

    def close(self) -> None:
        """End the worker, and say what became of the frames; what it died of, if it did, is raised."""
        self.inbox.close()
        self._worker.join()
        told = self.localizer.summary
        self.node.get_logger().info(
            f"{told.frames} frames, {told.dropped + self.inbox.dropped} dropped; "
            f"{'; '.join(f'{n} left out: {why}' for why, n in told.left_out.items()) or 'none left out'}"
        )
        self.node.destroy_node()
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        try:
            run(self.inbox, self.localizer, [self])
        except BaseException as error:  # noqa: BLE001  # told to whoever waits for the node
            self._error = error
            self.node.get_logger().fatal(f"The localizer has ended: {error}")
            self.ros.rclpy.try_shutdown()

    # ---------------------------------------------------------------------------- messages in

    def look(self) -> None:
        """Subscribe to what may be wanted; once it is known what is, to that alone."""
        chosen = self.localizer.topics
        own = {told.topic_name for told in list(self._publishers.values()) if told is not None}
        for name, kinds in self.node.get_topic_names_and_types():
            for kind in kinds:
                wanted = kind.replace("/msg/", "/") in WANTED
                asked = (
                    name not in own - {"/tf", "/tf_static"} if chosen is None else name in chosen
                )
                if wanted and asked and (name, kind) not in self._subscribed:
                    self._subscribe(name, kind)
        for key in [k for k in self._subscribed if chosen is not None and k[0] not in chosen]:
            self.node.destroy_subscription(self._subscribed.pop(key))

    def _subscribe(self, name: str, kind: str) -> None:
        if (message := self._type(kind)) is None:
            return
        q = self.ros.qos
        profile = q.qos_profile_sensor_data
        if kind.endswith("TFMessage"):
            kept = (
                q.DurabilityPolicy.TRANSIENT_LOCAL
                if is_static(name)
                else q.DurabilityPolicy.VOLATILE
            )
            profile = q.QoSProfile(depth=100, durability=kept)
        self._subscribed[name, kind] = self.node.create_subscription(
            message, name, partial(self._received, name, kind), profile, raw=True
        )

    def _received(self, name: str, kind: str, data: bytes) -> None:
        now = self.node.get_clock().now().nanoseconds * 1e-9
        self.inbox.put(Packet(name, kind, now, bytes(data)))

    # --------------------------------------------------------------------------- messages out

    def write(self, message: Message) -> None:
        """Publish a message; one whose package is not installed is passed over, and that is said once."""
        if message.topic == "tf" and not self.publish_tf:
            return
        if message.topic == STATUS and message.fields["message"] != self._status:
            self._status = message.fields["message"]
            self.node.get_logger().info(self._status)
        if message.topic not in self._publishers:
            kind = self._type(message.type)
            self._publishers[message.topic] = kind and self.node.create_publisher(
                kind, f"/{message.topic}" if message.topic in _GLOBAL else message.topic,
                self._profile(message),
            )  # fmt: skip
        if (publisher := self._publishers[message.topic]) is not None:
            data = cdr(message)
            try:
                publisher.publish(data)
            except Exception:  # what is said after a Ctrl-C has nowhere to go
                if self.ros.rclpy.ok():
                    raise

    def _profile(self, message: Message) -> Any:  # noqa: ANN401  # rclpy's
        q = self.ros.qos
        if message.latched:
            return q.QoSProfile(depth=1, durability=q.DurabilityPolicy.TRANSIENT_LOCAL)
        if message.type.endswith("ParticleCloud"):
            return q.qos_profile_sensor_data
        return q.QoSProfile(depth=100 if message.topic == "tf" else 10)

    def _type(self, kind: str) -> Any:  # noqa: ANN401  # of rosidl
        try:
            return self.ros.message(kind)
        except (ImportError, AttributeError, ValueError):
            package = kind.partition("/")[0]
            if kind not in self._unknown:
                self._unknown.add(kind)
                self.node.get_logger().warning(
                    f"{kind} is passed over: {package} is not installed "
                    f"(apt install ros-$ROS_DISTRO-{package.replace('_', '-')})."
                )
            return None


def _spin(ros: Ros) -> None:
    shell = LocalizerNode(ros)
    try:
        # a thread for what takes long, which is to open another map
        executor = ros.executors.MultiThreadedExecutor(num_threads=2)
        executor.add_node(shell.node)
        executor.spin()
    except (KeyboardInterrupt, ros.executors.ExternalShutdownException):
        pass
    finally:
        shell.close()


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is shut down; the exit code is that of placegraph's errors."""
    try:
        ros = Ros.imported()
    except PlacegraphError as error:
        print(f"placegraph: {error}", file=sys.stderr)  # noqa: T201  # nobody logs yet
        return error.exit_code
    ros.rclpy.init(args=args)
    try:
        _spin(ros)
    except PlacegraphError as error:
        ros.rclpy.logging.get_logger(NAME).fatal(str(error))
        return error.exit_code
    finally:
        ros.rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())


TOPICS = ("colour", "depth", "camera", "depth_camera", "odometry", "imu", "frame")
PARAMETERS: dict[str, Any] = {
    "map": "",
    "mode": "continuous",
    "map_frame": "map",
    "base_frame": "",
    "transform_tolerance": 0.1,
    "publish_tf": True,
    "topics": "",
    **dict.fromkeys(TOPICS, ""),
    "seed": 0,
    "device": "auto",
}
"""`config/localizer.yaml` of the package says what each means."""


def options_of(given: Mapping[str, Any]) -> LiveOptions:
    """How the localizer works by the parameters; `OptionError` where one is out of its range."""
    tolerance = given["transform_tolerance"]
    if type(tolerance) not in {int, float}:
        raise OptionError(f"transform_tolerance is {tolerance!r}; it is seconds, such as 0.1.")
    return LiveOptions(
        mode=mode_of(given["mode"]),
        map_frame=given["map_frame"].lstrip("/"),
        base_frame=given["base_frame"].lstrip("/"),
        tolerance=tolerance,
        whole=False,
        seed=given["seed"],
    )


def beside(given: Mapping[str, Any], name: str) -> Path:
    """What the stream is called: the file `topics` without its ending, or a name."""
    return Path(given["topics"].removesuffix(".json") or name)


def wishes_of_parameters(given: Mapping[str, Any], name: str) -> Wishes:
    """What is said of topics, by the parameters and by the file `topics` (NAME.json if not given).

    The file is as one beside a bag; empty parameters say nothing. Raises `InputError` of its content.
    """
    said = {role: given[role] for role in TOPICS if given[role]}
    return wishes_of(beside(given, name), said)
