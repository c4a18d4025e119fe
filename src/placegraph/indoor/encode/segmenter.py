"""Segmenters of images, and captures whose frames they label."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np

from placegraph.errors import OptionError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.formats.capture.capture import Capture
    from placegraph.formats.capture.frame import Images
    from placegraph.geometry import Camera

_KEPT = 64
"""Label images of a capture that are kept; what was used last stays."""


@runtime_checkable
class Segmenter(Protocol):
    """Anything that says of each pixel of an image what it shows."""

    @property
    def names(self) -> dict[int, str]:
        """Names of the labels it gives."""

    def labels(self, rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Labels (h, w) of an image (H, W, 3) sRGB, as large or smaller; -1: nothing."""

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of the labels of images of a width and height [px]."""


def labelled(capture: Capture, segmenter: Segmenter) -> Capture:
    """Capture whose frames' labels are what a segmenter says of their colours.

    Images are segmented when their labels are asked for; the last 64 are kept. The capture's own
    labels, if it has any, are hidden.
    """
    size = segmenter.size(capture.camera.width, capture.camera.height)
    cameras = [frame.camera.resized(*size) for frame in capture.frames]  # some refocus
    names = dict(segmenter.names)
    cache: OrderedDict[int, NDArray[np.int32]] = OrderedDict()
    frames = tuple(
        replace(
            frame,
            label_camera=cameras[i],
            label_kind="labels",
            label_names=names,
            images=SegmentedImages(frame.images, segmenter, cameras[i], i, cache),
        )
        for i, frame in enumerate(capture.frames)
    )
    return replace(
        capture, frames=frames, label_camera=cameras[0], label_kind="labels", label_names=names
    )


@dataclass(frozen=True, slots=True, eq=False)
class SegmentedImages:
    """A frame's images, and a segmenter for its labels."""

    images: Images
    segmenter: Segmenter
    camera: Camera
    """Of the labels."""
    row: int
    """Of the frame, in the cache."""
    cache: OrderedDict[int, NDArray[np.int32]] = field(repr=False)
    """Shared by the frames of a capture."""

    def rgb(self) -> NDArray[np.uint8]:
        """As `Frame.rgb`."""
        return self.images.rgb()

    def depth(self) -> NDArray[np.float32] | None:
        """As `Frame.depth`."""
        return self.images.depth()

    def labels(self) -> NDArray[np.int32]:
        """As `Frame.labels`; `OptionError` where the segmenter's answer is not what it said."""
        known = self.cache.pop(self.row, None)
        if known is None:
            known = np.asarray(self.segmenter.labels(self.images.rgb()))
            wanted = self.camera.height, self.camera.width
            if known.shape != wanted or known.dtype.kind not in "iu":
                raise OptionError(
                    f"segmenter: labels are {known.dtype} {known.shape}; it promised whole numbers "
                    f"{wanted}."
                )
            known = known.astype(np.int32)
            known.flags.writeable = False
        self.cache[self.row] = known
        while len(self.cache) > _KEPT:
            self.cache.popitem(last=False)
        return known
