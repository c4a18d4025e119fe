"""ScanNet's recordings as captures: a `.sens` file, version 4, or the folder that its tools export.

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
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial as bound
from os import PathLike
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame import (
    Capture,
    DepthUnit,
    Frame,
    LazyImages,
    colour_file,
    depth_file,
    posed_frame,
)
from placegraph.io.capture.images import ENDINGS, image_size, open_image, to_rgb
from placegraph_io.dataset.scannet import (
    LabelImages,
    Wanted,
    camera_of_matrix,
    find_labels,
    is_rigid,
    list_numbered,
    read_matrix,
    read_meta,
)

VERSION = 4
RAW, PNG, JPEG = 0, 1, 2
RAW_DEPTH, ZLIB_DEPTH = 0, 1
_FIXED = struct.Struct("<64f2i4If")
_FRAME = struct.Struct("<16f4Q")
_LONGEST_NAME = 1 << 16
_LARGEST_SIDE = 1 << 14


@dataclass(frozen=True, slots=True, eq=False)
class SensHeader:
    """Header of a file."""

    path: Path
    sensor: str
    colour_intrinsic: NDArray[np.float64]  # (4, 4) [px], the first pixel's centre at (0, 0)
    depth_intrinsic: NDArray[np.float64]
    extrinsics: tuple[NDArray[np.float64], NDArray[np.float64]]  # (4, 4) of colour and of depth
    colour_coding: int
    depth_coding: int
    colour_size: tuple[int, int]  # Width and height [px]
    depth_size: tuple[int, int]
    depth_per_metre: float
    count: int  # Frames, as the file says
    first_frame: int  # Where the first one begins
    size: int  # Bytes of the whole file


class SensFrame(NamedTuple):
    """Pose, stamp and offsets of the images of a frame."""

    number: int
    world_from_camera: NDArray[np.float64]  # (4, 4) [m]; infinite where the frame was not tracked
    stamp: int  # Of the colour image [us]
    colour_at: int
    colour_bytes: int
    depth_bytes: int  # Of the depth image, which follows the colour image


def read_header(path: Path) -> SensHeader:
    """Return the header of a `.sens` file.

    Raises `InputError`: the file is missing, empty, of another kind or version, truncated, or codes its
    images in a way that is not read.
    """
    with _open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        version, length = struct.unpack("<IQ", _read_exactly(file, path, 12, "its header"))
        if version != VERSION:
            raise InputError(
                f"{path} is not a .sens file of version {VERSION}, but of {version}; download it "
                "again, or export its frames with ScanNet's SensReader of that version."
            )
        if length > min(_LONGEST_NAME, size):
            raise InputError(
                f"{path}: the sensor's name has {length} bytes, so the file is damaged; download "
                "it again."
            )
        sensor = _read_exactly(file, path, length, "its header").decode("utf-8", "replace")
        fixed = _FIXED.unpack(_read_exactly(file, path, _FIXED.size, "its header"))
        (count,) = struct.unpack("<Q", _read_exactly(file, path, 8, "its header"))
        first_frame = file.tell()
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
        first_frame=first_frame,
        size=size,
    )
    _check(header)
    return header


def _check(header: SensHeader) -> None:
    if header.colour_coding not in {RAW, PNG, JPEG}:
        raise InputError(
            f"{header.path}: the colour codec is {header.colour_coding}, but only raw (0), "
            "PNG (1) and JPEG (2) are supported; export the frames with ScanNet's "
            "SensReader and open that folder."
        )
    if header.depth_coding not in {RAW_DEPTH, ZLIB_DEPTH}:
        raise InputError(
            f"{header.path}: the depth codec is {header.depth_coding}, but only raw (0) and "
            "zlib (1) are supported; export the frames with ScanNet's SensReader and open "
            "that folder."
        )
    if not all(0 < side <= _LARGEST_SIDE for side in (*header.colour_size, *header.depth_size)):
        raise InputError(
            f"{header.path}: image sizes of {header.colour_size} and {header.depth_size} pixels "
            "are impossible; download the file again."
        )
    if not 1.0 <= header.depth_per_metre < 1e9:
        raise InputError(
            f"{header.path}: {header.depth_per_metre:g} depth units per metre are "
            "impossible (ScanNet has 1000); download the file again."
        )


def read_frames(header: SensHeader, *, partial: bool = False) -> list[SensFrame]:
    """Return the table of a file's frames; 96 bytes of each are read.

    Raises `InputError`: the file ends before its last frame does, and `partial` does not allow that; or
    it has not one whole frame.
    """
    found: list[SensFrame] = []
    with _open_file(header.path) as file:
        at = header.first_frame
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
        raise InputError(f"{header.path} contains no complete frame; download it again.")
    if len(found) < header.count and not partial:
        raise InputError(
            f"{header.path} ends within frame {len(found)} of {header.count}, so it is truncated. "
            f"Download it again, or use its first {len(found)} frames: read_sens(..., "
            "partial=True)."
        )
    return found


def read_colour(header: SensHeader, frame: SensFrame) -> NDArray[np.uint8]:
    """Colours (H, W, 3) uint8 of a frame; `InputError` where they are broken or of another size."""
    name = f"{header.path}, colour of frame {frame.number}"
    data = _read_slice(header.path, frame.colour_at, frame.colour_bytes, name)
    width, height = header.colour_size
    if header.colour_coding == RAW:
        _check_length(name, len(data), 3 * width * height)
        return np.frombuffer(data, np.uint8).reshape(height, width, 3)
    with open_image(io.BytesIO(data), name) as image:
        if image.size != header.colour_size:
            raise InputError(
                f"{name} has {image.width} x {image.height} pixels, but the header says {width} x "
                f"{height}; download the file again."
            )
        return to_rgb(image)


def read_depth(header: SensHeader, frame: SensFrame) -> NDArray[np.float32]:
    """Return the depth (h, w) float32 [m] of a frame, NaN: no reading; `InputError` where it is broken."""
    name = f"{header.path}, depth of frame {frame.number}"
    at = frame.colour_at + frame.colour_bytes
    data = _read_slice(header.path, at, frame.depth_bytes, name)
    width, height = header.depth_size
    if header.depth_coding == ZLIB_DEPTH:
        try:  # no more than belongs there is unpacked
            data = zlib.decompressobj().decompress(data, 2 * width * height + 1)
        except zlib.error as error:
            raise InputError(f"{name} is damaged ({error}); download the file again.") from error
    _check_length(name, len(data), 2 * width * height)
    units = np.frombuffer(data, "<u2").reshape(height, width)
    metres = (units / header.depth_per_metre).astype(np.float32)
    metres[units == 0] = np.nan
    return metres


def _check_length(name: str, length: int, wanted: int) -> None:
    if length != wanted:
        raise InputError(
            f"{name} has {length} bytes, but its size needs {wanted}; download the file again."
        )


def _read_slice(path: Path, at: int, length: int, name: str) -> bytes:
    with _open_file(path) as file:
        file.seek(at)
        return _read_exactly(file, path, length, name)


def _read_exactly(file: BinaryIO, path: Path, length: int, what: str) -> bytes:
    data = file.read(length)
    if len(data) < length:
        if not data and not file.tell():
            raise InputError(f"{path} is empty; download it again.")
        raise InputError(f"{path} ends within {what}: it is truncated; download it again.")
    return data


def _open_file(path: Path) -> BinaryIO:
    try:
        return check_regular(path).open("rb")
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error


DEPTH_PER_METRE = 1000.0  # Units of depth in a metre of exported images
_RIGID = 1e-2  # Poses are single precision, and rounded where they are exported
_INTRINSICS = ("intrinsic/intrinsic_{}.txt", "intrinsics_{}.txt")
"""Names of intrinsics of SensReader, and of ScanNet's own selection of 25,000 frames."""


