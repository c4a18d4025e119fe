"""What frames are made of, found in a stream while it is heard: as in a bag, of its first messages."""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np

from placegraph.errors import PlacegraphError
from placegraph_io.ros.files.bag import Bag
from placegraph_io.ros.files.storage import Topic
from placegraph_io.ros.packets import Held, Packet, is_static
from placegraph_io.ros.plan import Plan, Wishes, plan_of
from placegraph_io.ros.poses import TRANSFORM_TYPES
from placegraph_io.ros.views import IMAGES

LISTEN = 1.0
"""Seconds of a stream that are heard before something is chosen, and between two tries."""
_IMAGES, _OTHERS = 16, 2000  # messages of a topic that are kept until then
OTHERS = ("sensor_msgs/CameraInfo", "nav_msgs/Odometry", "sensor_msgs/Imu")
WANTED = frozenset((*IMAGES, *TRANSFORM_TYPES, *OTHERS))
"""Types of messages that are listened to, such as `sensor_msgs/Image`."""


class Discovery:
    """Listens to a stream until it is known what frames are made of.

    Parameters
    ----------
    path
        What the stream is called in messages; a file of this name with ``.json`` behind it is where
        they say that what is missing can be written.
    wishes
        What the user says of it.

    """

    def __init__(self, path: Path, wishes: Wishes) -> None:
        self.path, self.wishes = path, wishes
        self.lacks: tuple[str, ...] = ()
        """Sentences on what is missing still."""
        self._heard: dict[tuple[str, str, str], deque[Packet]] = {}
        self._next: float | None = None

    def take(self, packet: Packet) -> Plan | None:
        """Take in a message; what frames are made of, as soon as that is known."""
        if packet.type.replace("/msg/", "/") not in WANTED:
            return None
        key = packet.topic, packet.type, packet.encoding
        if key not in self._heard:
            short = packet.type.replace("/msg/", "/")
            self._heard[key] = deque(maxlen=_IMAGES if short in IMAGES else _OTHERS)
        self._heard[key].append(packet)
        if (
            self._next is None or packet.time < self._next - LISTEN
        ):  # the first, or the clock was set
            self._next = packet.time + LISTEN
        return self.found() if packet.time >= self._next else None

    def found(self) -> Plan | None:
        """What frames are made of by what was heard, or None, and what is missing is told in `lacks`."""
        held = [packet for packets in self._heard.values() for packet in packets]
        if not held:
            self.lacks = (f"{self.path}: no message of a camera has come yet.",)
            return None
        self._next = max(packet.time for packet in held) + LISTEN
        try:
            plan = plan_of(self._bag(), self.wishes)
        except PlacegraphError as error:
            self.lacks = (str(error),)
            return None
        self.lacks = tuple(plan.lacks.values())
        return None if plan.lacks else plan

    def heard(self) -> list[Packet]:
        """The messages that were heard, transforms that never change first, then in order."""
        held = [packet for packets in self._heard.values() for packet in packets]
        return sorted(held, key=lambda p: (not is_static(p.topic), p.time))

    def _bag(self) -> Bag:
        """What was heard, as a bag."""
        topics: dict[str, Topic] = {}
        for (name, kind, encoding), packets in self._heard.items():
            times = np.array([p.time for p in packets])
            order = np.argsort(times, kind="stable")
            if name in topics and len(topics[name]) >= len(packets):
                continue  # of types that share a name, the most frequent
            topics[name] = Topic(
                name=name, type=kind, encoding=encoding,
                times=np.rint(times[order] * 1e9).astype(np.int64),
                places=(Held(self.path, [p.data for p in packets]),),
                which=np.zeros(len(packets), np.int64), offsets=order.astype(np.int64),
            )  # fmt: skip
        return Bag(self.path, dict(sorted(topics.items())), ())
