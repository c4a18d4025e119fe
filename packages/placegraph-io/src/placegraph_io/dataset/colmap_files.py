"""Files of a COLMAP model, binary or text, and its dense depth maps.

A model is `cameras`, `images` and `points3D`, all `.bin` or all `.txt`. Poses are
camera_from_model, quaternions w first; cameras have OpenCV's axes, and pixel centres lie at +0.5.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import regular
from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.posed import camera_of, pose_of, read_text

_MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)  # fmt: skip
"""Camera models by number, and how many parameters they have."""
_PARAMETERS = dict(_MODELS)
_RADIAL = ("SIMPLE_RADIAL", "RADIAL")
_RADIAL_FISHEYE = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_NO_POINT = np.uint64(2**64 - 1)
_PIXEL = np.dtype([("uv", "<f8", 2), ("point", "<u8")])
_TRACK = 8  # bytes of an element of a point's track


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """An image of a model."""

    name: str
    """Path below the folder of images."""
    camera_from_model: NDArray[np.float64]
    """(4, 4), lengths in the model's unit."""
    camera: int
    """Number of its camera."""
    uv: NDArray[np.float64]
    """(n, 2) where it sees points [px]."""
    points: NDArray[np.uint64]
    """(n,) ids of those points."""


@dataclass(frozen=True, slots=True, eq=False)
class ColmapModel:
    """Content of a model's three files."""

    cameras: dict[int, Camera]
    pictures: tuple[Picture, ...]
    points: dict[int, NDArray[np.float64]]
    """(3,) in the model's unit, by id."""


def model_folder(path: Path) -> Path | None:
    """Folder of the model: `sparse/0`, `sparse` or the path itself; None: there is none."""
    for folder in (path / "sparse" / "0", path / "sparse", path):
        if _ending(folder):
            return folder
    return None


def read_model(folder: Path) -> ColmapModel:
    """Read a model; `InputError` where a file is missing, truncated, or a camera is no pinhole's."""
    if _ending(folder) == ".bin":
        cameras = dict(_binary_cameras(folder / "cameras.bin"))
        pictures = tuple(_binary_pictures(folder / "images.bin"))
        points = dict(_binary_points(folder / "points3D.bin"))
    else:
        cameras = dict(_text_cameras(folder / "cameras.txt"))
        pictures = tuple(_text_pictures(folder / "images.txt"))
        points = dict(_text_points(folder / "points3D.txt"))
    for picture in pictures:
        if picture.camera not in cameras:
            raise InputError(
                f"{folder}: image {picture.name!r} is of camera {picture.camera}, which is not there."
            )
    return ColmapModel(cameras, pictures, points)


def read_depth_map(path: Path) -> NDArray[np.float32]:
    """Depth (h, w) float32 in the model's unit, NaN: none, of `stereo/depth_maps/*.bin`."""
    data = _bytes(path)
    head = re.match(rb"([0-9]{1,9})&([0-9]{1,9})&([0-9]{1,9})&", data)
    if not head:
        raise InputError(f"{path} does not begin with `width&height&channels&`.")
    width, height, channels = (int(part) for part in head.groups())
    body = data[head.end() :]
    if channels != 1 or min(width, height) < 1 or len(body) != 4 * width * height:
        raise InputError(
            f"{path} says {width} x {height} x {channels}, but holds {len(body)} bytes; it may be "
            "truncated: copy it again."
        )
    depth = np.frombuffer(body, "<f4").reshape(height, width).copy()
    depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
    return depth


def _ending(folder: Path) -> str | None:
    """Ending of a model's files; None: it is none."""
    for ending in (".bin", ".txt"):
        if all((folder / f"{name}{ending}").is_file() for name in ("cameras", "images")):
            return ending
    return None


def model_camera(where: str, model: str, size: tuple[int, int], values: list[float]) -> Camera:
    """Camera of a COLMAP model's name and parameters; `InputError` where it is no pinhole."""
    if len(values) != _PARAMETERS.get(model, -1):
        raise InputError(f"{where}: no camera model {model!r} has {len(values)} parameters.")
    if model in {*_RADIAL, *_RADIAL_FISHEYE, "SIMPLE_PINHOLE"}:
        focal, *values = values
        values = [focal, focal, *values]
    if model in {"SIMPLE_PINHOLE", "PINHOLE"}:
        distortion = []
    elif model in {*_RADIAL, *_RADIAL_FISHEYE}:
        distortion = [*values[4:], 0.0, 0.0, 0.0][:4]
    elif model in {"OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"}:
        distortion = values[4:]
    else:
        raise InputError(
            f"{where}: the camera model {model} cannot be used; run `colmap image_undistorter`, and "
            "give its folder."
        )
    kind = "fisheye" if model in {*_RADIAL_FISHEYE, "OPENCV_FISHEYE"} else "opencv"
    return camera_of(where, size, values[:4], distortion, kind)


