"""Captures: frames with camera, gravity and odometry, optionally depth and labels.

The folder's layout stands in `docs/formats.md`. `trajectory.tum`, the truth, is never read here:
nothing that localizes may see it.
"""

from __future__ import annotations

import itertools
import operator
import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, overload

import numpy as np

from placegraph.errors import InputError, OptionError
from placegraph.formats.camera import CameraFile, read_camera, read_json
from placegraph.formats.frame import ArrayImages, Frame, LabelKind
from placegraph.formats.frame_files import (
    DepthUnit,
    LazyImages,
    Meanings,
    colour_file,
    depth_file,
    label_file,
)
from placegraph.formats.images import ENDINGS, image_size
from placegraph.formats.tum import read_table, read_tum

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from os import PathLike

    from numpy.typing import NDArray

    from placegraph.geometry import Camera

__all__ = ["ArrayImages", "Capture", "Frame", "LabelKind", "open_capture"]

_GRAVITY_COLUMNS = ("stamp", "gx", "gy", "gz")
_GRAVITY_TOLERANCE = 0.02  # two decimals are a direction still; an accelerometer's 9.81 is not


@dataclass(frozen=True, eq=False, repr=False)
class Capture:
    """Frames in order of time. `capture[i]` is a `Frame`, `capture[5:10]` a `Capture`.

    Made by `open_capture`, or of frames in memory by `Capture.from_frames`.
    """

    path: Path | None
    """Folder, or None for frames in memory."""
    frames: tuple[Frame, ...]
    camera: Camera
    """Of the colour images."""
    depth_camera: Camera | None
    """Of the depth images; None where the capture has none."""
    label_camera: Camera | None
    """Of the label or instance images; None where the capture has none."""
    label_kind: LabelKind | None
    label_names: dict[int, str]
    """Names of label ids, from `labels.json`."""

    @classmethod
    def from_frames(cls, frames: Iterable[Frame]) -> Capture:
        """Capture of frames in memory; `OptionError` where they are none or not of one camera."""
        held = tuple(frames)
        if not held:
            raise OptionError("frames: there is none; a capture needs at least one frame.")
        first = held[0]
        cameras = {(f.camera, f.depth_camera, f.label_camera, f.label_kind) for f in held}
        if len(cameras) > 1:
            raise OptionError("frames: their cameras differ; a capture is of one camera.")
        if any(b.stamp <= a.stamp for a, b in itertools.pairwise(held)):
            raise OptionError("frames: their stamps do not ascend; sort them, drop repeated ones.")
        names = {i: name for f in held for i, name in f.label_names.items()}
        return cls(
            None,
            held,
            first.camera,
            first.depth_camera,
            first.label_camera,
            first.label_kind,
            names,
        )

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self.frames)

    @overload
    def __getitem__(self, which: int) -> Frame: ...
    @overload
    def __getitem__(self, which: slice) -> Capture: ...
    def __getitem__(self, which: int | slice) -> Frame | Capture:
        if isinstance(which, slice):
            return replace(self, frames=self.frames[which])
        return self.frames[operator.index(which)]

    @cached_property
    def stamps(self) -> NDArray[np.float64]:
        """(T,) seconds, or frame numbers; strictly ascending."""
        return _read_only(np.array([f.stamp for f in self.frames], np.float64))

    @cached_property
    def odometry(self) -> NDArray[np.float64]:
        """(T, 4, 4) odometry_from_camera [m], in the odometry's own frame, drifting."""
        poses = np.array([f.odometry for f in self.frames], np.float64)
        return _read_only(poses.reshape(-1, 4, 4))

    @cached_property
    def gravity(self) -> NDArray[np.float64]:
        """(T, 3) unit direction of gravity in the camera's axes."""
        return _read_only(np.array([f.gravity for f in self.frames], np.float64).reshape(-1, 3))

    def __repr__(self) -> str:
        with_ = [
            what
            for what, there in (("depth", self.depth_camera), (self.label_kind, self.label_camera))
            if there is not None
        ]
        where = repr(str(self.path)) if self.path else "in memory"
        size = f"{self.camera.width} x {self.camera.height}"
        return f"Capture({where}, {len(self)} frames of {size}{''.join(f', {w}' for w in with_)})"


def open_capture(
    path: str | PathLike[str], *, labels: Literal["auto", "labels", "instances"] | None = "auto"
) -> Capture:
    """Open a capture folder; images are read when they are asked for.

    Parameters
    ----------
    path
        Folder with `rgb/`, `camera.json`, `odometry.tum`, and optionally `depth/`, `instances/` or
        `labels/` with `labels.json`, and `gravity.txt`. Without the last, gravity is -z of the
        odometry's frame, which must then be gravity-aligned.
    labels
        Which folder of labels to use; "auto" takes `instances/`, else `labels/`, else none.

    Raises
    ------
    InputError
        A file is missing, unreadable, or not what it should be; rows and images differ in number.
    OptionError
        `labels` is none of its values.

    """
    path = Path(path)
    if labels not in {"auto", "labels", "instances", None}:
        raise OptionError(f"labels is {labels!r}; it is 'auto', 'labels', 'instances' or None.")
    if not path.is_dir():
        what = "is not a folder" if path.exists() else "does not exist"
        raise InputError(
            f"{path} {what}; a capture is a folder with rgb/, camera.json, odometry.tum."
        )
    cameras = read_camera(path / "camera.json")
    colours = _images(path / "rgb")
    if not colours:
        raise InputError(f"{path / 'rgb'} holds no image; a capture needs colour images there.")
    depths = _images(path / "depth")
    kind = _label_kind(path, labels)
    marks = _images(path / kind) if kind else {}
    for folder, found in (("depth", depths), (kind, marks)):
        extra = sorted(set(found) - set(colours))
        if extra:
            raise InputError(
                f"{found[extra[0]]} belongs to no image in rgb/; {folder} images bear the names of "
                "their colour images."
            )
    names = _label_names(path / "labels.json")
    label_camera = None
    if kind and marks:
        label_camera = cameras.label_camera(kind, image_size(next(iter(marks.values()))))
    frames = _frames(path, cameras, colours, depths, marks, kind, label_camera, names)
    shown = {i: name for i, name in names.items() if name}
    depth_camera = cameras.depth if depths else None
    return Capture(
        path, frames, cameras.camera, depth_camera, label_camera, kind if marks else None, shown
    )


