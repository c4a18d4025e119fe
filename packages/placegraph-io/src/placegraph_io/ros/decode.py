"""Decoding of messages with `rosbags`, by the definitions of ROS, nav2_msgs and foxglove_msgs.

The types that are read are the same in all releases of ROS 2, and of ROS 1, so that bags without
definitions are read, too.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable
from functools import cached_property, lru_cache
from struct import unpack_from
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.images import open_image, to_rgb
from placegraph_io.ros.containers import Message, Topic
from placegraph_io.storage import rvl_image, rvl_size

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

TRANSFORMS = "tf2_msgs/msg/TFMessage"
_SOLID = "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 size\n{}foxglove_msgs/Color color"
_POINTS = (
    "geometry_msgs/Point[] points\nfoxglove_msgs/Color color\nfoxglove_msgs/Color[] colors\n"
    "uint32[] indices"
)
_DEFINITIONS = {
    "bond/msg/Status": (
        "std_msgs/Header header\nstring id\nstring instance_id\nbool active\n"
        "float32 heartbeat_timeout\nfloat32 heartbeat_period"
    ),
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
    """Return the types of ROS 2, or of ROS 1 where the encoding is `ros1`."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    lacking = dict(_DEFINITIONS)
    if encoding == "ros1":
        lacking[TRANSFORMS] = "geometry_msgs/TransformStamped[] transforms"
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for name, text in lacking.items():
        store.register(get_types_from_msg(text, name))
    return store


HEAD = 24  # Bytes from which a message's stamp is read


def decode_message(message: Message, topic: str, kind: str, encoding: str) -> Any:  # noqa: ANN401  # rosbags'
    """Decode a message; `InputError`, naming file and topic, where its bytes are damaged."""
    return decode(message.read(), f"{message.place.path}, {topic}", kind, encoding)


def decode(data: bytes, where: str, kind: str, encoding: str) -> Any:  # noqa: ANN401  # rosbags'
    """Decode bytes as a type; `InputError`, beginning with `where`, where they are none of it."""
    store, kind = typestore(encoding), kind.replace("tf/msg/tfMessage", TRANSFORMS)
    try:
        if encoding == "ros1":
            return store.deserialize_ros1(data, kind)
        return store.deserialize_cdr(data, kind)
    except Exception as error:  # generated code raises anything at damaged bytes
        raise InputError(
            f"{where}: a message does not match the ROS definition of "
            f"{kind.replace('/msg/', '/')} ({type(error).__name__}: {error}); record that "
            "topic again, or exclude it."
        ) from error


def read_stamps(heads: Iterable[bytes], topic: Topic) -> NDArray[np.float64]:
    """Return the header stamps (N,) [s] of messages' first bytes; where 0, the time of recording."""
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


def header_stamp(header: Any) -> float:  # noqa: ANN401  # rosbags'
    """Return the stamp of a header [s]."""
    return float(header.stamp.sec) + float(header.stamp.nanosec) * 1e-9


def frame_name(name: str) -> str:
    """Return the name of a frame without ROS 1's leading slash."""
    return name.lstrip("/")


_PLAIN: dict[str, tuple[str, int, tuple[int, ...]]] = {
    "rgb8": ("u1", 3, (0, 1, 2)), "bgr8": ("u1", 3, (2, 1, 0)), "8UC3": ("u1", 3, (2, 1, 0)),
    "rgba8": ("u1", 4, (0, 1, 2)), "bgra8": ("u1", 4, (2, 1, 0)), "8UC4": ("u1", 4, (2, 1, 0)),
    "mono8": ("u1", 1, (0, 0, 0)), "8UC1": ("u1", 1, (0, 0, 0)), "rgb16": ("u2", 3, (0, 1, 2)),
    "bgr16": ("u2", 3, (2, 1, 0)), "mono16": ("u2", 1, (0, 0, 0)),
}  # fmt: skip
"""Number type, channels, and the channels of red, green and blue."""
_YUV = {"yuv422": (1, 0, 2), "uyvy": (1, 0, 2), "yuv422_yuy2": (0, 1, 3), "yuyv": (0, 1, 3)}
"""Positions of the first luminance, U and V in four bytes of two pixels."""
_BAYER = {"rggb": (0, 0), "grbg": (0, 1), "gbrg": (1, 0), "bggr": (1, 1)}
"""Row and column of the first red pixel."""
DEPTHS = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}  # Number types of depth encodings
GREYS = ("mono8", "8UC1", "mono16")
_LARGEST = 1 << 16
_PACKED_HEAD = 12  # bytes before the image in compressedDepth: format and two numbers


