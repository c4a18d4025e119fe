"""The localizer as a lifecycle node of ROS 2: a shell around `Localizer` that carries messages.

Callbacks put bytes into an inbox and return; a thread of its own takes them out. Messages are neither
decoded nor made by rclpy: what comes is decoded where it is used, what goes are the bytes of `encode`.
"""

from __future__ import annotations

import sys
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from threading import Condition, Thread
from typing import Any
from urllib.parse import unquote, urlsplit
from uuid import uuid4

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import InputError, MissingExtraError, OptionError, PlacegraphError
from placegraph.io.capture.posed import pose_from_quaternion
from placegraph.maps import open_scenes
from placegraph_io.ros.decode import frame_name
from placegraph_io.ros.poses import is_static
from placegraph_io.ros.stream import WANTED, Packet
from placegraph_io.ros.topics import IMAGES, read_topic_choice
from placegraph_ros.localizer import Localizer, Request, run
from placegraph_ros.message import Message, cdr, header
from placegraph_ros.options import (
    CHANGEABLE,
    PARAMETERS,
    RANGES,
    TOPICS,
    LiveOptions,
    stream_name,
)
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
    """Subscription to `initialpose`, and the services of nav2's localizers, of an active node.

    Services answer at once, and take effect before the next message; `load_map` answers when the map is
    open.
    """

    def __init__(self, shell: LocalizerNode, active: ExitStack) -> None:
        self._shell, ros, node = shell, shell.ros, shell.node

        def serve(kind: Any, name: str, answer: Any, **group: Any) -> None:  # noqa: ANN401  # rclpy's
            active.callback(node.destroy_service, node.create_service(kind, name, answer, **group))

        pose = ros.message("geometry_msgs/msg/PoseWithCovarianceStamped")
        told = node.create_subscription(pose, "initialpose", self.place, 10)
        active.callback(node.destroy_subscription, told)
        empty = ros.service("std_srvs/srv/Empty")
        everywhere = partial(self._forward, Localizer.relocalize)
        serve(empty, "reinitialize_global_localization", everywhere)
        serve(empty, "request_nomotion_update", partial(self._forward, Localizer.update))
        try:
            pose_reader = ros.service("nav2_msgs/srv/SetInitialPose")
            loading = ros.service("nav2_msgs/srv/LoadMap")
        except (ImportError, AttributeError, ValueError):
            node.get_logger().warning(
                "set_initial_pose and load_map are not offered: nav2_msgs is not installed "
                "(apt install ros-$ROS_DISTRO-nav2-msgs)."
            )
            return
        serve(pose_reader, "set_initial_pose", self.set_pose)
        alone = ros.groups.MutuallyExclusiveCallbackGroup()  # opening takes seconds; others go on
        serve(loading, "load_map", self.load, callback_group=alone)

    def place(self, message: Any) -> None:  # noqa: ANN401  # rclpy's
        """Take a pose that was told; what is none is refused, and the log says why."""
        try:
            frame = self._shell.localizer.options.map_frame
            pose, covariance = read_initial_pose(message, frame)
        except InputError as error:
            self._shell.node.get_logger().error(str(error))
            return
        self._shell.inbox.ask(lambda localizer: localizer.place(pose, covariance))

    def set_pose(self, request: Any, response: Any) -> Any:  # noqa: ANN401  # rclpy's
        """`set_initial_pose`."""
        self.place(request.pose)
        return response

    def _forward(self, what: Any, _request: Any, response: Any) -> Any:  # noqa: ANN401  # rclpy's
        self._shell.inbox.ask(what)
        return response

    def load(self, request: Any, response: Any) -> Any:  # noqa: ANN401  # rclpy's
        """Load a map of a path or a file:// URL (`load_map`)."""
        address = urlsplit(request.map_url)
        path = Path(unquote(address.path) if address.scheme == "file" else request.map_url)
        try:
            self._shell.maps = maps = open_scenes(path)
        except PlacegraphError as error:
            self._shell.node.get_logger().error(f"load_map: {error}")
            response.result = _INVALID if path.exists() else _MISSING
            return response
        self._shell.inbox.ask(lambda localizer: localizer.load(maps))
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
_UPDATE_INTERVAL = 0.5  # seconds between two looks at which topics there are
_SILENT = 10  # looks after which missing topics are named
_GLOBAL = ("tf", "tf_static", "diagnostics")  # topics that stand in no namespace
_TRANSFORMS = ("/tf", "/tf_static")


