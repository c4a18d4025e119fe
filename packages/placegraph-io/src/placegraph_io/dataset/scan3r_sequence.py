"""3RScan's recordings as captures: the folder `sequence/` of a scan, or its `sequence.zip`.

Colour and depth are of one viewpoint, and depth is stretched to its own size. Intrinsics put the
centre of the first pixel at (0, 0), we at (0.5, 0.5). The telephone was held upright and its images
are stored lying on their side.
"""

from __future__ import annotations

import io
import re
import zipfile
from collections import Counter
from dataclasses import dataclass
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from placegraph.core.files import check_regular
from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame import (
    Capture,
    DepthUnit,
    LazyImages,
    check_shape,
    posed_frame,
    upright_turns,
)
from placegraph.io.capture.images import open_image, to_rgb
from placegraph_io.dataset.scannet import camera_of_matrix, is_rigid
from placegraph_io.storage import Archive

INFO = "_info.txt"
_FRAME = re.compile(r"frame-(\d{1,9})\.(color\.jpg|depth\.pgm|pose\.txt)", re.ASCII)
_RIGID = 1e-2  # poses are written with few digits
_PGM = re.compile(rb"P5\s(?:#[^\n]*\n|\s)*(\d{1,9})\s+(\d{1,9})\s+(\d{1,9})\s")


def is_scan3r_sequence(path: Path) -> bool:
    """Return whether a path is a `sequence/`, a `sequence.zip`, or a folder with one of them."""
    try:
        if path.is_file():
            return path.name.lower() == "sequence.zip" and zipfile.is_zipfile(path)
        return (
            any((p / INFO).is_file() for p in (path, path / "sequence"))
            or (path / "sequence.zip").is_file()
        )
    except (OSError, ValueError):
        return False


def read_scan3r_sequence(path: str | PathLike[str], *, rotate: bool = True) -> Capture:
    """Open a scan's recording; images are read, in place, when they are asked for.

    Frames without an image or without a valid pose (3RScan writes infinite ones) are left out and
    counted. A frame's `index` and stamp are its number. Its odometry is 3RScan's own pose, in the
    axes of the scan's meshes: the truth, which an evaluation has to spoil before it localizes.

    `path`: folder of the scan, `sequence/` or `sequence.zip`; `rotate`: stand the images upright by
    quarter turns (one number for all of them, by gravity), and colour, depth, intrinsics and poses with
    them.

    Raises `InputError`: the recording or its `_info.txt` is missing or damaged, or no frame can be used.
    """
    files = _files(Path(path))
    info = _Info.read(files)
    left_out: Counter[str] = Counter()
    found = _find_frames(files, info, left_out)
    turns = upright_turns([-pose[2, :3] for *_, pose in found]) if rotate else 0
    deep = {digits for _, digits, _ in found if f"frame-{digits}.depth.pgm" in files.names}
    frames = tuple(
        posed_frame(
            number,
            float(number),
            pose,
            info.colour,
            info.images(files, digits, with_depth=digits in deep),
            depth_camera=info.depth if deep else None,
            turns=turns,
        )
        for number, digits, pose in found
    )
    first = frames[0]
    return Capture(
        path=Path(path),
        frames=frames,
        camera=first.camera,
        depth_camera=first.depth_camera,
        label_camera=None,
        label_kind=None,
        label_names={},
        left_out=left_out,
    )


def _find_frames(
    files: _Files, info: _Info, left_out: Counter[str]
) -> list[tuple[int, str, NDArray[np.float64]]]:
    """Return the number, digits and pose of the frames that have one; `InputError` where none has."""
    there = {int(m[1]): m[1] for name in files.names if (m := _FRAME.fullmatch(name))}
    numbers = sorted(there.items())
    found = []
    for number, digits in numbers:
        pose = _read_pose(files, digits, left_out)
        if pose is not None:
            found.append((number, digits, pose))
    announced = info.frames - len(numbers)
    if announced > 0:
        left_out["frames that are listed, but missing"] += announced
    if not found:
        why = "; ".join(f"{reason}: {count}" for reason, count in left_out.items())
        raise InputError(f"{files.where('')} has no frame to use ({why or 'it is empty'}).")
    return found


