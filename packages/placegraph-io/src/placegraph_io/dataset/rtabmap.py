"""Databases of RTAB-Map (`.db`), of its telephone apps and of its ROS nodes.

SQLite: `Node` (id, map_id, stamp, pose), `Data` (image, depth, calibration, since 0.23
depth_confidence) and `Admin` (version, and the poses as they were optimized last). Poses are 3 x 4
float32 by rows, of the base in a world with z up; a calibration's local transform leads from the
base to the camera's optical frame, whose axes are OpenCV's. (DatabaseSchema.sql of introlab/rtabmap.)

`compressData`: a zlib stream and rows, columns and OpenCV's type of the matrix, three int32.
`CameraModel::serialize`: eleven int32 (version, kind, width, height, how many numbers of K, D, R, P
and the local transform follow), those of K, D, R and P as float64, the transform's as float32.
`compressImage`: JPEG, PNG, or `DEPTHRVL` and an RVL image; float32 is the PNG's blue, green, red and
alpha byte; or `DEPTHINV`, two float32 a and b, and such an image, whose v means a / (v - b) metres.
(Compression.cpp, CameraModel.cpp and DBDriverSqlite3.cpp of introlab/rtabmap.)
"""

from __future__ import annotations

import io
import math
import sqlite3
import zlib
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame import Capture, DepthUnit, LazyImages, check_shape
from placegraph.io.capture.images import open_image, read_rgb
from placegraph.io.capture.posed import (
    StoredFrame,
    make_camera,
    make_capture,
    orthonormalize_pose,
    resize_camera,
)
from placegraph_io.storage import Database, rvl_image

_TYPES = {0: "u1", 4: "<i4", 5: "<f4"}  # OpenCV's types of one channel, of those that are read
_MOST = 1 << 24  # numbers of a matrix
_RVL, _INVERSE = b"DEPTHRVL", b"DEPTHINV"
_SERIALIZED, _SIZED, _OLDEST = (0, 18), (0, 11, 2), (0, 10)
"""Versions since which calibrations are serialized, have a size, and are read."""


class Calibration(NamedTuple):
    """Calibration of the first camera of a node."""

    size: tuple[int, int]  # Width and height of the images [px]; 0, 0 if unknown
    intrinsics: tuple[
        float, float, float, float
    ]  # fx, fy, cx, cy; the centre of the first pixel is (0, 0)
    base_from_camera: NDArray[np.float64]  # (4, 4)
    cameras: int  # Number of cameras, whose images stand side by side

    def camera(self, size: tuple[int, int], name: str) -> Camera:
        """Return the camera; `size` is used where the calibration has none."""
        fx, fy, cx, cy = self.intrinsics
        return make_camera(
            name, size if self.size == (0, 0) else self.size, (fx, fy, cx + 0.5, cy + 0.5)
        )


def decode_matrix(data: bytes, name: str) -> NDArray[Any]:
    """Decode a compressed matrix; `InputError`, beginning with `name`, where it is damaged."""
    rows, columns, kind = (
        np.frombuffer(data[-12:], "<i4").tolist() if len(data) > 12 else (0, 0, -1)
    )
    if not (kind in _TYPES and rows > 0 and columns > 0 and rows * columns <= _MOST):
        raise InputError(
            f"{name} declares {rows} x {columns} numbers of type {kind}, which is impossible; copy "
            "it again."
        )
    wanted = rows * columns * np.dtype(_TYPES[kind]).itemsize
    try:
        unpacked = zlib.decompressobj().decompress(data[:-12], wanted + 1)
    except zlib.error as error:
        raise InputError(f"{name} is damaged ({error}); copy the database again.") from error
    if len(unpacked) != wanted:
        raise InputError(f"{name} does not contain {rows} x {columns} numbers; copy it again.")
    return np.frombuffer(unpacked, _TYPES[kind]).reshape(rows, columns)


