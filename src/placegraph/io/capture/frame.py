"""Frames of captures, in memory or read from files on demand, and captures as sequences of frames.

A reader makes `LazyImages` from functions without arguments: `colour_file` and `depth_file` for image
files, its own for videos and containers. `posed_frame` takes them with the camera and the pose *of the
image as stored*:

    images = LazyImages(
        colour_file(folder / "7.jpg", camera),
        depth_file(folder / "7.png", depth_camera, 1000.0),
        unit=DepthUnit(folder, 1000.0),
    )
    posed_frame(i, stamp, pose, camera, images, depth_camera=depth_camera, turns=turns)

`turns` rotates images, intrinsics and pose upright by quarter turns; `upright_turns` counts them.
"""

from __future__ import annotations

import itertools
import operator
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Camera
from placegraph.core.pickling import HtmlRepr, PickleFields
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.images import INTEGER_MODES, read_integers, read_rgb

LabelKind = Literal["labels", "instances"]
"""Meaning of the values of label images: ids of labels, or ids of objects of the map."""


class Images(Protocol):
    """Source of a frame's images."""

    def rgb(self) -> NDArray[np.uint8]:
        """Return (H, W, 3) uint8, sRGB."""

    def depth(self) -> NDArray[np.float32] | None:
        """Return (h, w) float32 [m], NaN: no reading."""

    def labels(self) -> NDArray[np.int32] | None:
        """Return (h, w) int32, -1: nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame(PickleFields):
    """One moment of a capture. Images are read and checked at each call."""

    index: int
    """Row in the capture's folder."""
    stamp: float
    """Seconds, or frame number."""
    odometry: NDArray[np.float64]
    """(4, 4) odometry_from_camera [m]"""
    gravity: NDArray[np.float64]
    """(3,) unit direction of gravity in the camera's axes."""
    camera: Camera
    """Intrinsics of the colour image."""
    depth_camera: Camera | None
    """Intrinsics of the depth image; None without depth."""
    label_camera: Camera | None
    """Intrinsics of the label image; None without labels."""
    label_kind: LabelKind | None
    label_names: dict[int, str]
    """Names of label ids; may be empty for instances."""
    images: Images = field(repr=False)
    has_colour: bool = True
    """Whether there is a colour image; without one `rgb` is black, and only depth is compared."""

    def rgb(self) -> NDArray[np.uint8]:
        """Return colours (H, W, 3) uint8, sRGB; `InputError` where the file is broken or of another size."""
        return self.images.rgb()

    def depth(self) -> NDArray[np.float32] | None:
        """Return the depth along the optical axis (h, w) float32 [m], NaN: no reading; None: no such image.

        Raises `InputError` as `rgb` does, and where pixels are not 16 bits.
        """
        return self.images.depth()

    def labels(self) -> NDArray[np.int32] | None:
        """Return the ids of labels or of objects (h, w) int32, -1: nothing; None: no such image.

        Raises `InputError` as `rgb` does, and where label ids have no name.
        """
        return self.images.labels()

    @classmethod
    def from_arrays(
        cls,
        rgb: ArrayLike | None,
        camera: Camera,
        *,
        depth: ArrayLike | None = None,
        depth_camera: Camera | None = None,
        labels: ArrayLike | None = None,
        label_camera: Camera | None = None,
        label_kind: LabelKind = "labels",
        label_names: Mapping[int, str] | None = None,
        odometry: ArrayLike | None = None,
        gravity: ArrayLike | None = None,
        stamp: float = 0.0,
        index: int = 0,
    ) -> Frame:
        """Return a frame of arrays in memory, which are not copied: do not change them.

        Parameters
        ----------
        rgb
            (H, W, 3) uint8, sRGB; None: a frame of depth alone.
        depth
            (h, w) along the optical axis [m]; 0, negative or not finite: no reading.
        depth_camera
            Intrinsics of `depth`; those of `camera`, resized, if not given.
        labels
            (h, w) integers: ids of labels or of objects; negative: none.
        label_camera
            Intrinsics of `labels`; those of `camera`, resized, if not given.
        label_kind
            Whether `labels` are ids of labels or of objects ("instances").
        label_names
            Names of the label ids.
        odometry
            (4, 4) odometry_from_camera [m]; the identity if not given.
        gravity
            (3,) direction of gravity in the camera's axes; -z of the odometry's frame if not given.
        stamp
            Seconds, or frame number.

        Raises
        ------
        OptionError
            An array has the wrong shape or type, or does not fit its camera.

        """
        black = NoColour((camera.width, camera.height))
        colours = black() if rgb is None else np.asarray(rgb)
        if colours.dtype != np.uint8:
            raise OptionError(f"rgb: {colours.dtype}; colours must be uint8, 0 to 255.")
        if label_kind not in {"labels", "instances"}:
            raise OptionError(f"label_kind is {label_kind!r}; it must be 'labels' or 'instances'.")
        _check_size("rgb", colours, camera, (3,))
        metres = None if depth is None else _to_metres(depth)
        ids = None if labels is None else _to_ids(labels)
        if metres is not None:
            depth_camera = depth_camera or _resized("depth", metres, camera)
            _check_size("depth", metres, depth_camera, ())
        if ids is not None:
            label_camera = label_camera or _resized("labels", ids, camera)
            _check_size("labels", ids, label_camera, ())
        pose = np.eye(4) if odometry is None else _floats("odometry", odometry, (4, 4))
        down = -pose[2, :3] if gravity is None else _floats("gravity", gravity, (3,))
        length = float(np.linalg.norm(down))
        if not length > 0 or not np.isfinite(stamp):
            raise OptionError("gravity has no direction, or the stamp is not a number.")
        return cls(
            index=index,
            stamp=float(stamp),
            odometry=_freeze(pose),
            gravity=_freeze(down / length),
            camera=camera,
            depth_camera=depth_camera,
            label_camera=label_camera,
            label_kind=None if label_camera is None else label_kind,
            label_names=dict(label_names or {}),
            images=ArrayImages(
                _freeze(colours),
                None if metres is None else _freeze(metres),
                None if ids is None else _freeze(ids),
            ),
            has_colour=rgb is not None,
        )