def is_colour(encoding: str) -> bool:
    """Return whether images of this encoding are read as colours."""
    return encoding in _PLAIN or encoding in _YUV or _bayer(encoding) is not None


def decode_colour(image: Any, name: str) -> NDArray[np.uint8]:  # noqa: ANN401  # rosbags'
    """Return the sRGB colours (H, W, 3) uint8 of an image message."""
    if hasattr(image, "format"):
        return _decode_compressed_colour(image, name)
    encoding = image.encoding
    if encoding in _PLAIN:
        kind, channels, rgb = _PLAIN[encoding]
        pixels = _rows(image, np.dtype(kind), channels, name)
        if kind == "u2":
            pixels = (pixels >> 8).astype(np.uint8)
        return np.ascontiguousarray(pixels[..., rgb])
    if encoding in _YUV:
        return _from_yuv(_rows(image, np.dtype("u1"), 2, name), *_YUV[encoding], name)
    red = _bayer(encoding)
    if red is not None:
        wide = encoding.endswith("16")
        raw = _rows(image, np.dtype("u2" if wide else "u1"), 1, name)[..., 0]
        return demosaic((raw >> 8).astype(np.uint8) if wide else raw, red)
    raise InputError(
        f"{name}: the colour encoding {encoding[:40]!r} is not supported; record "
        f"{', '.join(_PLAIN)}, Bayer, yuv422 or a compressed image."
    )


def decode_depth(image: Any, per_metre: float | None, name: str) -> NDArray[np.float32]:  # noqa: ANN401
    """Return the depth (h, w) float32 [m], NaN without a reading; `per_metre`: depth units per metre."""
    units = (
        _decode_compressed_depth(image, name)
        if hasattr(image, "format")
        else _depth_rows(image, name)
    )
    is_integer = units.dtype.kind == "u"
    scale = np.float32(per_metre or (1000.0 if is_integer else 1.0))
    metres: NDArray[np.float32] = np.divide(units, scale, dtype=np.float32)
    if is_integer:
        metres[units == 0] = np.nan
    else:
        metres[~(np.isfinite(metres) & (metres > 0))] = np.nan
    return metres


def read_size(image: Any, name: str) -> tuple[int, int, str]:  # noqa: ANN401  # rosbags'
    """Return width, height [px] and encoding of an image message, compressed or not."""
    if not hasattr(image, "format"):
        return int(image.width), int(image.height), str(image.encoding)
    encoding, data = image.format.partition(";")[0].strip(), bytes(image.data)
    if "compressedDepth" in image.format:
        encoding, data = encoding or "16UC1", data[_PACKED_HEAD:]
        if _is_rvl(image):
            return *rvl_size(data), encoding
    with open_image(io.BytesIO(data), f"{name} ({image.format[:40]!r})") as picture:
        inside = {"L": "mono8", "I;16": "16UC1", "I;16B": "16UC1", "I": "16UC1"}.get(
            picture.mode, "rgb8"
        )
        is_known = encoding in DEPTHS or _bayer(encoding) is not None
        return picture.width, picture.height, encoding if is_known else inside