def decode_calibration(data: bytes, version: tuple[int, ...], name: str) -> Calibration:
    """Calibration of a node; `InputError`, which begins with `name`, where it is none that is read."""
    if version < _OLDEST:
        raise InputError(
            f"{name}: databases before version 0.10 are not supported; convert it with "
            "`rtabmap-reprocess old.db new.db`."
        )
    if version >= _SERIALIZED:
        return _decode_serialized(data, name)
    head = 6 if version >= _SIZED else 4  # fx, fy, cx, cy, perhaps the size, and 3 x 4
    if not data or len(data) % (4 * (head + 12)):
        raise _stereo_error(name) if len(data) in {4 * 17, 4 * 19} else _broken_error(name)
    values = np.frombuffer(data, "<f4").astype(np.float64)
    fx, fy, cx, cy = values[:4].tolist()
    width, height = (0, 0) if head == 4 else _read_size(values[4:6], name)
    pose = orthonormalize_pose(values[head : head + 12], f"{name}: the local transform")
    return Calibration((width, height), (fx, fy, cx, cy), pose, len(data) // (4 * (head + 12)))


def _decode_serialized(data: bytes, name: str) -> Calibration:
    first: Calibration | None = None
    count = at = 0
    while at < len(data):
        if len(data) < at + 44:
            raise _broken_error(name)
        head = np.frombuffer(data[at : at + 44], "<i4").tolist()
        if head[3] != 0:
            raise _stereo_error(name) if head[3] == 1 else _broken_error(name)
        lengths = head[6:11]
        sizes = [8 * n for n in lengths[:4]] + [4 * lengths[4]]
        if not all(0 <= n <= 64 for n in lengths) or at + 44 + sum(sizes) > len(data):
            raise _broken_error(name)
        ends = at + 44 + np.cumsum([0, *sizes])
        first = first or _decode_model(data, head, ends.tolist(), name)
        count, at = count + 1, int(ends[-1])
    if first is None:
        raise _broken_error(name)
    return first._replace(cameras=count)


def _decode_model(data: bytes, head: list[int], ends: list[int], name: str) -> Calibration:
    """Return the camera that RTAB-Map projects with: of its images as they were rectified (P), else K."""
    k, p, local = (data[ends[i] : ends[i + 1]] for i in (0, 3, 4))
    used, columns = (p, 4) if len(p) == 96 else (k, 3)
    if len(used) != 24 * columns or len(local) not in {0, 48}:
        raise _broken_error(name)
    m = np.frombuffer(used, "<f8").reshape(3, columns)
    pose = np.eye(4)
    if local:
        pose = orthonormalize_pose(np.frombuffer(local, "<f4"), f"{name}: the local transform")
    size = _read_size(np.array(head[4:6], np.float64), name)
    return Calibration(
        size, (float(m[0, 0]), float(m[1, 1]), float(m[0, 2]), float(m[1, 2])), pose, 1
    )


def _read_size(values: NDArray[np.float64], name: str) -> tuple[int, int]:
    if not ((values >= 0) & (values < 1 << 16)).all():
        raise InputError(
            f"{name} declares images of {values[0]:g} x {values[1]:g} pixels; calibrate the "
            "camera, and record again."
        )
    return int(values[0]), int(values[1])


def _stereo_error(name: str) -> InputError:
    return InputError(
        f"{name} was recorded with a stereo camera, so the database has no depth; record with a "
        "depth camera, or a phone with LiDAR."
    )


def _broken_error(name: str) -> InputError:
    return InputError(
        f"{name} is not an RTAB-Map calibration; calibrate the camera, and record again."
    )


def decode_depth(data: bytes, name: str) -> NDArray[np.float32]:
    """Return the depth (h, w) float32 [m], NaN: no reading; `InputError`, which begins with `name`."""
    inverse = data.startswith(_INVERSE) and len(data) > 16
    head = np.frombuffer(data[8:16], "<f4") if inverse else None
    units = _units(data if head is None else data[16:], name)
    metres: NDArray[np.float32] = units.astype(np.float32)
    if head is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            metres = head[0] / (metres - head[1])
        metres[units == 0] = np.nan
    elif units.dtype.kind != "f":
        metres /= np.float32(1000.0)
    metres[~(np.isfinite(metres) & (metres > 0))] = np.nan
    return metres


def _units(data: bytes, name: str) -> NDArray[Any]:
    """Return the pixels (h, w): whole numbers, or float32."""
    if data.startswith(_RVL):
        return rvl_image(data[len(_RVL) :], name)
    with open_image(io.BytesIO(data), name) as image:
        if image.mode == "RGBA":
            bgra = np.ascontiguousarray(np.asarray(image)[..., [2, 1, 0, 3]])
            return bgra.view("<f4")[..., 0]
        if not image.mode.startswith("I"):
            raise InputError(
                f"{name} has pixels of mode {image.mode!r}, not depth, and may be the right image "
                "of a stereo camera; record with a depth camera."
            )
        return np.asarray(image)


_COLUMNS = "n.id, n.map_id, n.stamp, n.pose, length(d.image), length(d.depth), d.calibration"


def is_rtabmap(path: Path) -> bool:
    """Return whether a path is a `.db` file."""
    return path.suffix.lower() == ".db" and path.is_file()


def read_rtabmap(path: Path) -> Capture:
    """Read a database; images are read on demand.

    Poses are the optimized ones if the database was closed with them, else odometry of the longest
    session. Raises `InputError` where the file is no such database, is
    older than 0.10, is of a stereo camera, or holds no node with an image, a pose and a calibration.
    """
    base = Database(path)
    try:
        version = _version(base)
        base.select("id", "Data")
        known = base.columns("Data")
        if not {"image", "depth", "calibration"} <= known:
            raise InputError(
                f"{path} is a database of RTAB-Map {'.'.join(map(str, version))}, which is not "
                "supported; convert it with `rtabmap-reprocess old.db new.db`."
            )
        has_confidence = "depth_confidence" in known
        columns = _COLUMNS + (", length(d.depth_confidence)" if has_confidence else ", NULL")
        rows = base.select(columns, "Node", "n JOIN Data d ON n.id = d.id ORDER BY n.id").fetchall()
        poses, notes = _read_optimized_poses(base)
    except (sqlite3.Error, ValueError, OverflowError) as error:
        raise InputError(f"{path} is not an RTAB-Map database ({error}); copy it again.") from error
    return _capture(base, version, [_Node(*row) for row in rows], poses, notes)


class _Node(NamedTuple):
    """Row of a node; SQLite's values have any type."""

    id: Any
    session: Any
    stamp: Any
    pose: Any
    image: Any  # Bytes of the image
    depth: Any
    calibration: Any
    confidence: Any

    @property
    def has_stamp(self) -> bool:
        return (
            isinstance(self.id, int) and isinstance(self.stamp, float) and math.isfinite(self.stamp)
        )


def _version(base: Database) -> tuple[int, ...]:
    row = base.select("version", "Admin", "WHERE version IS NOT NULL").fetchone()
    numbers = str(row[0]).split(".") if row else []
    if not numbers or not all(n.isascii() and n.isdigit() and len(n) < 6 for n in numbers):
        raise ValueError("its table Admin has no version")
    return tuple(int(n) for n in numbers)


def _read_optimized_poses(base: Database) -> tuple[dict[int, NDArray[np.float64]], tuple[str, ...]]:
    """Return world_from_base (3, 4) by node, as optimized last; empty where they were not saved."""
    if not {"opt_ids", "opt_poses"} <= base.columns("Admin"):
        return {}, ()
    row = base.select("opt_ids, opt_poses", "Admin", "WHERE length(opt_poses) > 0").fetchone()
    if row is None or not all(isinstance(value, bytes) for value in row):
        return {}, ()
    ids, poses = (
        decode_matrix(v, f"{base.path}, Admin.{n}")
        for v, n in zip(row, ("opt_ids", "opt_poses"), strict=True)
    )
    if ids.dtype.kind != "i" or poses.dtype.kind != "f" or poses.size != 12 * ids.size:
        raise InputError(
            f"{base.path}: Admin.opt_poses must have twelve numbers for each of opt_ids; copy the "
            "database again."
        )
    held = dict(zip(ids.ravel().tolist(), poses.reshape(-1, 3, 4).astype(np.float64), strict=True))
    return held, ("Poses are those that RTAB-Map optimized when it closed the database.",)


def _read_odometry(nodes: list[_Node]) -> tuple[dict[int, NDArray[np.float64]], tuple[str, ...]]:
    """Return world_from_base (3, 4) by node of the longest session; each session has its own world."""
    held = [n for n in nodes if isinstance(n.pose, bytes) and len(n.pose) == 48]
    sessions = Counter(n.session for n in held)
    session = sessions.most_common(1)[0][0] if sessions else None
    poses = {
        n.id: np.frombuffer(n.pose, "<f4").reshape(3, 4).astype(np.float64)
        for n in held
        if n.session == session
    }
    notes = ["The poses are those of the odometry, because the database has no optimized ones."]
    if len(sessions) > 1:
        notes.append(
            f"Only the longest of {len(sessions)} sessions is used, because each has its "
            "own world frame."
        )
    return poses, tuple(notes)


def _capture(
    base: Database,
    version: tuple[int, ...],
    nodes: list[_Node],
    poses: dict[int, NDArray[np.float64]],
    notes: tuple[str, ...],
) -> Capture:
    stamped = [n for n in nodes if n.has_stamp]
    if not poses:
        poses, notes = _read_odometry(stamped)
    left_out = Counter({"no stamp": len(nodes) - len(stamped)})
    frames: dict[float, StoredFrame] = {}
    sizes = _ImageSizes(base)
    for node in stamped:
        pose = poses.get(node.id)
        if not node.image or not isinstance(node.calibration, bytes) or not node.calibration:
            left_out["no colour image" if not node.image else "no calibration"] += 1
        elif pose is None or not pose.any():
            left_out["no pose"] += 1
        elif node.stamp in frames:
            left_out["a repeated stamp"] += 1
        else:
            frames[node.stamp] = _read_frame(base, version, node, pose, sizes)
    return make_capture(base.path, frames.values(), left_out=+left_out, notes=notes)


class _ImageSizes:
    """Width and height [px] of a database's images by kind, of the first image."""

    def __init__(self, base: Database) -> None:
        self.base = base
        self.known: dict[str, tuple[int, int]] = {}

    def of(self, kind: str, node: int) -> tuple[int, int]:
        """Return the size of "image" or "depth", read from a node if unknown."""
        if kind not in self.known:
            data, name = _blob(self.base, kind, node)
            if kind == "depth":
                height, width = decode_depth(data, name).shape
            else:
                with open_image(io.BytesIO(data), name) as image:
                    width, height = image.size
            self.known[kind] = width, height
        return self.known[kind]


def _read_frame(
    base: Database,
    version: tuple[int, ...],
    node: _Node,
    world_from_base: NDArray[np.float64],
    sizes: _ImageSizes,
) -> StoredFrame:
    name = f"{base.path}, node {node.id}"
    model = decode_calibration(node.calibration, version, f"{name}, calibration")
    wide, height = sizes.of("image", node.id)
    camera = model.camera((wide // model.cameras, height), f"{name}, calibration")
    depth_camera = metres = None
    if node.depth:
        wide, height = sizes.of("depth", node.id)
        depth_camera = resize_camera(camera, (wide // model.cameras, height), f"{name}, depth")
        metres = partial(
            _read_depth, base, node.id, depth_camera, model.cameras, bool(node.confidence)
        )
    pose = np.vstack([world_from_base, (0.0, 0.0, 0.0, 1.0)]) @ model.base_from_camera
    images = LazyImages(
        partial(_read_colour, base, node.id, camera, model.cameras),
        metres,
        unit=DepthUnit(f"the depth images of {base.path}", 1000.0),
    )
    return StoredFrame(f"{name}, pose", node.stamp, pose, camera, images, depth_camera)


def _blob(base: Database, column: str, node: int) -> tuple[bytes, str]:
    name = f"{base.path}, {column} of node {node}"
    return base.blob(("Data", column, node), name), name


def _read_colour(base: Database, node: int, camera: Camera, cameras: int) -> NDArray[np.uint8]:
    data, name = _blob(base, "image", node)
    image = read_rgb(Path(name), (camera.width * cameras, camera.height), io.BytesIO(data))
    return image[:, : camera.width]


def _read_depth(
    base: Database, node: int, camera: Camera, cameras: int, has_confidence: bool
) -> NDArray[np.float32]:
    data, name = _blob(base, "depth", node)
    image = decode_depth(data, name)
    if has_confidence:
        packed, label = _blob(base, "depth_confidence", node)
        confidence = decode_matrix(packed, label)
        if confidence.shape != image.shape:
            raise InputError(
                f"{label} has {confidence.shape[1]} x {confidence.shape[0]} numbers, but the depth "
                f"image has {image.shape[1]} x {image.shape[0]}; record again."
            )
        image[confidence == 0] = np.nan
    image = image[:, : image.shape[1] // cameras]
    check_shape(image, camera, name)
    return image
