"""Frames as they are once their camera is mended, and the sentence that says what was wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import Calibration, PoseEstimate
from placegraph.core.geometry import Camera, Floats
from placegraph.indoor.pose.query import PoseQuery
from placegraph.indoor.refine.calibrate import (
    COUNT,
    FOCAL,
    IMAGE,
    PLACE,
    SCALE,
    TILT,
    depth_from_camera,
    turned_gravity,
)
from placegraph.indoor.status import choose_camera
from placegraph.io.capture.frame import Frame, Images, LazyImages

_SAME = 1e-3  # of an image's width: intrinsics of one view
_ALIKE = 0.01  # focal lengths that are off by one factor
_DEVICE = 0.2  # cameras of one device stand no further apart [m]: depth or images are late


@dataclass(frozen=True, eq=False)
class Mend:
    """What the unknowns of a camera were found to be (`calibrate`)."""

    values: Floats
    """(COUNT,)"""
    errors: Floats
    """(COUNT,) standard deviations."""

    @classmethod
    def nothing(cls) -> Mend:
        """The camera is as it is said to be."""
        return cls(np.zeros(COUNT), np.zeros(COUNT))

    def frames(self, frames: Sequence[Frame]) -> list[Frame]:
        """Frames of one capture as their camera should have them."""
        mount = depth_from_camera(self.values) if self.values[list(PLACE)].any() else None
        return [self._frame(f, mount) for f in frames]

    def _frame(self, frame: Frame, mount: Floats | None) -> Frame:
        depth, labels, images = frame.depth_camera, frame.label_camera, frame.images
        shared = share_view(frame.camera, labels)
        depth = None if depth is None else longer(depth, self.values[FOCAL])
        if mount is not None or self.values[SCALE]:
            images = MendedImages(images, float(np.exp(self.values[SCALE])), depth, mount)
        return replace(
            frame,
            camera=longer(frame.camera, self.values[IMAGE]),
            depth_camera=depth,
            label_camera=longer(labels, self.values[IMAGE if shared else FOCAL])
            if labels
            else None,
            images=images,
            gravity=turned_gravity(frame.gravity, self.values),
        )

    def calibration(self) -> Calibration:
        """The same for the user."""
        factors, errors = np.exp(self.values), self.errors
        return Calibration(
            focal_factor=(float(factors[IMAGE]), float(errors[IMAGE])),
            depth_focal_factor=(float(factors[FOCAL]), float(errors[FOCAL])),
            depth_scale=(float(factors[SCALE]), float(errors[SCALE])),
            camera_from_depth=depth_from_camera(self.values),
            gravity_turn=self.values[list(TILT)],
        )

    def chosen(self, asked: PoseQuery, before: PoseEstimate, after: PoseEstimate) -> PoseEstimate:
        """Return the better answer of those before and after mending, with what was found."""
        return choose_camera(
            before, after, self.calibration(), self.sentence(asked.frames[-1]),
            tilt_only=not self.values[: TILT[0]].any(), implausible=self._late,
        )  # fmt: skip

    @property
    def _late(self) -> bool:
        return bool(np.linalg.norm(self.values[list(PLACE[:3])]) > _DEVICE)

    def sentence(self, frame: Frame) -> str:
        """What is wrong, and what should stand in `camera.json` instead."""
        return " ".join([*self._focal(frame), *self._scale(frame), *self._offset(), *self._tilt()])

    def _focal(self, frame: Frame) -> list[str]:
        image, depth = self.values[[IMAGE, FOCAL]]
        said = []
        if image:
            fits = longer(frame.camera, image)
            both = " (depth likewise)" if abs(depth - image) < _ALIKE else ""
            said.append(
                f"The focal length is {_percent(image)} than the camera says{both}: "
                f"fx {fits.fx:.1f}, fy {fits.fy:.1f} would fit."
            )
        if depth and abs(depth - image) >= _ALIKE and frame.depth_camera is not None:
            fits = longer(frame.depth_camera, depth)
            said.append(
                f"The focal length of the depth camera is {_percent(depth)} than it says: fx "
                f"{fits.fx:.1f}, fy {fits.fy:.1f} would fit."
            )
        return said

    def _scale(self, frame: Frame) -> list[str]:
        if not self.values[SCALE]:
            return []
        factor, images = float(np.exp(self.values[SCALE])), frame.images
        how = f"{abs(1.0 / factor - 1.0):.1%} too {'short' if factor > 1 else 'long'}"
        unit = images.unit if isinstance(images, LazyImages) else None
        mend = f"{unit.said} {unit.per_metre / factor:.5g}" if unit else f"{factor:.3f} times them"
        return [f"Depth readings are {how}: {mend} would fit."]

    def _offset(self) -> list[str]:
        place = self.values[list(PLACE)]
        if not place.any():
            return []
        way, turn = np.linalg.norm(place[:3]), np.degrees(np.linalg.norm(place[3:]))
        apart = f"{100 * way:.0f} cm and {turn:.1f} degrees"
        late = "; that is no device, one of them is late" if self._late else ""
        return [f"Depth and images are not of one view: {apart} lie between their cameras{late}."]

    def _tilt(self) -> list[str]:
        turn = np.degrees(self.values[list(TILT)])
        if not turn.any():
            return []
        x, y, z = turn + 0.0
        off = f"Gravity is {np.linalg.norm(turn):.1f} degrees off"
        return [f"{off}: turned by {x:.1f}, {y:.1f}, {z:.1f} degrees in camera axes it would fit."]


@dataclass(frozen=True, slots=True, eq=False)
class MendedImages:
    """Images whose depth is brought to scale, and to where the camera was."""

    images: Images
    factor: float
    camera: Camera | None
    """Of the depth images."""
    mount: Floats | None
    """(4, 4) pose of the depth camera in the camera; None: they are one."""

    def rgb(self) -> NDArray[np.uint8]:
        """As `Frame.rgb`."""
        return self.images.rgb()

    def labels(self) -> NDArray[np.int32] | None:
        """As `Frame.labels`."""
        return self.images.labels()

    def depth(self) -> NDArray[np.float32] | None:
        """As `Frame.depth`."""
        return self.brought(self.images.depth())

    def brought(self, depth: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
        """Depth (h, w) [m] as it was read, mended."""
        if depth is None:
            return None
        scaled = (depth * np.float32(self.factor)).astype(np.float32)
        if self.mount is None or self.camera is None:
            return scaled
        return moved_depth(scaled, self.camera, self.mount)


def brought(frame: Frame, depth: NDArray[np.float32] | None) -> NDArray[np.float32] | None:
    """Depth (h, w) [m] of a mended frame, from what was read."""
    return frame.images.brought(depth) if isinstance(frame.images, MendedImages) else depth


def moved_depth(
    depth: NDArray[np.float32], camera: Camera, seen_from_camera: Floats
) -> NDArray[np.float32]:
    """Depth (h, w) [m] as the same camera would read it from elsewhere, NaN where that is not known.

    `seen_from_camera`: (4, 4) pose of the camera that read it, in the axes of the one that would.
    """
    v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
    rays = camera.directions(np.stack([u, v], axis=1) + 0.5)
    points = rays * depth[v, u, None] @ seen_from_camera[:3, :3].T + seen_from_camera[:3, 3]
    at = camera.project(points)
    with np.errstate(invalid="ignore"):
        inside = ((at >= 0) & (at < (camera.width, camera.height))).all(axis=1)
    x, y = at[inside].astype(np.int64).T
    out = np.full(depth.shape, np.inf, np.float32)
    np.minimum.at(out, (y, x), points[inside, 2].astype(np.float32))
    return np.where(np.isfinite(out), out, np.float32(np.nan))


def longer(camera: Camera, logarithm: float) -> Camera:
    """Camera whose focal length is another, by the logarithm of the factor."""
    factor = float(np.exp(logarithm))
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor) if logarithm else camera


def share_view(camera: Camera, other: Camera | None) -> bool:
    """Whether two cameras are told to see the same, in images of whatever size."""
    if other is None:
        return False
    same = camera.resized(other.width, other.height)
    pairs = [(getattr(same, k), getattr(other, k)) for k in ("fx", "fy", "cx", "cy")]
    return all(abs(a - b) < _SAME * other.width for a, b in pairs)


def _percent(logarithm: float) -> str:
    factor = float(np.exp(logarithm))
    return f"{abs(factor - 1.0):.1%} {'longer' if factor > 1.0 else 'shorter'}"
