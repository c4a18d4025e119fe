"""Positions on Earth: OGC GeoPose 1.0, anchors of maps, and tiles of the Mercator grid."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from math import sqrt
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import (
    WGS84_A,
    WGS84_E2,
    Floats,
    LocalPlane,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_z,
    split_pose,
)
from placegraph.errors import GeoPoseError, OptionError

CAMERA_FROM_BODY = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""Axes of a GeoPose's body (x right, y forward, z up) in a camera's (x right, y down, z forward)."""


@dataclass(frozen=True, eq=False)
class EarthPose:
    """Pose on Earth; unknown numbers are NaN, in the covariance too."""

    longitude: float
    latitude: float
    """[deg, WGS84]."""
    height: float
    """Height above the ellipsoid [m]."""
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
    def from_place(
        cls, longitude: float, latitude: float, covariance: ArrayLike, *, probability: float = 1.0
    ) -> EarthPose:
        """Return a place with covariance (2, 2) east-north [m^2], of unknown height and orientation."""
        full = np.full((6, 6), np.nan)
        full[:2, :2] = covariance
        return cls(longitude, latitude, np.nan, np.full(4, np.nan), full, probability)

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> EarthPose:
        """Undo `to_dict`; `KeyError`, `TypeError` or `ValueError` where it is no pose."""
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
        """Heading clockwise from north [rad, 0 to 2 pi), the yaw of `geometry.split_pose`."""
        if not np.isfinite(self.quaternion).all():
            return np.nan
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_from_quaternion(self.quaternion) @ CAMERA_FROM_BODY.T
        if not np.isfinite(matrix).all():
            return np.nan
        return float((np.pi / 2.0 - split_pose(matrix)[0][3]) % (2.0 * np.pi))

    @property
    def unknown(self) -> tuple[str, ...]:
        """Those of ``height`` and ``orientation`` that are unknown."""
        pairs = (("height", self.height), ("orientation", self.quaternion))
        return tuple(name for name, value in pairs if not np.isfinite(value).all())

    @property
    def accuracy(self) -> dict[str, float | None]:
        """Root mean variances: ``position`` over the known axes [m], ``orientation`` [deg] or None."""
        variances, unknown = np.diag(self.covariance), self.unknown
        metres = sqrt(float(variances[: 2 if "height" in unknown else 3].mean()))
        degrees = float(np.degrees(np.sqrt(variances[3:].mean())))
        return {"position": metres, "orientation": None if "orientation" in unknown else degrees}

    def geopose(self) -> dict[str, Any]:
        """Return OGC GeoPose 1.0, Basic-Quaternion, with ``accuracy``, ``probability``, ``unknown``.

        The frame is east, north, up at the position; the body's axes are x right, y forward, z up.
        Since the standard demands numbers, an unknown height is 0, an unknown orientation the identity.
        """
        quaternion = self.quaternion if "orientation" not in self.unknown else np.eye(4)[3]
        height = 0.0 if "height" in self.unknown else self.height
        return {
            "position": {"lat": self.latitude, "lon": self.longitude, "h": height},
            "quaternion": dict(zip("xyzw", quaternion.tolist(), strict=True)),
            "accuracy": self.accuracy,
            "probability": self.probability,
            "unknown": list(self.unknown),
        }

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, None for unknown ones."""
        heading = np.degrees(self.heading)
        return {
            "longitude": self.longitude,
            "latitude": self.latitude,
            "height": self.height if np.isfinite(self.height) else None,
            "heading_deg": float(heading) if np.isfinite(heading) else None,
            "quaternion": _nan_to_none(self.quaternion),
            "covariance": [_nan_to_none(row) for row in self.covariance],
            "probability": self.probability,
            "level": self.level,
            "room": self.room,
            "building": self.building,
            "osm": self.osm,
        }


def _nan_to_none(numbers: Floats) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in numbers.tolist()]


_AXIS = WGS84_A * sqrt(1.0 - WGS84_E2)  # semi-minor axis [m]


def ecef_from_geodetic(lonlath: ArrayLike) -> Floats:
    """Return Earth-centred points (..., 3) [m] of longitude, latitude [deg] and height [m] (..., 3)."""
    lon, lat, height = np.moveaxis(np.asarray(lonlath, np.float64), -1, 0)
    lon, lat = np.radians(lon), np.radians(lat)
    prime_vertical = WGS84_A / np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    across = (prime_vertical + height) * np.cos(lat)
    up = (prime_vertical * (1.0 - WGS84_E2) + height) * np.sin(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), up], axis=-1)


def geodetic_from_ecef(points: ArrayLike) -> Floats:
    """Return longitude, latitude [deg] and height [m] (..., 3) of Earth-centred points (..., 3) [m].

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
    """Return the rotation (3, 3) from the axes east, north, up at a place [deg] to Earth-centred axes."""
    lon, lat = np.radians(longitude), np.radians(latitude)
    sl, cl, sp, cp = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    return np.array([[-sl, -sp * cl, cp * cl], [cl, -sp * sl, cp * sl], [0.0, cp, sp]])


