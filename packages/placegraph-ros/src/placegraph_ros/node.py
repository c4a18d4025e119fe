"""The localizer as a node of ROS 2: a shell that carries messages, and leaves the rest to `Localizer`.

Callbacks put bytes into an inbox and return; a thread of its own takes them out. Messages are neither
decoded nor made by rclpy: what comes is decoded where it is used, what goes are the bytes of `encode`.
"""

from __future__ import annotations

import sys
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Condition, Thread
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import InputError, MissingExtraError, OptionError, PlacegraphError
from placegraph.io.capture.posed import pose_from_quaternion
from placegraph.maps import open_scenes
from placegraph_io.ros.decode import frame_name
from placegraph_io.ros.poses import is_static
from placegraph_io.ros.stream import WANTED, Packet
from placegraph_io.ros.topics import IMAGES
from placegraph_ros.localizer import Localizer, Request, run
from placegraph_ros.message import Message, cdr
from placegraph_ros.options import PARAMETERS, LiveOptions, choice_of_parameters, stream_name
from placegraph_ros.pose_messages import STATUS

NEWEST = 4  # Most waiting images of a topic; then the oldest is dropped
_MAX_OTHERS = 5000  # other messages
_TICK = 0.02  # seconds after which None is handed out


class Inbox:
    """Queue of packets and requests from any thread, handed out in order without blocking senders.

    `dropped` counts packets for which there was no room.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._changed = Condition()
        self._queue: deque[Packet | Request] = deque()
        self._images: Counter[str] = Counter()
        self._closed = False

    def put(self, packet: Packet) -> None:
        """Add a packet."""
        with self._changed:
            if packet.type.replace("/msg/", "/") in IMAGES:
                self._images[packet.topic] += 1
                if self._images[packet.topic] > NEWEST:
                    self._drop(packet.topic)
            elif len(self._queue) >= _MAX_OTHERS:
                self.dropped += 1
                return
            self._queue.append(packet)
            self._changed.notify()

    def ask(self, request: Request) -> None:
        """Add a request to the localizer."""
        with self._changed:
            self._queue.append(request)
            self._changed.notify()

    def close(self) -> None:
        """End the queue."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def __iter__(self) -> Iterator[Packet | Request | None]:
        while True:
            with self._changed:
                if not self._queue and not self._closed:
                    self._changed.wait(_TICK)
                if self._closed:
                    return
                event = self._queue.popleft() if self._queue else None
                if isinstance(event, Packet) and event.topic in self._images:
                    self._images[event.topic] -= 1
            yield event

    def _drop(self, topic: str) -> None:
        """Drop the oldest image of a topic."""
        row = next(
            i
            for i, held in enumerate(self._queue)
            if isinstance(held, Packet) and held.topic == topic
        )
        del self._queue[row]
        self._images[topic] -= 1
        self.dropped += 1


_LOADED, _MISSING, _INVALID = 0, 1, 2  # results of nav2_msgs/LoadMap


class Services:
    """Subscription to `initialpose`, and the services of nav2's localizers.

    Services answer at once, and take effect before the next message; `load_map` answers when the map is
    open.
    """

    def __init__(self, ros: RosModules, node: Any, inbox: Inbox, map_frame: str) -> None:  # noqa: ANN401
        self._node, self._inbox, self._map = node, inbox, map_frame
        told = ros.message("geometry_msgs/msg/PoseWithCovarianceStamped")
        node.create_subscription(told, "initialpose", self.place, 10)
        empty = ros.service("std_srvs/srv/Empty")
        node.create_service(
            empty, "reinitialize_global_localization", partial(self._forward, Localizer.relocalize)
        )
        node.create_service(
            empty, "request_nomotion_update", partial(self._forward, Localizer.update)
        )
        try:
            pose_reader = ros.service("nav2_msgs/srv/SetInitialPose")
            loading = ros.service("nav2_msgs/srv/LoadMap")
        except (ImportError, AttributeError, ValueError):
            node.get_logger().warning(
                "set_initial_pose and load_map are not offered: nav2_msgs is not installed "
                "(apt install ros-$ROS_DISTRO-nav2-msgs)."
            )
            return
        node.create_service(pose_reader, "set_initial_pose", self.set_pose)
        alone = ros.groups.MutuallyExclusiveCallbackGroup()  # opening takes seconds; others go on
        node.create_service(loading, "load_map", self.load, callback_group=alone)

    def place(self, message: Any) -> None:  # noqa: ANN401  # rclpy's
        """Take a pose that was told; what is none is refused, and the log says why."""
        try:
            pose, covariance = read_initial_pose(message, self._map)
        except InputError as error:
            self._node.get_logger().error(str(error))
            return
        self._inbox.ask(lambda localizer: localizer.place(pose, covariance))

    def set_pose(self, request: Any, response: Any) -> Any:  # noqa: ANN401  # rclpy's
        """`set_initial_pose`."""
        self.place(request.pose)
        return response

    def _forward(self, what: Any, _request: Any, response: Any) -> Any:  # noqa: ANN401  # rclpy's
        self._inbox.ask(what)
        return response

    def load(self, request: Any, response: Any) -> Any:  # noqa: ANN401  # rclpy's
        """Load a map of a path or a file:// URL (`load_map`)."""
        address = urlsplit(request.map_url)
        path = Path(unquote(address.path) if address.scheme == "file" else request.map_url)
        try:
            maps = open_scenes(path)
        except PlacegraphError as error:
            self._node.get_logger().error(f"load_map: {error}")
            response.result = _INVALID if path.exists() else _MISSING
            return response
        self._inbox.ask(lambda localizer: localizer.load(maps))
        response.result = _LOADED
        return response


