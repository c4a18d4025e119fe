"""Captures of telephone apps: Record3D, 3D Scanner App, ios_logger, Polycam and Stray Scanner.

**Record3D.** A `.r3d` is a ZIP with `metadata` and, for every frame N, `rgbd/N.jpg`, `rgbd/N.depth`
(float32 [m], LZFSE) and, of LiDAR, `rgbd/N.conf` (0 to 2, LZFSE). The export has `metadata.json`,
`rgb/N.jpg` or `.png` and `depth/N.exr` (channel R [m]). `metadata`: `w`, `h` of the colour images, `dw`,
`dh` of depth, `K` by columns, `perFrameIntrinsicCoeffs` (fx, fy, cx, cy), `poses` (qx, qy, qz, qw, tx,
ty, tz: world_from_camera in ARKit's axes, of the image as it is stored) and `frameTimestamps` [s].

**3D Scanner App.** For every frame N: `frame_N.json` with `cameraPoseARFrame` (16 numbers by rows,
world_from_camera in ARKit's axes, of the image as it is stored), `intrinsics` (9 by rows [px of the
image]) and `time`; `depth_N.png` (16 bits [mm]) and `conf_N.png` (0 to 2). Only some have a
`frame_N.jpg`; the others are frames of depth alone.

**ios_logger.** `Frames.m4v`; `Frames.txt`, a row a frame of it: `time, number, fx, fy, cx, cy` [s, px];
`ARposes.txt`, rows `time, x, y, z, qw, qx, qy, qz` in ARKit's axes, of the image as it is stored. Rows
have no header. (ViewController.mm of Varvrar/ios_logger.)

**Polycam.** `keyframes/` holds `images/`, `cameras/` and, where the app optimized its poses,
`corrected_images/` (undistorted) and `corrected_cameras/`, further `depth/` (PNG of 16 bits [mm]) and
`confidence/` (0, 127, 255). A frame's files bear its time in microseconds. `cameras/*.json`: `fx fy cx
cy width height` and `t_00` to `t_23`, by rows: world_from_camera in ARKit's axes, of the image as it is
stored. (README of PolyCam/polyform.)

**Stray Scanner.** `rgb.mp4`; `odometry.csv` with a header and rows `timestamp, frame, x, y, z, qx, qy,
qz, qw` and, in newer versions, `fx, fy, cx, cy`; `camera_matrix.csv` (3 x 3 [px of the video]); `depth/`
(PNG of 16 bits [mm]) and `confidence/` (0 to 2), named by the frame. The world has ARKit's y up, but the
cameras have OpenCV's axes already (OdometryEncoder.swift of strayrobots/scanner). The video is stored as
the sensor lies, whatever way the telephone was held.
"""

from __future__ import annotations

import csv
import io
import json
from collections import Counter
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, MissingExtraError
from placegraph.io.capture.frame import (
    Capture,
    DepthUnit,
    LazyImages,
    NoColour,
    check_shape,
    colour_file,
    depth_file,
)
from placegraph.io.capture.images import image_size, list_images, natural_key, read_rgb
from placegraph.io.capture.json_files import read_json
from placegraph.io.capture.posed import (
    ARKIT_FROM_OPENCV,
    MAP_FROM_Y_UP,
    StoredFrame,
    make_camera,
    make_capture,
    match_stamps,
    orthonormalize_pose,
    pose_from_quaternion,
    read_number,
    read_numbers,
    read_rows,
    read_text,
    resize_camera,
)
from placegraph.io.capture.video import Video
from placegraph_io.storage import Archive

_END = b"bvx$"  # of an LZFSE stream


