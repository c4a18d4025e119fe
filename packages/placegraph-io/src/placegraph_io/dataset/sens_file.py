"""ScanNet's `.sens` container, version 4: header, and where the images of its frames lie.

All numbers are little-endian and follow each other without gaps:

- uint32 version; uint64 length and bytes of the sensor's name
- 4x4 float32 each, rows first: intrinsics and extrinsics of colour, then of depth
- int32 coding of colour (0 raw, 1 PNG, 2 JPEG) and of depth (0 raw uint16, 1 zlib, 2 Occipital's)
- uint32 width, height of colour, then of depth; float32 units of depth in a metre
- uint64 number of frames; a frame is: 4x4 float32 camera_to_world; uint64 stamps of colour and
  depth [us]; uint64 bytes of the colour and of the depth image; these bytes
- uint64 number of inertial readings, and these; none of that is read

Files are gigabytes: images are read when they are asked for, by place and length.
"""

from __future__ import annotations

import io
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular
from placegraph.errors import InputError
from placegraph.io.capture.images import opened, rgb_of

VERSION = 4
RAW, PNG, JPEG = 0, 1, 2
RAW_DEPTH, ZLIB_DEPTH = 0, 1
_FIXED = struct.Struct("<64f2i4If")
_FRAME = struct.Struct("<16f4Q")
_LONGEST_NAME = 1 << 16
_LARGEST_SIDE = 1 << 14


@dataclass(frozen=True, slots=True, eq=False)
class SensHeader:
    """What stands before the frames."""

    path: Path
    sensor: str
    colour_intrinsic: NDArray[np.float64]
    """(4, 4) [px], the first pixel's centre at (0, 0)."""
    depth_intrinsic: NDArray[np.float64]
    extrinsics: tuple[NDArray[np.float64], NDArray[np.float64]]
    """(4, 4) of colour and of depth."""
    colour_coding: int
    depth_coding: int
    colour_size: tuple[int, int]
    """Width and height [px]."""
    depth_size: tuple[int, int]
    depth_per_metre: float
    count: int
    """Frames, as the file says."""
    begin: int
    """Where the first one begins."""
    size: int
    """Bytes of the whole file."""


class SensFrame(NamedTuple):
    """Where a frame's images lie, and what stands before them."""

    number: int
    world_from_camera: NDArray[np.float64]
    """(4, 4) [m]; infinite where the frame was not tracked."""
    stamp: int
    """Of the colour image [us]."""
    colour_at: int
    colour_bytes: int
    depth_bytes: int
    """Of the depth image, which follows the colour image."""


def read_header(path: Path) -> SensHeader:
    """Header of a `.sens` file.

    Raises
    ------
    InputError
        The file is missing, empty, of another kind or version, truncated, or codes its images in a
        way that is not read.

    """
    with _file(path) as file:
        size = os.fstat(file.fileno()).st_size
        version, length = struct.unpack("<IQ", _exactly(file, path, 12, "its header"))
        if version != VERSION:
            raise InputError(
                f"{path} is no .sens file of version {VERSION} (it says {version}); download it again, "
                "or export its frames with ScanNet's SensReader of that version."
            )
        if length > min(_LONGEST_NAME, size):
            raise InputError(f"{path}: the sensor's name has {length} bytes; download it again.")
        sensor = _exactly(file, path, length, "its header").decode("utf-8", "replace")
        fixed = _FIXED.unpack(_exactly(file, path, _FIXED.size, "its header"))
        (count,) = struct.unpack("<Q", _exactly(file, path, 8, "its header"))
        begin = file.tell()
    matrices = np.array(fixed[:64]).reshape(4, 4, 4)
    header = SensHeader(
        path=path,
        sensor=sensor,
        colour_intrinsic=matrices[0],
        depth_intrinsic=matrices[2],
        extrinsics=(matrices[1], matrices[3]),
        colour_coding=fixed[64],
        depth_coding=fixed[65],
        colour_size=(fixed[66], fixed[67]),
        depth_size=(fixed[68], fixed[69]),
        depth_per_metre=fixed[70],
        count=count,
        begin=begin,
        size=size,
    )
    _check(header)
    return header