MAX_HEIGHT = 1e5
"""Largest height of a map above or below the ellipsoid [m]."""


@dataclass(frozen=True, eq=False)
class Anchor:
    """Georeference of a scene map: one candidate for its position, height and heading on Earth.

    Raises `OptionError` where a number is out of its range.
    """

    longitude: float
    latitude: float
    """Position of the map's origin (0, 0, 0) [deg, WGS84]."""
    height: float
    """Height of the map's z = 0 above the ellipsoid [m]."""
    heading: float
    """Direction of the map's y axis, clockwise from north [rad, 0 to 2 pi); 0: x east, y north."""
    covariance: Floats = field(default_factory=lambda: np.zeros((4, 4)), repr=False)
    """(4, 4) float64 of east, north, up [m] and heading [rad]; all zero where it is unknown, which
    counts as exact."""
    building: str = ""
    """Name of the building."""
    osm: str = ""
    """Id of the building, such as ``way/123``."""
    level: str = ""
    """OpenStreetMap's level of the map's floor, such as ``1``."""
    probability: float = 1.0
    """Probability of this candidate."""
    method: str = ""
    """Method that found it."""
    residuals: tuple[float, ...] = field(default=(), repr=False)
    """Distance of each fitted point from its target [m]."""
    scene: str = ""
    """Merged scene that it georeferences; empty: the whole map."""

    def __post_init__(self) -> None:
        values = {}
        for name, bound in (("longitude", 180.0), ("latitude", 90.0), ("height", MAX_HEIGHT)):
            values[name] = float(getattr(self, name))
            if not abs(values[name]) <= bound:
                raise OptionError(
                    f"anchor: {name} is {values[name]:g}; it must be between {-bound:g} and "
                    f"{bound:g}."
                )
        heading, probability = float(self.heading), float(self.probability)
        if not np.isfinite(heading):
            raise OptionError(f"anchor: heading is {heading}; it must be an angle in radians.")
        if not 0.0 < probability <= 1.0:
            raise OptionError(
                f"anchor: probability is {probability:g}; it must be greater than 0 and at most 1."
            )
        residuals = tuple(float(r) for r in self.residuals)
        if not all(np.isfinite(r) and r >= 0 for r in residuals):
            raise OptionError("anchor: residuals must be finite lengths in metres, 0 or more.")
        covariance = np.array(self.covariance, np.float64)
        if covariance.shape != (4, 4) or not np.isfinite(covariance).all():
            raise OptionError(
                f"anchor: covariance is {covariance.shape}; it must be (4, 4) finite numbers."
            )
        covariance = (covariance + covariance.T) / 2.0
        eigenvalues = np.linalg.eigvalsh(covariance)
        if eigenvalues[0] < -1e-9 * max(1.0, float(eigenvalues[-1])):
            raise OptionError(
                "anchor: covariance is invalid, because an eigenvalue is negative; give a "
                "positive semidefinite matrix."
            )
        covariance.flags.writeable = False
        heading %= 2.0 * np.pi
        values |= {"heading": heading if heading < 2.0 * np.pi else 0.0, "probability": probability}
        for name, value in {**values, "residuals": residuals, "covariance": covariance}.items():
            object.__setattr__(self, name, value)

    @property
    def has_covariance(self) -> bool:
        """Whether the covariance is known."""
        return bool(self.covariance.any())

    @property
    def enu_from_map(self) -> Floats:
        """Transform (4, 4) from the map to the axes east, north, up at its origin [m]."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation_z(-self.heading)
        return matrix

    @property
    def ecef_from_map(self) -> Floats:
        """Transform (4, 4) from the map to the Earth-centred frame [m]."""
        matrix = np.eye(4)
        matrix[:3, :3] = ecef_from_enu(self.longitude, self.latitude) @ self.enu_from_map[:3, :3]
        matrix[:3, 3] = ecef_from_geodetic((self.longitude, self.latitude, self.height))
        return matrix

    def to_earth(self, points: ArrayLike) -> Floats:
        """Return longitude, latitude [deg] and height [m] (..., 3) of the map's points (..., 3) [m]."""
        matrix = self.ecef_from_map
        return geodetic_from_ecef(np.asarray(points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3])

    def to_map(self, lonlath: ArrayLike) -> Floats:
        """Return the map's points (..., 3) [m] at longitude, latitude [deg] and height [m] (..., 3)."""
        matrix = self.ecef_from_map
        return np.asarray((ecef_from_geodetic(lonlath) - matrix[:3, 3]) @ matrix[:3, :3])

    def shift_origin(self, shift: ArrayLike, *, scene: str = "") -> Anchor:
        """Return the anchor of the same map after its points were shifted by (3,) [m]."""
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
        """Return the pose on Earth of a camera in the map.

        Parameters
        ----------
        map_from_camera
            (4, 4) [m].
        covariance
            (6, 6) of x, y, z [m] and of a turn about the map's axes [rad], as in `PoseMode`; None:
            exact. The anchor's covariance is propagated and added.
        probability
            Probability of the pose in the map; it is multiplied by the anchor's.
        room, storey
            Name of the room, and storeys above the map's floor, added to a numeric level.

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
            self.probability * probability, _raise_level(self.level, storey), room, self.building,
            self.osm,
        )  # fmt: skip

    def pose_in_box(self, box: ArrayLike, *, probability: float = 1.0) -> EarthPose:
        """Return the pose of a camera anywhere in a box (2, 3) of the map [m], of any orientation."""
        low, high = np.asarray(box, np.float64)
        middle, spread = np.eye(4), np.zeros((6, 6))
        middle[:3, 3] = (low + high) / 2.0
        np.fill_diagonal(spread[:3, :3], (high - low) ** 2 / 12.0)
        there = self.pose(middle, spread, probability=probability)
        covariance = there.covariance.copy()
        covariance[3:] = covariance[:, 3:] = np.nan
        return replace(there, quaternion=np.full(4, np.nan), covariance=covariance)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, as stored in the map file."""
        return asdict(self) | {
            "covariance": self.covariance.tolist(),
            "residuals": list(self.residuals),
        }

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """Undo `to_dict`; `OptionError`, `TypeError` or `ValueError` where it is no anchor."""
        texts = {"building", "osm", "level", "method", "scene"}
        values = {f.name: plain[f.name] for f in fields(cls) if f.name in plain}
        if wrong := [name for name in texts & values.keys() if not isinstance(values[name], str)]:
            raise OptionError(f"anchor: {wrong[0]} is not text.")
        return cls(**values)


