"""COLMAP models with depth: poses of structure from motion, brought to metres and z up.

Beside the model (`sparse/0`, or the folder itself) lie `images/` and depth: `depth/` with a PNG of
16 bits [mm] an image, or COLMAP's own `stereo/depth_maps/*.geometric.bin`. Model units become
metres by the median ratio of measured depth to that of the sparse points; COLMAP's own depth has
the model's unit, whose metres must be given. Up is found from cameras and level surfaces.

A model is `cameras`, `images` and `points3D`, all `.bin` or all `.txt`. Poses are
camera_from_model, quaternions w first; cameras have OpenCV's axes, and pixel centres lie at +0.5.
"""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.frame import (
    Capture,
    DepthUnit,
    LazyImages,
    check_shape,
    colour_file,
    depth_file,
)
from placegraph.io.capture.images import image_size, natural_key
from placegraph.io.capture.posed import (
    StoredFrame,
    make_camera,
    make_capture,
    pose_from_quaternion,
    read_text,
    resize_camera,
)
from placegraph.io.capture.up import estimated_up, surface_normals, upright
from placegraph.io.mesh.model import read_bytes

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

    name: str  # Path below the folder of images
    camera_from_model: NDArray[np.float64]  # (4, 4), lengths in the model's unit
    camera: int  # Number of its camera
    uv: NDArray[np.float64]  # (n, 2) where it sees points [px]
    points: NDArray[np.uint64]  # (n,) ids of those points


@dataclass(frozen=True, slots=True, eq=False)
class ColmapModel:
    """Content of a model's three files."""

    cameras: dict[int, Camera]
    pictures: tuple[Picture, ...]
    points: dict[int, NDArray[np.float64]]  # (3,) in the model's unit, by id


def model_folder(path: Path) -> Path | None:
    """Return the folder of the model: `sparse/0`, `sparse` or the path itself; None: there is none."""
    for folder in (path / "sparse" / "0", path / "sparse", path):
        if _find_ending(folder):
            return folder
    return None


def read_model(folder: Path) -> ColmapModel:
    """Read a model; `InputError` where a file is missing, truncated, or a camera is no pinhole's."""
    if _find_ending(folder) == ".bin":
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
                f"{folder}: image {picture.name!r} refers to the missing camera "
                f"{picture.camera}; copy the model again."
            )
    return ColmapModel(cameras, pictures, points)


def read_depth_map(path: Path) -> NDArray[np.float32]:
    """Return the depth (h, w) float32 in the model's unit, NaN: none, of `stereo/depth_maps/*.bin`."""
    data = read_bytes(path)
    head = re.match(rb"([0-9]{1,9})&([0-9]{1,9})&([0-9]{1,9})&", data)
    if not head:
        raise InputError(f"{path} does not begin with `width&height&channels&`.")
    width, height, channels = (int(part) for part in head.groups())
    body = data[head.end() :]
    if channels != 1 or min(width, height) < 1 or len(body) != 4 * width * height:
        raise InputError(
            f"{path} declares {width} x {height} x {channels}, but contains {len(body)} bytes; it "
            "may be truncated: copy it again."
        )
    depth = np.frombuffer(body, "<f4").reshape(height, width).copy()
    depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
    return depth


def _find_ending(folder: Path) -> str | None:
    """Return the ending of a model's files; None: it is none."""
    for ending in (".bin", ".txt"):
        if all((folder / f"{name}{ending}").is_file() for name in ("cameras", "images")):
            return ending
    return None


def model_camera(where: str, model: str, size: tuple[int, int], values: list[float]) -> Camera:
    """Return the camera of a COLMAP model's name and parameters; `InputError` where it is no pinhole."""
    if len(values) != _PARAMETERS.get(model, -1):
        raise InputError(
            f"{where}: the camera model {model!r} does not have {len(values)} parameters; copy the "
            "model again."
        )
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
            f"{where}: the camera model {model} is not supported; run `colmap image_undistorter`, "
            "and give its folder."
        )
    kind = "fisheye" if model in {*_RADIAL_FISHEYE, "OPENCV_FISHEYE"} else "opencv"
    return make_camera(where, size, values[:4], distortion, kind)