class Folder:
    """Files of a folder and its subfolders, by name."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.names = frozenset(
            p.relative_to(path).as_posix() for pattern in ("*", "*/*") for p in path.glob(pattern)
        )

    def open(self, name: str) -> IO[bytes]:
        """Return the file for reading."""
        try:
            return check_regular(self.path / name).open("rb")
        except OSError as error:
            raise InputError(f"{self.path / name} cannot be read: {error.strerror}.") from error

    def read(self, name: str) -> bytes:
        """Return the content of a file."""
        with self.open(name) as stream:
            return stream.read()

    def json(self, name: str) -> dict[str, Any]:
        """Return the content of a JSON file, an object."""
        return _object(read_json(self.path / name), f"{self.path / name}")


class ZipArchive(Archive):
    """Files of a ZIP, by name."""

    def open(self, name: str) -> IO[bytes]:
        """Return the file for reading."""
        return io.BytesIO(self.read(name))

    def json(self, name: str) -> dict[str, Any]:
        """Return the content of a JSON file, an object."""
        where = self.where(name)
        try:
            return _object(json.loads(self.read(name).decode("utf-8-sig")), where)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{where} is not JSON ({error}).") from error


def _object(content: object, where: str) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise InputError(f"{where} must be a JSON object with poses, K, w and h.")
    return content


def decode_lzfse_depth(data: bytes, camera: Camera, where: str) -> NDArray[np.float32]:
    """Return the depth (h, w) float32 [m], NaN: no reading, of an LZFSE stream; `InputError` as its size."""
    return _mask_invalid(np.frombuffer(_decode_lzfse(data, camera, 4, where), "<f4"), camera)


def decode_confidences(data: bytes, camera: Camera, where: str) -> NDArray[np.uint8]:
    """Return the confidences (h, w) uint8 of an LZFSE stream."""
    values = np.frombuffer(_decode_lzfse(data, camera, 1, where), np.uint8)
    return values.reshape(camera.height, camera.width)


def read_exr_depth(path: Path, camera: Camera) -> NDArray[np.float32]:
    """Return the depth (h, w) float32 [m], NaN: no reading, of the first channel of an OpenEXR file."""
    try:
        import OpenEXR
    except ImportError as error:
        raise MissingExtraError(
            f"{path} is an OpenEXR file, and its reader is not installed: pip install "
            '"placegraph[record3d]".'
        ) from error
    if not path.is_file():
        raise InputError(f"{path} does not exist; it was there when the folder was read.")
    try:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
        name = next(n for n in ("R", "Z", "Y", *channels) if n in channels)
        metres = np.array(channels[name].pixels, np.float32)
    except (RuntimeError, ValueError, TypeError, StopIteration, MemoryError) as error:
        why = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"{path} cannot be read as OpenEXR ({why}); copy it again.") from error
    check_shape(metres, camera, path)
    return _mask_invalid(metres, camera)


def _mask_invalid(metres: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    image = metres.astype(np.float32).reshape(camera.height, camera.width)
    image[~(np.isfinite(image) & (image > 0))] = np.nan
    return image


def _decode_lzfse(data: bytes, camera: Camera, each: int, where: str) -> bytes:
    """Return the bytes of an LZFSE stream, `each` a pixel."""
    wanted = camera.width * camera.height * each
    if len(data) == wanted and not data.startswith(b"bvx"):
        return data  # some tools write them unpacked
    try:
        import liblzfse
    except ImportError as error:
        raise MissingExtraError(
            f"{where} is compressed by LZFSE, and its decoder is not installed: pip install "
            '"placegraph[record3d]".'
        ) from error
    if not (data.startswith(b"bvx") and data.endswith(_END)):
        raise InputError(
            f"{where} is not a complete LZFSE stream; it may be truncated, so copy it again."
        )
    try:
        unpacked: bytes = liblzfse.decompress(data)
    except (liblzfse.error, MemoryError, ValueError) as error:
        raise InputError(f"{where} is a damaged LZFSE stream; copy it again.") from error
    if len(unpacked) != wanted:
        raise InputError(
            f"{where} has {len(unpacked) // each} pixels, but metadata declares {camera.width} x "
            f"{camera.height}; export the recording again."
        )
    return unpacked


_LIDAR = 192, 256  # width and height of depth where old recordings do not say


def is_record3d(path: Path) -> bool:
    """Return whether a path is a `.r3d` file, its folder, or an export's."""
    if path.is_file():
        return path.suffix.lower() == ".r3d"
    known = _find_export(path)
    unpacked = any((path / name).is_file() for name in ("metadata", "metadata.json"))
    return known is not None or (unpacked and (path / "rgbd").is_dir())


