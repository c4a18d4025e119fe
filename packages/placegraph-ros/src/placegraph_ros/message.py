"""Messages of ROS, their common parts, and their encoding.

Fields are nested as in the definition of the type; omitted ones are zero or empty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.geometry import Floats, quaternion_from_rotation
from placegraph.errors import MissingExtraError, OptionError
from placegraph_io.ros.decode import typestore

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

Fields = dict[str, Any]
_SECONDS = float(1 << 31)


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """One message, for a bag, Foxglove or a node."""

    topic: str  # Without a slash before it: ``localization/pose``
    type: str  # As ROS 2 names it: ``geometry_msgs/msg/PoseWithCovarianceStamped``
    stamp: float  # Time of sending [s]
    fields: Fields  # Plain numbers, strings, lists and dicts, NumPy arrays of numbers
    latched: bool = False  # Whether later subscribers receive it (transient local)


@dataclass(frozen=True, slots=True)
class FrameIds:
    """Names of the frames (REP-105); the camera's has the axes of OpenCV, the base's x forward, z up."""

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"
    camera: str = "camera"


def nanoseconds(stamp: float) -> int:
    """Return the nanoseconds of a stamp [s]; `OptionError` out of ROS's range."""
    if not 0.0 <= stamp < _SECONDS:
        raise OptionError(f"stamp is {stamp}; ROS needs seconds since 1970, up to 2038.")
    return round(stamp * 1e9)


def stamp_or_zero(stamp: float) -> float:
    """Return the stamp [s], or 0 (unset) out of ROS's range."""
    return stamp if 0.0 <= stamp < _SECONDS else 0.0


def time(stamp: float) -> Fields:
    """`builtin_interfaces/Time` of a stamp [s]; `OptionError` out of ROS's range."""
    seconds, nanos = divmod(nanoseconds(stamp), 10**9)
    return {"sec": seconds, "nanosec": nanos}


def header(stamp: float, frame: str) -> Fields:
    """`std_msgs/Header` of a stamp [s]."""
    return {"stamp": time(stamp), "frame_id": frame}


def xyz(vector: Floats) -> Fields:
    """`geometry_msgs/Point` or `Vector3` of (3,)."""
    return dict(zip("xyz", np.asarray(vector, np.float64).tolist(), strict=True))


def scale(value: float) -> Fields:
    """`geometry_msgs/Vector3` of three times the same."""
    return xyz(np.full(3, value))


def points(places: Floats) -> list[Fields]:
    """`geometry_msgs/Point[]` of (N, 3)."""
    return [{"x": x, "y": y, "z": z} for x, y, z in np.asarray(places, np.float64).tolist()]


def quaternion(rotation: Floats) -> Fields:
    """`geometry_msgs/Quaternion` of a rotation (3, 3)."""
    return dict(zip("xyzw", quaternion_from_rotation(rotation).tolist(), strict=True))


def pose(matrix: Floats) -> Fields:
    """`geometry_msgs/Pose` of a rigid transform (4, 4)."""
    return poses(matrix[None])[0]


def poses(matrices: Floats) -> list[Fields]:
    """`geometry_msgs/Pose[]` of rigid transforms (N, 4, 4)."""
    turned = quaternion_from_rotation(matrices[:, :3, :3]).tolist()
    return [
        {"position": place, "orientation": {"x": x, "y": y, "z": z, "w": w}}
        for place, (x, y, z, w) in zip(points(matrices[:, :3, 3]), turned, strict=True)
    ]


def transform(parent: str, child: str, parent_from_child: Floats, stamp: float) -> Fields:
    """`geometry_msgs/TransformStamped` of a rigid transform (4, 4)."""
    moved = xyz(parent_from_child[:3, 3])
    turned = quaternion(parent_from_child[:3, :3])
    return {
        "header": header(stamp, parent),
        "child_frame_id": child,
        "transform": {"translation": moved, "rotation": turned},
    }


