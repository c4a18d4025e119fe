"""Recordings of Record3D: `.r3d` files, such files unpacked, and the export "EXR + JPG".

A `.r3d` is a ZIP with `metadata` and, for every frame N, `rgbd/N.jpg`, `rgbd/N.depth` (float32 [m],
LZFSE) and, of LiDAR, `rgbd/N.conf` (0 to 2, LZFSE). The export has `metadata.json`, `rgb/N.jpg` or
`.png` and `depth/N.exr` (channel R [m]). `metadata`: `w`, `h` of the colour images, `dw`, `dh` of
depth, `K` by columns, `perFrameIntrinsicCoeffs` (fx, fy, cx, cy), `poses` (qx, qy, qz, qw, tx, ty,
tz: world_from_camera in ARKit's axes, of the image as it is stored) and `frameTimestamps` [s].
"""

from __future__ import annotations

import io
import json
from collections import Counter
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, MissingExtraError
from placegraph.io.capture.archive import Archive
from placegraph.io.capture.camera import read_json
from placegraph.io.capture.frame_files import DepthUnit, LazyImages, check_shape
from placegraph.io.capture.frames import Capture
from placegraph.io.capture.images import natural, read_rgb
from placegraph.io.capture.posed import (
    ARKIT_FROM_OPENCV,
    MAP_FROM_Y_UP,
    Shot,
    camera_of,
    capture_of,
    pose_of,
    smaller_view,
)

_END = b"bvx$"  # of an LZFSE stream


class Folder:
    """Files of a folder and its subfolders, by name."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.names = frozenset(
            p.relative_to(path).as_posix() for pattern in ("*", "*/*") for p in path.glob(pattern)
        )

    def open(self, name: str) -> IO[bytes]:
        """File for reading."""
        try:
            return regular(self.path / name).open("rb")
        except OSError as error:
            raise InputError(f"{self.path / name} cannot be read: {error.strerror}.") from error

    def read(self, name: str) -> bytes:
        """Content of a file."""
        with self.open(name) as stream:
            return stream.read()

    def json(self, name: str) -> dict[str, Any]:
        """Content of a JSON file, an object."""
        return _object(read_json(self.path / name), f"{self.path / name}")


class Zipped(Archive):
    """Files of a ZIP, by name."""

    def open(self, name: str) -> IO[bytes]:
        """File for reading."""
        return io.BytesIO(self.read(name))

    def json(self, name: str) -> dict[str, Any]:
        """Content of a JSON file, an object."""
        where = self.where(name)
        try:
            return _object(json.loads(self.read(name).decode("utf-8-sig")), where)
        except (ValueError, RecursionError) as error:
            raise InputError(f"{where} is not JSON ({error}).") from error


def _object(content: object, where: str) -> dict[str, Any]:
    if not isinstance(content, dict):
        raise InputError(f"{where} must be a JSON object with poses, K, w and h.")
    return content


# ---------------------------------------------------------------------------------------- depth


def lzfse_depth(data: bytes, camera: Camera, where: str) -> NDArray[np.float32]:
    """Depth (h, w) float32 [m], NaN: no reading, of an LZFSE stream; `InputError` as its size."""
    return _readings(np.frombuffer(_unpacked(data, camera, 4, where), "<f4"), camera)


def confidences(data: bytes, camera: Camera, where: str) -> NDArray[np.uint8]:
    """Confidences (h, w) uint8 of an LZFSE stream."""
    values = np.frombuffer(_unpacked(data, camera, 1, where), np.uint8)
    return values.reshape(camera.height, camera.width)


def exr_depth(path: Path, camera: Camera) -> NDArray[np.float32]:
    """Depth (h, w) float32 [m], NaN: no reading, of the first channel of an OpenEXR file."""
    try:
        import OpenEXR
    except ImportError as error:
        raise MissingExtraError(
            f'{path} is OpenEXR, whose reader is not installed: pip install "placegraph[record3d]".'
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
    return _readings(metres, camera)


def _readings(metres: NDArray[np.float32], camera: Camera) -> NDArray[np.float32]:
    image = metres.astype(np.float32).reshape(camera.height, camera.width)
    image[~(np.isfinite(image) & (image > 0))] = np.nan
    return image


def _unpacked(data: bytes, camera: Camera, each: int, where: str) -> bytes:
    """Bytes of an LZFSE stream, `each` a pixel."""
    wanted = camera.width * camera.height * each
    if len(data) == wanted and not data.startswith(b"bvx"):
        return data  # some tools write them unpacked
    try:
        import liblzfse
    except ImportError as error:
        raise MissingExtraError(
            f"{where} is packed by LZFSE, which is not installed: "
            'pip install "placegraph[record3d]".'
        ) from error
    if not (data.startswith(b"bvx") and data.endswith(_END)):
        raise InputError(f"{where} is no whole LZFSE stream; it may be truncated: copy it again.")
    try:
        unpacked: bytes = liblzfse.decompress(data)
    except (liblzfse.error, MemoryError, ValueError) as error:
        raise InputError(f"{where} is a damaged LZFSE stream; copy it again.") from error
    if len(unpacked) != wanted:
        raise InputError(
            f"{where} has {len(unpacked) // each} pixels, but metadata says {camera.width} x "
            f"{camera.height}; export the recording again."
        )
    return unpacked


_LIDAR = 192, 256  # width and height of depth where old recordings do not say


def is_record3d(path: Path) -> bool:
    """Whether this is a `.r3d` file, its folder, or an export's."""
    if path.is_file():
        return path.suffix.lower() == ".r3d"
    known = _exported(path)
    unpacked = any((path / name).is_file() for name in ("metadata", "metadata.json"))
    return known is not None or (unpacked and (path / "rgbd").is_dir())