def read_record3d(path: Path) -> Capture:
    """Read a recording; frames without depth or pose are left out.

    Raises `InputError` where files are missing or broken, `MissingExtraError` where what unpacks
    depth (LZFSE or OpenEXR) is not installed.
    """
    exported = _find_export(path)
    source = ZipArchive(path) if path.is_file() else Folder(exported or path)
    meta = source.json("metadata.json" if "metadata.json" in source.names else "metadata")
    where = f"{source.path}, metadata"
    colours, depths = ("rgb/", "depth/") if exported else ("rgbd/", "rgbd/")
    pictures = {n[len(colours) :].partition(".")[0]: n for n in source.names
                if n.startswith(colours) and n.lower().endswith((".jpg", ".png"))}  # fmt: skip
    poses = _record3d_table(meta, where, "poses", 7)
    stamps = _record3d_stamps(meta, where, len(poses))
    cameras = _record3d_cameras(meta, where, len(poses))
    size = _record3d_size(meta, where, ("dw", "dh"), _LIDAR)
    left_out: Counter[str] = Counter()
    frames_ = []
    for stem in sorted(pictures, key=natural_key):
        row = int(stem) if stem.isascii() and stem.isdigit() else -1
        depth = f"{depths}{stem}.{'exr' if exported else 'depth'}"
        if depth not in source.names or not 0 <= row < len(poses):
            left_out[f"no {'pose' if row < 0 or row >= len(poses) else 'depth'}"] += 1
            continue
        camera = cameras[row]
        depth_camera = resize_camera(camera, size, f"{source.path}, {depth}")
        name = f"{where}: poses[{row}]"
        pose = pose_from_quaternion(poses[row, 4:], poses[row, :4], name)
        images = LazyImages(
            partial(_record3d_colour, source, pictures[stem], camera),
            partial(_record3d_depth, source, depth, depth_camera),
            unit=DepthUnit(f"{source.path}, {depths}", 1.0),
        )
        pose = MAP_FROM_Y_UP @ pose @ ARKIT_FROM_OPENCV
        frames_.append(StoredFrame(name, stamps[row], pose, camera, images, depth_camera))
    return make_capture(path, frames_, left_out=left_out)


def _find_export(path: Path) -> Path | None:
    """Return the folder with `metadata.json`, `rgb/` and `depth/*.exr`."""
    for folder in (path, path / "EXR_RGBD"):
        if (folder / "metadata.json").is_file() and (folder / "rgb").is_dir():
            depth = folder / "depth"
            if depth.is_dir() and next(depth.glob("*.exr"), None):
                return folder
    return None


def _record3d_colour(source: Folder | ZipArchive, name: str, camera: Camera) -> NDArray[np.uint8]:
    with source.open(name) as stream:
        return read_rgb(source.path / name, (camera.width, camera.height), stream)


def _record3d_depth(source: Folder | ZipArchive, name: str, camera: Camera) -> NDArray[np.float32]:
    where = f"{source.path}, {name}"
    if name.endswith(".exr"):
        return read_exr_depth(source.path / name, camera)
    metres = decode_lzfse_depth(source.read(name), camera, where)
    confidence = name.removesuffix("depth") + "conf"
    if confidence in source.names:
        metres[decode_confidences(source.read(confidence), camera, where) == 0] = np.nan
    return metres


