"""Messages as `rosbags` decodes them, by the definitions that ROS itself ships.

The few types that are read are the same in all of ROS 2, and in all of ROS 1; so a bag without
definitions, as sqlite has them, is read like one with them. Of packages that ROS does not bring, the
definitions are what nav2_msgs and foxglove_msgs say; a bag carries them along.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from functools import lru_cache
from struct import unpack_from
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph_io.ros.files.storage import Message, Topic

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


TRANSFORMS = "tf2_msgs/msg/TFMessage"
_SOLID = "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 size\n{}foxglove_msgs/Color color"
_POINTS = (
    "geometry_msgs/Point[] points\nfoxglove_msgs/Color color\nfoxglove_msgs/Color[] colors\n"
    "uint32[] indices"
)
_DEFINITIONS = {
    "nav2_msgs/msg/Particle": "geometry_msgs/Pose pose\nfloat64 weight",
    "nav2_msgs/msg/ParticleCloud": "std_msgs/Header header\nnav2_msgs/Particle[] particles",
    "foxglove_msgs/msg/Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a",
    "foxglove_msgs/msg/KeyValuePair": "string key\nstring value",
    "foxglove_msgs/msg/ArrowPrimitive": (
        "geometry_msgs/Pose pose\nfloat64 shaft_length\nfloat64 shaft_diameter\n"
        "float64 head_length\nfloat64 head_diameter\nfoxglove_msgs/Color color"
    ),
    "foxglove_msgs/msg/CubePrimitive": _SOLID.format(""),
    "foxglove_msgs/msg/SpherePrimitive": _SOLID.format(""),
    "foxglove_msgs/msg/CylinderPrimitive": _SOLID.format(
        "float64 bottom_scale\nfloat64 top_scale\n"
    ),
    "foxglove_msgs/msg/LinePrimitive": (
        "uint8 LINE_STRIP=0\nuint8 LINE_LOOP=1\nuint8 LINE_LIST=2\nuint8 type\n"
        f"geometry_msgs/Pose pose\nfloat64 thickness\nbool scale_invariant\n{_POINTS}"
    ),
    "foxglove_msgs/msg/TriangleListPrimitive": f"geometry_msgs/Pose pose\n{_POINTS}",
    "foxglove_msgs/msg/TextPrimitive": (
        "geometry_msgs/Pose pose\nbool billboard\nfloat64 font_size\nbool scale_invariant\n"
        "foxglove_msgs/Color color\nstring text"
    ),
    "foxglove_msgs/msg/ModelPrimitive": (
        "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nfoxglove_msgs/Color color\n"
        "bool override_color\nstring url\nstring media_type\nuint8[] data"
    ),
    "foxglove_msgs/msg/SceneEntityDeletion": (
        "builtin_interfaces/Time timestamp\nuint8 MATCHING_ID=0\nuint8 ALL=1\nuint8 type\nstring id"
    ),
    "foxglove_msgs/msg/SceneEntity": (
        "builtin_interfaces/Time timestamp\nstring frame_id\nstring id\n"
        "builtin_interfaces/Duration lifetime\nbool frame_locked\n"
        "foxglove_msgs/KeyValuePair[] metadata\nfoxglove_msgs/ArrowPrimitive[] arrows\n"
        "foxglove_msgs/CubePrimitive[] cubes\nfoxglove_msgs/SpherePrimitive[] spheres\n"
        "foxglove_msgs/CylinderPrimitive[] cylinders\nfoxglove_msgs/LinePrimitive[] lines\n"
        "foxglove_msgs/TriangleListPrimitive[] triangles\nfoxglove_msgs/TextPrimitive[] texts\n"
        "foxglove_msgs/ModelPrimitive[] models"
    ),
    "foxglove_msgs/msg/SceneUpdate": (
        "foxglove_msgs/SceneEntityDeletion[] deletions\nfoxglove_msgs/SceneEntity[] entities"
    ),
}


@lru_cache(maxsize=2)
def typestore(encoding: str) -> Typestore:
    """Types of ROS 2, or of ROS 1 where the encoding is `ros1`."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    lacking = dict(_DEFINITIONS)
    if encoding == "ros1":
        lacking[TRANSFORMS] = "geometry_msgs/TransformStamped[] transforms"
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for name, text in lacking.items():
        store.register(get_types_from_msg(text, name))
    return store


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