def is_sens(path: Path) -> bool:
    """Return whether a path is a `.sens` file, or a folder with one of its name or with one alone."""
    return _find_sens(path) is not None


def is_scannet_export(path: Path) -> bool:
    """Return whether a path is a folder with `color/`, `pose/` and ScanNet's intrinsics."""
    try:
        there = all((path / name).is_dir() for name in ("color", "pose"))
        return there and any((path / name.format("color")).is_file() for name in _INTRINSICS)
    except (OSError, ValueError):
        return False


def _find_sens(path: Path) -> Path | None:
    try:
        if path.is_file():
            return path if path.suffix.lower() == ".sens" else None
        own = path / f"{path.absolute().name}.sens"
        if own.is_file():
            return own
        found = [p for p in path.iterdir() if p.suffix.lower() == ".sens" and p.is_file()]
    except (OSError, ValueError):
        return None
    return found[0] if len(found) == 1 else None


def read_sens(
    path: str | PathLike[str],
    *,
    labels: Wanted = "auto",
    label_column: str | None = None,
    partial: bool = False,
) -> Capture:
    """Open a `.sens` file; its images are read, a frame at a time, when they are asked for.

    Frames without a finite pose were not tracked, and are left out and counted; a frame's `index` is
    its number in the file. Poses are those of ScanNet's reconstruction, in the axes of the scan's
    meshes (z up): `placegraph_io.dataset.scannet.axis_alignment` leads from there to the map.
    Colour and depth are taken as of one viewpoint, as ScanNet says they are; extrinsics are not
    applied.

    `path`: file, or the folder of the scan that it lies in; `labels`: which label images beside it to
    use: `instance-filt/`, `label-filt/`, either, or none; `label_column`: column of ScanNet's label
    table that names labels; `raw_category` if not given; `partial`: whether a truncated file is used as
    far as its frames are whole.

    Raises `InputError`: the file is missing, of another version, or truncated, or no frame of it can be
    used; `OptionError`: `labels` is none of its values; the table has no such column.
    """
    file = _find_sens(Path(path))
    if file is None:
        raise InputError(f"{path} is not a .sens file or the folder of one.")
    counts: Counter[str] = Counter()
    header = read_header(file)
    entries = read_frames(header, partial=partial)
    if len(entries) < header.count:
        counts["frames missing in the truncated file"] = header.count - len(entries)
    camera = camera_of_matrix(f"{file} (colour)", header.colour_intrinsic, header.colour_size)
    depth_camera = camera_of_matrix(f"{file} (depth)", header.depth_intrinsic, header.depth_size)
    notes = []
    if not np.allclose(*header.extrinsics, atol=_RIGID):
        notes.append(
            "The extrinsics between colour and depth are ignored, because ScanNet's images are "
            "aligned."
        )
    marks = find_labels(file.parent, labels, camera, label_column=label_column)
    used = _select_tracked(file, entries, counts)
    frames = [
        _frame(header, entry, stamp, camera, depth_camera, marks)
        for entry, stamp in zip(used, _stamps(used, notes), strict=True)
    ]
    return _capture(file, frames, camera, depth_camera, marks, notes, counts)


