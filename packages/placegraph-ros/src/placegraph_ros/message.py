"""A message of ROS, whoever carries it, and the parts that most messages are made of.

Fields are nested as the definition of the type names them. What is left out is zero or empty.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from placegraph.core.geometry import Floats, quaternion_from_rotation
from placegraph.errors import OptionError

Fields = dict[str, Any]
_SECONDS = float(1 << 31)


@dataclass(frozen=True, slots=True, eq=False)
class Message:
    """One message to be sent, independent of who carries it: a bag, Foxglove, a node."""

    topic: str
    """Without a slash before it: ``localization/pose``."""
    type: str
    """As ROS 2 names it: ``geometry_msgs/msg/PoseWithCovarianceStamped``."""
    stamp: float
    """When it was sent [s]."""
    fields: Fields
    """Plain numbers, strings, lists and dicts, NumPy arrays of numbers."""
    latched: bool = False
    """Kept for those who come later (transient local)."""


@dataclass(frozen=True, slots=True)
class FrameIds:
    """Names of the frames (REP-105); the camera's has the axes of OpenCV, the base's x forward, z up."""

    map: str = "map"
    odom: str = "odom"
    base: str = "base_link"
    camera: str = "camera"


def nanoseconds(stamp: float) -> int:
    """Nanoseconds of a stamp [s]; `OptionError` where it is none that ROS can say."""
    if not 0.0 <= stamp < _SECONDS:
        raise OptionError(f"stamp is {stamp}; ROS tells seconds since 1970, up to 2038.")
    return round(stamp * 1e9)


def sayable(stamp: float) -> float:
    """The stamp [s]; 0, which is none, where ROS cannot say it."""
    return stamp if 0.0 <= stamp < _SECONDS else 0.0


def time(stamp: float) -> Fields:
    """`builtin_interfaces/Time` of a stamp [s]; `OptionError` where it is none that ROS can say."""
    seconds, nanos = divmod(nanoseconds(stamp), 10**9)
    return {"sec": seconds, "nanosec": nanos}


def header(stamp: float, frame: str) -> Fields:
    """`std_msgs/Header` of a stamp [s]."""
    return {"stamp": time(stamp), "frame_id": frame}


def xyz(vector: Floats) -> Fields:
    """`geometry_msgs/Point` or `Vector3` of (3,)."""
    return dict(zip("xyz", np.asarray(vector, np.float64).tolist(), strict=True))


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
