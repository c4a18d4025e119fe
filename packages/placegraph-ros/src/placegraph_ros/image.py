"""A frame's colours and its camera as messages, for viewers."""

from __future__ import annotations

import io

import numpy as np

from placegraph.core.geometry import Camera
from placegraph.io.capture.frame import Frame
from placegraph_ros.message import Fields, FrameIds, Message, header

QUALITY = 80
"""Of JPEG."""
MODELS = {0: "plumb_bob", 4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}
"""ROS's names of lenses by how many numbers tell of their distortion."""


def image_messages(frame: Frame, stamp: float, frames: FrameIds | None = None) -> list[Message]:
    """`CompressedImage` (JPEG) of a frame's colours, and its `CameraInfo`.

    Raises `InputError` where the image is broken, `OptionError` where ROS cannot say the stamp [s].
    """
    from PIL import Image

    frames = frames or FrameIds()
    head, file = header(stamp, frames.camera), io.BytesIO()
    Image.fromarray(frame.rgb()).save(file, "JPEG", quality=QUALITY)
    data = np.frombuffer(file.getvalue(), np.uint8)
    image = {"header": head, "format": "jpeg", "data": data}
    info = {"header": head} | info_fields(frame.camera)
    return [
        Message("localization/image", "sensor_msgs/msg/CompressedImage", stamp, image),
        Message("localization/camera_info", "sensor_msgs/msg/CameraInfo", stamp, info),
    ]


def info_fields(camera: Camera) -> Fields:
    """`sensor_msgs/CameraInfo` without its header; ROS's pixel centres are whole numbers."""
    k = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1.0]])
    fisheye = camera.model == "fisheye"
    return {
        "width": camera.width, "height": camera.height,
        "distortion_model": "equidistant" if fisheye else MODELS[len(camera.distortion)],
        "d": np.array(camera.distortion or [0.0] * 5),
        "k": k, "r": np.eye(3), "p": np.insert(k, 3, 0.0, axis=1),
    }  # fmt: skip