@dataclass(frozen=True, slots=True)
class RosModules:
    """Modules of ROS 2 that the node uses."""

    rclpy: Any
    lifecycle: Any
    clock: Any
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
            from rclpy import callback_groups, clock, executors, lifecycle, qos
            from rosidl_runtime_py.utilities import get_message, get_service
        except ImportError as error:
            raise MissingExtraError(
                f"The node needs rclpy, which comes with ROS 2 ({error}): source its setup.bash "
                "(source /opt/ros/jazzy/setup.bash), or install RoboStack; then run pip install "
                '"placegraph[ros]" in the same Python environment. Bags and `placegraph live` need '
                "no ROS."
            ) from error
        return cls(
            rclpy, lifecycle, clock, qos, executors, callback_groups, get_message, get_service
        )

    def steady(self) -> Any:  # noqa: ANN401  # rclpy's
        """Return a clock that neither simulated time nor a correction of the system's clock moves."""
        return self.clock.Clock(clock_type=self.clock.ClockType.STEADY_TIME)

    def publish(self, publisher: Any, message: Message) -> None:  # noqa: ANN401  # rclpy's
        """Publish a message; after a Ctrl-C it has nowhere to go."""
        data = cdr(message)
        try:
            publisher.publish(data)
        except Exception:
            if self.rclpy.ok():
                raise


class Bond:
    """Heartbeat by which nav2's lifecycle manager knows that an active node lives, as bondcpp sends it."""

    def __init__(self, ros: RosModules, node: Any, period: float, active: ExitStack) -> None:  # noqa: ANN401
        self._ros, self._node, self._period = ros, node, period
        self._instance, self._beats = str(uuid4()), True
        kind = ros.message("bond/msg/Status")
        self._publisher = node.create_publisher(kind, "bond", 5)
        active.callback(node.destroy_publisher, self._publisher)
        active.callback(self.beat, last=True)
        heard = node.create_subscription(kind, "bond", self._hear, 100)
        active.callback(node.destroy_subscription, heard)
        timer = node.create_timer(period, self.beat, clock=ros.steady())
        active.callback(node.destroy_timer, timer)

    def beat(self, *, last: bool = False) -> None:
        """Send a heartbeat, or that there will be none."""
        if not self._beats:
            return
        self._beats = not last
        now = self._node.get_clock().now().nanoseconds * 1e-9
        fields = {
            "header": header(now, ""), "id": self._node.get_name(), "instance_id": self._instance,
            "active": not last, "heartbeat_timeout": 4.0, "heartbeat_period": self._period,
        }  # fmt: skip
        self._ros.publish(self._publisher, Message("bond", "bond/msg/Status", now, fields))

    def _hear(self, status: Any) -> None:  # noqa: ANN401  # rclpy's
        is_mine = status.id == self._node.get_name() and status.instance_id != self._instance
        if is_mine and not status.active:  # the manager has let go
            self.beat(last=True)


