"""What people and navigation ask of the node, and where it waits: nobody keeps a robot waiting."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from threading import Condition
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import InputError, PlacegraphError
from placegraph.io.capture.posed import pose_of
from placegraph.maps import open_rooms
from placegraph_io.ros.decode import frame_of
from placegraph_io.ros.stream import Packet
from placegraph_io.ros.topics import IMAGES
from placegraph_ros.localizer import Localizer
from placegraph_ros.message import Message

if TYPE_CHECKING:
    from placegraph_ros.node import Ros


Asked = Callable[[Localizer], list[Message]]


NEWEST = 4
"""Images of a topic that wait at most; then the oldest is dropped."""
_MOST = 5000  # other messages
_TICK = 0.02  # seconds after which None is handed out


class Inbox:
    """Takes messages and questions from any thread without waiting, and hands them out in order.

    `dropped` counts images, and others, for which there was no room.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._changed = Condition()
        self._held: deque[Packet | Asked] = deque()
        self._images: Counter[str] = Counter()
        self._closed = False

    def put(self, packet: Packet) -> None:
        """Take a message."""
        with self._changed:
            if packet.type.replace("/msg/", "/") in IMAGES:
                self._images[packet.topic] += 1
                if self._images[packet.topic] > NEWEST:
                    self._drop(packet.topic)
            elif len(self._held) >= _MOST:
                self.dropped += 1
                return
            self._held.append(packet)
            self._changed.notify()

    def ask(self, asked: Asked) -> None:
        """Take what is to be done with the localizer."""
        with self._changed:
            self._held.append(asked)
            self._changed.notify()

    def close(self) -> None:
        """Hand out nothing more."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def __iter__(self) -> Iterator[Packet | Asked | None]:
        while True:
            with self._changed:
                if not self._held and not self._closed:
                    self._changed.wait(_TICK)
                if self._closed:
                    return
                event = self._held.popleft() if self._held else None
                if isinstance(event, Packet) and event.topic in self._images:
                    self._images[event.topic] -= 1
            yield event

    def _drop(self, topic: str) -> None:
        """Drop the oldest image of a topic."""
        row = next(
            i
            for i, held in enumerate(self._held)
            if isinstance(held, Packet) and held.topic == topic
        )
        del self._held[row]
        self._images[topic] -= 1
        self.dropped += 1


_LOADED, _MISSING, _INVALID = 0, 1, 2  # results of nav2_msgs/LoadMap


class Services:
    """Subscribes to `initialpose`, and offers the services of nav2's localizers.

    They are answered at once, and take effect before the next message; but for `load_map`, which is
    answered when the map is open.
    """

    def __init__(self, ros: Ros, node: Any, inbox: Inbox, map_frame: str) -> None:  # noqa: ANN401
        self._node, self._inbox, self._map = node, inbox, map_frame
        told = ros.message("geometry_msgs/msg/PoseWithCovarianceStamped")
        node.create_subscription(told, "initialpose", self.place, 10)
        empty = ros.service("std_srvs/srv/Empty")
        node.create_service(
            empty, "reinitialize_global_localization", partial(self._asked, Localizer.relocalize)
        )
        node.create_service(
            empty, "request_nomotion_update", partial(self._asked, Localizer.update)
        )
        try:
            placing = ros.service("nav2_msgs/srv/SetInitialPose")
            loading = ros.service("nav2_msgs/srv/LoadMap")
        except (ImportError, AttributeError, ValueError):
            node.get_logger().warning(
                "set_initial_pose and load_map are not offered: nav2_msgs is not installed "
                "(apt install ros-$ROS_DISTRO-nav2-msgs)."
            )
            return
        node.create_service(placing, "set_initial_pose", self.set_pose)
        alone = ros.groups.MutuallyExclusiveCallbackGroup()  # opening takes seconds; others go on
        node.create_service(loading, "load_map", self.load, callback_group=alone)

    def place(self, message: Any) -> None:  # noqa: ANN401  # rclpy's
        """Take a pose that was told; what is none is refused, and the log says why."""
        try:
            pose, covariance = told_pose(message, self._map)
        except InputError as error:
            self._node.get_logger().error(str(error))
            return
        self._inbox.ask(lambda localizer: localizer.place(pose, covariance))

    def set_pose(self, request: Any, response: Any) -> Any:  # noqa: ANN401  # rclpy's
        """`set_initial_pose`."""
        self.place(request.pose)
        return response

    def _asked(self, what: Any, _request: Any, response: Any) -> Any:  # noqa: ANN401  # rclpy's
        self._inbox.ask(what)
        return response

    def load(self, request: Any, response: Any) -> Any:  # noqa: ANN401  # rclpy's
        """`load_map`: of a path or a file:// address."""
        address = urlsplit(request.map_url)
        path = Path(unquote(address.path) if address.scheme == "file" else request.map_url)
        try:
            maps = open_rooms(path)
        except PlacegraphError as error:
            self._node.get_logger().error(f"load_map: {error}")
            response.result = _INVALID if path.exists() else _MISSING
            return response
        self._inbox.ask(lambda localizer: localizer.load(maps))
        response.result = _LOADED
        return response


def told_pose(message: Any, map_frame: str) -> tuple[Floats, Floats]:  # noqa: ANN401  # rclpy's
    """Pose (4, 4) and covariance (6, 6) of a `PoseWithCovarianceStamped`; `InputError`: it is none here."""
    frame = frame_of(message.header.frame_id)
    if frame not in {"", map_frame}:
        raise InputError(
            f"initialpose: the pose is told in {frame!r}; tell it in {map_frame!r} (in RViz: Fixed Frame)."
        )
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    pose = pose_of([at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w], "initialpose: the pose")
    return pose, np.array(message.pose.covariance, np.float64).reshape(6, 6)