def no_anchor_error(scene: str) -> GeoPoseError:
    """Return the error for a scene map without an anchor."""
    return GeoPoseError(
        f"The scene map {scene!r} is not georeferenced; anchor it with `placegraph scene anchor`."
    )


def _raise_level(level: str, storeys: int) -> str:
    """Return OpenStreetMap's level so many storeys up, if it is a number."""
    try:
        number = float(level)
    except ValueError:
        return level
    return f"{number + storeys:g}" if storeys and np.isfinite(number) else level


def sort_anchors(anchors: Iterable[Anchor], scenes: Sequence[str]) -> tuple[Anchor, ...]:
    """Return candidate anchors of a map of merged scenes, best first.

    Raises `OptionError` where probabilities of a scene exceed 1, or a scene is unknown.
    """
    best_first = tuple(sorted(anchors, key=lambda anchor: -anchor.probability))
    for scene in scenes:
        total = sum(a.probability for a in best_first if a.scene in {"", scene})
        if total > 1.0 + 1e-6:
            raise OptionError(
                f"anchors: the probabilities of the candidates of {scene!r} add up to "
                f"{total:.2f}; they must not exceed 1."
            )
    if unknown := [a.scene for a in best_first if a.scene not in {"", *scenes}]:
        raise OptionError(
            f"anchors: {unknown[0]!r} is not a scene of the map; use its scene names."
        )
    return best_first


MAX_ZOOM = 16
"""Finest zoom: tiles of 600 m at the equator."""
MAX_LATITUDE = 85.0511287
"""Latitude at which the projection ends [deg]; the last rows reach to the poles."""
EQUATOR_LENGTH = 40_075_016.7
"""Length of the equator [m]."""


class Box(NamedTuple):
    """Edges of a box: longitudes and latitudes [deg], or east and north [m]."""

    west: float
    south: float
    east: float
    north: float

    @property
    def center(self) -> tuple[float, float]:
        """Middle of the box."""
        return (self.west + self.east) / 2.0, (self.south + self.north) / 2.0

    def expand(self, metres: float) -> Box:
        """Return a box [deg] with a margin; its west may lie beyond the date line."""
        middle, latitude = self.center
        across, along = metres / np.array(LocalPlane(middle, latitude).metres_per_degree)
        return Box(self.west - across, self.south - along, self.east + across, self.north + along)