class LocalizerNode:
    """Lifecycle node that subscribes to images and odometry, and publishes the pose as a localizer does.

    Configuring opens the map; while the node is active, it listens and publishes. A transition that fails
    is logged, with the reason in `refused`.
    """

    localizer: Localizer
    inbox: Inbox
    maps: Any  # A scene map or a library

    def __init__(self, ros: RosModules) -> None:
        self.ros = ros
        changes = {
            "configure": self._configure, "activate": self._activate, "deactivate": self._deactivate,
            "cleanup": self._deactivate, "shutdown": self._deactivate, "error": self._deactivate,
        }  # fmt: skip
        own = {f"on_{k}": staticmethod(partial(self._change, v)) for k, v in changes.items()}
        self.node = type("Localizer", (ros.lifecycle.LifecycleNode,), own)(NAME)
        self.given = {
            name: self.node.declare_parameter(
                name, value, self._descriptor(name, value, text)
            ).value
            for name, (value, text) in PARAMETERS.items()
        }
        self.node.add_on_set_parameters_callback(self._set_parameters)
        self.refused: Exception | None = None
        self._active = ExitStack()  # destroys what the active node has made
        self._subscribed: dict[tuple[str, str], Any] = {}
        self._publishers: dict[str, Any] = {}
        self._unknown: set[str] = set()
        self._status, self._looks = "", 0
        self._names: dict[str, str] = {}  # topics by role
        self._worker: Thread | None = None  # while the node is active
        self._error: BaseException | None = None

    def _descriptor(self, name: str, value: object, text: str) -> Any:  # noqa: ANN401  # of rcl_interfaces
        """Return the descriptor of a parameter; seconds may be integers (`1`), too."""
        descriptor = self.ros.message("rcl_interfaces/msg/ParameterDescriptor")()
        descriptor.description = text
        descriptor.read_only = name not in CHANGEABLE
        descriptor.dynamic_typing = isinstance(value, float)
        if name in RANGES:
            kind = "floating_point" if isinstance(value, float) else "integer"
            limits = self.ros.message(f"rcl_interfaces/msg/{kind.title().replace('_', '')}Range")()
            limits.from_value, limits.to_value = RANGES[name]
            setattr(descriptor, f"{kind}_range", [limits])
        return descriptor

    def _set_parameters(self, parameters: Sequence[Any]) -> Any:  # noqa: ANN401  # of rcl_interfaces
        """Use new values of parameters at once, or refuse them with the reason."""
        result = self.ros.message("rcl_interfaces/msg/SetParametersResult")()
        given = self.given | {p.name: p.value for p in parameters if p.name in PARAMETERS}
        try:
            options = LiveOptions.from_parameters(given)
        except OptionError as error:
            result.successful, result.reason = False, str(error)
            return result
        self.given, result.successful = given, True
        if self._worker is not None:
            self.inbox.ask(lambda localizer: localizer.change(options))
        return result

    def _change(self, change: Any, _state: Any) -> Any:  # noqa: ANN401  # rclpy's
        """Make a transition; rclpy itself would hide errors."""
        returns, self.refused = self.ros.lifecycle.TransitionCallbackReturn, None
        try:
            change()
        except Exception as error:  # noqa: BLE001
            self._active.close()
            self.refused = error
            self.node.get_logger().fatal(str(error) or repr(error))
            return returns.FAILURE if isinstance(error, PlacegraphError) else returns.ERROR
        return returns.SUCCESS

    def _configure(self) -> None:
        """Open the map; raises for parameters out of range, and where it cannot be opened."""
        if not self.given["map"]:
            raise OptionError(
                "map: no map is given; set the parameter map to a .scene or a library."
            )
        LiveOptions.from_parameters(self.given)
        self.maps = open_scenes(self.given["map"])

    def _activate(self) -> None:
        """Listen and publish, beginning without a pose."""
        stream, node = stream_name(self.given, NAME), self.node
        choice = read_topic_choice(stream, None)
        self._names.clear()
        if not self.given["discover"]:
            unused = {"depth": not choice.with_depth, "imu": not choice.with_imu}
            for role, name in TOPICS.items():
                said = getattr(choice, role) or name
                if isinstance(said, str) and not unused.get(role):  # else intrinsics
                    self._names[role] = node.resolve_topic_name(said)
            named = {r: self._names[r] for r in ("colour", "camera") if r in self._names}
            choice = replace(choice, **named)  # type: ignore[arg-type]
        self.inbox, self._looks = Inbox(), 0
        self.localizer = Localizer(
            self.maps, LiveOptions.from_parameters(self.given), name=str(stream), choice=choice,
            device=self.given["device"],
        )  # fmt: skip
        with ExitStack() as active:
            active.callback(self._end_worker)
            self._worker = Thread(target=self._work, name="placegraph", daemon=True)
            self._worker.start()
            Services(self, active)
            look = node.create_timer(
                _UPDATE_INTERVAL, self.update_subscriptions, clock=self.ros.steady()
            )
            active.callback(node.destroy_timer, look)
            period = self.given["bond_heartbeat_period"]
            if period > 0 and self._type("bond/msg/Status") is not None:
                Bond(self.ros, node, float(period), active)
            self._active = active.pop_all()
        self.update_subscriptions()

    def _deactivate(self) -> None:
        """Destroy what the active node has made; the pose is forgotten."""
        self._active.close()

    def _end_worker(self) -> None:
        """End the worker and log the counts of frames."""
        while self._subscribed:
            self.node.destroy_subscription(self._subscribed.popitem()[1])
        self.inbox.close()
        if self._worker is not None:
            self._worker.join()
            self._worker = None
        while self._publishers:
            if (publisher := self._publishers.popitem()[1]) is not None:
                self.node.destroy_publisher(publisher)
        summary = self.localizer.summary
        self.node.get_logger().info(
            f"{summary.frames} frames, {summary.dropped + self.inbox.dropped} dropped; "
            f"{'; '.join(f'{n} left out: {why}' for why, n in summary.left_out.items()) or 'none left out'}"
        )

    def start(self) -> None:
        """Configure and activate without a lifecycle manager; raises the reason where that fails."""
        for trigger in (self.node.trigger_configure, self.node.trigger_activate):
            trigger()
            if self.refused is not None:
                raise self.refused

    def close(self) -> None:
        """End the node; raise the worker's error, if any."""
        self._active.close()
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
        """Subscribe to named or discovered topics that are published, later only to the chosen ones."""
        chosen = self.localizer.topics
        published = self.node.get_topic_names_and_types()
        for name, kinds in published:
            is_chosen = self._is_candidate(name) if chosen is None else name in chosen
            for kind in kinds:
                wanted = is_chosen and kind.replace("/msg/", "/") in WANTED
                if wanted and (name, kind) not in self._subscribed:
                    self._subscribe(name, kind)
        for key in [k for k in self._subscribed if chosen is not None and k[0] not in chosen]:
            self.node.destroy_subscription(self._subscribed.pop(key))
        self._looks += 1
        missing = {n for r, n in self._names.items() if r in {"colour", "camera"}} - {
            name for name, _ in published
        }
        if self._looks == _SILENT and missing:
            self.node.get_logger().warning(
                f"Nothing is published on {', '.join(sorted(missing))}; remap the topics, as in "
                f"-r {TOPICS['colour']}:=/camera/color/image_raw."
            )

    def _is_candidate(self, name: str) -> bool:
        """Return whether a topic may make frames, before any are chosen.

        Discovery stays in the node's namespace, and takes what others listen to: a lazy publisher sleeps on.
        """
        node = self.node
        if name in {node.resolve_topic_name(fixed) for fixed in _TRANSFORMS}:
            return True
        if not self.given["discover"]:
            return name in self._names.values()
        own = {p.topic_name for p in list(self._publishers.values()) if p is not None}
        inside = name.startswith(f"{node.get_namespace().rstrip('/')}/") and name not in own
        return inside and node.count_subscribers(name) > 0

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
        if message.topic == "tf" and not self.given["publish_tf"]:
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
            self.ros.publish(publisher, message)

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
            if shell.given["autostart_node"]:
                shell.start()
            # a thread for what takes long, which is to open another map
            executor = ros.executors.MultiThreadedExecutor(num_threads=2)
            executor.add_node(shell.node)
            executor.spin()
        except (KeyboardInterrupt, ros.executors.ExternalShutdownException):
            pass
        finally:
            shell.close()
    except PlacegraphError as error:  # the log has it
        return error.exit_code
    finally:
        ros.rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