@dataclass(frozen=True, slots=True)
class _Info:
    """Cameras, depth unit and number of frames, of `_info.txt`."""

    colour: Camera
    depth: Camera
    unit: DepthUnit
    frames: int

    @classmethod
    def read(cls, files: _Files) -> _Info:
        where = files.where(INFO)
        text = files.read(INFO).decode("latin-1")
        fields = {
            k.strip(): v.strip()
            for k, sign, v in (s.partition("=") for s in text.splitlines())
            if sign
        }

        def numbers(key: str, count: int, default: str = "") -> list[float]:
            words = fields.get(key, default).split()
            try:
                values = [float(word) for word in words]
            except ValueError:
                values = []
            if len(values) != count or not np.isfinite(values).all() or np.abs(values).max() > 1e9:
                raise InputError(
                    f"{where}: {key} is {fields.get(key, 'missing')[:60]!r}; it must be {count} finite "
                    "number(s). Download the sequence again."
                )
            return values

        def camera(kind: str) -> Camera:
            size = tuple(int(numbers(f"m_{kind}{side}", 1)[0]) for side in ("Width", "Height"))
            matrix = np.array(numbers(f"m_calibration{kind.title()}Intrinsic", 16)).reshape(4, 4)
            return camera_of_matrix(where, matrix, (size[0], size[1]))

        unit = numbers("m_depthShift", 1, "1000")[0]
        if not unit >= 1:
            raise InputError(
                f"{where}: m_depthShift is {unit:g}; it must be the depth units per metre, such as "
                "1000."
            )
        return cls(
            camera("color"),
            camera("depth"),
            DepthUnit(f"`m_depthShift` in {where}", unit),
            int(numbers("m_frames.size", 1, "0")[0]),
        )

    def images(self, files: _Files, digits: str, *, with_depth: bool) -> LazyImages:
        return LazyImages(
            partial(_read_colour, files, f"frame-{digits}.color.jpg", self.colour),
            partial(
                _read_depth, files, f"frame-{digits}.depth.pgm", self.depth, self.unit.per_metre
            )
            if with_depth
            else None,
            unit=self.unit,
        )


def _read_pose(files: _Files, digits: str, left_out: Counter[str]) -> NDArray[np.float64] | None:
    """Return (4, 4) scan_from_camera [m] of a frame, or None, counted, where it cannot be used."""
    names = files.names
    if f"frame-{digits}.color.jpg" not in names:
        left_out["frames without a colour image"] += 1
        return None
    if f"frame-{digits}.pose.txt" not in names:
        left_out["frames without a pose"] += 1
        return None
    words = files.read(f"frame-{digits}.pose.txt").split()
    try:
        pose = np.array([float(word) for word in words]).reshape(4, 4)
    except ValueError:
        pose = np.full((4, 4), np.nan)
    if not is_rigid(pose, _RIGID):
        left_out["frames with an invalid pose"] += 1
        return None
    u, _, vt = np.linalg.svd(pose[:3, :3])
    pose[:3, :3], pose[3] = u @ vt, (0, 0, 0, 1)
    return pose


def _read_colour(files: _Files, name: str, camera: Camera) -> NDArray[np.uint8]:
    with open_image(io.BytesIO(files.read(name)), files.where(name)) as image:
        found = to_rgb(image)
    check_shape(found, camera, files.where(name))
    return found


def _read_depth(files: _Files, name: str, camera: Camera, per_metre: float) -> NDArray[np.float32]:
    units = read_pgm(files.read(name), files.where(name))
    check_shape(units, camera, files.where(name))
    metres = (units / per_metre).astype(np.float32)
    metres[units == 0] = np.nan
    return metres


def read_pgm(data: bytes, name: str) -> NDArray[np.uint16]:
    """Return the grey values (h, w) of a binary PGM of 8 or 16 bits, as they stand there.

    Pillow scales the values of those whose maximum is not the largest of their type: no depth.
    `InputError` about `name` where it is none, or truncated.
    """
    head = _PGM.match(data)
    if head is None:
        raise InputError(f"{name} is not a binary PGM (P5); copy it again.")
    width, height, most = (int(v) for v in head.groups())
    kind = np.dtype(">u2" if most > 255 else "u1")
    size = width * height * kind.itemsize
    if not size or most > 65535 or len(data) - head.end() < size:
        raise InputError(
            f"{name} has {len(data) - head.end()} of {size} bytes of {width} x {height} pixels: it is "
            "truncated; copy it again."
        )
    pixels = np.frombuffer(data, kind, width * height, head.end())
    return pixels.reshape(height, width).astype(np.uint16)


class _Files(Protocol):
    """Files of a recording, by their names."""

    @property
    def names(self) -> frozenset[str]: ...
    def read(self, name: str) -> bytes: ...
    def where(self, name: str) -> str: ...


def _files(path: Path) -> _Files:
    for folder in (path, path / "sequence"):
        if (folder / INFO).is_file():
            return _Folder.of(folder)
    for file in (path, path / "sequence.zip"):
        if file.is_file():
            return Archive(file, flat=True)
    raise InputError(
        f"{path} is not a recording of 3RScan; add sequence/ with {INFO}, or sequence.zip."
    )


@dataclass(frozen=True, slots=True)
class _Folder:
    folder: Path
    names: frozenset[str]

    @classmethod
    def of(cls, folder: Path) -> _Folder:
        try:
            return cls(folder, frozenset(p.name for p in folder.iterdir()))
        except OSError as error:
            raise InputError(f"{folder} cannot be read: {error.strerror}.") from error

    def where(self, name: str) -> str:
        return str(self.folder / name)

    def read(self, name: str) -> bytes:
        try:
            return check_regular(self.folder / name).read_bytes()
        except OSError as error:
            raise InputError(f"{self.where(name)} cannot be read: {error.strerror}.") from error