def _frames(
    path: Path,
    cameras: CameraFile,
    colours: dict[str, Path],
    depths: dict[str, Path],
    marks: dict[str, Path],
    kind: LabelKind | None,
    label_camera: Camera | None,
    names: dict[int, str | None],
) -> tuple[Frame, ...]:
    """One frame an image, with row i of every text file."""
    odometry = read_tum(_needed(path / "odometry.tum", len(colours)))
    _count(path / "odometry.tum", len(odometry), len(colours))
    gravity = _gravity(path / "gravity.txt", odometry.poses)
    known = None
    if kind == "labels":
        known = Meanings.read(names, path / "labels.json", cameras.offsets[kind])
    shown = {i: name for i, name in names.items() if name}
    unit = DepthUnit(f"`depth.scale` in {cameras.path}", cameras.depth_scale)

    def images(stem: str, colour: Path) -> LazyImages:
        metres = ids = None
        if stem in depths:
            metres = depth_file(depths[stem], cameras.depth, cameras.depth_scale)
        if kind and label_camera and stem in marks:
            ids = label_file(marks[stem], label_camera, cameras.offsets[kind], known)
        return LazyImages(colour_file(colour, cameras.camera), metres, ids, unit)

    return tuple(
        Frame(
            index=i,
            stamp=float(odometry.stamps[i]),
            odometry=odometry.poses[i],
            gravity=gravity[i],
            camera=cameras.camera,
            depth_camera=cameras.depth if depths else None,
            label_camera=label_camera,
            label_kind=kind if marks else None,
            label_names=shown,
            images=images(stem, colour),
        )
        for i, (stem, colour) in enumerate(colours.items())
    )


def _images(folder: Path) -> dict[str, Path]:
    """Images of a folder by stem, in natural order: 2 comes before 10."""
    if not folder.exists():
        return {}
    try:
        files = [p for p in folder.iterdir() if p.suffix.lower() in ENDINGS and p.name[0] != "."]
    except OSError as error:
        raise InputError(f"{folder} cannot be read: {error.strerror}.") from error
    found: dict[str, Path] = {}
    for file in sorted(files, key=lambda p: (_natural(p.stem), p.name)):
        if file.stem in found:
            raise InputError(f"{file} and {found[file.stem].name} bear one name; keep one of them.")
        found[file.stem] = file
    return found


def _natural(stem: str) -> list[tuple[int, int, str]]:
    return [
        (0, int(part), part) if part.isascii() and part.isdigit() else (1, 0, part)
        for part in re.split(r"([0-9]{1,4000})", stem)
    ]


def _label_kind(path: Path, labels: str | None) -> LabelKind | None:
    there: list[LabelKind] = [k for k in ("instances", "labels") if (path / k).is_dir()]
    if labels == "auto":
        return there[0] if there else None
    for kind in ("instances", "labels"):
        if labels == kind and kind not in there:
            raise InputError(f"{path / kind} does not exist, but labels={kind!r} asks for it.")
        if labels == kind:
            return kind
    return None


def _label_names(path: Path) -> dict[int, str | None]:
    """Names by id; None where the file says null: such pixels say nothing."""
    if not path.exists():
        return {}
    content = read_json(path)
    if not isinstance(content, dict):
        raise InputError(f'{path} must be a JSON object from label ids to names: {{"3": "chair"}}.')
    names: dict[int, str | None] = {}
    for key, name in content.items():
        number = key.strip()
        if not (number.isascii() and number.isdigit() and len(number) < 6 and int(number) < 65536):
            raise InputError(f"{path}: {key[:40]!r} is no label id; ids are 0 to 65535.")
        if not (name is None or isinstance(name, str)):
            raise InputError(f"{path}: the name of label {key} is {str(name)[:40]!r}, not text.")
        names[int(number)] = name or None
    return names


def _gravity(path: Path, poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit gravity (T, 3) in the camera's axes, from the file or else from the odometry's -z."""
    if not path.exists():
        return _read_only(-poses[:, 2, :3])
    table = read_table(path, _GRAVITY_COLUMNS)
    _count(path, len(table.values), len(poses))
    vectors = table.values[:, 1:]
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(vectors, axis=1)
    wrong = np.flatnonzero(~(np.abs(lengths - 1.0) <= _GRAVITY_TOLERANCE))
    if wrong.size:
        row = int(wrong[0])
        raise table.error(
            row,
            f"gravity has length {lengths[row]:.6g}; give its direction (down, in the camera's axes) "
            "as a unit vector.",
        )
    return _read_only(vectors / lengths[:, None])


def _needed(path: Path, count: int) -> Path:
    if not path.exists():
        raise InputError(
            f"{path} does not exist; it holds one row `stamp tx ty tz qx qy qz qw` for each of the "
            f"{count} images (a single image: `0 0 0 0 0 0 0 1`, and gravity.txt)."
        )
    return path


def _count(path: Path, rows: int, images: int) -> None:
    if rows != images:
        raise InputError(
            f"{path} has {rows} rows, but rgb/ has {images} images; row i belongs to image i."
        )


def _read_only(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.flags.writeable = False
    return array
