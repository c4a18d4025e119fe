"""Frames of captures whose images are read when they are asked for, whoever recorded them.

A reader makes a `LazyImages` of functions without arguments, `colour_file` and `depth_file` where
images are files, its own where they come out of a video or a container, and gives it to
`posed_frame` with the camera and the pose *of the image as it is stored*:

    images = LazyImages(
        colour_file(folder / "7.jpg", camera),
        depth_file(folder / "7.png", depth_camera, 1000.0),
        unit=DepthUnit(folder, 1000.0),
    )
    posed_frame(i, stamp, pose, camera, images, depth_camera=depth_camera, turns=turns)

`turns` stands all of it upright, images, intrinsics and pose: `upright_turns` says how many.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame import Frame, LabelKind
from placegraph.io.capture.images import WHOLE_MODES, read_rgb, read_whole

DEPTH_MODES = ("I;16", "I;16B", "I;16L", "I")
"""Pillow's modes of a depth image."""

_UNNAMED = -2


class DepthUnit(NamedTuple):
    """Where the unit of depth images is said, for messages on depth that cannot be right."""

    said: str
    """As it stands in a sentence: "`depth.scale` in walk/camera.json"."""
    per_metre: float
    """Units in a metre."""


@dataclass(frozen=True, slots=True, eq=False)
class LazyImages:
    """Images of one frame behind functions: read, checked and turned each time they are asked for.

    The functions return the images as they are stored, of the size of their cameras as stored, and
    raise `InputError` where that fails (`check_shape` says so for arrays from elsewhere).
    """

    colours: Callable[[], NDArray[np.uint8]]
    """() -> (H, W, 3) uint8, sRGB."""
    metres: Callable[[], NDArray[np.float32]] | None = None
    """() -> (h, w) float32 along the optical axis [m], NaN: no reading; None: no such image."""
    ids: Callable[[], NDArray[np.int32]] | None = None
    """() -> (h, w) int32, -1: nothing; None: no such image."""
    unit: DepthUnit | None = None
    """Where the unit of depth is said."""
    turns: int = 0
    """Quarter turns, counter-clockwise, of the stored images."""

    def rgb(self) -> NDArray[np.uint8]:
        """As `Frame.rgb`."""
        return self._turned(self.colours())

    def depth(self) -> NDArray[np.float32] | None:
        """As `Frame.depth`."""
        return None if self.metres is None else self._turned(self.metres())

    def labels(self) -> NDArray[np.int32] | None:
        """As `Frame.labels`."""
        return None if self.ids is None else self._turned(self.ids())

    def _turned(self, image: NDArray[Any]) -> NDArray[Any]:
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
    gravity: ArrayLike | None = None,
    turns: int = 0,
) -> Frame:
    """Frame of images, cameras and pose as they are stored, turned by quarters.

    Parameters
    ----------
    index, stamp
        Number of the frame; seconds, or its number.
    odometry
        (4, 4) odometry_from_camera [m] of the stored image, odometry z up.
    camera, depth_camera, label_camera
        Of the stored images; None where there is no depth, no label.
    images
        Where the stored images come from.
    label_kind, label_names
        As of `Frame`.
    gravity
        (3,) in the stored camera's axes, of any length; -z of the odometry's frame if not given.
    turns
        Quarter turns, counter-clockwise, that the frame is of.

    """
    stored = np.array(odometry, np.float64)
    down = -stored[2, :3] if gravity is None else np.asarray(gravity, np.float64)
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
        camera=turned_camera(camera, turns),
        depth_camera=None if depth_camera is None else turned_camera(depth_camera, turns),
        label_camera=None if label_camera is None else turned_camera(label_camera, turns),
        label_kind=None if label_camera is None else label_kind,
        label_names=dict(label_names or {}),
        images=replace(images, turns=turns) if turns else images,
    )


# -------------------------------------------------------------------------------- quarter turns


def upright_turns(gravity: ArrayLike) -> int:
    """Quarter turns (0 to 3, counter-clockwise) that stand most images of a capture upright.

    `gravity`: (..., 3), direction of gravity in the cameras' axes as they are stored. One number
    for a whole capture keeps its images of one size.
    """
    x, y, _ = np.asarray(gravity, np.float64).reshape(-1, 3).sum(axis=0)
    return int(np.argmax([y, -x, -y, x]))


