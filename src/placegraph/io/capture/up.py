"""Estimation of the up direction of a reconstruction without gravity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError

MEAN_UP = "according to the mean up direction of the images"
"""Reason of `estimated_up` where neither cameras nor surfaces tell more."""
_WINDOWS_ACROSS = 20  # windows along an image's width: some 20 cm at 3 m, which averages noise
_MIN_SIDE = 4  # of a window [px]
_MIN_READ = 0.8  # share of a window that must have readings
_FLATNESS = 0.015  # largest RMS deviation from a plane, relative to depth
_MIN_SPREAD = 0.03  # of the cameras' x axes along their second axis, for several viewing directions
_SEARCH = np.radians(20.0)  # radius about the cameras' up
_PEAK = np.radians(3.0)  # tolerance of votes for a direction
_CORE = np.radians(2.0)  # the same for refinement
_STEPS = 14  # of the search along a radius
_MIN_NORMALS, _MIN_SHARE = 20, 0.1  # evidence that overrides the cameras; share of all normals


def estimated_up(
    rotations: NDArray[np.float64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.float64], str]:
    """Estimate the up direction (3,) from cameras and surfaces; also return how it was found.

    Up is perpendicular to the x axes of level cameras with several viewing directions, else the mean
    up of the images. Of the directions near it, the one to which most surfaces are parallel or
    perpendicular is taken, if there are enough.

    `rotations`: (T, 3, 3) model_from_camera, OpenCV's camera axes; `normals`: (N, 3) of surfaces in the
    model, of either sign; rows with NaN are ignored.
    """
    up = -rotations[:, :, 1].mean(axis=0)
    if np.linalg.norm(up) < 1e-6:
        raise InputError(
            "The cameras have no common up direction; give `up` in the frame of their poses."
        )
    up /= np.linalg.norm(up)
    how = MEAN_UP
    right = rotations[:, :, 0]
    spread, axes = np.linalg.eigh(right.T @ right / len(right))
    level = axes[:, 0] * np.sign(axes[:, 0] @ up)
    if spread[1] > _MIN_SPREAD and level @ up > np.cos(np.pi / 6):
        up, how = level, "the cameras' x axes are level to it"
    voted = vote_for_up(normals[np.isfinite(normals).all(axis=1)], up)
    return (up, how) if voted is None else (voted, "horizontal and vertical surfaces show")


def vote_for_up(
    normals: NDArray[np.float64], about: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the direction (3,) near `about` with most parallel or perpendicular surfaces, or None."""
    side = np.tan(_SEARCH) * np.linspace(-1.0, 1.0, 2 * _STEPS + 1)
    x, y = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2).T
    disk = np.hypot(x, y) <= np.tan(_SEARCH)
    tried = np.stack([x[disk], y[disk], np.ones(disk.sum())], axis=1)
    tried = tried / np.linalg.norm(tried, axis=1, keepdims=True) @ upright(about, np.eye(3)[0])
    towards = np.abs(normals @ tried.T)
    votes = (towards > np.cos(_PEAK)).sum(axis=0) + (towards < np.sin(_PEAK)).sum(axis=0)
    up: NDArray[np.float64] = tried[votes.argmax()]
    for angle in (_PEAK, *[_CORE] * 5):
        towards = np.abs(normals @ up)
        level, wall = normals[towards > np.cos(angle)], normals[towards < np.sin(angle)]
        weights, axes = np.linalg.eigh(level.T @ level - wall.T @ wall)
        up = axes[:, 2] * (1.0 if axes[:, 2] @ up > 0 else -1.0)
    # curvature of the vote about up: 0 for a single wall
    evidence = weights[2] - weights[1]
    is_certain = evidence >= max(_MIN_NORMALS, _MIN_SHARE * len(normals)) and up @ about > np.cos(
        _SEARCH
    )
    return up if is_certain else None


def surface_normals(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float64]:
    """Return the unit normals (N, 3), in camera axes, of the flat windows of a depth image (h, w).

    The inverse depth of a plane is linear in the rays' coordinates; windows across edges are left out.
    """
    side = max(_MIN_SIDE, camera.width // _WINDOWS_ACROSS)
    height, width = camera.height // side * side, camera.width // side * side
    v, u = np.mgrid[:height, :width]
    rays = _windows(camera.directions(np.stack([u + 0.5, v + 0.5], axis=-1)), side)
    z = _windows(depth[:height, :width, None].astype(np.float64), side)[..., 0]
    read = np.isfinite(z) & (z > 0) & np.isfinite(rays).all(axis=2)
    enough = np.count_nonzero(read, axis=1) >= _MIN_READ * side**2
    read, z = read[enough], z[enough]
    rays = np.where(read[..., None], rays[enough], 0.0)
    inverse = np.divide(1.0, z, out=np.zeros_like(z), where=read)
    squares, right = rays.swapaxes(1, 2) @ rays, np.einsum("npi,np->ni", rays, inverse)
    squares += 1e-12 * np.eye(3)  # regularization
    normals = np.linalg.solve(squares, right[..., None])[..., 0]
    count = np.maximum(np.count_nonzero(read, axis=1), 1)
    off = np.einsum("npi,ni->np", rays, normals) - inverse
    flat = np.sqrt((off**2).sum(axis=1) / count) < _FLATNESS * inverse.sum(axis=1) / count
    lengths = np.linalg.norm(normals, axis=1)
    flat &= np.isfinite(lengths) & (lengths > 0)
    unit: NDArray[np.float64] = normals[flat] / lengths[flat, None]
    return unit


def _windows(image: NDArray[np.float64], side: int) -> NDArray[np.float64]:
    """Return the values (N, side * side, C) of an image (h, w, C), h and w being multiples of the side."""
    h, w, c = image.shape
    parts = image.reshape(h // side, side, w // side, side, c).swapaxes(1, 2)
    return parts.reshape(-1, side * side, c)


def upright(up: NDArray[np.float64], ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation (3, 3) that maps the unit vector `up` to z, and the level part of `ahead` to x."""
    x = ahead - up * (ahead @ up)
    if np.linalg.norm(x) < 1e-3:  # straight up or down
        x = np.eye(3)[np.abs(up).argmin()]
        x = x - up * (x @ up)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
