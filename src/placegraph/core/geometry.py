"""Geometry of the ground floor: the local east-north plane, and poses.

Bearings are radians clockwise from north, as on a compass: north 0, east pi/2. Yaw is radians
counter-clockwise from the map's x axis, seen from above. Conventions: `docs/conventions.md`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.camera_models import Camera as Camera  # noqa: PLC0414 - found here too

Floats = NDArray[np.float64]

WGS84_A = 6_378_137.0
"""Semi-major axis of the WGS84 ellipsoid [m]."""
WGS84_E2 = 6.694_379_990_14e-3
"""First eccentricity of the WGS84 ellipsoid, squared."""


@dataclass(frozen=True, slots=True)
class LocalPlane:
    """East-north metric plane that touches WGS84 at an origin.

    Metres per degree come from the ellipsoid's radii of curvature at the origin. The scale is
    exact at the origin's latitude; 15 km north or south of it, lengths from west to east are off
    by 0.24 % times the tangent of the latitude (0.24 % at 45 degrees, 0.42 % at 60).
    """

    longitude: float
    """Origin [deg]."""
    latitude: float
    """Origin [deg]."""

    @property
    def metres_per_degree(self) -> tuple[float, float]:
        """Metres per degree of longitude and of latitude at the origin."""
        phi = radians(self.latitude)
        w2 = 1.0 - WGS84_E2 * (1.0 - cos(phi) ** 2)
        prime_vertical = WGS84_A / sqrt(w2)
        meridian = WGS84_A * (1.0 - WGS84_E2) / w2**1.5
        return radians(prime_vertical * cos(phi)), radians(meridian)

    def to_plane(self, lonlat: ArrayLike) -> Floats:
        """Longitude and latitude (..., 2) [deg] to east and north (..., 2) [m]."""
        delta = np.asarray(lonlat, np.float64) - (self.longitude, self.latitude)
        delta[..., 0] = (delta[..., 0] + 180.0) % 360.0 - 180.0  # across the date line
        return delta * self.metres_per_degree

    def to_lonlat(self, east_north: ArrayLike) -> Floats:
        """East and north (..., 2) [m] to longitude and latitude (..., 2) [deg]."""
        degrees = np.asarray(east_north, np.float64) / self.metres_per_degree
        degrees += (self.longitude, self.latitude)
        degrees[..., 0] = (degrees[..., 0] + 180.0) % 360.0 - 180.0
        return degrees


def bearing(delta: ArrayLike) -> Floats:
    """Bearing (...) [rad, 0 to 2 pi, clockwise from north] of vectors (..., 2) east, north."""
    delta = np.asarray(delta, np.float64)
    turn: Floats = np.arctan2(delta[..., 0], delta[..., 1]) % (2.0 * np.pi)
    turn *= turn < 2.0 * np.pi  # a hair west of north rounds to a full turn
    return turn


def angle_between(a: ArrayLike, b: ArrayLike) -> Floats:
    """Smallest angle (...) [rad, 0 to pi] between two bearings."""
    difference = np.abs(np.asarray(a, np.float64) - np.asarray(b, np.float64)) % (2.0 * np.pi)
    return np.minimum(difference, 2.0 * np.pi - difference)


# ------------------------------------------------------------------------------------- poses
#
# A pose of four degrees of freedom is (x, y, z, yaw) of the camera in the map. The other two, the
# tilt, are known from gravity: `level_from_camera` stands the camera upright, and then
# map_from_camera = translation(x, y, z) @ rotation_z(yaw) @ level_from_camera.

_UPRIGHT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""level_from_camera of a camera held upright: forward is x, left is y, up is z."""
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""Of a camera about its optical axis."""


def wrap(angle: ArrayLike) -> Floats:
    """Angles (...) [rad] to the same directions in [-pi, pi)."""
    return (np.asarray(angle, np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def level_from_camera(gravity: ArrayLike) -> Floats:
    """Rotation (..., 3, 3) from camera axes to the level frame (z up, x forward of the camera).

    `gravity`: (..., 3), direction of gravity in the camera's axes, of any length. The rotation is
    the smallest that brings gravity to the upright camera's down, so that it is defined for a
    camera that looks straight down or up too. A camera held upside down is turned about its
    optical axis; yaw is not continuous there.
    """
    down = np.asarray(gravity, np.float64)
    down = down / np.linalg.norm(down, axis=-1, keepdims=True)
    # Rodrigues from `down` to (0, 1, 0): R = I + [v] + [v]^2 / (1 + c), v = down x (0, 1, 0)
    v = np.stack([-down[..., 2], np.zeros(down.shape[:-1]), down[..., 0]], axis=-1)
    c, square = down[..., 1], np.sum(v * v, axis=-1)
    cross = np.zeros((*down.shape[:-1], 3, 3))
    cross[..., 0, 1], cross[..., 0, 2] = -v[..., 2], v[..., 1]
    cross[..., 1, 0], cross[..., 1, 2] = v[..., 2], -v[..., 0]
    cross[..., 2, 0], cross[..., 2, 1] = -v[..., 1], v[..., 0]
    # 1 / (1 + c) loses its digits near c = -1; there it is (1 - c) / |v|^2
    inverse = np.where(c > 0, 1.0 / np.maximum(1.0 + c, 1.0), (1.0 - c) / np.maximum(square, 1e-24))
    least = np.eye(3) + cross + cross @ cross * inverse[..., None, None]
    over = (c < 0) & (square < 1e-24)
    turned: Floats = _UPRIGHT @ np.where(over[..., None, None], _HALF_TURN, least)
    return turned


def rotation_z(yaw: ArrayLike) -> Floats:
    """Rotations (..., 3, 3) by `yaw` (...) [rad] about z."""
    yaw = np.asarray(yaw, np.float64)
    rotation = np.zeros((*yaw.shape, 3, 3))
    rotation[..., 0, 0] = rotation[..., 1, 1] = np.cos(yaw)
    rotation[..., 1, 0] = np.sin(yaw)
    rotation[..., 0, 1] = -rotation[..., 1, 0]
    rotation[..., 2, 2] = 1.0
    return rotation


def pose_matrix(pose: ArrayLike, level: ArrayLike) -> Floats:
    """map_from_camera (..., 4, 4) of poses (..., 4) x, y, z [m], yaw [rad] and tilt (..., 3, 3)."""
    pose = np.asarray(pose, np.float64)
    matrix = np.zeros((*pose.shape[:-1], 4, 4))
    matrix[..., :3, :3] = rotation_z(pose[..., 3]) @ np.asarray(level, np.float64)
    matrix[..., :3, 3] = pose[..., :3]
    matrix[..., 3, 3] = 1.0
    return matrix


def split_pose(map_from_camera: ArrayLike) -> tuple[Floats, Floats]:
    """Pose (..., 4) x, y, z, yaw and tilt `level_from_camera` (..., 3, 3) of matrices (..., 4, 4)."""
    matrix = np.asarray(map_from_camera, np.float64)
    rotation = matrix[..., :3, :3]
    level = level_from_camera(-rotation[..., 2, :])  # gravity is -z of the map
    yawed = rotation @ np.swapaxes(level, -1, -2)
    yaw = np.arctan2(yawed[..., 1, 0], yawed[..., 0, 0])
    return np.concatenate([matrix[..., :3, 3], yaw[..., None]], axis=-1), level


def compose(pose: ArrayLike, step: ArrayLike) -> Floats:
    """Pose (..., 4) followed by a step (..., 4) in its own level frame: Eq. 1's circled plus."""
    pose, step = np.asarray(pose, np.float64), np.asarray(step, np.float64)
    c, s = np.cos(pose[..., 3]), np.sin(pose[..., 3])
    return np.stack(
        [
            pose[..., 0] + c * step[..., 0] - s * step[..., 1],
            pose[..., 1] + s * step[..., 0] + c * step[..., 1],
            pose[..., 2] + step[..., 2],
            wrap(pose[..., 3] + step[..., 3]),
        ],
        axis=-1,
    )


