"""One frame of a capture, and frames of arrays in memory; `frame_files` has those of files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Camera
from placegraph.core.pickling import Portable
from placegraph.errors import OptionError

LabelKind = Literal["labels", "instances"]
"""What the values of label images are: ids of labels, or ids of objects of the map."""


class Images(Protocol):
    """Where a frame's images come from."""

    def rgb(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8, sRGB."""

    def depth(self) -> NDArray[np.float32] | None:
        """(h, w) float32 [m], NaN: no reading."""

    def labels(self) -> NDArray[np.int32] | None:
        """(h, w) int32, -1: nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame(Portable):
    """One moment of a capture. Images are read, and checked, each time they are asked for."""

    index: int
    """Row in the capture's folder."""
    stamp: float
    """Seconds, or frame number."""
    odometry: NDArray[np.float64]
    """(4, 4) odometry_from_camera [m]"""
    gravity: NDArray[np.float64]
    """(3,) unit direction of gravity in the camera's axes."""
    camera: Camera
    """Of the colour image."""
    depth_camera: Camera | None
    """Of the depth images; None where the capture has none."""
    label_camera: Camera | None
    """Of the label images; None where the capture has none."""
    label_kind: LabelKind | None
    label_names: dict[int, str]
    """Names of label ids; may be empty for instances."""
    images: Images = field(repr=False)

    def rgb(self) -> NDArray[np.uint8]:
        """Colours (H, W, 3) uint8, sRGB; `InputError` where the file is broken or of another size."""
        return self.images.rgb()

    def depth(self) -> NDArray[np.float32] | None:
        """Depth along the optical axis (h, w) float32 [m], NaN: no reading; None: no such image.

        Raises `InputError` as `rgb` does, and where pixels are not 16 bits.
        """
        return self.images.depth()

    def labels(self) -> NDArray[np.int32] | None:
        """Ids of labels or of objects (h, w) int32, -1: nothing; None: no such image.

        Raises `InputError` as `rgb` does, and where label ids have no name.
        """
        return self.images.labels()

    @classmethod
    def from_arrays(
        cls,
        rgb: ArrayLike,
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
        """Frame of a robot's own arrays. They are not copied: leave them as they are.

        Parameters
        ----------
        rgb
            (H, W, 3) uint8, sRGB.
        depth
            (h, w) along the optical axis [m]; 0, negative or not finite: no reading.
        depth_camera
            Intrinsics of `depth`; `camera`'s, brought to its size, if not given.
        labels
            (h, w) whole numbers: ids of labels or of objects; negative: nothing.
        label_camera
            Intrinsics of `labels`; `camera`'s, brought to its size, if not given.
        label_kind
            What the ids of `labels` are.
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
        colours = np.asarray(rgb)
        if colours.dtype != np.uint8:
            raise OptionError(f"rgb: {colours.dtype}; colours are uint8, 0 to 255.")
        if label_kind not in {"labels", "instances"}:
            raise OptionError(f"label_kind is {label_kind!r}; it is 'labels' or 'instances'.")
        _fit("rgb", colours, camera, (3,))
        metres = None if depth is None else _metres(depth)
        ids = None if labels is None else _ids(labels)
        if metres is not None:
            depth_camera = depth_camera or _resized("depth", metres, camera)
            _fit("depth", metres, depth_camera, ())
        if ids is not None:
            label_camera = label_camera or _resized("labels", ids, camera)
            _fit("labels", ids, label_camera, ())
        pose = np.eye(4) if odometry is None else _floats("odometry", odometry, (4, 4))
        down = -pose[2, :3] if gravity is None else _floats("gravity", gravity, (3,))
        length = float(np.linalg.norm(down))
        if not length > 0 or not np.isfinite(stamp):
            raise OptionError("gravity has no direction, or the stamp is not a number.")
        return cls(
            index=index,
            stamp=float(stamp),
            odometry=_locked(pose),
            gravity=_locked(down / length),
            camera=camera,
            depth_camera=depth_camera,
            label_camera=label_camera,
            label_kind=None if label_camera is None else label_kind,
            label_names=dict(label_names or {}),
            images=ArrayImages(
                _locked(colours),
                None if metres is None else _locked(metres),
                None if ids is None else _locked(ids),
            ),
        )


@dataclass(frozen=True, slots=True, eq=False)
class ArrayImages:
    """Images in memory."""

    colours: NDArray[np.uint8]
    metres: NDArray[np.float32] | None
    ids: NDArray[np.int32] | None

    def rgb(self) -> NDArray[np.uint8]:
        """As `Frame.rgb`."""
        return self.colours

    def depth(self) -> NDArray[np.float32] | None:
        """As `Frame.depth`."""
        return self.metres

    def labels(self) -> NDArray[np.int32] | None:
        """As `Frame.labels`."""
        return self.ids


def _fit(what: str, array: NDArray[Any], camera: Camera, rest: tuple[int, ...]) -> None:
    wanted = (camera.height, camera.width, *rest)
    if array.shape != wanted:
        raise OptionError(f"{what}: shape {array.shape}, but its camera's images are {wanted}.")


def _resized(what: str, array: NDArray[Any], camera: Camera) -> Camera:
    """Camera of images of another size that show the same."""
    if array.ndim != 2 or not array.size:
        raise OptionError(f"{what}: shape {array.shape}; an image has a height and a width.")
    height, width = array.shape
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        raise OptionError(
            f"{what}: {width} x {height} is not {camera.width} x {camera.height} made smaller or "
            f"larger; give its camera."
        )
    return camera if array.shape == (camera.height, camera.width) else camera.resized(width, height)


def _metres(depth: ArrayLike) -> NDArray[np.float32]:
    try:
        metres = np.array(depth, np.float32)
    except (TypeError, ValueError, OverflowError) as error:
        raise OptionError(f"depth: not an array of metres ({error}).") from error
    metres[~(np.isfinite(metres) & (metres > 0))] = np.nan
    return metres


def _ids(labels: ArrayLike) -> NDArray[np.int32]:
    ids = np.asarray(labels)
    if ids.dtype.kind not in "iu":
        raise OptionError(f"labels: {ids.dtype}; ids are whole numbers.")
    return np.maximum(ids, -1).astype(np.int32) if ids.dtype.kind == "i" else ids.astype(np.int32)


def _floats(what: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    array = np.asarray(values, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise OptionError(f"{what}: shape {array.shape}; {shape} finite numbers belong.")
    return array


def _locked(array: NDArray[Any]) -> NDArray[Any]:
    """Read-only view: the caller's array stays as it is."""
    view = array.view()
    view.flags.writeable = False
    return view