@dataclass(frozen=True, slots=True, eq=False)
class ArrayImages:
    """Images in memory."""

    colours: NDArray[np.uint8]
    metres: NDArray[np.float32] | None
    ids: NDArray[np.int32] | None

    def rgb(self) -> NDArray[np.uint8]:
        """Return (H, W, 3) uint8, sRGB."""
        return self.colours

    def depth(self) -> NDArray[np.float32] | None:
        """Return (h, w) float32 [m], NaN: no reading."""
        return self.metres

    def labels(self) -> NDArray[np.int32] | None:
        """Return (h, w) int32, -1: none."""
        return self.ids


def _check_size(what: str, array: NDArray[Any], camera: Camera, channels: tuple[int, ...]) -> None:
    wanted = (camera.height, camera.width, *channels)
    if array.shape != wanted:
        raise OptionError(f"{what}: shape is {array.shape}, but its camera's images have {wanted}.")


def _resized(what: str, array: NDArray[Any], camera: Camera) -> Camera:
    """Return the camera of the same view in another size."""
    if array.ndim != 2 or not array.size:
        raise OptionError(
            f"{what}: shape is {array.shape}; an image must have a height and a width."
        )
    height, width = array.shape
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        raise OptionError(
            f"{what}: {width} x {height} is not a scaled version of {camera.width} x "
            f"{camera.height}; give its own camera."
        )
    return camera if array.shape == (camera.height, camera.width) else camera.resize(width, height)


