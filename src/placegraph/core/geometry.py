"""Geometry: the local east-north plane, poses, and camera models.

Bearings are radians clockwise from north, as on a compass: north 0, east pi/2. Yaw is radians
counter-clockwise from the map's x axis, seen from above. Conventions: `docs/conventions.md`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import cos, radians, sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.errors import OptionError

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
        """Convert longitude and latitude (..., 2) [deg] to east and north (..., 2) [m]."""
        delta = np.asarray(lonlat, np.float64) - (self.longitude, self.latitude)
        delta[..., 0] = (delta[..., 0] + 180.0) % 360.0 - 180.0  # across the date line
        return delta * self.metres_per_degree

    def to_lonlat(self, east_north: ArrayLike) -> Floats:
        """Convert east and north (..., 2) [m] to longitude and latitude (..., 2) [deg]."""
        degrees = np.asarray(east_north, np.float64) / self.metres_per_degree
        degrees += (self.longitude, self.latitude)
        degrees[..., 0] = (degrees[..., 0] + 180.0) % 360.0 - 180.0
        return degrees


def bearing(delta: ArrayLike) -> Floats:
    """Return the bearing (...) [rad, 0 to 2 pi, clockwise from north] of vectors (..., 2) east, north."""
    delta = np.asarray(delta, np.float64)
    turn: Floats = np.arctan2(delta[..., 0], delta[..., 1]) % (2.0 * np.pi)
    turn *= turn < 2.0 * np.pi  # a hair west of north rounds to a full turn
    return turn


def angle_between(a: ArrayLike, b: ArrayLike) -> Floats:
    """Return the smallest angle (...) [rad, 0 to pi] between two bearings."""
    difference = np.abs(np.asarray(a, np.float64) - np.asarray(b, np.float64)) % (2.0 * np.pi)
    return np.minimum(difference, 2.0 * np.pi - difference)


# A pose of four degrees of freedom is (x, y, z, yaw) of the camera in the map. The other two, the
# tilt, are known from gravity: `level_from_camera` turns the camera upright, and then
# map_from_camera = translation(x, y, z) @ rotation_z(yaw) @ level_from_camera.

_UPRIGHT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""level_from_camera of a camera held upright: forward is x, left is y, up is z."""
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])
"""Rotation of a camera about its optical axis."""


