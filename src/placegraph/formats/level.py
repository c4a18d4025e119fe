"""Which way is up in a reconstruction that does not know gravity."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.geometry import Camera

_ABOUT = 64  # normals of an image along its width
_JUMP = 0.05  # neighbours whose depth differs by more of it are of two surfaces
_ALONG = 0.03  # mean square of the cameras' x axes on their second axis: they look several ways
_NEAR = np.radians([20.0, 10.0, 5.0, 3.0, 2.0, 1.0, 1.0])  # of up, narrower and narrower
_FEWEST = 50  # normals of level surfaces that say more than who held the camera


def estimated_up(
    rotations: NDArray[np.float64], normals: NDArray[np.float64]
) -> tuple[NDArray[np.float64], str]:
    """Up (3,), of unit length, and how it was found, of cameras and of what they see.

    Who holds a camera level holds its x axis level, whatever it looks at: up is at right angles to
    the x axes of cameras that look several ways; where all look one way, it is what is up in their
    images on average. Floor, ceiling and tables, whose normals are near that, then say it exactly.

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
    for angle in _NEAR:
        along = normals @ up
        near = np.abs(along) > np.cos(angle)
        if np.count_nonzero(near) < _FEWEST:
            break
        total = np.sign(along[near]) @ normals[near]
        up, how = total / np.linalg.norm(total), "level surfaces tell"
    return up, how


def surface_normals(depth: NDArray[np.float32], camera: Camera) -> NDArray[np.float64]:
    """Unit normals (N, 3), in the camera's axes, of surfaces seen in a depth image (h, w)."""
    step = max(1, camera.width // _ABOUT)
    v, u = np.mgrid[0 : camera.height : step, 0 : camera.width : step]
    z = depth[v, u].astype(np.float64)
    points = camera.directions(np.stack([u + 0.5, v + 0.5], axis=-1)) * z[..., None]
    right, below = points[:-1, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, :-1]
    normals = np.cross(right, below)
    lengths = np.linalg.norm(normals, axis=-1)
    with np.errstate(invalid="ignore"):
        jump = np.maximum(np.abs(right[..., 2]), np.abs(below[..., 2])) > _JUMP * z[:-1, :-1]
        whole = np.isfinite(lengths) & (lengths > 0) & ~jump
    unit: NDArray[np.float64] = normals[whole] / lengths[whole, None]
    return unit


def upright(up: NDArray[np.float64], ahead: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation (3, 3) that takes the unit vector `up` to z, and `ahead`, without its up, to x."""
    x = ahead - up * (ahead @ up)
    if np.linalg.norm(x) < 1e-3:  # straight up or down
        x = np.eye(3)[np.abs(up).argmin()]
        x = x - up * (x @ up)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
