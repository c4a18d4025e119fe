"""Captures written as bags of ROS, for tests and benchmarks, by the library's own writer."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.io.capture.frame import Capture
from placegraph_ros import bag
from placegraph_ros.message import Message, header, pose, transform, xyz
from placegraph_ros.scene_messages import info_fields

OPTICAL = "camera_optical_frame"
BASE_FROM_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.02], [0.0, -1.0, 0.0, 0.4], [0.0, 0.0, 0.0, 1.0]]
)
"""Pose of the camera on the robot: it looks ahead, 0.4 m above the base."""


class BagWriter(bag.BagWriter):
    """Writes what a robot with a camera records, message by message."""

    def send(self, topic: str, kind: str, stamp: float, frame: str, **fields: Any) -> None:  # noqa: ANN401
        """Write a message of a type such as `sensor_msgs/msg/Image` with a header, at its stamp."""
        content = {"header": header(stamp, frame)} | fields
        self.write(Message(topic, kind, stamp, content))

    def image(
        self, topic: str, stamp: float, pixels: NDArray[Any], encoding: str, frame: str = OPTICAL
    ) -> None:
        """Write a `sensor_msgs/Image` of pixels (H, W[, C])."""
        rows = np.ascontiguousarray(pixels)
        self.send(topic, "sensor_msgs/msg/Image", stamp, frame,
            height=rows.shape[0], width=rows.shape[1], encoding=encoding,
            step=rows.strides[0], data=rows.reshape(-1).view(np.uint8),
        )  # fmt: skip

    def send_compressed(
        self, topic: str, stamp: float, data: bytes, encoding: str, frame: str = OPTICAL
    ) -> None:
        """Write a `sensor_msgs/CompressedImage`."""
        self.send(topic, "sensor_msgs/msg/CompressedImage", stamp, frame,
            format=encoding, data=np.frombuffer(data, np.uint8),
        )  # fmt: skip

    def info(
        self,
        topic: str,
        stamp: float,
        camera: Camera,
        frame: str = OPTICAL,
        **fields: Any,  # noqa: ANN401
    ) -> None:
        """Write a `sensor_msgs/CameraInfo`; `fields` are others than the camera's."""
        self.send(topic, "sensor_msgs/msg/CameraInfo", stamp, frame, **info_fields(camera) | fields)

    def transform(
        self, parent: str, child: str, pose: NDArray[np.float64], stamp: float,
        topic: str = "/tf", recorded: float | None = None,
    ) -> None:  # fmt: skip
        """Write a transform parent_from_child (4, 4)."""
        at = stamp if recorded is None else recorded
        content = {"transforms": [transform(parent, child, pose, stamp)]}
        self.write(Message(topic, "tf2_msgs/msg/TFMessage", at, content))

    def odometry(
        self, topic: str, stamp: float, matrix: NDArray[np.float64], child: str = "base_link"
    ) -> None:
        """Write a `nav_msgs/Odometry` in the frame odom."""
        self.send(topic, "nav_msgs/msg/Odometry", stamp, "odom",
            child_frame_id=child, pose={"pose": pose(matrix)},
        )  # fmt: skip

    def imu(
        self, topic: str, stamp: float, up: NDArray[np.float64], frame: str = "base_link"
    ) -> None:
        """Write a `sensor_msgs/Imu` that rests, with up (3,) in its axes."""
        self.send(topic, "sensor_msgs/msg/Imu", stamp, frame, linear_acceleration=xyz(9.81 * up))


@dataclass(frozen=True)
class Layout:
    """Layout of a written capture: topics and encodings."""

    images: Literal["raw", "packed", "none"] = "raw"
    """`sensor_msgs/Image`, or `CompressedImage` (PNG, compressedDepth), or nothing."""
    poses: Literal["tf", "odometry", "none"] = "tf"
    infos: bool = True
    depth: bool = True
    start: float = 1_700_000_000.0  # added to the stamps [s]


def write_capture(writer: BagWriter, capture: Capture, layout: Layout | None = None) -> None:
    """Write the frames of a capture, as a robot with a camera of depth would record them."""
    layout = layout or Layout()
    first = layout.start + capture.frames[0].stamp
    fixed = {"base_link": ("camera_link", BASE_FROM_CAMERA), "camera_link": (OPTICAL, np.eye(4))}
    for parent, (child, matrix) in fixed.items():
        writer.transform(parent, child, matrix, first, "/tf_static")
    camera_from_base = np.linalg.inv(BASE_FROM_CAMERA)
    for frame in capture:
        stamp = layout.start + frame.stamp
        base = frame.odometry @ camera_from_base
        if layout.poses == "tf":
            writer.transform("odom", "base_link", base, stamp)
        elif layout.poses == "odometry":
            writer.odometry("/odom", stamp, base)
        if layout.infos:
            writer.info("/camera/color/camera_info", stamp, frame.camera)
            if layout.depth and frame.depth_camera is not None:
                name = "/camera/aligned_depth_to_color/camera_info"
                writer.info(name, stamp, frame.depth_camera)
        depth = frame.depth() if layout.depth else None
        if layout.images != "none":
            _images(writer, stamp, frame.rgb(), depth, layout.images)


def _images(
    writer: BagWriter,
    stamp: float,
    rgb: NDArray[np.uint8],
    depth: NDArray[np.float32] | None,
    how: str,
) -> None:
    colour, measured = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
    units = None
    if depth is not None:
        units = np.rint(np.nan_to_num(depth) * 1000.0).astype(np.uint16)
    if how == "raw":
        writer.image(colour, stamp, rgb, "rgb8")
        if units is not None:
            writer.image(measured, stamp, units, "16UC1")
        return
    writer.send_compressed(f"{colour}/compressed", stamp, png(rgb), "rgb8; png compressed bgr8")
    if units is not None:
        data = bytes(12) + png(units)
        writer.send_compressed(
            f"{measured}/compressedDepth", stamp, data, "16UC1; compressedDepth png"
        )


def png(pixels: NDArray[Any]) -> bytes:
    """A PNG of an image."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG", compress_level=1)
    return out.getvalue()