class _Reader:
    """Walks through the bytes of a file; `InputError` where they end too early."""

    def __init__(self, path: Path) -> None:
        self.path, self.data, self.at = path, read_bytes(path), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """Return the numbers of a `struct` layout, little-endian."""
        size = struct.calcsize("<" + layout)
        self.skip(size)
        return struct.unpack_from("<" + layout, self.data, self.at - size)

    def skip(self, size: int) -> None:
        """Pass over bytes."""
        if size > len(self.data) - self.at:
            raise InputError(f"{self.path} ends too early; it is truncated: copy it again.")
        self.at += size

    def text(self) -> str:
        """Return the text that ends with a zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise InputError(f"{self.path} ends too early; it is truncated: copy it again.")
        text = self.data[self.at : end].decode(errors="replace")
        self.at = end + 1
        return text

    def rows(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return the rows of a table."""
        self.skip(count * dtype.itemsize)
        return np.frombuffer(self.data, dtype, count, self.at - count * dtype.itemsize)


def _binary_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        number, model, width, height = reader.take("IiQQ")
        if not 0 <= model < len(_MODELS):
            raise InputError(
                f"{path}: camera {number} has an unknown model, {model}; undistort the images with "
                "`colmap image_undistorter`."
            )
        name, count = _MODELS[model]
        values = list(reader.take(f"{count}d"))
        yield number, model_camera(f"{path}, camera {number}", name, (width, height), values)


def _binary_pictures(path: Path) -> Iterator[Picture]:
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        _, *pose, camera = reader.take("I7dI")
        name = reader.text()
        seen = reader.rows(reader.take("Q")[0], _PIXEL)
        yield _make_picture(f"{path}, {name!r}", name, pose, camera, seen["uv"], seen["point"])


def _binary_points(path: Path) -> Iterator[tuple[int, NDArray[np.float64]]]:
    if not path.is_file():
        return  # a model may have none
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        number, x, y, z, *_, track = reader.take("Q3d3BdQ")
        reader.skip(track * _TRACK)
        yield number, np.array([x, y, z])


def _text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    for where, words in _read_lines(path):
        if len(words) < 4:
            raise InputError(f"{where}: a row must be `CAMERA_ID MODEL WIDTH HEIGHT PARAMS`.")
        number, width, height = (int(v) for v in _parse_numbers(where, [words[0], *words[2:4]]))
        values = _parse_numbers(where, words[4:]).tolist()
        yield number, model_camera(where, words[1], (width, height), values)


def _text_pictures(path: Path) -> Iterator[Picture]:
    rows = _read_lines(path, blank=True)
    for where, words in rows:
        if not words:
            continue
        if len(words) < 10:
            raise InputError(
                f"{where}: a row must be `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`."
            )
        values = _parse_numbers(where, words[:9])
        _, seen = next(rows, (where, []))
        if len(seen) % 3:
            raise InputError(f"{where}: the next row must be `X Y POINT3D_ID ...`.")
        table = _parse_numbers(where, seen).reshape(-1, 3)
        points = np.where(table[:, 2] < 0, 0, table[:, 2]).astype(np.uint64)
        points[table[:, 2] < 0] = _NO_POINT
        name = " ".join(words[9:])
        yield _make_picture(where, name, values[1:8].tolist(), int(values[8]), table[:, :2], points)


def _text_points(path: Path) -> Iterator[tuple[int, NDArray[np.float64]]]:
    if not path.is_file():
        return
    for where, words in _read_lines(path):
        if len(words) < 8:
            raise InputError(f"{where}: a row must be `POINT3D_ID X Y Z R G B ERROR TRACK`.")
        values = _parse_numbers(where, words[:4])
        yield int(values[0]), values[1:]


def _make_picture(
    where: str,
    name: str,
    pose: list[float],
    camera: int,
    uv: NDArray[np.float64],
    points: NDArray[np.uint64],
) -> Picture:
    w, x, y, z, *position = pose
    known = points != _NO_POINT
    return Picture(
        name, pose_from_quaternion(position, (x, y, z, w), where), camera, uv[known], points[known]
    )