def quarter_turn(turns: int) -> NDArray[np.float64]:
    """Rotation (3, 3), turned_from_stored, of a camera whose image `np.rot90` turns."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[turns % 4]
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def turned_camera(camera: Camera, turns: int) -> Camera:
    """Intrinsics of a camera whose images are turned as `np.rot90` does."""
    for _ in range(turns % 4):
        bent = camera.distortion
        if camera.model == "opencv" and bent:  # a fisheye's is the same all around
            k1, k2, p1, p2, *more = bent
            bent = (k1, k2, -p2, p1, *more)
        camera = Camera(
            width=camera.height,
            height=camera.width,
            fx=camera.fy,
            fy=camera.fx,
            cx=camera.cy,
            cy=camera.width - camera.cx,
            distortion=bent,
            model=camera.model,
        )
    return camera


# ---------------------------------------------------------------------------------------- files


@dataclass(frozen=True, slots=True)
class ColourFile:
    """Reads the colours of an image file, which must have this width and height [px]."""

    path: Path
    size: tuple[int, int]

    def __call__(self) -> NDArray[np.uint8]:
        """(H, W, 3)."""
        return read_rgb(self.path, self.size)


def colour_file(path: Path, camera: Camera) -> ColourFile:
    """Reads the colours of an image file, which must have the camera's size."""
    return ColourFile(path, _size(camera))


def depth_file(
    path: Path, camera: Camera, per_metre: float, *, confidence: Path | None = None
) -> Callable[[], NDArray[np.float32]]:
    """Reads the depth of a PNG of 16 bits, 0: no reading, that must have the camera's size.

    Where the image `confidence`, of the same size, is 0, the sensor did not trust its reading, and
    there is none.
    """
    return partial(_depth, path, _size(camera), per_metre, confidence)


def _depth(
    path: Path, size: tuple[int, int], per_metre: float, confidence: Path | None
) -> NDArray[np.float32]:
    units = read_whole(path, size, DEPTH_MODES)
    metres = (units / per_metre).astype(np.float32)
    metres[units <= 0] = np.nan
    if confidence is not None:
        metres[read_whole(confidence, size, WHOLE_MODES) == 0] = np.nan
    return metres


def label_file(
    path: Path, camera: Camera, offset: int = 0, known: Meanings | None = None
) -> Callable[[], NDArray[np.int32]]:
    """Reads ids of labels or objects, of 8 or 16 bits; below `offset`, which is subtracted: none.

    `known` says what the ids mean; `InputError` where an id of the image has no name.
    """
    return partial(_labels, path, _size(camera), offset, known)


def _labels(
    path: Path, size: tuple[int, int], offset: int, known: Meanings | None
) -> NDArray[np.int32]:
    ids = np.maximum(read_whole(path, size, WHOLE_MODES) - offset, -1)
    return ids if known is None else known.of(ids, path)


class Meanings(NamedTuple):
    """What label ids mean."""

    names: Mapping[int, str | None]
    """By id; None or empty: says nothing."""
    path: Path
    """File that says so."""
    offset: int
    """Was subtracted from the ids."""

    def of(self, ids: NDArray[np.int32], image: Path) -> NDArray[np.int32]:
        """Ids (h, w) of an image, -1 where they say nothing; `InputError`: one has no name."""
        table = np.full(1 << 16, _UNNAMED, np.int32)
        if not self.offset:
            table[0] = -1  # by custom 0 is "unlabelled", where no name says otherwise
        for number, name in self.names.items():
            table[number] = number if name else -1
        meant: NDArray[np.int32] = np.where(ids < 0, -1, table[np.minimum(ids, len(table) - 1)])
        if meant.min() == _UNNAMED:
            nameless = np.unique(ids[meant == _UNNAMED]).tolist()
            listed = ", ".join(map(str, nameless[:8])) + (" ..." if len(nameless) > 8 else "")
            raise InputError(
                f"{image} holds label ids without a name in {self.path}: {listed}; "
                "name them there (null: says nothing)."
            )
        return meant


def check_shape(image: NDArray[Any], camera: Camera, name: object) -> None:
    """Refuse an image (h, w, ...) of another size than its camera's; `name` says which it is."""
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"{name} has {image.shape[1]} x {image.shape[0]} pixels, but its camera says "
            f"{camera.width} x {camera.height}; give the intrinsics of the images as they are."
        )


def _size(camera: Camera) -> tuple[int, int]:
    return camera.width, camera.height
