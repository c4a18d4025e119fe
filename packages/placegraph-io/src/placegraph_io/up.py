"""Which way is up in a reconstruction that does not know gravity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError

_ACROSS = 20  # windows of an image along its width: at 3 m some 20 cm, in which noise averages out
_FEWEST_PIXELS = 4  # along a window's side
_READ = 0.8  # part of a window that must have readings
_FLAT = 0.015  # root mean square deviation from a plane, of the depth; more is an edge or is round
_ALONG = 0.03  # mean square of the cameras' x axes on their second axis: they look several ways
_NEAR = np.radians(20.0)  # of the cameras' up, within which up is looked for
_PEAK = np.radians(3.0)  # about a direction, what counts for it
_CORE = np.radians(2.0)  # the same, once up is nearly known
_TRIED = 14  # directions from the cameras' up to that
_FEWEST = 20  # normals that say more than who held the camera
_SHARE = 0.1  # of all normals; of those without order a few per cent agree by chance


def estimated_up(
    rotations: NDArray[np.float64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.float64], str]:
    """Return the up (3,), of unit length, and how it was found, of cameras and of what they see.

    Who holds a camera level holds its x axis level, whatever it looks at: up is at right angles to
    the x axes of cameras that look several ways; where all look one way, it is what is up in their
    images on average. Floor, tables and walls then say it exactly: of the directions near that, up is
    the one to which most surfaces are level or upright. Where few are, the cameras' word stands.

    Parameters
    ----------
    rotations
        (T, 3, 3) model_from_camera, camera axes as OpenCV's.
    normals
        (N, 3) of surfaces in the model, of either sign; rows with NaN are none.

    """
    up = -rotations[:, :, 1].mean(axis=0)
    if np.linalg.norm(up) < 1e-6:
        raise InputError("The cameras have no common up; give up, a direction in their world.")
    up /= np.linalg.norm(up)
    how = "it is up in the images on average"
    right = rotations[:, :, 0]
    spread, axes = np.linalg.eigh(right.T @ right / len(right))
    level = axes[:, 0] * np.sign(axes[:, 0] @ up)
    if spread[1] > _ALONG and level @ up > np.cos(np.pi / 6):
        up, how = level, "the cameras' x axes are level to it"
    told = _told(normals[np.isfinite(normals).all(axis=1)], up)
    return (up, how) if told is None else (told, "level and upright surfaces tell")


def _told(normals: NDArray[np.float64], about: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Direction (3,) near `about` to which most is level or upright; None where that says little."""
    side = np.tan(_NEAR) * np.linspace(-1.0, 1.0, 2 * _TRIED + 1)
    x, y = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2).T
    disk = np.hypot(x, y) <= np.tan(_NEAR)
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
    # what would have to be wrong for up to lean: nothing, of one wall, or of none that agree
    evidence = weights[2] - weights[1]
    sure = evidence >= max(_FEWEST, _SHARE * len(normals)) and up @ about > np.cos(_NEAR)
    return up if sure else None


def surface_normals(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float64]:
    """Return the unit normals (N, 3), in the camera's axes, of flat surfaces seen in a depth image (h, w).

    One a window: of a plane, the inverse of depth is linear in the rays' coordinates, so that all
    readings of a window count and their noise averages out. Windows across edges are left out.
    """
    side = max(_FEWEST_PIXELS, camera.width // _ACROSS)
    height, width = camera.height // side * side, camera.width // side * side
    v, u = np.mgrid[:height, :width]
    rays = _windows(camera.directions(np.stack([u + 0.5, v + 0.5], axis=-1)), side)
    z = _windows(depth[:height, :width, None].astype(np.float64), side)[..., 0]
    read = np.isfinite(z) & (z > 0) & np.isfinite(rays).all(axis=2)
    enough = np.count_nonzero(read, axis=1) >= _READ * side**2
    read, z = read[enough], z[enough]
    rays = np.where(read[..., None], rays[enough], 0.0)
    inverse = np.divide(1.0, z, out=np.zeros_like(z), where=read)
    squares, right = rays.swapaxes(1, 2) @ rays, np.einsum("npi,np->ni", rays, inverse)
    squares += 1e-12 * np.eye(3)  # where a lens bends all rays into one, there is an answer too
    normals = np.linalg.solve(squares, right[..., None])[..., 0]
    count = np.maximum(np.count_nonzero(read, axis=1), 1)
    off = np.einsum("npi,ni->np", rays, normals) - inverse
    flat = np.sqrt((off**2).sum(axis=1) / count) < _FLAT * inverse.sum(axis=1) / count
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
    """Return the rotation (3, 3) that takes the unit vector `up` to z, and `ahead`, without its up, to x."""
    x = ahead - up * (ahead @ up)
    if np.linalg.norm(x) < 1e-3:  # straight up or down
        x = np.eye(3)[np.abs(up).argmin()]
        x = x - up * (x @ up)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