def wrap_angle(angle: ArrayLike) -> Floats:
    """Return angles (...) [rad] wrapped to [-pi, pi)."""
    return (np.asarray(angle, np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def level_from_camera(gravity: ArrayLike) -> Floats:
    """Return the rotation (..., 3, 3) from camera axes to the level frame (z up, x forward).

    `gravity`: (..., 3), direction of gravity in the camera's axes, of any length. The rotation is the
    smallest that brings gravity to the upright camera's down, which also works for a camera that looks
    straight down or up. A camera held upside down is turned about its optical axis; yaw is not
    continuous there.
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
    """Return rotations (..., 3, 3) by `yaw` (...) [rad] about z."""
    yaw = np.asarray(yaw, np.float64)
    rotation = np.zeros((*yaw.shape, 3, 3))
    rotation[..., 0, 0] = rotation[..., 1, 1] = np.cos(yaw)
    rotation[..., 1, 0] = np.sin(yaw)
    rotation[..., 0, 1] = -rotation[..., 1, 0]
    rotation[..., 2, 2] = 1.0
    return rotation


def pose_matrix(pose: ArrayLike, level: ArrayLike) -> Floats:
    """Return map_from_camera (..., 4, 4) of poses (..., 4) x, y, z [m], yaw [rad], tilt (..., 3, 3)."""
    pose = np.asarray(pose, np.float64)
    matrix = np.zeros((*pose.shape[:-1], 4, 4))
    matrix[..., :3, :3] = rotation_z(pose[..., 3]) @ np.asarray(level, np.float64)
    matrix[..., :3, 3] = pose[..., :3]
    matrix[..., 3, 3] = 1.0
    return matrix


def split_pose(map_from_camera: ArrayLike) -> tuple[Floats, Floats]:
    """Split matrices (..., 4, 4) into poses (..., 4) x, y, z, yaw and tilt `level_from_camera`."""
    matrix = np.asarray(map_from_camera, np.float64)
    rotation = matrix[..., :3, :3]
    level = level_from_camera(-rotation[..., 2, :])  # gravity is -z of the map
    yawed = rotation @ np.swapaxes(level, -1, -2)
    yaw = np.arctan2(yawed[..., 1, 0], yawed[..., 0, 0])
    return np.concatenate([matrix[..., :3, 3], yaw[..., None]], axis=-1), level


def compose(pose: ArrayLike, step: ArrayLike) -> Floats:
    """Return poses (..., 4) followed by steps (..., 4) in their level frames: Eq. 1's circled plus."""
    pose, step = np.asarray(pose, np.float64), np.asarray(step, np.float64)
    c, s = np.cos(pose[..., 3]), np.sin(pose[..., 3])
    return np.stack(
        [
            pose[..., 0] + c * step[..., 0] - s * step[..., 1],
            pose[..., 1] + s * step[..., 0] + c * step[..., 1],
            pose[..., 2] + step[..., 2],
            wrap_angle(pose[..., 3] + step[..., 3]),
        ],
        axis=-1,
    )


def between(pose: ArrayLike, other: ArrayLike) -> Floats:
    """Return the step (..., 4) from `pose` to `other`: compose(pose, between(pose, other)) = other."""
    pose, other = np.asarray(pose, np.float64), np.asarray(other, np.float64)
    c, s = np.cos(pose[..., 3]), np.sin(pose[..., 3])
    d = other - pose
    return np.stack(
        [
            c * d[..., 0] + s * d[..., 1],
            c * d[..., 1] - s * d[..., 0],
            d[..., 2],
            wrap_angle(d[..., 3]),
        ],
        axis=-1,
    )


def rotation_from_quaternion(xyzw: ArrayLike) -> Floats:
    """Return rotations (..., 3, 3) of quaternions (..., 4) x, y, z, w, which are normalized first."""
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
    """Return unit quaternions (..., 4) x, y, z, w with w >= 0 of rotations (..., 3, 3)."""
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
    """Return rotations (..., 3, 3) of rotation vectors (..., 3) [rad]: axis times angle (Rodrigues)."""
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
    """Return rotation vectors (..., 3) [rad, shorter than pi] of rotations (..., 3, 3)."""
    q = quaternion_from_rotation(rotation)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    scale = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    vector: Floats = q[..., :3] * scale
    return vector


def cross_matrix(vector: ArrayLike) -> Floats:
    """Return matrices (..., 3, 3) with [a] b = a x b of vectors (..., 3)."""
    x, y, z = np.moveaxis(np.asarray(vector, np.float64), -1, 0)
    o = np.zeros_like(x)
    rows = [[o, -z, y], [z, o, -x], [-y, x, o]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


MODELS = ("opencv", "fisheye")
COEFFICIENT_COUNTS = {"opencv": (0, 4, 5, 8), "fisheye": (0, 4)}
"""Numbers of distortion coefficients of each model; 0: no distortion."""
MAX_FISHEYE_ANGLE = radians(85.0)
"""Largest angle off a fisheye's axis: rays with z = 1 grow without bound beyond."""
_MAX_PARAMETER = 1e9
REFOCUS = 0.2
"""Largest relative change of a focal length between images of one camera; phones drift by some 4 %."""
_ROUNDS = 100
_NEWTON = 12


@dataclass(frozen=True, slots=True)
class Camera:
    """Camera of one of OpenCV's models; pixel (i, j) has its centre at (i + 0.5, j + 0.5)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()
    """Coefficients of OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]], or the four of its fisheye."""
    model: str = "opencv"
    """`MODELS`: a pinhole ("opencv"), or "fisheye", which shows up to 85 degrees off its axis."""
    focal_error: float = 0.0
    """Standard deviation of the focal lengths, as a share of them; 0: they are calibrated."""

    def __post_init__(self) -> None:
        sizes = (self.width, self.height, self.fx, self.fy)
        if not all(0 < v < _MAX_PARAMETER for v in sizes):
            raise OptionError(
                f"camera: width, height, fx, fy are {sizes}; they must be greater than 0 "
                "and less than 1e9."
            )
        if not all(abs(v) < _MAX_PARAMETER for v in (self.cx, self.cy, *self.distortion)):
            raise OptionError("camera: cx, cy and the distortion must be finite numbers.")
        if self.model not in MODELS:
            raise OptionError(
                f"camera: model is {self.model!r}; choose one of {', '.join(MODELS)}."
            )
        if len(self.distortion) not in COEFFICIENT_COUNTS[self.model]:
            raise OptionError(
                f"camera: {len(self.distortion)} distortion coefficients are given; "
                "OpenCV's model k1, k2, p1, p2[, k3[, k4, k5, k6]] has 4, 5 or 8, its "
                "fisheye model 4."
            )

    @property
    def is_rectilinear(self) -> bool:
        """Whether straight lines stay straight in images."""
        return self.model == "opencv" and not any(self.distortion)

    def resize(self, width: int, height: int) -> Camera:
        """Return the camera with images of another size."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height,
            fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy,
        )  # fmt: skip

    def is_refocused(self, other: Camera) -> bool:
        """Return whether another camera is this one, perhaps refocused: same size, `REFOCUS` of fx, fy."""
        same = (self.width, self.height, self.model) == (other.width, other.height, other.model)
        ratios = self.fx / other.fx, self.fy / other.fy
        return same and all(abs(ratio - 1.0) < REFOCUS for ratio in ratios)

    def directions(self, uv: ArrayLike) -> Floats:
        """Return rays (..., 3) in the camera with z = 1 through image points (..., 2) [px].

        x and y are NaN outside a fisheye's image circle and beyond `MAX_FISHEYE_ANGLE`.
        """
        distorted = (np.asarray(uv, np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        xy = undistort(self.model, self.distortion, distorted)
        return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)

    def project(self, points: ArrayLike) -> Floats:
        """Return image points (..., 2) [px] of points (..., 3) [m] in the camera's axes.

        They are NaN behind the camera, and for a fisheye beyond `MAX_FISHEYE_ANGLE`.
        """
        points = np.asarray(points, np.float64)
        depth = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        distorted = distort(self.model, self.distortion, points[..., :2] / depth)
        uv: Floats = distorted * (self.fx, self.fy) + (self.cx, self.cy)
        return uv

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, as in `camera.json`."""
        out: dict[str, Any] = {
            name: getattr(self, name) for name in ("width", "height", "fx", "fy", "cx", "cy")
        }
        out |= {"distortion": list(self.distortion)} if self.distortion else {}
        return out | ({} if self.model == "opencv" else {"model": self.model})


def distort(model: str, distortion: tuple[float, ...], rays: Floats) -> Floats:
    """Return distorted points (..., 2) of rays (..., 2) with z = 1; NaN beyond a fisheye's range."""
    if model == "fisheye":
        return _fisheye_places(rays, distortion)
    if not any(distortion):
        return rays
    points: Floats = rays * _radial(rays, distortion)[..., None] + _tangential(rays, distortion)
    return points


def undistort(model: str, distortion: tuple[float, ...], points: Floats) -> Floats:
    """Return rays (..., 2) of distorted points (..., 2); NaN beyond a fisheye's range."""
    if model == "fisheye":
        return _fisheye_rays(points, distortion)
    rays = points
    for _ in range(_ROUNDS if any(distortion) else 0):
        # fixed point, as in OpenCV, but until it converges: wide corners need many rounds
        before = rays
        rays = (points - _tangential(rays, distortion)) / _radial(rays, distortion)[..., None]
        if np.abs(rays - before).max(initial=0.0) < 1e-9:
            break
    return rays


def _radial(rays: Floats, distortion: tuple[float, ...]) -> Floats:
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, *(0.0,) * 8)[:8]
    r2 = np.sum(rays * rays, axis=-1)
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    ratio: Floats = above / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return ratio