def colour(rgb: tuple[float, float, float], alpha: float = 1.0) -> Fields:
    """`std_msgs/ColorRGBA` or `foxglove_msgs/Color` of intensities between 0 and 1."""
    return dict(zip("rgba", (*map(float, rgb), float(alpha)), strict=True))


def cdr(message: Message) -> bytes:
    """Return a message as ROS 2 sends it: CDR, little endian, with its head.

    Raises `OptionError` for an unknown type or a field that does not fit it, `MissingExtraError` without
    `rosbags`.
    """
    return encode(message, "cdr")


def encode(message: Message, encoding: str) -> bytes:
    """Return a message as `cdr`, or as `ros1` writes it; raises as `cdr` does."""
    store = load_types(encoding)
    kind = type_name(message.type, store)
    serialize = store.serialize_ros1 if encoding == "ros1" else store.serialize_cdr
    try:
        return bytes(serialize(_maker(kind, encoding)(message.fields), kind))
    except OptionError:
        raise
    except Exception as error:  # generated code raises anything
        raise OptionError(
            f"{message.topic}: a field does not fit the definition of {message.type} "
            f"({type(error).__name__}: {error})."
        ) from error


def definition(kind: str) -> str:
    """Return the definition of a type and of all types in it, for the schema `ros2msg` of MCAP.

    Raises `OptionError` where the type is unknown, `MissingExtraError` without `rosbags`.
    """
    store = load_types("cdr")
    text, _ = store.generate_msgdef(type_name(kind, store), ros_version=2)
    return text


def load_types(encoding: str) -> Typestore:
    """Return all types; `MissingExtraError` where `rosbags` is not installed."""
    try:
        return typestore(encoding)
    except ImportError as error:
        raise MissingExtraError(
            'ROS messages need the extra `ros`: pip install "placegraph[ros]".'
        ) from error


def type_name(kind: str, store: Typestore) -> str:
    """Return the type as the store names it; `OptionError` where there is none."""
    name = kind if "/msg/" in kind else kind.replace("/", "/msg/")
    if name not in store.fielddefs:
        raise OptionError(
            f"type: {kind!r} is not a message type of ROS or placegraph; check the spelling."
        )
    return name


@lru_cache(maxsize=256)
def _maker(kind: str, encoding: str) -> Callable[[Mapping[str, Any]], Any]:
    """Return the function that makes a message of `rosbags` from fields."""
    store = typestore(encoding)
    cls: Any = store.types[kind]
    fields = store.fielddefs[kind][1]
    # ROS 1 writes some in capitals
    parts = [(name, name.lower(), _part(what, encoding)) for name, what in fields]
    names = {lower for _, lower, _ in parts}

    def made(given: Mapping[str, Any]) -> Any:  # noqa: ANN401  # of rosbags
        held = {name.lower(): value for name, value in given.items()}
        if not held.keys() <= names:
            unknown = ", ".join(sorted(held.keys() - names))
            raise OptionError(
                f"fields: {kind} has no {unknown}; check the definition of the message."
            )
        return cls(**{name: make(held.get(lower)) for name, lower, make in parts})

    return made


def _part(described: Any, encoding: str) -> Callable[[Any], Any]:  # noqa: ANN401  # of rosbags
    """Return the function that makes one field from a value, or from None."""
    from rosbags.interfaces import Nodetype

    node, what = described
    if node == Nodetype.BASE:
        empty: Any = "" if what[0] == "string" else 0
        return lambda value: empty if value is None else value
    if node == Nodetype.NAME:
        return lambda value: _maker(what, encoding)({} if value is None else value)
    (inner, name), length = what
    if inner == Nodetype.NAME:
        return lambda value: [_maker(name, encoding)(part) for part in value or ()]
    if name[0] == "string":
        return lambda value: list(value or ())
    kind = np.dtype("u1" if name[0] in {"octet", "byte", "char"} else name[0])
    size = length if node == Nodetype.ARRAY else 0
    return lambda value: np.zeros(size, kind) if value is None else np.asarray(value, kind).ravel()