def between(pose: ArrayLike, other: ArrayLike) -> Floats:
    """Step (..., 4) that leads from `pose` to `other`: compose(pose, between(pose, other)) = other."""
    pose, other = np.asarray(pose, np.float64), np.asarray(other, np.float64)
    c, s = np.cos(pose[..., 3]), np.sin(pose[..., 3])
    d = other - pose
    return np.stack(
        [
            c * d[..., 0] + s * d[..., 1],
            c * d[..., 1] - s * d[..., 0],
            d[..., 2],
            wrap(d[..., 3]),
        ],
        axis=-1,
    )


def rotation_from_quaternion(xyzw: ArrayLike) -> Floats:
    """Rotations (..., 3, 3) of quaternions (..., 4) x, y, z, w; they are normalised first."""
    q = np.asarray(xyzw, np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: ArrayLike) -> Floats:
    """Unit quaternions (..., 4) x, y, z, w with w >= 0 of rotations (..., 3, 3)."""
    r = np.asarray(rotation, np.float64)
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    # Four times the outer product of the quaternion with itself; its longest row is best rounded.
    outer = np.empty((*r.shape[:-2], 4, 4))
    outer[..., 0, 0], outer[..., 1, 1] = 1 + xx - yy - zz, 1 - xx + yy - zz
    outer[..., 2, 2], outer[..., 3, 3] = 1 - xx - yy + zz, 1 + xx + yy + zz
    for i, j, value in (
        (0, 1, r[..., 1, 0] + r[..., 0, 1]),
        (0, 2, r[..., 0, 2] + r[..., 2, 0]),
        (1, 2, r[..., 2, 1] + r[..., 1, 2]),
        (0, 3, r[..., 2, 1] - r[..., 1, 2]),
        (1, 3, r[..., 0, 2] - r[..., 2, 0]),
        (2, 3, r[..., 1, 0] - r[..., 0, 1]),
    ):
        outer[..., i, j] = outer[..., j, i] = value
    best = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    upright: Floats = np.where(q[..., 3:] < 0, -q, q)
    return upright


def rotation_from_vector(vector: ArrayLike) -> Floats:
    """Rotations (..., 3, 3) of rotation vectors (..., 3) [rad]: axis times angle (Rodrigues)."""
    w = np.asarray(vector, np.float64)
    angle = np.linalg.norm(w, axis=-1)[..., None, None]
    small = angle < 1e-6  # there sin(a)/a and (1 - cos a)/a^2 are their limits to all digits
    a = np.where(small, 1.0, angle)
    cross = cross_matrix(w)
    first = np.where(small, 1.0, np.sin(a) / a)
    second = np.where(small, 0.5, 2.0 * np.sin(0.5 * a) ** 2 / a**2)
    rotation: Floats = np.eye(3) + first * cross + second * (cross @ cross)
    return rotation


def vector_from_rotation(rotation: ArrayLike) -> Floats:
    """Rotation vectors (..., 3) [rad, shorter than pi] of rotations (..., 3, 3)."""
    q = quaternion_from_rotation(rotation)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    scale = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    vector: Floats = q[..., :3] * scale
    return vector


def cross_matrix(vector: ArrayLike) -> Floats:
    """Matrices (..., 3, 3) with [a] b = a x b of vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(vector, np.float64), -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