def _stamps(entries: Sequence[SensFrame], notes: list[str]) -> NDArray[np.float64]:
    """Return the seconds of frames (T,), or their numbers where seconds do not ascend, which is noted."""
    stamps = np.array([entry.stamp for entry in entries], np.float64) * 1e-6
    if np.any(np.diff(stamps) <= 0):
        notes.append("The file's stamps do not increase, so frame numbers replace them.")
        stamps = np.array([entry.number for entry in entries], np.float64)
    return stamps


def _select_tracked(
    file: Path, entries: Sequence[SensFrame], counts: Counter[str]
) -> list[SensFrame]:
    """Return the entries with a pose and a colour image."""
    used = []
    for entry in entries:
        if not np.isfinite(entry.world_from_camera).all():
            counts["frames without a pose"] += 1
        elif not entry.colour_bytes:
            counts["frames without a colour image"] += 1
        else:
            _check_pose(f"{file}, frame {entry.number}", entry.world_from_camera)
            used.append(entry)
    return used


def _frame(
    header: SensHeader,
    entry: SensFrame,
    stamp: float,
    camera: Camera,
    depth_camera: Camera,
    marks: LabelImages,
) -> Frame:
    images = LazyImages(
        bound(read_colour, header, entry),
        bound(read_depth, header, entry) if entry.depth_bytes else None,
        marks.reader(entry.number),
        DepthUnit(f"the header of {header.path}", header.depth_per_metre),
    )
    return posed_frame(
        entry.number,
        stamp,
        entry.world_from_camera,
        camera,
        images,
        depth_camera=depth_camera,
        label_camera=marks.camera,
        label_kind=marks.kind,
        label_names=marks.names,
    )