def _record3d_table(
    meta: dict[str, Any], where: str, field: str, columns: int
) -> NDArray[np.float64]:
    """Return the rows (T, columns) of numbers."""
    try:
        table = np.array(meta.get(field), np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: {field} is not a list of rows of numbers.") from error
    if table.ndim != 2 or table.shape[1] != columns or not len(table):
        raise InputError(
            f"{where}: {field} has shape {table.shape}; it must have rows of {columns} numbers."
        )
    return table


def _record3d_stamps(meta: dict[str, Any], where: str, count: int) -> list[float]:
    """Return the seconds of every frame; of old recordings, by their rate."""
    given = meta.get("frameTimestamps")
    if not given:
        rate = meta.get("fps", 60)
        if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0 < rate < 1e6:
            raise InputError(f"{where}: fps is {str(rate)[:40]!r}; it must be greater than 0.")
        return [i / rate for i in range(count)]
    stamps = _record3d_table({"frameTimestamps": [[s] for s in given]} if isinstance(given, list) else {},
                    where, "frameTimestamps", 1)[:, 0]  # fmt: skip
    if len(stamps) < count or not np.isfinite(stamps).all():
        raise InputError(f"{where}: frameTimestamps has {len(stamps)} numbers for {count} poses.")
    return [float(stamp) for stamp in stamps]


def _record3d_cameras(meta: dict[str, Any], where: str, count: int) -> list[Camera]:
    """Return the camera of every frame."""
    size = _record3d_size(meta, where, ("w", "h"), None)
    if meta.get("perFrameIntrinsicCoeffs"):
        table = _record3d_table(meta, where, "perFrameIntrinsicCoeffs", 4)
        if len(table) >= count:
            return [
                make_camera(f"{where}: perFrameIntrinsicCoeffs[{i}]", size, row)
                for i, row in enumerate(table.tolist())
            ]
    k = _record3d_table({"K": [meta.get("K")]}, where, "K", 9)[0].tolist()
    return [make_camera(f"{where}: K", size, (k[0], k[4], k[6], k[7]))] * count


def _record3d_size(
    meta: dict[str, Any], where: str, fields: tuple[str, str], default: tuple[int, int] | None
) -> tuple[int, int]:
    if default and not any(name in meta for name in fields):
        return default
    values = [meta.get(name) for name in fields]
    if not all(isinstance(v, int) and 0 < v < 1 << 16 for v in values):
        raise InputError(
            f"{where}: {' and '.join(fields)} are {values}; they must be sizes in pixels."
        )
    return int(values[0] or 0), int(values[1] or 0)


_UNIT = 1000.0
_MAX_OFFSET = 0.15  # principal points lie nearer to the middle than this share of the width


def is_arkit_app(path: Path) -> bool:
    """Return whether a folder holds a `frame_N.json`."""
    return path.is_dir() and next(path.glob("frame_[0-9]*.json"), None) is not None


def read_arkit_app(path: Path) -> Capture:
    """Read an export.

    Raises `InputError` where files are missing or broken, intrinsics are those of images of another
    size, or depth is not of the images' view.
    """
    images = list_images(path)
    left_out: Counter[str] = Counter()
    named = []
    for stem in list_images(path, (".json",)):
        row = stem.removeprefix("frame_")
        if row == stem or not (row.isascii() and row.isdigit()):
            continue  # info.json and the like
        if f"depth_{row}" in images:
            named.append(row)
        else:
            left_out["no depth"] += 1
    coloured = next((row for row in named if f"frame_{row}" in images), None)
    if coloured is None:
        raise InputError(
            f"{path} has no frame with frame_*.json, frame_*.jpg and depth_*.png; record with a "
            "device with LiDAR, and export all data."
        )
    first = images[f"frame_{coloured}"], images[f"depth_{coloured}"]
    return make_capture(
        path, (_read_arkit_app_frame(path, images, row, first) for row in named), left_out=left_out
    )


def _read_arkit_app_frame(
    path: Path, images: dict[str, Path], row: str, first: tuple[Path, Path]
) -> StoredFrame:
    """Return the frame of a number; `first` are the colour and the depth image whose sizes all have."""
    file = path / f"frame_{row}.json"
    content = read_json(file)
    if not isinstance(content, dict):
        raise InputError(f"{file} must be a JSON object with cameraPoseARFrame and intrinsics.")
    fx, _, cx, _, fy, cy, *_ = read_numbers(file, content, "intrinsics", 9)
    width, height = image_size(first[0])
    if not max(abs(cx / width - 0.5), abs(cy / height - 0.5)) < _MAX_OFFSET:
        raise InputError(
            f"{file}: the principal point {cx:g}, {cy:g} is not the middle of {first[0].name}, "
            f"{width} x {height}, so the images were resized or rotated; export them again."
        )
    camera = make_camera(f"{file}: intrinsics", (width, height), (fx, fy, cx, cy))
    colour, confidence = (images.get(f"{kind}_{row}") for kind in ("frame", "conf"))
    depth = images[f"depth_{row}"]
    depth_camera = resize_camera(camera, image_size(first[1]), first[1])
    pose = orthonormalize_pose(
        read_numbers(file, content, "cameraPoseARFrame", 16), f"{file}: cameraPoseARFrame"
    )
    return StoredFrame(
        name=str(file),
        stamp=read_number(file, content, "time") if "time" in content else float(int(row)),
        pose=MAP_FROM_Y_UP @ pose @ ARKIT_FROM_OPENCV,
        camera=camera,
        images=LazyImages(
            colour_file(colour, camera) if colour else NoColour((width, height)),
            depth_file(depth, depth_camera, _UNIT, confidence=confidence),
            unit=DepthUnit(f"{path / 'depth_*.png'}", _UNIT),
        ),
        depth_camera=depth_camera,
    )


_TOLERANCE = 0.002  # seconds: both files have the frame's own stamp, rounded to a microsecond


def is_ios_logger(path: Path) -> bool:
    """Return whether a folder has `Frames.txt` and `ARposes.txt`."""
    return (path / "Frames.txt").is_file() and (path / "ARposes.txt").is_file()


def read_ios_logger(path: Path) -> Capture:
    """Read a recording; frames without a pose are left out.

    Raises `InputError` where files are missing or broken, or the frames have no intrinsics (recorded
    outside of the AR mode), `MissingExtraError` where no decoder of videos is installed.
    """
    video = Video(path / "Frames.m4v")
    frames = read_rows(path / "Frames.txt", (6,), "time, number, fx, fy, cx, cy")
    poses = read_rows(path / "ARposes.txt", (8,), "time, x, y, z, qw, qx, qy, qz")
    found = match_stamps([row[0] for _, row in poses], [row[0] for _, row in frames], _TOLERANCE)
    left_out: Counter[str] = Counter()
    frames_ = []
    for (line, (stamp, index, *intrinsics)), at in zip(frames, found.tolist(), strict=True):
        number = int(index)
        if number != index or number < 0:
            raise InputError(
                f"{line}: number is {index:g}; it must be the frame's number in Frames.m4v."
            )
        if at < 0 or number >= len(video):
            left_out[f"no {'pose' if at < 0 else 'colour image'}"] += 1
            continue
        where, (_, x, y, z, qw, *q) = poses[at]
        camera = make_camera(line, video.size, intrinsics)
        pose = MAP_FROM_Y_UP @ pose_from_quaternion((x, y, z), (*q, qw), where) @ ARKIT_FROM_OPENCV
        images = LazyImages(partial(video.picture, number, camera))
        frames_.append(StoredFrame(where, stamp, pose, camera, images))
    return make_capture(path, frames_, left_out=left_out)


def is_polycam(path: Path) -> bool:
    """Return whether a folder is an export, or its `keyframes/`."""
    return (_find_keyframes(path) / "cameras").is_dir() or (
        _find_keyframes(path) / "corrected_cameras"
    ).is_dir()


def read_polycam(path: Path) -> Capture:
    """Read an export; the corrected images and poses are used where there are any.

    Raises `InputError` where files are missing or broken, or depth is not of the images' view.
    """
    folder = _find_keyframes(path)
    corrected = list_images(folder / "corrected_images")
    kind = (
        "corrected_" if corrected and list_images(folder / "corrected_cameras", (".json",)) else ""
    )
    colours = corrected if kind else list_images(folder / "images")
    cameras = list_images(folder / f"{kind}cameras", (".json",))
    depths, confidence = list_images(folder / "depth"), list_images(folder / "confidence")
    if not colours:
        raise InputError(f"{folder / 'images'} contains no image; export the raw data again.")
    if not depths:
        raise InputError(
            f"{folder / 'depth'} contains no image; only captures in LiDAR or room mode have depth."
        )
    first = next(iter(depths.values()))
    size, unit = image_size(first), DepthUnit(str(folder / "depth"), _UNIT)
    left_out: Counter[str] = Counter()
    frames_ = []
    for i, (stem, file) in enumerate(colours.items()):
        if stem not in cameras or stem not in depths:
            left_out[f"no {'camera' if stem not in cameras else 'depth'}"] += 1
            continue
        camera, pose = _read_polycam_camera(cameras[stem])
        depth_camera = resize_camera(camera, size, first)
        depth = depth_file(depths[stem], depth_camera, _UNIT, confidence=confidence.get(stem))
        frames_.append(
            StoredFrame(
                name=str(cameras[stem]),
                stamp=int(stem) / 1e6 if stem.isascii() and stem.isdigit() else float(i),
                pose=pose,
                camera=camera,
                images=LazyImages(colour_file(file, camera), depth, unit=unit),
                depth_camera=depth_camera,
            )
        )
    notes = (
        ()
        if kind
        else (
            (
                "Polycam's uncorrected poses and images are used, because corrected ones are "
                "missing."
            ),
        )
    )
    return make_capture(path, frames_, left_out=left_out, notes=notes)


def _find_keyframes(path: Path) -> Path:
    return path if path.name == "keyframes" else path / "keyframes"


def _read_polycam_camera(path: Path) -> tuple[Camera, NDArray[np.float64]]:
    """Return the intrinsics, and the pose (4, 4) of a frame."""
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f"{path} must be a JSON object with fx, fy, cx, cy and t_00 to t_23.")
    try:
        width, height = (int(read_number(path, content, name)) for name in ("width", "height"))
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: width and height must be whole numbers of pixels.") from error
    intrinsics = [read_number(path, content, name) for name in ("fx", "fy", "cx", "cy")]
    rows = [read_number(path, content, f"t_{i}{j}") for i in range(3) for j in range(4)]
    pose = MAP_FROM_Y_UP @ orthonormalize_pose(rows, str(path)) @ ARKIT_FROM_OPENCV
    return make_camera(str(path), (width, height), intrinsics), pose