def _check(header: SensHeader) -> None:
    if header.colour_coding not in {RAW, PNG, JPEG}:
        raise InputError(
            f"{header.path}: colour is coded in way {header.colour_coding}; raw (0), PNG (1) and JPEG "
            "(2) are read: export the frames with ScanNet's SensReader and open that folder."
        )
    if header.depth_coding not in {RAW_DEPTH, ZLIB_DEPTH}:
        raise InputError(
            f"{header.path}: depth is coded in way {header.depth_coding}; raw (0) and zlib (1) are "
            "read: export the frames with ScanNet's SensReader and open that folder."
        )
    if not all(0 < side <= _LARGEST_SIDE for side in (*header.colour_size, *header.depth_size)):
        raise InputError(
            f"{header.path}: images of {header.colour_size} and {header.depth_size} pixels cannot be; "
            "download the file again."
        )
    if not 1.0 <= header.depth_per_metre < 1e9:
        raise InputError(
            f"{header.path}: {header.depth_per_metre:g} units of depth in a metre cannot be; it is 1000 "
            "in ScanNet: download the file again."
        )


def read_frames(header: SensHeader, *, partial: bool = False) -> list[SensFrame]:
    """Table of a file's frames; 96 bytes of each are read.

    Raises
    ------
    InputError
        The file ends before its last frame does, and `partial` does not allow that; or it has not
        one whole frame.

    """
    found: list[SensFrame] = []
    with _file(header.path) as file:
        at = header.begin
        for number in range(header.count):
            file.seek(at)
            head = file.read(_FRAME.size)
            if len(head) < _FRAME.size:
                break
            *pose, stamp, _, colour_bytes, depth_bytes = _FRAME.unpack(head)
            colour_at = at + _FRAME.size
            at = colour_at + colour_bytes + depth_bytes
            if at > header.size:
                break
            matrix = np.array(pose).reshape(4, 4)
            found.append(SensFrame(number, matrix, stamp, colour_at, colour_bytes, depth_bytes))
    if not found:
        raise InputError(f"{header.path} holds not one whole frame; download it again.")
    if len(found) < header.count and not partial:
        raise InputError(
            f"{header.path} ends within frame {len(found)} of {header.count}: it is truncated. Download "
            f"it again, or use the {len(found)} whole frames before: read_sens(..., partial=True)."
        )
    return found


def read_colour(header: SensHeader, frame: SensFrame) -> NDArray[np.uint8]:
    """Colours (H, W, 3) uint8 of a frame; `InputError` where they are broken or of another size."""
    name = f"{header.path}, colour of frame {frame.number}"
    data = _slice(header.path, frame.colour_at, frame.colour_bytes, name)
    width, height = header.colour_size
    if header.colour_coding == RAW:
        _length(name, len(data), 3 * width * height)
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)
    with opened(io.BytesIO(data), name) as image:
        if image.size != header.colour_size:
            raise InputError(
                f"{name} has {image.width} x {image.height} pixels, but the header says {width} x "
                f"{height}; download the file again."
            )
        return rgb_of(image)


def read_depth(header: SensHeader, frame: SensFrame) -> NDArray[np.float32]:
    """Depth (h, w) float32 [m] of a frame, NaN: no reading; `InputError` where it is broken."""
    name = f"{header.path}, depth of frame {frame.number}"
    at = frame.colour_at + frame.colour_bytes
    data = _slice(header.path, at, frame.depth_bytes, name)
    width, height = header.depth_size
    if header.depth_coding == ZLIB_DEPTH:
        try:  # no more than belongs there is unpacked
            data = zlib.decompressobj().decompress(data, 2 * width * height + 1)
        except zlib.error as error:
            raise InputError(f"{name} is damaged ({error}); download the file again.") from error
    _length(name, len(data), 2 * width * height)
    units = np.frombuffer(data, "<u2").reshape(height, width)
    metres = (units / header.depth_per_metre).astype(np.float32)
    metres[units == 0] = np.nan
    return metres


def _length(name: str, length: int, wanted: int) -> None:
    if length != wanted:
        raise InputError(
            f"{name} has {length} bytes where its size needs {wanted}; download the file again."
        )


def _slice(path: Path, at: int, length: int, name: str) -> bytes:
    with _file(path) as file:
        file.seek(at)
        return _exactly(file, path, length, name)


def _exactly(file: BinaryIO, path: Path, length: int, what: str) -> bytes:
    data = file.read(length)
    if len(data) < length:
        if not data and not file.tell():
            raise InputError(f"{path} is empty; download it again.")
        raise InputError(f"{path} ends within {what}: it is truncated; download it again.")
    return data


def _file(path: Path) -> BinaryIO:
    try:
        return regular(path).open("rb")
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error
