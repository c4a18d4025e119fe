"""What RTAB-Map packs into the columns of its databases: matrices, calibrations, images.

`compressData`: a zlib stream and rows, columns and OpenCV's type of the matrix, three int32.
`CameraModel::serialize`: eleven int32 (version, kind, width, height, how many numbers of K, D, R, P
and the local transform follow), those of K, D, R and P as float64, the transform's as float32.
`compressImage`: JPEG, PNG, or `DEPTHRVL` and an RVL image; float32 is the PNG's blue, green, red and
alpha byte; or `DEPTHINV`, two float32 a and b, and such an image, whose v means a / (v - b) metres.
(Compression.cpp, CameraModel.cpp and DBDriverSqlite3.cpp of introlab/rtabmap.)
"""

from __future__ import annotations

import io
import zlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.images import opened
from placegraph.io.capture.posed import camera_of, exact_pose
from placegraph_io.rvl import rvl_image

_TYPES = {0: "u1", 4: "<i4", 5: "<f4"}
"""OpenCV's types of one channel, of those that are read."""
_MOST = 1 << 24  # numbers of a matrix
_RVL, _INVERSE = b"DEPTHRVL", b"DEPTHINV"
_SERIALIZED, _SIZED, _OLDEST = (0, 18), (0, 11, 2), (0, 10)
"""Versions since which calibrations are serialized, have a size, and are read."""


class Calibration(NamedTuple):
    """Of the first camera of a node."""

    size: tuple[int, int]
    """Of the images [px]; 0, 0 where it does not say."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy; the centre of the first pixel is (0, 0)."""
    base_from_camera: NDArray[np.float64]
    """(4, 4)"""
    cameras: int
    """Whose images stand side by side in the node's image."""

    def camera(self, size: tuple[int, int], name: str) -> Camera:
        """Camera of images of this size, where the calibration has none of its own."""
        fx, fy, cx, cy = self.intrinsics
        return camera_of(
            name, size if self.size == (0, 0) else self.size, (fx, fy, cx + 0.5, cy + 0.5)
        )


def matrix(data: bytes, name: str) -> NDArray[Any]:
    """Matrix of packed data; `InputError`, which begins with `name`, where it makes none."""
    rows, columns, kind = (
        np.frombuffer(data[-12:], "<i4").tolist() if len(data) > 12 else (0, 0, -1)
    )
    if not (kind in _TYPES and rows > 0 and columns > 0 and rows * columns <= _MOST):
        raise InputError(
            f"{name} says it has {rows} x {columns} numbers of type {kind}; copy it again."
        )
    wanted = rows * columns * np.dtype(_TYPES[kind]).itemsize
    try:
        unpacked = zlib.decompressobj().decompress(data[:-12], wanted + 1)
    except zlib.error as error:
        raise InputError(f"{name} is damaged ({error}); copy the database again.") from error
    if len(unpacked) != wanted:
        raise InputError(f"{name} does not hold its {rows} x {columns} numbers; copy it again.")
    return np.frombuffer(unpacked, _TYPES[kind]).reshape(rows, columns)


def calibration(data: bytes, version: tuple[int, ...], name: str) -> Calibration:
    """Calibration of a node; `InputError`, which begins with `name`, where it is none that is read."""
    if version < _OLDEST:
        raise InputError(
            f"{name}: databases before 0.10 are not read; `rtabmap-reprocess old.db new.db` makes a new one."
        )
    if version >= _SERIALIZED:
        return _serialized(data, name)
    head = 6 if version >= _SIZED else 4  # fx, fy, cx, cy, perhaps the size, and 3 x 4
    if not data or len(data) % (4 * (head + 12)):
        raise _stereo(name) if len(data) in {4 * 17, 4 * 19} else _broken(name)
    values = np.frombuffer(data, "<f4").astype(np.float64)
    fx, fy, cx, cy = values[:4].tolist()
    width, height = (0, 0) if head == 4 else _whole(values[4:6], name)
    pose = exact_pose(values[head : head + 12], f"{name}: the local transform")
    return Calibration((width, height), (fx, fy, cx, cy), pose, len(data) // (4 * (head + 12)))


def _serialized(data: bytes, name: str) -> Calibration:
    first: Calibration | None = None
    count = at = 0
    while at < len(data):
        if len(data) < at + 44:
            raise _broken(name)
        head = np.frombuffer(data[at : at + 44], "<i4").tolist()
        if head[3] != 0:
            raise _stereo(name) if head[3] == 1 else _broken(name)
        lengths = head[6:11]
        sizes = [8 * n for n in lengths[:4]] + [4 * lengths[4]]
        if not all(0 <= n <= 64 for n in lengths) or at + 44 + sum(sizes) > len(data):
            raise _broken(name)
        ends = at + 44 + np.cumsum([0, *sizes])
        first = first or _model(data, head, ends.tolist(), name)
        count, at = count + 1, int(ends[-1])
    if first is None:
        raise _broken(name)
    return first._replace(cameras=count)


def _model(data: bytes, head: list[int], ends: list[int], name: str) -> Calibration:
    """The camera that RTAB-Map projects with: of its images as they were rectified (P), else K."""
    k, p, local = (data[ends[i] : ends[i + 1]] for i in (0, 3, 4))
    used, columns = (p, 4) if len(p) == 96 else (k, 3)
    if len(used) != 24 * columns or len(local) not in {0, 48}:
        raise _broken(name)
    m = np.frombuffer(used, "<f8").reshape(3, columns)
    pose = np.eye(4)
    if local:
        pose = exact_pose(np.frombuffer(local, "<f4"), f"{name}: the local transform")
    size = _whole(np.array(head[4:6], np.float64), name)
    return Calibration(
        size, (float(m[0, 0]), float(m[1, 1]), float(m[0, 2]), float(m[1, 2])), pose, 1
    )


def _whole(values: NDArray[np.float64], name: str) -> tuple[int, int]:
    if not ((values >= 0) & (values < 1 << 16)).all():
        raise InputError(f"{name} says its images have {values[0]:g} x {values[1]:g} pixels.")
    return int(values[0]), int(values[1])


def _stereo(name: str) -> InputError:
    return InputError(
        f"{name} is of a stereo camera, of which the database has no depth; record with a depth camera, "
        "or a telephone with LiDAR."
    )


def _broken(name: str) -> InputError:
    return InputError(
        f"{name} is no calibration of RTAB-Map; calibrate the camera, and record again."
    )


def depth_image(data: bytes, name: str) -> NDArray[np.float32]:
    """Depth (h, w) float32 [m], NaN: no reading; `InputError`, which begins with `name`."""
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
    """Pixels (h, w): whole numbers, or float32."""
    if data.startswith(_RVL):
        return rvl_image(data[len(_RVL) :], name)
    with opened(io.BytesIO(data), name) as image:
        if image.mode == "RGBA":
            bgra = np.ascontiguousarray(np.asarray(image)[..., [2, 1, 0, 3]])
            return bgra.view("<f4")[..., 0]
        if not image.mode.startswith("I"):
            raise InputError(
                f"{name} has pixels of mode {image.mode!r}, which are no depth: the other image of a "
                "stereo camera? Record with a depth camera."
            )
        return np.asarray(image)