def _to_metres(depth: ArrayLike) -> NDArray[np.float32]:
    try:
        metres = np.array(depth, np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise OptionError(f"depth: it is not a numeric array of metres ({error}).") from error
    metres[~(np.isfinite(metres) & (metres > 0))] = np.nan
    return metres


def _to_ids(labels: ArrayLike) -> NDArray[np.int32]:
    ids = np.asarray(labels)
    if ids.dtype.kind not in "iu":
        raise OptionError(f"labels: {ids.dtype}; ids must be integers.")
    return np.maximum(ids, -1).astype(np.int32) if ids.dtype.kind == "i" else ids.astype(np.int32)


def _floats(what: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.asarray(values, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise OptionError(f"{what}: shape is {array.shape}, expected {shape} finite numbers.")
    return array


def _freeze(array: NDArray[Any]) -> NDArray[Any]:
    """Return a read-only view; the caller's array stays writeable."""
    view = array.view()
    view.flags.writeable = False
    return view


DEPTH_MODES = ("I;16", "I;16B", "I;16L", "I")
"""Pillow's modes of a depth image."""

_UNNAMED = -2


class DepthUnit(NamedTuple):
    """Unit of depth images, for messages about implausible depth."""

    source: str
    """Place where the unit is set, in words: "`depth.scale` in walk/camera.json"."""
    per_metre: float
    """Units in a metre."""


@dataclass(frozen=True, slots=True, eq=False)
class LazyImages:
    """Images of one frame, read by functions and turned upright at each call.

    The functions return the images as stored, in the size of their cameras, and raise `InputError`
    where that fails (`check_shape` checks the size).
    """

    colours: Callable[[], NDArray[np.uint8]]
    """() -> (H, W, 3) uint8, sRGB."""
    metres: Callable[[], NDArray[np.float32]] | None = None
    """() -> (h, w) float32 along the optical axis [m], NaN: no reading; None: no such image."""
    ids: Callable[[], NDArray[np.int32]] | None = None
    """() -> (h, w) int32, -1: nothing; None: no such image."""
    unit: DepthUnit | None = None
    turns: int = 0
    """Counter-clockwise quarter turns from the stored images to upright ones."""

    def rgb(self) -> NDArray[np.uint8]:
        """Return (H, W, 3) uint8, sRGB."""
        return self._rotate(self.colours())

    def depth(self) -> NDArray[np.float32] | None:
        """Return (h, w) float32 [m], NaN: no reading."""
        return None if self.metres is None else self._rotate(self.metres())

    def labels(self) -> NDArray[np.int32] | None:
        """Return (h, w) int32, -1: none."""
        return None if self.ids is None else self._rotate(self.ids())

    def _rotate(self, image: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(np.rot90(image, self.turns)) if self.turns % 4 else image


def posed_frame(
    index: int,
    stamp: float,
    odometry: ArrayLike,
    camera: Camera,
    images: LazyImages,
    *,
    depth_camera: Camera | None = None,
    label_camera: Camera | None = None,
    label_kind: LabelKind = "labels",
    label_names: Mapping[int, str] | None = None,
    turns: int = 0,
) -> Frame:
    """Return the frame of images, cameras and pose as stored, rotated by quarter turns.

    Parameters
    ----------
    index, stamp
        Number of the frame; seconds, or its number.
    odometry
        (4, 4) odometry_from_camera [m] of the stored image, odometry z up; gravity is its -z.
    camera, depth_camera, label_camera
        Intrinsics of the stored images; None where there is no depth, no label.
    images
        Stored images.
    label_kind, label_names
        Meaning of the labels; see `Frame`.
    turns
        Counter-clockwise quarter turns from the stored images to the frame.

    """
    stored = np.array(odometry, np.float64)
    down = -stored[2, :3]
    turned_from_stored = quarter_turn(turns)
    pose = stored.copy()
    pose[:3, :3] = stored[:3, :3] @ turned_from_stored.T
    down = turned_from_stored @ down / np.linalg.norm(down)
    pose.flags.writeable = down.flags.writeable = False
    return Frame(
        index=index,
        stamp=float(stamp),
        odometry=pose,
        gravity=down,
        camera=rotate_camera(camera, turns),
        depth_camera=None if depth_camera is None else rotate_camera(depth_camera, turns),
        label_camera=None if label_camera is None else rotate_camera(label_camera, turns),
        label_kind=None if label_camera is None else label_kind,
        label_names=dict(label_names or {}),
        images=replace(images, turns=turns) if turns else images,
        has_colour=not isinstance(images.colours, NoColour),
    )


def upright_turns(gravity: ArrayLike) -> int:
    """Return the counter-clockwise quarter turns (0 to 3) that turn most images of a capture upright.

    `gravity`: (..., 3), direction of gravity in the axes of the stored cameras.
    """
    x, y, _ = np.asarray(gravity, np.float64).reshape(-1, 3).sum(axis=0)
    return int(np.argmax([y, -x, -y, x]))


def quarter_turn(turns: int) -> NDArray[np.float64]:
    """Return the rotation (3, 3), turned_from_stored, of a camera whose image `np.rot90` turns."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns % 4]
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def rotate_camera(camera: Camera, turns: int) -> Camera:
    """Return the intrinsics of a camera whose images `np.rot90` turns."""
    for _ in range(turns % 4):
        distortion = camera.distortion
        if camera.model == "opencv" and distortion:  # a fisheye's is rotationally symmetric
            k1, k2, p1, p2, *more = distortion
            distortion = (k1, k2, -p2, p1, *more)
        camera = replace(
            camera, width=camera.height, height=camera.width, fx=camera.fy, fy=camera.fx,
            cx=camera.cy, cy=camera.width - camera.cx, distortion=distortion,
        )  # fmt: skip
    return camera


@dataclass(frozen=True, slots=True)
class NoColour:
    """Reader of a frame that has no colour image, of this width and height [px]: black."""

    size: tuple[int, int]

    def __call__(self) -> NDArray[np.uint8]:
        """Return (H, W, 3)."""
        return np.zeros((*self.size[::-1], 3), np.uint8)


@dataclass(frozen=True, slots=True)
class ColourFile:
    """Reader of the colours of an image file of this width and height [px]."""

    path: Path
    size: tuple[int, int]

    def __call__(self) -> NDArray[np.uint8]:
        """Return (H, W, 3)."""
        return read_rgb(self.path, self.size)


def colour_file(path: Path, camera: Camera) -> ColourFile:
    """Return a reader of the colours of an image file, which must have the camera's size."""
    return ColourFile(path, (camera.width, camera.height))


def depth_file(
    path: Path, camera: Camera, per_metre: float, *, confidence: Path | None = None
) -> Callable[[], NDArray[np.float32]]:
    """Return a reader of the depth of a 16-bit PNG, 0: no reading, which must have the camera's size.

    Readings where the image `confidence`, of the same size, is 0 are dropped.
    """
    return partial(_read_depth, path, (camera.width, camera.height), per_metre, confidence)


def _read_depth(
    path: Path, size: tuple[int, int], per_metre: float, confidence: Path | None
) -> NDArray[np.float32]:
    units = read_integers(path, size, DEPTH_MODES)
    metres = (units / per_metre).astype(np.float32)
    metres[units <= 0] = np.nan
    if confidence is not None:
        metres[read_integers(confidence, size, INTEGER_MODES) == 0] = np.nan
    return metres


def label_file(
    path: Path, camera: Camera, offset: int = 0, table: LabelTable | None = None
) -> Callable[[], NDArray[np.int32]]:
    """Return a reader of ids of labels or objects, of 8 or 16 bits; ids below `offset` mean none.

    The reader subtracts `offset`. It raises `InputError` for an id without a name in `table`.
    """
    return partial(_read_labels, path, (camera.width, camera.height), offset, table)


def _read_labels(
    path: Path, size: tuple[int, int], offset: int, table: LabelTable | None
) -> NDArray[np.int32]:
    ids = np.maximum(read_integers(path, size, INTEGER_MODES) - offset, -1)
    return ids if table is None else table.map_ids(ids, path)


class LabelTable(NamedTuple):
    """Names of label ids."""

    names: Mapping[int, str | None]
    """Names by id; None or empty: pixels of that id have no label."""
    path: Path
    """File of the names."""
    offset: int
    """Number that was subtracted from the ids."""

    def map_ids(self, ids: NDArray[np.int32], image: Path) -> NDArray[np.int32]:
        """Return the ids (h, w) of an image, -1 without a label; `InputError` for unnamed ids."""
        table = np.full(1 << 16, _UNNAMED, np.int32)
        if not self.offset:
            table[0] = -1  # by custom 0 is "unlabelled", unless it has a name
        for number, name in self.names.items():
            table[number] = number if name else -1
        mapped: NDArray[np.int32] = np.where(ids < 0, -1, table[np.minimum(ids, len(table) - 1)])
        if mapped.min() == _UNNAMED:
            unnamed = np.unique(ids[mapped == _UNNAMED]).tolist()
            listed = ", ".join(map(str, unnamed[:8])) + (" ..." if len(unnamed) > 8 else "")
            raise InputError(
                f"{image} contains label ids without a name in {self.path}: {listed}; add "
                "their names (null for ids to ignore)."
            )
        return mapped


def check_shape(image: NDArray[Any], camera: Camera, name: object) -> None:
    """Raise `InputError` for an image (h, w, ...) of another size than its camera's."""
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"{name} has {image.shape[1]} x {image.shape[0]} pixels, but its camera has "
            f"{camera.width} x {camera.height}; give intrinsics for this image size."
        )


@dataclass(frozen=True, eq=False, repr=False)
class Capture(HtmlRepr):
    """Frames in order of time. `capture[i]` is a `Frame`, `capture[5:10]` a `Capture`.

    Made by `open_capture`, or from frames in memory by `Capture.from_frames`.
    """

    path: Path | None
    """Folder, or None for frames in memory."""
    frames: tuple[Frame, ...]
    camera: Camera
    """Intrinsics of the colour images; of the first, if the recorder refocuses between frames."""
    depth_camera: Camera | None
    """Intrinsics of the depth images; None without depth."""
    label_camera: Camera | None
    """Intrinsics of the label or instance images; None without labels."""
    label_kind: LabelKind | None
    label_names: dict[int, str]
    """Names of label ids, from `labels.json`."""
    notes: tuple[str, ...] = ()
    """Assumptions and estimates of the reader, in sentences: a scale, a direction."""
    left_out: Counter[str] = field(default_factory=Counter)
    """Numbers of recorded frames that the capture lacks, by reason."""

    @classmethod
    def from_frames(cls, frames: Iterable[Frame]) -> Capture:
        """Return the capture of frames in memory; `OptionError` without any, or if sizes differ."""
        frames = tuple(frames)
        if not frames:
            raise OptionError("frames: the list is empty; give at least one frame.")
        first = frames[0]
        views = {
            (_shape(f.camera), _shape(f.depth_camera), _shape(f.label_camera), f.label_kind)
            for f in frames
        }
        if len(views) > 1:
            raise OptionError("frames: their cameras differ; give frames with the same image size.")
        if any(b.stamp <= a.stamp for a, b in itertools.pairwise(frames)):
            raise OptionError(
                "frames: their stamps do not increase; sort them, and drop duplicates."
            )
        names = {i: name for f in frames for i, name in f.label_names.items()}
        return cls(
            None,
            frames,
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


def _shape(camera: Camera | None) -> tuple[int, int] | None:
    return None if camera is None else (camera.width, camera.height)


def _read_only(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.flags.writeable = False
    return array