def read_scannet_export(
    path: str | PathLike[str], *, labels: Wanted = "auto", label_column: str | None = None
) -> Capture:
    """Open a folder of exported frames: `color/7.jpg`, `depth/7.png`, `pose/7.txt`, intrinsics.

    Intrinsics are `intrinsic/intrinsic_color.txt` and `..._depth.txt` (ScanNet's SensReader), or
    `intrinsics_color.txt` and `intrinsics_depth.txt` (its selection of 25,000 frames). Images made
    smaller need `<scan>.txt` beside, which says what size the intrinsics are of. Depth is in
    millimetres. Stamps are the frames' numbers. Everything else is as in `read_sens`.

    Raises `InputError`: a file is missing, unreadable, or not what it should be, or no frame can be
    used; `OptionError`: `labels` is none of its values; the table has no such column.
    """
    path = Path(path)
    colours = list_numbered(path / "color", ENDINGS)
    if not colours:
        raise InputError(
            f"{path / 'color'} contains no image such as 0.jpg; export the frames again."
        )
    depths = list_numbered(path / "depth", (".png",))
    counts: Counter[str] = Counter()
    camera = _exported_camera(path, "color", next(iter(colours.values())))
    depth_camera = _exported_camera(path, "depth", next(iter(depths.values()))) if depths else None
    marks = find_labels(path, labels, camera, label_column=label_column)
    poses = list_numbered(path / "pose", (".txt",))
    frames = []
    for index, colour in colours.items():
        pose = read_matrix(poses[index]) if index in poses else None
        if pose is None or not np.isfinite(pose).all():
            counts["frames without a pose"] += 1
            continue
        _check_pose(poses[index], pose)
        metres = None
        if depth_camera and index in depths:
            metres = depth_file(depths[index], depth_camera, DEPTH_PER_METRE)
        images = LazyImages(
            colour_file(colour, camera),
            metres,
            marks.reader(index),
            DepthUnit(f"ScanNet's depth images in {path / 'depth'}", DEPTH_PER_METRE),
        )
        frames.append(
            posed_frame(
                index,
                float(index),
                pose,
                camera,
                images,
                depth_camera=depth_camera,
                label_camera=marks.camera,
                label_kind=marks.kind,
                label_names=marks.names,
            )
        )
    return _capture(path, frames, camera, depth_camera, marks, [], counts)


def _exported_camera(path: Path, what: str, image: Path) -> Camera:
    """Return the camera of the exported images that are like this one."""
    files = [path / name.format(what) for name in _INTRINSICS]
    file = next((f for f in files if f.is_file()), None)
    if file is None:
        raise InputError(f"{files[0]} does not exist; export the intrinsics of {what}/ too.")
    meta: dict[str, str] = {}
    for folder in (path.absolute(), path.absolute().parent):
        meta = meta or read_meta(folder / f"{folder.name}.txt")
    sides = [meta.get(f"{what}{side}", "") for side in ("Width", "Height")]
    said = None
    if all(s.isascii() and s.isdigit() and 0 < int(s[:9]) < 1 << 16 for s in sides):
        said = (int(sides[0]), int(sides[1]))
    return camera_of_matrix(file, read_matrix(file), image_size(image), said)


def _check_pose(name: object, pose: NDArray[np.float64]) -> None:
    if not is_rigid(pose, _RIGID):
        raise InputError(
            f"{name}: the pose is not a rigid transform, so the file is damaged; download it again."
        )


def _capture(
    path: Path,
    frames: Sequence[Frame],
    camera: Camera,
    depth_camera: Camera | None,
    marks: LabelImages,
    notes: Sequence[str],
    left_out: Counter[str],
) -> Capture:
    if not frames:
        why = ", ".join(f"{count} {what}" for what, count in left_out.items())
        raise InputError(f"{path} contains no usable frame ({why}); use another scan.")
    return Capture(
        path=path,
        frames=tuple(frames),
        camera=camera,
        depth_camera=depth_camera,
        label_camera=marks.camera,
        label_kind=None if marks.camera is None else marks.kind,
        label_names=marks.names,
        notes=(*marks.notes, *notes),
        left_out=left_out,
    )