_POSE = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")


def is_stray(path: Path) -> bool:
    """Return whether a folder has `odometry.csv` and `camera_matrix.csv`."""
    return (path / "odometry.csv").is_file() and (path / "camera_matrix.csv").is_file()


def read_stray(path: Path) -> Capture:
    """Read a recording; frames without depth are left out.

    Raises `InputError` where files are missing or broken, `MissingExtraError` where no decoder of
    videos is installed.
    """
    video = Video(path / "rgb.mp4")
    matrix = _read_stray_intrinsics(path / "camera_matrix.csv")
    depths, confidence = list_images(path / "depth"), list_images(path / "confidence")
    if not depths:
        raise InputError(f"{path / 'depth'} contains no image; copy the whole recording.")
    first = next(iter(depths.values()))
    size, unit = image_size(first), DepthUnit(str(path / "depth"), _UNIT)
    left_out: Counter[str] = Counter()
    frames_ = []
    for line, row in _read_stray_rows(path / "odometry.csv"):
        number = int(row["frame"])
        stem = f"{number:06d}"
        if number >= len(video) or stem not in depths:
            left_out[f"no {'colour image' if number >= len(video) else 'depth'}"] += 1
            continue
        intrinsics = [row.get(name, matrix[name]) for name in _INTRINSICS]
        camera = make_camera(f"{path / 'camera_matrix.csv'}", video.size, intrinsics)
        depth_camera = resize_camera(camera, size, first)
        position, xyzw = ([row[name] for name in _POSE[a:b]] for a, b in ((2, 5), (5, 9)))
        depth = depth_file(depths[stem], depth_camera, _UNIT, confidence=confidence.get(stem))
        frames_.append(
            StoredFrame(
                name=line,
                stamp=row["timestamp"],
                pose=MAP_FROM_Y_UP @ pose_from_quaternion(position, xyzw, line),
                camera=camera,
                images=LazyImages(partial(video.picture, number, camera), depth, unit=unit),
                depth_camera=depth_camera,
            )
        )
    return make_capture(path, frames_, left_out=left_out)