# --------------------------------------------------------------------------------------- binary


class _Reader:
    """Walks through the bytes of a file; `InputError` where they end too early."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, _bytes(path), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """Numbers of a `struct` layout, little-endian."""
        size = struct.calcsize("<" + layout)
        self.skip(size)
        return struct.unpack_from("<" + layout, self.data, self.at - size)

    def skip(self, size: int) -> None:
        """Pass over bytes."""
        if size > len(self.data) - self.at:
            raise InputError(f"{self.path} ends too early; it is truncated: copy it again.")
        self.at += size

    def text(self) -> str:
        """Text that ends with a zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise InputError(f"{self.path} ends too early; it is truncated: copy it again.")
        text = self.data[self.at : end].decode(errors="replace")
        self.at = end + 1
        return text

    def rows(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Rows of a table."""
        self.skip(count * dtype.itemsize)
        return np.frombuffer(self.data, dtype, count, self.at - count * dtype.itemsize)


def _binary_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        number, model, width, height = reader.take("IiQQ")
        if not 0 <= model < len(_MODELS):
            raise InputError(f"{path}: camera {number} is of a model {model} that is not known.")
        name, count = _MODELS[model]
        values = list(reader.take(f"{count}d"))
        yield number, model_camera(f"{path}, camera {number}", name, (width, height), values)


def _binary_pictures(path: Path) -> Iterator[Picture]:
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        _, *pose, camera = reader.take("I7dI")
        name = reader.text()
        seen = reader.rows(reader.take("Q")[0], _PIXEL)
        yield _picture(f"{path}, {name!r}", name, pose, camera, seen["uv"], seen["point"])


def _binary_points(path: Path) -> Iterator[tuple[int, NDArray[np.float64]]]:
    if not path.is_file():
        return  # a model may have none
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        number, x, y, z, *_, track = reader.take("Q3d3BdQ")
        reader.skip(track * _TRACK)
        yield number, np.array([x, y, z])


# ----------------------------------------------------------------------------------------- text


def _text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    for where, words in _lines(path):
        if len(words) < 4:
            raise InputError(f"{where}: a row is `CAMERA_ID MODEL WIDTH HEIGHT PARAMS`.")
        number, width, height = (int(v) for v in _floats(where, [words[0], *words[2:4]]))
        values = _floats(where, words[4:]).tolist()
        yield number, model_camera(where, words[1], (width, height), values)


def _text_pictures(path: Path) -> Iterator[Picture]:
    rows = _lines(path, blank=True)
    for where, words in rows:
        if not words:
            continue
        if len(words) < 10:
            raise InputError(f"{where}: a row is `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`.")
        values = _floats(where, words[:9])
        _, seen = next(rows, (where, []))
        if len(seen) % 3:
            raise InputError(f"{where}: the row below is not `X Y POINT3D_ID ...`.")
        table = _floats(where, seen).reshape(-1, 3)
        points = np.where(table[:, 2] < 0, 0, table[:, 2]).astype(np.uint64)
        points[table[:, 2] < 0] = _NO_POINT
        name = " ".join(words[9:])
        yield _picture(where, name, values[1:8].tolist(), int(values[8]), table[:, :2], points)


def _text_points(path: Path) -> Iterator[tuple[int, NDArray[np.float64]]]:
    if not path.is_file():
        return
    for where, words in _lines(path):
        if len(words) < 8:
            raise InputError(f"{where}: a row is `POINT3D_ID X Y Z R G B ERROR TRACK`.")
        values = _floats(where, words[:4])
        yield int(values[0]), values[1:]


def _picture(
    where: str,
    name: str,
    pose: list[float],
    camera: int,
    uv: NDArray[np.float64],
    points: NDArray[np.uint64],
) -> Picture:
    w, x, y, z, *position = pose
    known = points != _NO_POINT
    return Picture(name, pose_of(position, (x, y, z, w), where), camera, uv[known], points[known])


def _lines(path: Path, *, blank: bool = False) -> Iterator[tuple[str, list[str]]]:
    """Words of every line that is no comment, and where it stands."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if not line.startswith("#") and (words or blank):
            yield f"{path}, line {number}", words


def _floats(where: str, words: list[str]) -> NDArray[np.float64]:
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"{where}: {error}.") from error
    if not np.isfinite(values).all() or np.abs(values).max(initial=0.0) > 1e15:
        raise InputError(f"{where}: a number is not finite.")
    return values


def _bytes(path: Path) -> bytes:
    try:
        return regular(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
