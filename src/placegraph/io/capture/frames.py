"""Captures: frames with camera, gravity and odometry, optionally depth and labels."""

from __future__ import annotations

import itertools
import operator
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import overload

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.io.capture.frame import Frame, LabelKind


@dataclass(frozen=True, eq=False, repr=False)
class Capture:
    """Frames in order of time. `capture[i]` is a `Frame`, `capture[5:10]` a `Capture`.

    Made by `open_capture`, or of frames in memory by `Capture.from_frames`.
    """

    path: Path | None
    """Folder, or None for frames in memory."""
    frames: tuple[Frame, ...]
    camera: Camera
    """Of the colour images; of the first, where the recorder refocuses from frame to frame."""
    depth_camera: Camera | None
    """Of the depth images; None where the capture has none."""
    label_camera: Camera | None
    """Of the label or instance images; None where the capture has none."""
    label_kind: LabelKind | None
    label_names: dict[int, str]
    """Names of label ids, from `labels.json`."""
    notes: tuple[str, ...] = ()
    """What a reader found out or took for granted, in sentences: a scale, a direction."""
    left_out: Counter[str] = field(default_factory=Counter)
    """Frames that the recorder has and the capture has not, by reason."""

    @classmethod
    def from_frames(cls, frames: Iterable[Frame]) -> Capture:
        """Capture of frames in memory; `OptionError` where they are none or differ in size."""
        held = tuple(frames)
        if not held:
            raise OptionError("frames: there is none; a capture needs at least one frame.")
        first = held[0]
        views = {
            (_size(f.camera), _size(f.depth_camera), _size(f.label_camera), f.label_kind)
            for f in held
        }
        if len(views) > 1:
            raise OptionError("frames: their cameras differ; a capture is of images of one size.")
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


def _size(camera: Camera | None) -> tuple[int, int] | None:
    return None if camera is None else (camera.width, camera.height)


def _read_only(array: NDArray[np.float64]) -> NDArray[np.float64]:
    array.flags.writeable = False
    return array