def _read_lines(path: Path, *, blank: bool = False) -> Iterator[tuple[str, list[str]]]:
    """Yield the words of every line that is no comment, and where it stands."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        if not line.startswith("#") and (words or blank):
            yield f"{path}, line {number}", words


def _parse_numbers(where: str, words: list[str]) -> NDArray[np.float64]:
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"{where}: {error}.") from error
    if not np.isfinite(values).all() or np.abs(values).max(initial=0.0) > 1e15:
        raise InputError(f"{where}: a number is not finite; copy the model again.")
    return values


_UNIT = 1000.0
_MIN_READINGS = 30  # readings at sparse points that a scale needs
_MAX_IMAGES = 40  # images whose depth is compared with sparse points


class _View(NamedTuple):
    """An image of the model whose files are there."""

    picture: Picture
    colour: Path
    depth: Path
    camera: Camera
    depth_camera: Camera


def is_colmap(path: Path) -> bool:
    """Return whether a folder has a model in `sparse/0`, in `sparse` or in itself."""
    return model_folder(path) is not None


def read_colmap(path: Path, *, scale: float | None = None, up: ArrayLike | None = None) -> Capture:
    """Read a model and its depth; `notes` of the capture say which scale and direction were found.

    `path`: folder with the model, `images/` and depth; `scale`: metres in a unit of the model; estimated
    if not given; `up`: (3,) direction of up in the model; estimated if not given.

    Raises `InputError`: there is no depth, or too little at sparse points; a file is missing, truncated
    or broken; a camera's model is none that `Camera` can express; `OptionError`: `scale` is not greater
    than 0, or `up` no direction.
    """
    if scale is not None and not (np.isfinite(scale) and scale > 0):
        raise OptionError(f"scale is {scale}; it must be greater than 0.")
    folder = model_folder(path) or path
    model = read_model(folder)
    left_out: Counter[str] = Counter()
    views = _views(path, model, left_out)
    own = views[0].depth.suffix == ".bin"
    metres, scale_note = _scale(model, views, scale, own=own)
    map_from_model, direction = _upright(views, up, own=own)
    map_from_model[:3, :3] *= metres
    unit = DepthUnit(str(views[0].depth.parent), 1.0 / metres if own else _UNIT)
    frames = []
    for i, view in enumerate(views):
        pose = map_from_model @ np.linalg.inv(view.picture.camera_from_model)
        pose[:3, :3] /= metres
        depth = partial(_read_own_depth, view.depth, view.depth_camera, metres) if own else None
        images = LazyImages(
            colour_file(view.colour, view.camera),
            depth or depth_file(view.depth, view.depth_camera, _UNIT),
            unit=unit,
        )
        name = f"{folder / 'images'}, {view.picture.name!r}"
        frames.append(StoredFrame(name, float(i), pose, view.camera, images, view.depth_camera))
    return make_capture(path, frames, left_out=left_out, notes=(scale_note, direction))


def _views(path: Path, model: ColmapModel, left_out: Counter[str]) -> list[_View]:
    """Return the images with colour and depth, in natural order of their names."""
    own = path / "stereo" / "depth_maps"
    if not (path / "depth").is_dir() and not own.is_dir():
        raise InputError(
            f"{path} has no depth, which a map needs: add depth/ (16-bit PNG [mm], named like the "
            "images) or stereo/depth_maps/ (from COLMAP's patch_match_stereo)."
        )
    sizes: dict[int, tuple[int, int]] = {}
    views = []
    for picture in sorted(model.pictures, key=lambda p: natural_key(p.name)):
        name = PurePosixPath(picture.name)
        if name.is_absolute() or ".." in name.parts:
            raise InputError(
                f"{path}: the image name {picture.name!r} lies outside the folder; rename the "
                "image."
            )
        colour = next((p for p in (path / "images" / name, path / name) if p.is_file()), None)
        below = path / "depth" / name.parent
        files = (below / f"{name.stem}.png", below / f"{name.name}.png",
                 own / f"{picture.name}.geometric.bin")  # fmt: skip
        depth = next((p for p in files if p.is_file()), None)
        if colour is None or depth is None:
            left_out[f"no {'colour image' if colour is None else 'depth'}"] += 1
            continue
        if picture.camera not in sizes:
            sizes[picture.camera] = _depth_size(depth)
        camera = model.cameras[picture.camera]
        depth_camera = resize_camera(camera, sizes[picture.camera], depth)
        views.append(_View(picture, colour, depth, camera, depth_camera))
    if len({view.depth.suffix for view in views}) > 1:
        raise InputError(f"{path} has two kinds of depth, depth/ and stereo/; remove one of them.")
    if not views:
        raise InputError(
            f"{path} has no image with both colour and depth; name the files in images/ and depth/ "
            f"like the {len(model.pictures)} images of the model."
        )
    return views


def _depth_size(path: Path) -> tuple[int, int]:
    if path.suffix == ".png":
        return image_size(path)
    height, width = read_depth_map(path).shape
    return width, height


def _read_own_depth(path: Path, camera: Camera, metres: float) -> NDArray[np.float32]:
    """Return the depth (h, w) [m] of COLMAP's own, whose unit is the model's."""
    depth = read_depth_map(path)
    check_shape(depth, camera, path)
    return np.asarray(depth * np.float32(metres))


def _scale(
    model: ColmapModel, views: list[_View], given: float | None, *, own: bool
) -> tuple[float, str]:
    """Return the metres in a unit of the model, and a sentence that says whence."""
    if given is not None:
        return given, f"The unit of the COLMAP model is {given:g} m, as given."
    if own:
        return 1.0, (
            "The unit of the COLMAP model is assumed to be the metre, because its own depth "
            "has no scale; give scale if it differs."
        )
    step = max(1, len(views) // _MAX_IMAGES)
    ratios = np.concatenate([_depth_ratios(model, view) for view in views[::step]])
    if len(ratios) < _MIN_READINGS:
        raise InputError(
            f"{views[0].depth.parent} has depth at only {len(ratios)} sparse points of the "
            f"model, too few to estimate the scale ({_MIN_READINGS} are needed); give the "
            "metres per unit as scale."
        )
    metres = float(np.median(ratios))
    spread = float(np.median(np.abs(ratios / metres - 1.0)))
    return metres, (
        f"The unit of the COLMAP model is {metres:.4g} m, estimated from depth at "
        f"{len(ratios)} sparse points (median deviation {100 * spread:.1f} %)."
    )


def _depth_ratios(model: ColmapModel, view: _View) -> NDArray[np.float64]:
    """Return the measured depth over that of sparse points (n,) [m a unit of the model] in an image."""
    seen = [(uv, model.points[int(i)]) for uv, i in
            zip(view.picture.uv, view.picture.points, strict=True) if int(i) in model.points]  # fmt: skip
    if not seen:
        return np.zeros(0)
    uv, points = (np.array(column, np.float64) for column in zip(*seen, strict=True))
    pose = view.picture.camera_from_model
    z = points @ pose[2, :3] + pose[2, 3]
    depth = depth_file(view.depth, view.depth_camera, _UNIT)()
    h, w = depth.shape
    with np.errstate(invalid="ignore"):
        column, row = np.floor(uv * (w / view.camera.width, h / view.camera.height)).T
    inside = (z > 0) & (column >= 0) & (column < w) & (row >= 0) & (row < h)
    measured = depth[row[inside].astype(int), column[inside].astype(int)]
    ratios: NDArray[np.float64] = measured.astype(np.float64) / z[inside]
    return ratios[np.isfinite(ratios)]


def _upright(
    views: list[_View], given: ArrayLike | None, *, own: bool
) -> tuple[NDArray[np.float64], str]:
    """Return the rotation (4, 4), map_from_model, that stands the model upright, and a sentence on it."""
    turns = np.stack([v.picture.camera_from_model[:3, :3].T for v in views])
    if given is None:
        step = max(1, len(views) // _MAX_IMAGES)
        read = read_depth_map if own else None
        normals = [
            surface_normals(
                read(v.depth) if read else depth_file(v.depth, v.depth_camera, _UNIT)(),
                v.depth_camera,
            )
            @ turn.T
            for v, turn in zip(views[::step], turns[::step], strict=True)
        ]
        up, how = estimated_up(turns, np.concatenate(normals))
    else:
        up, how = np.asarray(given, np.float64), "was given"
    if up.shape != (3,) or not (np.isfinite(up).all() and np.linalg.norm(up) > 0):
        raise OptionError(f"up is {given!r}; give a direction in the model as three numbers.")
    z = up / np.linalg.norm(up)
    turn = np.eye(4)
    turn[:3, :3] = upright(z, turns[0][:, 2])
    return turn, f"Up is ({z[0]:.3f}, {z[1]:.3f}, {z[2]:.3f}) in the COLMAP model, as {how}."
