"""Captures written as bags of ROS, for tests and benchmarks, by the writers of `rosbags`."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from placegraph.geometry import quaternion_from_rotation

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Self

    from numpy.typing import NDArray

    from placegraph.formats.capture.frames import Capture
    from placegraph.geometry import Camera

Container = Literal["mcap", "sqlite3", "rosbag1"]
OPTICAL = "camera_optical_frame"
BASE_FROM_CAMERA = np.array(
    [[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.02], [0.0, -1.0, 0.0, 0.4], [0.0, 0.0, 0.0, 1.0]]
)
"""Of the robot that carries the camera: it looks ahead, 0.4 m above the base."""


class BagWriter:
    """Writes messages by topic, type and fields; a context that closes the bag.

    `path` is the folder of a bag of ROS 2, the file of one of ROS 1, which must not be there yet.
    `packed`: chunks are compressed, by zstd or bz2; of sqlite, messages.
    """

    def __init__(self, path: Path, container: Container = "mcap", *, packed: bool = False) -> None:
        from rosbags import rosbag1, rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.ros1 = container == "rosbag1"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        if self.ros1:
            text = "geometry_msgs/TransformStamped[] transforms"
            self.store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
        self.writer: Any
        if self.ros1:
            self.writer = rosbag1.Writer(path)
            if packed:
                self.writer.set_compression(rosbag1.Writer.CompressionFormat.BZ2)
        else:
            plugin = rosbag2.StoragePlugin[container.upper()]
            self.writer = rosbag2.Writer(path, version=8, storage_plugin=plugin)
            if packed:
                modes = rosbag2.CompressionMode
                mode = modes.STORAGE if container == "mcap" else modes.MESSAGE
                self.writer.set_compression(mode, rosbag2.CompressionFormat.ZSTD)
        self._topics: dict[tuple[str, str], Any] = {}

    def __enter__(self) -> Self:
        self.writer.open()
        return self

    def __exit__(self, *error: object) -> None:
        self.writer.close()

    def write(self, topic: str, kind: str, time: float, message: Any) -> None:  # noqa: ANN401
        """Write a message, or its bytes, of a type such as `sensor_msgs/msg/Image`, recorded at [s]."""
        if (topic, kind) not in self._topics:
            self._topics[topic, kind] = self.writer.add_connection(
                topic, kind, typestore=self.store
            )
        if not isinstance(message, bytes):
            serialize = self.store.serialize_ros1 if self.ros1 else self.store.serialize_cdr
            message = bytes(serialize(message, kind))
        self.writer.write(self._topics[topic, kind], round(time * 1e9), message)

    def send(self, topic: str, kind: str, stamp: float, frame: str, **fields: Any) -> None:  # noqa: ANN401
        """Write a message with a header, at its stamp."""
        message = self.made(kind, header=self.header(stamp, frame), **fields)
        self.write(topic, kind, stamp, message)

    def made(self, kind: str, **fields: Any) -> Any:  # noqa: ANN401  # of rosbags
        """Message of a type; fields that are not given are zero or empty."""
        kind = kind if "/msg/" in kind else kind.replace("/", "/msg/")
        given = {name.lower(): value for name, value in fields.items()}
        values = {}
        for name, described in self.store.fielddefs[kind][1]:
            values[name] = given.pop(name.lower(), None)
            if values[name] is None:
                values[name] = self._empty(described)
        if given:
            raise ValueError(f"{kind} has no {', '.join(given)}.")
        return self.store.types[kind](**values)

    def header(self, stamp: float, frame: str) -> Any:  # noqa: ANN401  # of rosbags
        """Header of a stamp [s]."""
        nanos = round(stamp * 1e9)
        time = self.made("builtin_interfaces/Time", sec=nanos // 10**9, nanosec=nanos % 10**9)
        return self.made("std_msgs/Header", stamp=time, frame_id=frame)

    def _empty(self, described: Any) -> Any:  # noqa: ANN401  # of rosbags
        from rosbags.interfaces import Nodetype

        kind, what = described
        if kind == Nodetype.BASE:
            return "" if what[0] == "string" else 0
        if kind == Nodetype.NAME:
            return self.made(what)
        (inner, name), length = what
        if inner != Nodetype.BASE or name[0] == "string":
            return []
        return np.zeros(length, "u1" if name[0] in {"octet", "byte", "char"} else name[0])

    # ------------------------------------------------------------------------------- messages

    def image(
        self, topic: str, stamp: float, pixels: NDArray[Any], encoding: str, frame: str = OPTICAL
    ) -> None:
        """Write a `sensor_msgs/Image` of pixels (H, W[, C])."""
        rows = np.ascontiguousarray(pixels)
        self.send(topic, "sensor_msgs/msg/Image", stamp, frame,
            height=rows.shape[0], width=rows.shape[1], encoding=encoding,
            step=rows.strides[0], data=rows.reshape(-1).view(np.uint8),
        )  # fmt: skip

    def compressed(
        self, topic: str, stamp: float, data: bytes, said: str, frame: str = OPTICAL
    ) -> None:
        """Write a `sensor_msgs/CompressedImage`."""
        self.send(topic, "sensor_msgs/msg/CompressedImage", stamp, frame,
            format=said, data=np.frombuffer(data, np.uint8),
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
        k = np.array([camera.fx, 0, camera.cx - 0.5, 0, camera.fy, camera.cy - 0.5, 0, 0, 1.0])
        p = np.insert(k.reshape(3, 3), 3, 0.0, axis=1).reshape(-1)
        names = {0: "plumb_bob", 4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}
        model = "equidistant" if camera.model == "fisheye" else names[len(camera.distortion)]
        given = {
            "width": camera.width, "height": camera.height, "distortion_model": model,
            "d": np.array(camera.distortion or [0.0] * 5), "k": k, "r": np.eye(3).reshape(-1), "p": p,
        } | fields  # fmt: skip
        self.send(topic, "sensor_msgs/msg/CameraInfo", stamp, frame, **given)

    def transform(
        self, parent: str, child: str, pose: NDArray[np.float64], stamp: float,
        topic: str = "/tf", recorded: float | None = None,
    ) -> None:  # fmt: skip
        """Write a transform parent_from_child (4, 4)."""
        move, turn = self._parts(pose)
        made = self.made(
            "geometry_msgs/TransformStamped", header=self.header(stamp, parent),
            child_frame_id=child,
            transform=self.made("geometry_msgs/Transform", translation=move, rotation=turn),
        )  # fmt: skip
        at = stamp if recorded is None else recorded
        held = self.made("tf2_msgs/TFMessage", transforms=[made])
        self.write(topic, "tf2_msgs/msg/TFMessage", at, held)

    def odometry(
        self, topic: str, stamp: float, pose: NDArray[np.float64], child: str = "base_link"
    ) -> None:
        """Write a `nav_msgs/Odometry` in the frame odom."""
        move, turn = self._parts(pose, "Point")
        held = self.made("geometry_msgs/Pose", position=move, orientation=turn)
        self.send(topic, "nav_msgs/msg/Odometry", stamp, "odom",
            child_frame_id=child, pose=self.made("geometry_msgs/PoseWithCovariance", pose=held),
        )  # fmt: skip

    def imu(
        self, topic: str, stamp: float, up: NDArray[np.float64], frame: str = "base_link"
    ) -> None:
        """Write a `sensor_msgs/Imu` that rests, with up (3,) in its axes."""
        felt = self.made("geometry_msgs/Vector3", **dict(zip("xyz", 9.81 * up, strict=True)))
        self.send(topic, "sensor_msgs/msg/Imu", stamp, frame,
            linear_acceleration=felt,
        )  # fmt: skip

    def _parts(self, pose: NDArray[np.float64], point: str = "Vector3") -> tuple[Any, Any]:
        axes = dict(zip("xyzw", quaternion_from_rotation(pose[:3, :3]).tolist(), strict=True))
        move = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
        return self.made(f"geometry_msgs/{point}", **move), self.made(
            "geometry_msgs/Quaternion", **axes
        )


@dataclass(frozen=True)
class Layout:
    """How a capture is written."""

    images: Literal["raw", "packed", "none"] = "raw"
    """`sensor_msgs/Image`, or `CompressedImage` (PNG, compressedDepth), or nothing."""
    poses: Literal["tf", "odometry", "none"] = "tf"
    infos: bool = True
    depth: bool = True
    start: float = 1_700_000_000.0
    """Added to the stamps [s]."""


def write_capture(writer: BagWriter, capture: Capture, layout: Layout | None = None) -> None:
    """Write the frames of a capture, as a robot with a camera of depth would record them."""
    layout = layout or Layout()
    first = layout.start + capture.frames[0].stamp
    fixed = {"base_link": ("camera_link", BASE_FROM_CAMERA), "camera_link": (OPTICAL, np.eye(4))}
    for parent, (child, pose) in fixed.items():
        writer.transform(parent, child, pose, first, "/tf_static")
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
    writer.compressed(f"{colour}/compressed", stamp, png(rgb), "rgb8; png compressed bgr8")
    if units is not None:
        data = bytes(12) + png(units)
        writer.compressed(f"{measured}/compressedDepth", stamp, data, "16UC1; compressedDepth png")


def png(pixels: NDArray[Any]) -> bytes:
    """A PNG of an image."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG", compress_level=1)
    return out.getvalue()
