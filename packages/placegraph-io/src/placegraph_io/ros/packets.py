"""Messages as a stream brings them, one after the other: of a bag in the order of their recording."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from struct import error as struct_error
from struct import unpack_from
from typing import NamedTuple

import numpy as np

from placegraph.errors import InputError
from placegraph_io.ros.files.bag import Bag
from placegraph_io.ros.files.storage import Message


class Packet(NamedTuple):
    """One message, and when it came."""

    topic: str
    type: str
    """As ROS 2 names it: `sensor_msgs/msg/Image`."""
    time: float
    """When it was recorded, or received [s]."""
    data: bytes
    encoding: str = "cdr"
    """`cdr` (ROS 2) or `ros1`."""

    @property
    def stamp(self) -> float:
        """Stamp of its header [s]; where unset (0), the time at which it came; `InputError`: it has none."""
        at, form = (4, "<II") if self.encoding == "ros1" else (4, "<iI")
        if self.encoding == "cdr" and self.data[1:2] in {b"\x00", b"\x02"}:
            form = ">iI"
        try:
            seconds, nanos = unpack_from(form, self.data, at)
        except struct_error as error:
            raise InputError(f"{self.topic}: a message has no header; record again.") from error
        return float(seconds + nanos * 1e-9) or self.time

    def message(self, path: Path) -> Message:
        """The same as a message of a bag of this name."""
        return Message(Held(path, (self.data,)), 0)


class Fault(NamedTuple):
    """A message that could not be read."""

    topic: str
    reason: str
    """A sentence."""


@dataclass(frozen=True, slots=True)
class Held:
    """Messages in memory, as what messages of a bag lie in (`storage.Place`)."""

    path: Path
    """What they are called in messages."""
    data: Sequence[bytes]

    def read(self, offset: int, most: int | None = None) -> bytes:
        """As `storage.Place.read`; the offset counts messages."""
        return self.data[offset][:most]


def packets_of(bag: Bag, topics: Collection[str]) -> Iterator[Packet | Fault]:
    """Messages of some topics of a bag in the order of their recording, `tf_static` before all others.

    As for those who subscribe to it: transforms that never change are told to whoever comes.
    """
    chosen = [bag.topics[name] for name in sorted(topics) if name in bag.topics]
    times = np.concatenate([t.times for t in chosen] or [np.zeros(0, np.int64)])
    which = np.repeat(np.arange(len(chosen)), [len(t) for t in chosen])
    rows = np.concatenate([np.arange(len(t)) for t in chosen] or [np.zeros(0, np.intp)])
    moving = np.array([not is_static(t.name) for t in chosen], bool)[which]
    for i in np.lexsort((times, moving)).tolist():
        topic = chosen[which[i]]
        try:
            data = topic[int(rows[i])].read()
        except InputError as error:
            yield Fault(topic.name, str(error))
            continue
        yield Packet(topic.name, topic.type, float(times[i]) * 1e-9, data, topic.encoding)


def is_static(topic: str) -> bool:
    """Whether a topic's transforms never change."""
    return topic.endswith("tf_static")
