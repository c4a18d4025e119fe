"""What is known of images, whoever sent it: frames, and hints of where they were taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, hypot, log, sin, sqrt
from typing import Any

import numpy as np

from placegraph.core.geo import Anchor
from placegraph.core.geometry import Camera
from placegraph.errors import InputError, OptionError
from placegraph.indoor.pose.prior import Prior
from placegraph.io.capture.frame import Frame
from placegraph_serve.photo import Photo

LEVEL = (0.0, 1.0, 0.0)
"""Gravity in the axes of a camera that is held upright."""
TILTS = (0.17, -0.17)
"""Angles below the horizon that are tried after it, where nobody says how the camera was held [rad]."""
FAR_OFF, HOUSE = 5.0, 200.0
"""A fix so many radii and so far [m] from a map says nothing of where in it an image was taken."""
HALF = sqrt(2.0 * log(2.0))
"""Standard deviations of a round Gaussian in the radius within which half of it lies."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Hints:
    """What is known of the place, besides images."""

    map: str | None = None
    description: str | None = None
    prior: Prior | None = None
    """In the map's own axes."""
    near: tuple[float, float] | None = None
    """Longitude and latitude [deg]."""
    radius: float = 100.0
    """Within which half of the prior lies [m]."""
    height: float | None = None
    """Above the ellipsoid [m]."""
    heading: float | None = None
    """Of the camera, clockwise from north [rad]."""
    seed: int = 0

    def prior_in(self, anchors: Sequence[Anchor]) -> Prior | None:
        """Prior in a map's axes: the one given, or the fix, by the map's likeliest anchor."""
        if self.prior is not None or self.near is None or not anchors:
            return self.prior
        anchor = anchors[0]
        height = anchor.height if self.height is None else self.height
        x, y, z = anchor.to_map((*self.near, height)).tolist()
        if self.is_far(hypot(x, y)):  # one of the two is wrong; images decide
            return None
        # the map's y axis points to the anchor's heading, and yaw is counted from x the other way
        yaw = None if self.heading is None else np.pi / 2.0 + anchor.heading - self.heading
        return Prior(
            x, y, None if self.height is None else z, yaw, spread=max(self.radius / HALF, 0.05)
        )

    def notes(self, name: str, anchors: Sequence[Anchor]) -> list[str]:
        """What of it could not be used in a map, and why."""
        if self.prior is not None or self.near is None or not anchors:
            return []
        away, swapped = (
            hypot(*anchors[0].to_map((*near, anchors[0].height))[:2])
            for near in (self.near, self.near[::-1])
        )
        if not self.is_far(away):
            return []
        said = (
            f"The given position lies {away / 1000.0:.1f} km from map {name!r} and was left out; "
        )
        if not self.is_far(swapped):
            return [said + "swapped, it lies there: longitude comes first."]
        return [said + "check it, or how the map was placed on Earth."]

    def is_far(self, distance: float) -> bool:
        """Whether a fix is so far from a map [m] that it says nothing of where in it one is."""
        return distance > FAR_OFF * self.radius + HOUSE


@dataclass(frozen=True, slots=True, eq=False)
class Images:
    """Frames to be localized, and what was not said of them."""

    frames: tuple[Frame, ...]
    moved: bool
    """Whether odometry says how the camera moved from one to the next; else each stands alone."""
    leveled: bool
    """Whether gravity is known."""

    def trials(self) -> list[list[Frame]]:
        """Frames that belong together, in the order in which they are tried."""
        groups = [list(self.frames)] if self.moved else [[frame] for frame in self.frames]
        if self.leveled:
            return groups
        tilted = [
            [replace(f, gravity=np.array([0.0, cos(tilt), sin(tilt)])) for f in group]
            for tilt in TILTS
            for group in groups
        ]
        return groups + tilted


def camera_of(given: dict[str, Any] | None, photo: Photo | None) -> Camera | None:
    """Camera of intrinsics as JSON has them, of a photo's size if they tell none; None of none."""
    if given is None:
        return None
    width, height = (given["width"], given["height"]) if photo is None else photo.size
    width, height = given["width"] or width, given["height"] or height
    if width is None or height is None:
        raise OptionError("camera: width and height are missing; give those of the images.")
    cx = width / 2.0 if given["cx"] is None else given["cx"]
    cy = height / 2.0 if given["cy"] is None else given["cy"]
    fy = given["fy"] or given["fx"]
    return Camera(
        width, height, given["fx"], fy, cx, cy, tuple(given["distortion"]), given["model"]
    )


def images_of(photos: Sequence[Photo], depths: Sequence[Any], known: dict[str, Any]) -> Images:
    """Frames of photos, depth images and what `schema.Localize` says of them.

    Raises `InputError` where intrinsics or depth are of other images, `OptionError` where there are
    more or fewer of one than of another.
    """
    count = len(photos)
    for name in ("gravity", "odometry", "stamps"):
        if known.get(name) is not None and len(known[name]) != count:
            raise OptionError(f"{name}: {len(known[name])} for {count} images; give one an image.")
    if depths and len(depths) != count:
        raise OptionError(f"depth: {len(depths)} for {count} images; give one an image, or none.")
    cameras = [
        photo.camera(camera_of(known.get("intrinsics"), photo), f"images[{i}]")
        for i, photo in enumerate(photos)
    ]
    gravity, odometry = known.get("gravity"), known.get("odometry")
    stamps = known.get("stamps") or list(range(count))
    frames = [
        Frame.from_arrays(
            photo.rgb, camera,
            depth=depths[i] if depths else None,
            odometry=None if odometry is None else odometry[i],
            gravity=gravity[i] if gravity else None if odometry else LEVEL,
            stamp=stamps[i], index=i,
        )
        for i, (photo, camera) in enumerate(zip(photos, cameras, strict=True))
    ]  # fmt: skip
    together = odometry is not None
    if together and len({(f.camera.width, f.camera.height) for f in frames}) > 1:
        raise InputError("images: their sizes differ; images of one way are of one camera.")
    leveled = gravity is not None or together
    return Images(tuple(frames), together or count == 1, leveled)