def demosaic(raw: NDArray[np.uint8], red: tuple[int, int]) -> NDArray[np.uint8]:
    """Interpolate the colours (H, W, 3) of a Bayer image (H, W) bilinearly.

    `red`: row and column, 0 or 1, of the first red pixel.
    """
    height, width = raw.shape
    rows, columns = np.arange(height)[:, None] % 2, np.arange(width)[None] % 2
    reds = (rows == red[0]) & (columns == red[1])
    blues = (rows != red[0]) & (columns != red[1])
    weights = np.array([1, 2, 1], np.uint16)
    out = np.empty((height, width, 3), np.uint8)
    for channel, seen in enumerate((reds, ~(reds | blues), blues)):
        sums = []
        for plane in (np.where(seen, raw, 0).astype(np.uint16), seen.astype(np.uint16)):
            padded = np.pad(plane, 1)
            across = sum(w * padded[:, i : i + width] for i, w in enumerate(weights))
            sums.append(sum(w * across[i : i + height] for i, w in enumerate(weights)))
        mean = sums[0] // np.maximum(sums[1], 1)
        out[..., channel] = np.where(seen, raw, mean)
    return out


def _bayer(encoding: str) -> tuple[int, int] | None:
    name = encoding.removeprefix("bayer_")
    return _BAYER.get(name[:4]) if name != encoding and name[4:] in {"8", "16"} else None


def _rows(image: Any, kind: np.dtype[Any], channels: int, name: str) -> NDArray[Any]:  # noqa: ANN401
    """Return the pixels (H, W, channels) of an image, whose sizes are checked against its data."""
    width, height, step = int(image.width), int(image.height), int(image.step)
    row = width * channels * kind.itemsize
    data = np.asarray(image.data, np.uint8).reshape(-1)
    if not (0 < width <= _LARGEST and 0 < height <= _LARGEST):
        raise InputError(f"{name}: width and height are {width} and {height} pixels.")
    if step < row or step * (height - 1) + row > data.size:
        raise InputError(
            f"{name}: {width} x {height} of {image.encoding!r} with a step of {step} do not fit "
            f"{data.size} bytes of data; record that topic again."
        )
    lines = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1), writeable=False)
    pixels = np.ascontiguousarray(lines).view(kind.newbyteorder(">" if image.is_bigendian else "<"))
    return pixels.reshape(height, width, channels)


def _depth_rows(image: Any, name: str) -> NDArray[Any]:  # noqa: ANN401  # rosbags'
    kind = DEPTHS.get(image.encoding)
    if kind is None:
        raise InputError(
            f"{name}: the encoding {image.encoding[:40]!r} is not depth; record 16UC1 (mm) or "
            "32FC1 (m)."
        )
    return _rows(image, np.dtype(kind), 1, name)[..., 0]