def read_initial_pose(message: Any, map_frame: str) -> tuple[Floats, Floats]:  # noqa: ANN401  # rclpy's
    """Read pose (4, 4) and covariance (6, 6) of a `PoseWithCovarianceStamped` in the map's frame."""
    frame = frame_name(message.header.frame_id)
    if frame not in {"", map_frame}:
        raise InputError(
            f"initialpose: the pose is in frame {frame!r}; send it in {map_frame!r} (in RViz: Fixed Frame)."
        )
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    pose = pose_from_quaternion(
        [at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w], "initialpose: the pose"
    )
    return pose, np.array(message.pose.covariance, np.float64).reshape(6, 6)


NAME = "placegraph_localizer"
_UPDATE_INTERVAL = 1.0  # seconds between two looks at which topics there are
_GLOBAL = ("tf", "tf_static", "diagnostics")  # topics that stand in no namespace


@dataclass(frozen=True, slots=True)
class RosModules:
    """Modules of ROS 2 that the node uses."""

    rclpy: Any
    qos: Any
    executors: Any
    groups: Any
    message: Any  # Class of a message by its name
    service: Any

    @classmethod
    def load(cls) -> RosModules:
        """Import the modules; `MissingExtraError` where ROS 2 is not installed."""
        try:
            import rclpy
            from rclpy import callback_groups, executors, qos
            from rosidl_runtime_py.utilities import get_message, get_service
        except ImportError as error:
            raise MissingExtraError(
                f"The node needs rclpy, which comes with ROS 2 ({error}): source its setup.bash "
                "(source /opt/ros/jazzy/setup.bash), or install RoboStack; then run pip install "
                '"placegraph[ros]" in the same Python environment. Bags and `placegraph live` need '
                "no ROS."
            ) from error
        return cls(rclpy, qos, executors, callback_groups, get_message, get_service)


class LocalizerNode:
    """Subscribes to what frames are made of, tells the pose, and offers the services of a localizer.

    Raises `OptionError`: a parameter is out of its range; `InputError`, `MapError`: the map cannot be
    opened.
    """

    def __init__(self, ros: RosModules) -> None:
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
            open_scenes(given["map"]), LiveOptions.from_parameters(given), name=str(stream_name(given, NAME)),
            choice=choice_of_parameters(given, NAME), device=given["device"],
        )  # fmt: skip
        self._subscribed: dict[tuple[str, str], Any] = {}
        self._publishers: dict[str, Any] = {}
        self._unknown: set[str] = set()
        self._status = ""
        self.services = Services(ros, self.node, self.inbox, self.localizer.options.map_frame)
        self.node.create_timer(_UPDATE_INTERVAL, self.update_subscriptions)
        self._error: BaseException | None = None
        self._worker = Thread(target=self._work, name="placegraph", daemon=True)
        self._worker.start()

    def _descriptor(self, value: object) -> Any:  # noqa: ANN401  # of rcl_interfaces
        """Return the descriptor of a parameter; seconds may be integers (`1`), too."""
        descriptor = self.ros.message("rcl_interfaces/msg/ParameterDescriptor")()
        descriptor.dynamic_typing = isinstance(value, float)
        return descriptor

    def close(self) -> None:
        """End the worker and log the counts of frames; raise the worker's error, if any."""
        self.inbox.close()
        self._worker.join()
        summary = self.localizer.summary
        self.node.get_logger().info(
            f"{summary.frames} frames, {summary.dropped + self.inbox.dropped} dropped; "
            f"{'; '.join(f'{n} left out: {why}' for why, n in summary.left_out.items()) or 'none left out'}"
        )
        self.node.destroy_node()
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        try:
            run(self.inbox, self.localizer, [self])
        except BaseException as error:  # noqa: BLE001  # raised in `close`
            self._error = error
            self.node.get_logger().fatal(f"The localizer has ended: {error}")
            self.ros.rclpy.try_shutdown()

    def update_subscriptions(self) -> None:
        """Subscribe to all usable topics, and later only to the chosen ones."""
        chosen = self.localizer.topics
        own = {p.topic_name for p in list(self._publishers.values()) if p is not None}
        for name, kinds in self.node.get_topic_names_and_types():
            for kind in kinds:
                wanted = kind.replace("/msg/", "/") in WANTED
                is_chosen = (
                    name not in own - {"/tf", "/tf_static"} if chosen is None else name in chosen
                )
                if wanted and is_chosen and (name, kind) not in self._subscribed:
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
                    f"{kind} is skipped: {package} is not installed "
                    f"(apt install ros-$ROS_DISTRO-{package.replace('_', '-')})."
                )
            return None


def main(args: Sequence[str] | None = None) -> int:
    """Run the node until it is shut down; the exit code is that of placegraph's errors."""
    try:
        ros = RosModules.load()
    except PlacegraphError as error:
        print(f"placegraph: {error}", file=sys.stderr)  # noqa: T201  # nobody logs yet
        return error.exit_code
    ros.rclpy.init(args=args)
    try:
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
    except PlacegraphError as error:
        ros.rclpy.logging.get_logger(NAME).fatal(str(error))
        return error.exit_code
    finally:
        ros.rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
