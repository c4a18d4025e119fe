"""Messages as `rosbags` decodes them, by the definitions that ROS itself ships.

The few types that are read are the same in all of ROS 2, and in all of ROS 1; so a bag without
definitions, as sqlite has them, is read like one with them.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from struct import unpack_from
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph.formats.ros.types import TRANSFORMS, typestore

if TYPE_CHECKING:
    from placegraph.formats.ros.files.storage import Message, Topic

HEAD = 24
"""Bytes of a message with a header that hold its stamp."""


def decoded(message: Message, topic: str, kind: str, encoding: str) -> Any:  # noqa: ANN401  # rosbags'
    """Message of a type; `InputError`, which names file and topic, where its bytes are none."""
    return decode(message.read(), f"{message.place.path}, {topic}", kind, encoding)


def decode(data: bytes, where: str, kind: str, encoding: str) -> Any:  # noqa: ANN401  # rosbags'
    """Message of bytes; `InputError`, which begins with `where`, where they are none of that type."""
    store, kind = typestore(encoding), kind.replace("tf/msg/tfMessage", TRANSFORMS)
    try:
        if encoding == "ros1":
            return store.deserialize_ros1(data, kind)
        return store.deserialize_cdr(data, kind)
    except Exception as error:  # what generated code raises at damaged bytes is anything
        raise InputError(
            f"{where}: a message is no {kind.replace('/msg/', '/')} as ROS defines it "
            f"({type(error).__name__}: {error}); record that topic again, or leave it out."
        ) from error


def stamps(heads: Iterable[bytes], topic: Topic) -> NDArray[np.float64]:
    """Header's stamps (N,) [s] of the first bytes of messages; where unset (0), the time of recording."""
    at, form = (4, "II") if topic.encoding == "ros1" else (4, "iI")
    out = np.empty(len(topic))
    for i, head in enumerate(heads):
        order = ">" if topic.encoding == "cdr" and head[1:2] in {b"\x00", b"\x02"} else "<"
        try:
            seconds, nanos = unpack_from(order + form, head, at)
        except struct.error as error:
            raise InputError(f"{topic.name}: message {i} has no header; record again.") from error
        out[i] = seconds + nanos * 1e-9
    unset = out == 0.0
    out[unset] = topic.times[unset] * 1e-9
    return out


def stamp_of(header: Any) -> float:  # noqa: ANN401  # rosbags'
    """Stamp of a header [s]."""
    return float(header.stamp.sec) + float(header.stamp.nanosec) * 1e-9


def frame_of(name: str) -> str:
    """Name of a frame without the slash that ROS 1 wrote before it."""
    return name.lstrip("/")