def _tangential(rays: Floats, distortion: tuple[float, ...]) -> Floats:
    p1, p2 = distortion[2:4]
    x, y = rays[..., 0], rays[..., 1]
    r2 = x * x + y * y
    return np.stack(
        [2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], axis=-1
    )


def _fisheye_places(rays: Floats, distortion: tuple[float, ...]) -> Floats:
    radius = np.linalg.norm(rays, axis=-1)
    angle = np.arctan(radius)
    ratio = angle * _fisheye_radius(angle, distortion)[0] / np.maximum(radius, 1e-12)
    ratio = np.where(radius > 1e-12, ratio, 1.0)
    return rays * np.where(angle <= _max_angle(distortion), ratio, np.nan)[..., None]


def _fisheye_rays(points: Floats, distortion: tuple[float, ...]) -> Floats:
    max_angle = _max_angle(distortion)
    radius = np.linalg.norm(points, axis=-1)
    angle = np.minimum(radius, max_angle)
    for _ in range(_NEWTON):
        ratio, slope = _fisheye_radius(angle, distortion)
        angle = np.clip(angle - (angle * ratio - radius) / np.maximum(slope, 1e-3), 0.0, max_angle)
    scale = np.where(radius > 1e-12, np.tan(angle) / np.maximum(radius, 1e-12), 1.0)
    is_visible = radius <= max_angle * _fisheye_radius(np.asarray(max_angle), distortion)[0]
    return points * np.where(is_visible, scale, np.nan)[..., None]


def _fisheye_radius(angle: Floats, distortion: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Return image radius / angle at angles (...) off the axis, and the radius's derivative."""
    k1, k2, k3, k4 = distortion or (0.0,) * 4
    a2 = angle * angle
    ratio: Floats = 1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))
    slope: Floats = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
    return ratio, slope


@lru_cache(maxsize=16)
def _max_angle(distortion: tuple[float, ...]) -> float:
    """Return the angle up to which the image radius grows, `MAX_FISHEYE_ANGLE` at most."""
    angles = np.linspace(0.0, MAX_FISHEYE_ANGLE, 500)
    folded = np.flatnonzero(_fisheye_radius(angles, distortion)[1] <= 0)
    return float(angles[max(0, folded[0] - 1)]) if len(folded) else MAX_FISHEYE_ANGLE
