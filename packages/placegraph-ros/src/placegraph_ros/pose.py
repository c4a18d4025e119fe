"""A pose as robots ask for it: of their base, with a covariance, and as the transform map -> odom."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from placegraph.core.geometry import Floats, cross_matrix
from placegraph_ros.message import Fields, FrameIds, Message, header, pose, transform, xyz

UPRIGHT_BASE = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""base_from_camera of a base that is the camera itself with a body's axes (REP-103): x where it
looks, y to the left, z up."""
_UNKNOWN = 1e6
"""Variance of a speed that nobody measured [m^2/s^2, rad^2/s^2]."""


def based(
    map_from_camera: Floats, covariance: Floats, base_from_camera: Floats
) -> tuple[Floats, Floats]:
    """Pose (4, 4) and covariance (6, 6) of the base, of those of a camera on it.

    Both covariances are of x, y, z [m] and of a turn about the map's axes [rad]. A turn w moves
    the base by w x lever, which leads from the camera to the base in the map's axes.
    """
    map_from_base = map_from_camera @ np.linalg.inv(base_from_camera)
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -cross_matrix(map_from_base[:3, 3] - map_from_camera[:3, 3])
    return map_from_base, jacobian @ covariance @ jacobian.T


def pose_messages(
    map_from_camera: Floats,
    covariance: Floats,
    stamp: float,
    frames: FrameIds | None = None,
    *,
    map_from_odom: Floats | None = None,
    base_from_camera: Floats | None = None,
) -> list[Message]:
    """`PoseWithCovarianceStamped`, `Odometry`, and where it is known the transform map -> odom.

    Parameters
    ----------
    map_from_camera, covariance
        (4, 4), and (6, 6) of x, y, z [m] and a turn about the map's axes [rad], which is ROS's order.
    stamp
        When the camera was there [s].
    map_from_odom
        (4, 4), map_from_camera @ inv(odom_from_camera) of one moment.
    base_from_camera
        (4, 4) where the camera sits on the robot; `UPRIGHT_BASE` if not given.

    Raises
    ------
    OptionError
        The stamp is none that ROS can say.

    """
    frames = frames or FrameIds()
    mount = UPRIGHT_BASE if base_from_camera is None else base_from_camera
    map_from_base, spread = based(map_from_camera, covariance, mount)
    told = {"pose": pose(map_from_base), "covariance": spread.ravel()}
    head = header(stamp, frames.map)
    moving = {"covariance": np.eye(6).ravel() * _UNKNOWN}
    ridden = {"header": head, "child_frame_id": frames.base, "pose": told, "twist": moving}
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    messages = [
        Message("localization/pose", kind, stamp, {"header": head, "pose": told}),
        Message("localization/odometry", "nav_msgs/msg/Odometry", stamp, ridden),
    ]
    if map_from_odom is not None:
        moved = transform(frames.map, frames.odom, map_from_odom, stamp)
        messages.append(transforms_message([moved], stamp))
    return messages


def rig_message(
    base_from_camera: Floats | None, stamp: float, frames: FrameIds | None = None
) -> Message:
    """Where the camera sits on the robot, once and for all: base -> camera on `tf_static`."""
    frames = frames or FrameIds()
    mount = UPRIGHT_BASE if base_from_camera is None else base_from_camera
    fixed = transform(frames.base, frames.camera, mount, stamp)
    return transforms_message([fixed], stamp, latched=True)


def transforms_message(
    transforms: Sequence[Fields], stamp: float, *, latched: bool = False
) -> Message:
    """`tf2_msgs/TFMessage` of `message.transform`s, on `tf`, or latched on `tf_static`."""
    topic = "tf_static" if latched else "tf"
    fields = {"transforms": list(transforms)}
    return Message(topic, "tf2_msgs/msg/TFMessage", stamp, fields, latched)


def scale(value: float) -> Fields:
    """`geometry_msgs/Vector3` of three times the same."""
    return xyz(np.full(3, value))