def tile_coordinates(lonlat: NDArray[np.float64], zoom: int) -> NDArray[np.float64]:
    """Return fractional columns and rows (N, 2) of positions (N, 2) [deg]."""
    sine = np.sin(np.radians(np.clip(lonlat[:, 1], -MAX_LATITUDE, MAX_LATITUDE)))
    rows = 0.5 - np.arctanh(sine) / (2.0 * np.pi)
    found: NDArray[np.float64] = np.stack([lonlat[:, 0] / 360.0 + 0.5, rows], 1) * 2.0**zoom
    return found


def tile_ranges(
    low: NDArray[np.float64], high: NDArray[np.float64], zoom: int, margin: float
) -> NDArray[np.int64]:
    """Return first column, first row, last column, last row (N, 4) that boxes with a margin [m] touch.

    `low` and `high` are the south-western and north-eastern corners (N, 2) [deg]. Columns go beyond
    the grid at the date line: take them modulo 2^zoom.
    """
    farthest = np.minimum(np.maximum(np.abs(low[:, 1]), np.abs(high[:, 1])), MAX_LATITUDE)
    wide = margin * 1.01 * 2.0**zoom / (EQUATOR_LENGTH * np.cos(np.radians(farthest)))
    west, east = tile_coordinates(low, zoom), tile_coordinates(high, zoom)
    ends = np.stack([west[:, 0] - wide, east[:, 1] - wide, east[:, 0] + wide, west[:, 1] + wide], 1)
    found = np.floor(ends).astype(np.int64)
    found[:, 1::2] = np.clip(found[:, 1::2], 0, 2**zoom - 1)
    return found


def tiles_at(lonlat: NDArray[np.float64], zoom: int) -> NDArray[np.int64]:
    """Return column and row (N, 2) of the tiles that hold positions (N, 2) [deg]."""
    found = np.floor(tile_coordinates(lonlat, zoom)).astype(np.int64)
    found[:, 0] %= 1 << zoom
    found[:, 1] = np.clip(found[:, 1], 0, (1 << zoom) - 1)
    return found


def are_in_tile(lonlat: NDArray[np.float64], key: str) -> NDArray[np.bool_]:
    """Return which positions (N, 2) [deg] lie in a tile (N,); each lies in one tile of a zoom."""
    column, row, zoom = parse_tile_key(key)
    found: NDArray[np.bool_] = (tiles_at(lonlat, zoom) == (column, row)).all(axis=1)
    return found


def tile_key(column: int, row: int, zoom: int) -> str:
    """Return the quadkey of a tile; the column wraps around the Earth."""
    column %= 1 << zoom
    bits = range(zoom - 1, -1, -1)
    return "".join(str((column >> bit & 1) + 2 * (row >> bit & 1)) for bit in bits)


def key_at(longitude: float, latitude: float, zoom: int) -> str:
    """Return the quadkey of the tile at a position [deg]."""
    column, row = tiles_at(np.array([[longitude, latitude]]), zoom)[0].tolist()
    return tile_key(column, row, zoom)


def parse_tile_key(key: str) -> tuple[int, int, int]:
    """Return column, row and zoom of a quadkey; `OptionError` where it is none."""
    if not set(key) <= set("0123") or len(key) > MAX_ZOOM:
        raise OptionError(
            f"{key!r} is not a tile key; it must have at most {MAX_ZOOM} digits from 0 to 3."
        )
    digits = [int(digit) for digit in key]
    column = sum((digit & 1) << bit for bit, digit in enumerate(reversed(digits)))
    row = sum((digit >> 1) << bit for bit, digit in enumerate(reversed(digits)))
    return column, row, len(key)


def tile_bounds(key: str) -> Box:
    """Return the box of a tile [deg]."""
    column, row, zoom = parse_tile_key(key)
    n = 1 << zoom
    edges = np.array([row + 1, row]) / n
    south, north = np.degrees(np.arctan(np.sinh(np.pi * (1.0 - 2.0 * edges)))).tolist()
    south = -90.0 if row == n - 1 else south
    north = 90.0 if row == 0 else north
    return Box(column / n * 360.0 - 180.0, south, (column + 1) / n * 360.0 - 180.0, north)


def check_zoom(zoom: int) -> None:
    """Raise `OptionError` where a zoom is out of range."""
    if isinstance(zoom, bool) or not isinstance(zoom, int) or not 1 <= zoom <= MAX_ZOOM:
        raise OptionError(f"zoom is {zoom!r}; choose a whole number from 1 to {MAX_ZOOM}.")
