"""Cameras, and how their lenses bend rays: OpenCV's two models, on an image plane of focal length 1.

A ray is x and y where z is 1; a place is where the image shows it. "opencv": a pinhole, whose lens
moves places along the radius and a little across it. "fisheye": the angle off the axis tells how
far from the centre a ray is shown (Kannala and Brandt 2006).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import radians
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.errors import OptionError

Floats = NDArray[np.float64]

MODELS = ("opencv", "fisheye")
COEFFICIENTS = {"opencv": (0, 4, 5, 8), "fisheye": (0, 4)}
"""How many a model may have; 0: an ideal one."""
WIDEST = radians(85.0)
"""Angle off a fisheye's axis beyond which it is not asked: rays with z = 1 grow without end."""
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
    """Of the lens, empty: none. OpenCV's k1, k2, p1, p2[, k3[, k4, k5, k6]]; of a fisheye its four."""
    model: str = "opencv"
    """`MODELS`: a pinhole ("opencv"), or "fisheye", which shows up to 85 degrees off its axis."""

    def __post_init__(self) -> None:
        sizes = (self.width, self.height, self.fx, self.fy)
        if not all(_is_number(v) and v > 0 for v in sizes):
            raise OptionError(
                f"camera: width, height, fx, fy are {sizes}; they must be greater than 0, and below 1e9."
            )
        if not all(map(_is_number, (self.cx, self.cy, *self.distortion))):
            raise OptionError("camera: cx, cy or the distortion is not a number.")
        if self.model not in MODELS:
            raise OptionError(f"camera: model is {self.model!r}; it is one of {', '.join(MODELS)}.")
        if len(self.distortion) not in COEFFICIENTS[self.model]:
            raise OptionError(
                f"camera: {len(self.distortion)} distortion coefficients; OpenCV's "
                "k1, k2, p1, p2[, k3[, k4, k5, k6]] are 4, 5 or 8, those of its fisheye 4."
            )

    @property
    def straight(self) -> bool:
        """Whether straight lines are straight in its images."""
        return self.model == "opencv" and not any(self.distortion)

    def resized(self, width: int, height: int) -> Camera:
        """Intrinsics of the same camera with images of another size."""
        sx, sy = width / self.width, height / self.height
        focal, centre = (self.fx * sx, self.fy * sy), (self.cx * sx, self.cy * sy)
        return Camera(width, height, *focal, *centre, self.distortion, self.model)

    def directions(self, uv: ArrayLike) -> Floats:
        """Rays (..., 3) in the camera with z = 1 through image points (..., 2) [px].

        x and y are NaN where a fisheye's image shows nothing, or what is beyond `WIDEST`.
        """
        places = (np.asarray(uv, np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)
        xy = unbent(self.model, self.distortion, places)
        return np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)

    def project(self, points: ArrayLike) -> Floats:
        """Image points (..., 2) [px] of points (..., 3) [m] in the camera; NaN where it sees none.

        It sees none behind it, and a fisheye none beyond `WIDEST`.
        """
        points = np.asarray(points, np.float64)
        depth = np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
        places = bent(self.model, self.distortion, points[..., :2] / depth)
        uv: Floats = places * (self.fx, self.fy) + (self.cx, self.cy)
        return uv

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, as in `camera.json`."""
        out: dict[str, Any] = {
            name: getattr(self, name) for name in ("width", "height", "fx", "fy", "cx", "cy")
        }
        out |= {"distortion": list(self.distortion)} if self.distortion else {}
        return out | ({} if self.model == "opencv" else {"model": self.model})


def bent(model: str, distortion: tuple[float, ...], rays: Floats) -> Floats:
    """Places (..., 2) of rays (..., 2); NaN where a fisheye shows none."""
    if model == "fisheye":
        return _fisheye_places(rays, distortion)
    if not any(distortion):
        return rays
    places: Floats = rays * _radial(rays, distortion)[..., None] + _tangential(rays, distortion)
    return places


def unbent(model: str, distortion: tuple[float, ...], places: Floats) -> Floats:
    """Rays (..., 2) of places (..., 2); NaN where a fisheye shows nothing."""
    if model == "fisheye":
        return _fisheye_rays(places, distortion)
    rays = places
    for _ in range(_ROUNDS if any(distortion) else 0):
        # fixed point, as OpenCV does, but to its end: wide corners need more than a few rounds
        before = rays
        rays = (places - _tangential(rays, distortion)) / _radial(rays, distortion)[..., None]
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


# -------------------------------------------------------------------------------------- fisheye


def _fisheye_places(rays: Floats, distortion: tuple[float, ...]) -> Floats:
    radius = np.linalg.norm(rays, axis=-1)
    angle = np.arctan(radius)
    ratio = angle * _spread(angle, distortion)[0] / np.maximum(radius, 1e-12)
    ratio = np.where(radius > 1e-12, ratio, 1.0)
    return rays * np.where(angle <= _reach(distortion), ratio, np.nan)[..., None]


def _fisheye_rays(places: Floats, distortion: tuple[float, ...]) -> Floats:
    reach = _reach(distortion)
    radius = np.linalg.norm(places, axis=-1)
    angle = np.minimum(radius, reach)
    for _ in range(_NEWTON):
        share, slope = _spread(angle, distortion)
        angle = np.clip(angle - (angle * share - radius) / np.maximum(slope, 1e-3), 0.0, reach)
    ratio = np.where(radius > 1e-12, np.tan(angle) / np.maximum(radius, 1e-12), 1.0)
    seen = radius <= reach * _spread(np.asarray(reach), distortion)[0]
    return places * np.where(seen, ratio, np.nan)[..., None]


def _spread(angle: Floats, distortion: tuple[float, ...]) -> tuple[Floats, Floats]:
    """Radius over angle (...) at which a fisheye shows it, and the radius's derivative by it."""
    k1, k2, k3, k4 = distortion or (0.0,) * 4
    a2 = angle * angle
    share: Floats = 1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4)))
    slope: Floats = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
    return share, slope


@lru_cache(maxsize=16)
def _reach(distortion: tuple[float, ...]) -> float:
    """Angle up to which what is farther off the axis is shown farther out, `WIDEST` at most."""
    angles = np.linspace(0.0, WIDEST, 500)
    folded = np.flatnonzero(_spread(angles, distortion)[1] <= 0)
    return float(angles[max(0, folded[0] - 1)]) if len(folded) else WIDEST


def _is_number(value: float) -> bool:
    """Whether a value is a number that a camera may have: squares of larger ones are beyond all bounds."""
    return abs(value) < 1e9