def _read_stray_intrinsics(path: Path) -> dict[str, float]:
    """Return fx, fy, cx, cy of a matrix by rows."""
    try:
        values = [float(word) for word in read_text(path).replace(",", " ").split()]
    except ValueError as error:
        raise InputError(f"{path}: {error}; it must be a 3 x 3 matrix.") from error
    if len(values) != 9:
        raise InputError(f"{path} contains {len(values)} numbers; it must be a 3 x 3 matrix.")
    return dict(zip(_INTRINSICS, (values[0], values[4], values[2], values[5]), strict=True))


def _read_stray_rows(path: Path) -> list[tuple[str, dict[str, float]]]:
    """Rows of a table with a header, by column, and where they stand; empty cells have no entry."""
    try:
        lines = list(csv.reader(io.StringIO(read_text(path)), skipinitialspace=True))
    except csv.Error as error:
        raise InputError(f"{path} is not a table ({error}).") from error
    names = [name.strip() for name in lines[0]] if lines else []
    if not set(_POSE) <= set(names):
        raise InputError(f"{path}, line 1: the columns must be `{', '.join(_POSE)}`.")
    rows = []
    for row_number, cells in enumerate(lines[1:], 2):
        where = f"{path}, line {row_number}"
        try:
            row = {n: float(c) for n, c in zip(names, cells, strict=False) if c.strip()}
        except ValueError as error:
            raise InputError(f"{where}: {error}.") from error
        if not row:
            continue
        lost = [n for n in _POSE if not np.isfinite(row.get(n, np.nan))]
        if lost or row["frame"] < 0:
            raise InputError(f"{where}: {lost[0] if lost else 'frame'} is not a finite number.")
        rows.append((where, row))
    return rows
