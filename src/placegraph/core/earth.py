"""Where a map of rooms stands on Earth, and what follows for poses in it.

Longitude and latitude are degrees in this order, heights are metres above the ellipsoid. Headings
are radians clockwise from north. Conventions: `docs/conventions.md`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from math import sqrt
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.geometry import WGS84_A, WGS84_E2, Floats, quaternion_from_rotation, rotation_z
from placegraph.core.geopose import CAMERA_FROM_BODY
from placegraph.core.geopose import EarthPose as EarthPose  # noqa: PLC0414 - found here too
from placegraph.errors import GeoPoseError, OptionError

_AXIS = WGS84_A * sqrt(1.0 - WGS84_E2)  # semi-minor axis [m]


def ecef_from_geodetic(lonlath: ArrayLike) -> Floats:
    """Earth-centred points (..., 3) [m] of longitude, latitude [deg] and height [m] (..., 3)."""
    lon, lat, height = np.moveaxis(np.asarray(lonlath, np.float64), -1, 0)
    lon, lat = np.radians(lon), np.radians(lat)
    prime_vertical = WGS84_A / np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    across = (prime_vertical + height) * np.cos(lat)
    up = (prime_vertical * (1.0 - WGS84_E2) + height) * np.sin(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), up], axis=-1)


def geodetic_from_ecef(points: ArrayLike) -> Floats:
    """Longitude, latitude [deg] and height [m] (..., 3) of Earth-centred points (..., 3) [m].

    Bowring's iteration: to 1e-9 m within 100 km of the ellipsoid. At a pole longitude is 0.
    """
    x, y, z = np.moveaxis(np.asarray(points, np.float64), -1, 0)
    across, squash = np.hypot(x, y), sqrt(1.0 - WGS84_E2)
    reduced = np.arctan2(z, across * squash)
    for _ in range(4):
        lat = np.arctan2(
            z + WGS84_E2 / (1.0 - WGS84_E2) * _AXIS * np.sin(reduced) ** 3,
            across - WGS84_E2 * WGS84_A * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2(squash * np.sin(lat), np.cos(lat))
    surface = WGS84_A * np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    height = across * np.cos(lat) + z * np.sin(lat) - surface
    return np.stack([np.degrees(np.arctan2(y, x)), np.degrees(lat), height], axis=-1)


def ecef_from_enu(longitude: float, latitude: float) -> Floats:
    """Rotation (3, 3): the axes east, north, up of a place [deg] in the Earth-centred frame."""
    lon, lat = np.radians(longitude), np.radians(latitude)
    sl, cl, sp, cp = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    return np.array([[-sl, -sp * cl, cp * cl], [cl, -sp * sl, cp * sl], [0.0, cp, sp]])


HIGHEST = 1e5
"""Of a map above or below the ellipsoid [m]."""


@dataclass(frozen=True, eq=False)
class Anchor:
    """Where a scene map stands on Earth: one candidate, upright as the map is.

    Raises `OptionError` where a number is out of its range.
    """

    longitude: float
    latitude: float
    """Of the map's origin (0, 0, 0) [deg, WGS84]."""
    height: float
    """Of the map's z = 0 above the ellipsoid [m]."""
    heading: float
    """Where the map's y axis points, clockwise from north [rad, 0 to 2 pi); 0: x east, y north."""
    covariance: Floats = field(default_factory=lambda: np.zeros((4, 4)), repr=False)
    """(4, 4) float64 of east, north, up [m] and heading [rad]; all zero: nobody
    said, and it counts as exact."""
    building: str = ""
    """Name of the building."""
    osm: str = ""
    """Its id, such as ``way/123``."""
    level: str = ""
    """OpenStreetMap's level of the map's floor, such as ``1``."""
    probability: float = 1.0
    """That the map stands here and not where another candidate says."""
    method: str = ""
    """How it was found."""
    residuals: tuple[float, ...] = field(default=(), repr=False)
    """What is left between each thing that was fitted and where it should be [m]."""
    scene: str = ""
    """Which of the merged scenes of a map it is of; empty: of the whole map."""

    def __post_init__(self) -> None:
        for name, most in (("longitude", 180.0), ("latitude", 90.0), ("height", HIGHEST)):
            value = float(getattr(self, name))
            if not abs(value) <= most:
                raise OptionError(
                    f"anchor: {name} is {value:g}; it is between {-most:g} and {most:g}."
                )
            object.__setattr__(self, name, value)
        heading, probability = float(self.heading), float(self.probability)
        if not np.isfinite(heading):
            raise OptionError(f"anchor: heading is {heading}; it is an angle in radians.")
        if not 0.0 < probability <= 1.0:
            raise OptionError(f"anchor: probability is {probability:g}; it is above 0, at most 1.")
        residuals = tuple(float(r) for r in self.residuals)
        if not all(np.isfinite(r) and r >= 0 for r in residuals):
            raise OptionError("anchor: residuals are lengths in metres; some are none.")
        covariance = np.array(self.covariance, np.float64)
        if covariance.shape != (4, 4) or not np.isfinite(covariance).all():
            raise OptionError(
                f"anchor: covariance {covariance.shape}; (4, 4) finite numbers belong."
            )
        covariance = (covariance + covariance.T) / 2.0
        values = np.linalg.eigvalsh(covariance)
        if values[0] < -1e-9 * max(1.0, float(values[-1])):
            raise OptionError("anchor: covariance is none; one of its variances is negative.")
        covariance.flags.writeable = False
        heading %= 2.0 * np.pi
        object.__setattr__(self, "heading", heading if heading < 2.0 * np.pi else 0.0)
        object.__setattr__(self, "probability", probability)
        object.__setattr__(self, "residuals", residuals)
        object.__setattr__(self, "covariance", covariance)

    @property
    def known(self) -> bool:
        """Whether anybody said how far off it may be; `check` of a map asks."""
        return bool(self.covariance.any())

    @property
    def enu_from_map(self) -> Floats:
        """(4, 4): the map in the axes east, north, up at its origin [m]."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_z(-self.heading)
        return matrix

    @property
    def ecef_from_map(self) -> Floats:
        """(4, 4): the map in the Earth-centred frame [m]."""
        matrix = np.eye(4)
        matrix[:3, :3] = ecef_from_enu(self.longitude, self.latitude) @ self.enu_from_map[:3, :3]
        matrix[:3, 3] = ecef_from_geodetic((self.longitude, self.latitude, self.height))
        return matrix

    def to_earth(self, points: ArrayLike) -> Floats:
        """Longitude, latitude [deg] and height [m] (..., 3) of the map's points (..., 3) [m]."""
        matrix = self.ecef_from_map
        return geodetic_from_ecef(np.asarray(points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3])

    def to_map(self, lonlath: ArrayLike) -> Floats:
        """Points (..., 3) [m] of the map of longitude, latitude [deg] and height [m] (..., 3)."""
        matrix = self.ecef_from_map
        return np.asarray((ecef_from_geodetic(lonlath) - matrix[:3, 3]) @ matrix[:3, :3])

    def shifted(self, shift: ArrayLike, *, scene: str = "") -> Anchor:
        """Anchor of the same map once its points were shifted by (3,) [m], as one of merged scenes."""
        back = -np.asarray(shift, np.float64)
        lon, lat, height = self.to_earth(back).tolist()
        turned = ecef_from_enu(lon, lat).T @ self.ecef_from_map[:3, :3]  # (3, 3) ENU there from map
        jacobian = np.eye(4)
        jacobian[:3, 3] = np.cross((0.0, 0.0, -1.0), self.enu_from_map[:3, :3] @ back)
        return replace(
            self, longitude=lon, latitude=lat, height=height, scene=scene,
            heading=float(np.arctan2(turned[0, 1], turned[1, 1])),
            covariance=jacobian @ self.covariance @ jacobian.T,
        )  # fmt: skip

    def pose(
        self,
        map_from_camera: ArrayLike,
        covariance: ArrayLike | None = None,
        *,
        probability: float = 1.0,
        room: str = "",
        storey: int = 0,
    ) -> EarthPose:
        """Pose on Earth of a camera in the map.

        Parameters
        ----------
        map_from_camera
            (4, 4) [m].
        covariance
            (6, 6) of its x, y, z [m] and of a turn about the map's axes [rad], as of a `PoseMode`;
            None: it is exact. What is not known of the anchor is added to it.
        probability
            Of the pose in the map; the anchor's is multiplied.
        room, storey
            Where it is; how many storeys above the map's floor, which counts for a level that is a
            number.

        """
        pose = np.asarray(map_from_camera, np.float64)
        ecef_from_camera = self.ecef_from_map @ pose
        lon, lat, height = geodetic_from_ecef(ecef_from_camera[:3, 3]).tolist()
        there = ecef_from_enu(lon, lat).T
        enu_from_map = there @ self.ecef_from_map[:3, :3]
        # a turn of the anchor (clockwise) moves the camera about the map's origin, and turns it
        by_anchor = np.zeros((6, 4))
        by_anchor[:3, :3] = there @ ecef_from_enu(self.longitude, self.latitude)
        axis = by_anchor[:3, :3] @ (0.0, 0.0, -1.0)
        by_anchor[:3, 3] = np.cross(axis, enu_from_map @ pose[:3, 3])
        by_anchor[3:, 3] = axis
        by_pose = np.kron(np.eye(2), enu_from_map)
        total = by_anchor @ self.covariance @ by_anchor.T
        if covariance is not None:
            total = total + by_pose @ np.asarray(covariance, np.float64) @ by_pose.T
        body = there @ ecef_from_camera[:3, :3] @ CAMERA_FROM_BODY
        return EarthPose(
            lon, lat, height, quaternion_from_rotation(body), total,
            self.probability * probability, _raised(self.level, storey), room, self.building,
            self.osm,
        )  # fmt: skip

    def somewhere(self, box: ArrayLike, *, probability: float = 1.0) -> EarthPose:
        """Place on Earth of somebody anywhere in a box (2, 3) of the map [m], who looks anywhere."""
        low, high = np.asarray(box, np.float64)
        middle, spread = np.eye(4), np.zeros((6, 6))
        middle[:3, 3] = (low + high) / 2.0
        np.fill_diagonal(spread[:3, :3], (high - low) ** 2 / 12.0)
        there = self.pose(middle, spread, probability=probability)
        covariance = there.covariance.copy()
        covariance[3:] = covariance[:, 3:] = np.nan
        return replace(there, quaternion=np.full(4, np.nan), covariance=covariance)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, as the map file holds them."""
        return asdict(self) | {
            "covariance": self.covariance.tolist(),
            "residuals": list(self.residuals),
        }

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """Anchor of `to_dict`; `OptionError`, `TypeError` or `ValueError` where it is none."""
        texts = {"building", "osm", "level", "method", "scene"}
        given = {f.name: plain[f.name] for f in fields(cls) if f.name in plain}
        if wrong := [name for name in texts & given.keys() if not isinstance(given[name], str)]:
            raise OptionError(f"anchor: {wrong[0]} is no text.")
        return cls(**given)


def unplaced(scene: str) -> GeoPoseError:
    """What is raised where a scene map is asked for its place, and nobody has said it."""
    return GeoPoseError(
        f"The scene map {scene!r} has no place on Earth; give it one with `placegraph scene anchor`."
    )


def _raised(level: str, storeys: int) -> str:
    """OpenStreetMap's level so many storeys up; as it is where it is no number."""
    try:
        number = float(level)
    except ValueError:
        return level
    return f"{number + storeys:g}" if storeys and np.isfinite(number) else level


def ranked(anchors: Iterable[Anchor], scenes: Sequence[str]) -> tuple[Anchor, ...]:
    """Anchors of a map of these merged scenes, best first; raises `OptionError` where they are none."""
    found = tuple(sorted(anchors, key=lambda anchor: -anchor.probability))
    for scene in scenes:
        total = sum(a.probability for a in found if a.scene in {"", scene})
        if total > 1.0 + 1e-6:
            raise OptionError(
                f"anchors: the probabilities of {scene!r}'s candidates add up to {total:.2f}; "
                "at most 1 belongs."
            )
    if strange := [a.scene for a in found if a.scene not in {"", *scenes}]:
        raise OptionError(f"anchors: {strange[0]!r} is no scene of the map.")
    return found
