"""Poses on Earth, and the standard that they are told in: OGC GeoPose 1.0, Basic-Quaternion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.geometry import Floats, rotation_from_quaternion, split_pose

CAMERA_FROM_BODY = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Axes of a GeoPose's body (x right, y forward, z up) in a camera's (x right, y down, z forward)."""


@dataclass(frozen=True, eq=False)
class EarthPose:
    """A pose on Earth. What is not known of it is not a number (NaN), in the covariance too."""

    longitude: float
    latitude: float
    """[deg, WGS84]."""
    height: float
    """Above the ellipsoid [m]."""
    quaternion: Floats
    """(4,) x, y, z, w: the body's axes (x right, y forward, z up) in east, north, up."""
    covariance: Floats = field(repr=False)
    """(6, 6) of east, north, up [m] and of a small turn about these axes [rad]."""
    probability: float = 1.0
    level: str = ""
    """OpenStreetMap's level, such as ``1``."""
    room: str = ""
    building: str = ""
    osm: str = ""
    """Id of the building, such as ``way/123``."""

    @classmethod
    def of_place(
        cls, longitude: float, latitude: float, covariance: ArrayLike, *, probability: float = 1.0
    ) -> EarthPose:
        """A place with covariance (2, 2) east-north [m^2], of which no height is known, no direction."""
        whole = np.full((6, 6), np.nan)
        whole[:2, :2] = covariance
        return cls(longitude, latitude, np.nan, np.full(4, np.nan), whole, probability)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> EarthPose:
        """Pose of `to_dict`; `KeyError`, `TypeError` or `ValueError` where it is none."""
        numbers = {
            name: float(np.nan if plain[name] is None else plain[name])
            for name in ("longitude", "latitude", "height", "probability")
        }
        return cls(
            numbers["longitude"], numbers["latitude"], numbers["height"],
            np.array(plain["quaternion"], np.float64).reshape(4),
            np.array(plain["covariance"], np.float64).reshape(6, 6), numbers["probability"],
            *(str(plain[name]) for name in ("level", "room", "building", "osm")),
        )  # fmt: skip

    @property
    def heading(self) -> float:
        """Where it looks, clockwise from north [rad, 0 to 2 pi), as `geometry.split_pose` has it."""
        if not np.isfinite(self.quaternion).all():
            return np.nan
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_from_quaternion(self.quaternion) @ CAMERA_FROM_BODY.T
        if not np.isfinite(matrix).all():
            return np.nan
        return float((np.pi / 2.0 - split_pose(matrix)[0][3]) % (2.0 * np.pi))

    @property
    def unknown(self) -> tuple[str, ...]:
        """Which of ``height`` and ``orientation`` are not known."""
        pairs = (("height", self.height), ("orientation", self.quaternion))
        return tuple(name for name, value in pairs if not np.isfinite(value).all())

    @property
    def accuracy(self) -> dict[str, float | None]:
        """Standard deviations: ``position`` a mean axis of what is known [m], ``orientation`` [deg].

        None: not known.
        """
        variances = np.diag(self.covariance)
        height, turned = np.isfinite(self.height), np.isfinite(self.quaternion).all()
        metres = sqrt(float(variances[: 3 if height else 2].mean()))
        degrees = float(np.degrees(np.sqrt(variances[3:].mean()))) if turned else None
        return {"position": metres, "orientation": degrees}

    def geopose(self) -> dict[str, Any]:
        """OGC GeoPose 1.0, Basic-Quaternion, with ``accuracy``, ``probability`` and ``unknown`` beside.

        The frame is east, north, up at the position; the body's axes are x right, y forward, z up.
        What ``unknown`` names (``height``, ``orientation``) is written as 0 and as the identity,
        since the standard asks for numbers.
        """
        quaternion = self.quaternion if "orientation" not in self.unknown else np.eye(4)[3]
        x, y, z, w = (float(v) for v in quaternion)
        height = 0.0 if "height" in self.unknown else self.height
        return {
            "position": {"lat": self.latitude, "lon": self.longitude, "h": height},
            "quaternion": {"x": x, "y": y, "z": z, "w": w},
            "accuracy": self.accuracy,
            "probability": self.probability,
            "unknown": list(self.unknown),
        }

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings; None where nothing is known."""
        heading = np.degrees(self.heading)
        covariance = self.covariance
        return {
            "longitude": self.longitude,
            "latitude": self.latitude,
            "height": self.height if np.isfinite(self.height) else None,
            "heading_deg": float(heading) if np.isfinite(heading) else None,
            "quaternion": _known(self.quaternion),
            "covariance": [_known(row) for row in covariance],
            "probability": self.probability,
            "level": self.level,
            "room": self.room,
            "building": self.building,
            "osm": self.osm,
        }


def _known(numbers: Floats) -> list[float | None]:
    """Numbers as JSON takes them."""
    return [value if np.isfinite(value) else None for value in numbers.tolist()]