def _from_yuv(
    pairs: NDArray[np.uint8], luminance: int, u: int, v: int, name: str
) -> NDArray[np.uint8]:
    """Return the colours of two bytes a pixel, every second U or V (BT.601, 16 to 235)."""
    height, width, _ = pairs.shape
    if width % 2:
        raise InputError(
            f"{name}: a YUV 4:2:2 image has {width} columns, an odd number; record it again."
        )
    four = pairs.reshape(height, width // 2, 4).astype(np.float32)
    y = 1.164 * (pairs[..., luminance].astype(np.float32) - 16)
    cb, cr = (np.repeat(four[..., i] - 128, 2, axis=1) for i in (u, v))
    rgb = np.stack([y + 1.596 * cr, y - 0.392 * cb - 0.813 * cr, y + 2.017 * cb], axis=-1)
    return np.clip(np.rint(rgb), 0, 255).astype(np.uint8)


def _decode_compressed_colour(image: Any, name: str) -> NDArray[np.uint8]:  # noqa: ANN401  # rosbags'
    with open_image(io.BytesIO(bytes(image.data)), f"{name} ({image.format[:40]!r})") as picture:
        red = _bayer(image.format.partition(";")[0].strip())
        if red is not None and picture.mode == "L":
            return demosaic(np.asarray(picture), red)
        return to_rgb(picture)


def _decode_compressed_depth(image: Any, name: str) -> NDArray[Any]:  # noqa: ANN401  # rosbags'
    """Return the units of a compressed depth image: mm as uint16, or metres as float32."""
    data, kind = bytes(image.data), image.format
    packed, what = "compressedDepth" in kind, f"{name} ({kind[:40]!r})"
    pixels = data[_PACKED_HEAD if packed else 0 :]
    if packed and _is_rvl(image):
        units = rvl_image(pixels, what)
    else:
        with open_image(io.BytesIO(pixels), what) as picture:
            if not picture.mode.startswith("I"):
                raise InputError(
                    f"{name}: the format {kind[:40]!r} has pixels of mode {picture.mode!r}, which "
                    "is not depth; record the raw image, or compressedDepth."
                )
            units = np.asarray(picture).astype(np.uint16)
    if packed and kind.startswith("32FC1"):  # quantized 1 / depth, by two numbers of the head
        a, b = unpack_from("<ff", data, 4)
        with np.errstate(divide="ignore", invalid="ignore"):
            metres = np.float32(a) / (units.astype(np.float32) - np.float32(b))
        metres[units == 0] = np.nan
        return metres.astype(np.float32)
    return units


def _is_rvl(image: Any) -> bool:  # noqa: ANN401  # rosbags'
    return "rvl" in image.format.lower()


_VALID_RADIUS = 1.1  # relative to the farthest image corner; beyond, lens models are invalid


class Registration:
    """Registration of depth images to the colour camera, at the depth camera's resolution.

    `rays`: (h, w, 3) of the depth camera's pixels, times which depth is a point; z = 1 if not given.
    """

    def __init__(
        self, colour: Camera, depth: Camera, rays: NDArray[np.float64] | None = None
    ) -> None:
        self.colour, self.depth, self.rays = colour, depth, rays
        part = min(1.0, depth.fx / colour.fx, depth.fy / colour.fy)
        size = (max(1, round(colour.width * part)), max(1, round(colour.height * part)))
        self.camera = colour.resize(*size)
        """Camera of the registered images."""

    def __reduce__(self) -> tuple[type[Registration], tuple[Any, ...]]:
        return Registration, (self.colour, self.depth, self.rays)

    @cached_property
    def _rays(self) -> NDArray[np.float64]:
        """(h, w, 3) of the depth camera's pixels."""
        if self.rays is not None:
            return self.rays
        v, u = np.mgrid[: self.depth.height, : self.depth.width]
        return self.depth.directions(np.stack([u + 0.5, v + 0.5], axis=-1))

    @cached_property
    def _reach(self) -> float:
        """Radius at z = 1 within which the colour camera sees."""
        w, h = self.camera.width, self.camera.height
        edge = np.array([(x, y) for x in (0.0, w / 2, w) for y in (0.0, h / 2, h)])
        rays = self.camera.directions(edge)[:, :2]
        return _VALID_RADIUS * float(np.nanmax(np.linalg.norm(rays, axis=1)))

    def __call__(
        self, depth: NDArray[np.float32], colour_from_depth: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        """Return the depth (H, W) [m] of `camera` from depth (h, w) [m], with a z-buffer."""
        read = np.isfinite(depth)
        points = self._rays[read] * depth[read, None]
        points = points @ colour_from_depth[:3, :3].T + colour_from_depth[:3, 3]
        z = points[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = (z > 0) & (np.hypot(points[:, 0], points[:, 1]) < self._reach * z)
        places = self.camera.project(points[seen])
        z = z[seen].astype(np.float32)
        out = np.full((self.camera.height, self.camera.width), np.inf, np.float32)
        with np.errstate(invalid="ignore"):
            cells = np.floor(places)
            inside = (cells >= 0) & (cells < (self.camera.width, self.camera.height))
            kept = inside.all(axis=1)
        columns, rows = cells[kept].astype(np.intp).T
        np.minimum.at(out, (rows, columns), z[kept])
        out[np.isinf(out)] = np.nan
        return out