def read_record3d(path: Path) -> Capture:
    """Read a recording; frames without depth or pose are left out.

    Raises `InputError` where files are missing or broken, `MissingExtraError` where what unpacks
    depth (LZFSE or OpenEXR) is not installed.
    """
    exported = _exported(path)
    source = Zipped(path) if path.is_file() else Folder(exported or path)
    meta = source.json("metadata.json" if "metadata.json" in source.names else "metadata")
    where = f"{source.path}, metadata"
    colours, depths = ("rgb/", "depth/") if exported else ("rgbd/", "rgbd/")
    pictures = {n[len(colours) :].partition(".")[0]: n for n in source.names
                if n.startswith(colours) and n.lower().endswith((".jpg", ".png"))}  # fmt: skip
    poses = _table(meta, where, "poses", 7)
    stamps = _stamps(meta, where, len(poses))
    cameras = _cameras(meta, where, len(poses))
    size = _size(meta, where, ("dw", "dh"), _LIDAR)
    left_out: Counter[str] = Counter()
    shots = []
    for stem in sorted(pictures, key=natural):
        row = int(stem) if stem.isascii() and stem.isdigit() else -1
        depth = f"{depths}{stem}.{'exr' if exported else 'depth'}"
        if depth not in source.names or not 0 <= row < len(poses):
            left_out[f"no {'pose' if row < 0 or row >= len(poses) else 'depth'}"] += 1
            continue
        camera = cameras[row]
        depth_camera = smaller_view(camera, size, f"{source.path}, {depth}")
        name = f"{where}: poses[{row}]"
        pose = pose_of(poses[row, 4:], poses[row, :4], name)
        images = LazyImages(
            partial(_colour, source, pictures[stem], camera),
            partial(_depth, source, depth, depth_camera),
            unit=DepthUnit(f"{source.path}, {depths}", 1.0),
        )
        pose = MAP_FROM_Y_UP @ pose @ ARKIT_FROM_OPENCV
        shots.append(Shot(name, stamps[row], pose, camera, images, depth_camera))
    return capture_of(path, shots, left_out=left_out)


def _exported(path: Path) -> Path | None:
    """Folder with `metadata.json`, `rgb/` and `depth/*.exr`."""
    for folder in (path, path / "EXR_RGBD"):
        if (folder / "metadata.json").is_file() and (folder / "rgb").is_dir():
            depth = folder / "depth"
            if depth.is_dir() and next(depth.glob("*.exr"), None):
                return folder
    return None


def _colour(source: Folder | Zipped, name: str, camera: Camera) -> NDArray[np.uint8]:
    with source.open(name) as stream:
        return read_rgb(source.path / name, (camera.width, camera.height), stream)


def _depth(source: Folder | Zipped, name: str, camera: Camera) -> NDArray[np.float32]:
    where = f"{source.path}, {name}"
    if name.endswith(".exr"):
        return exr_depth(source.path / name, camera)
    metres = lzfse_depth(source.read(name), camera, where)
    sure = name.removesuffix("depth") + "conf"
    if sure in source.names:
        metres[confidences(source.read(sure), camera, where) == 0] = np.nan
    return metres


# ------------------------------------------------------------------------------------- metadata


def _table(meta: dict[str, Any], where: str, field: str, columns: int) -> NDArray[np.float64]:
    """Rows (T, columns) of numbers."""
    try:
        table = np.array(meta.get(field), np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: {field} is not a list of rows of numbers.") from error
    if table.ndim != 2 or table.shape[1] != columns or not len(table):
        raise InputError(f"{where}: {field} has shape {table.shape}; rows of {columns} belong.")
    return table


def _stamps(meta: dict[str, Any], where: str, count: int) -> list[float]:
    """Seconds of every frame; of old recordings, by their rate."""
    given = meta.get("frameTimestamps")
    if not given:
        rate = meta.get("fps", 60)
        if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0 < rate < 1e6:
            raise InputError(f"{where}: fps is {str(rate)[:40]!r}; it must be greater than 0.")
        return [i / rate for i in range(count)]
    stamps = _table({"frameTimestamps": [[s] for s in given]} if isinstance(given, list) else {},
                    where, "frameTimestamps", 1)[:, 0]  # fmt: skip
    if len(stamps) < count or not np.isfinite(stamps).all():
        raise InputError(f"{where}: frameTimestamps has {len(stamps)} numbers for {count} poses.")
    return [float(stamp) for stamp in stamps]


def _cameras(meta: dict[str, Any], where: str, count: int) -> list[Camera]:
    """Camera of every frame."""
    size = _size(meta, where, ("w", "h"), None)
    if meta.get("perFrameIntrinsicCoeffs"):
        table = _table(meta, where, "perFrameIntrinsicCoeffs", 4)
        if len(table) >= count:
            return [
                camera_of(f"{where}: perFrameIntrinsicCoeffs[{i}]", size, row)
                for i, row in enumerate(table.tolist())
            ]
    k = _table({"K": [meta.get("K")]}, where, "K", 9)[0].tolist()
    return [camera_of(f"{where}: K", size, (k[0], k[4], k[6], k[7]))] * count


def _size(
    meta: dict[str, Any], where: str, fields: tuple[str, str], default: tuple[int, int] | None
) -> tuple[int, int]:
    if default and not any(name in meta for name in fields):
        return default
    values = [meta.get(name) for name in fields]
    if not all(isinstance(v, int) and 0 < v < 1 << 16 for v in values):
        raise InputError(f"{where}: {' and '.join(fields)} are {values}; they are sizes in pixels.")
    return int(values[0] or 0), int(values[1] or 0)
