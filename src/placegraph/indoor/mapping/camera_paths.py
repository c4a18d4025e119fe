"""Ways of cameras beside an exported map: checked, and drawn as lines."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.errors import OptionError

Paths = Mapping[str, ArrayLike]


EYE = 0.12
"""Length of the pyramid that shows a camera in a .glb [m]."""
MOST_EYES = 60
"""Pyramids along one path."""


def path_lines(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """(L, 2, 3) segments [m] of a camera's way (T, 4, 4), with pyramids that look where it does."""
    at = poses[:, :3, 3]
    way = np.stack([at[:-1], at[1:]], axis=1)
    corners = EYE * np.array([(-0.5, -0.4, 1), (0.5, -0.4, 1), (0.5, 0.4, 1), (-0.5, 0.4, 1)])
    some = np.linspace(0, len(poses) - 1, min(len(poses), MOST_EYES)).round().astype(np.int64)
    eyes = np.einsum("tij,cj->tci", poses[some, :3, :3], corners) + at[some, None]
    rims = np.stack([eyes, np.roll(eyes, -1, axis=1)], axis=2)
    rays = np.stack([np.broadcast_to(at[some, None], eyes.shape), eyes], axis=2)
    return np.concatenate([way, rims.reshape(-1, 2, 3), rays.reshape(-1, 2, 3)])


def checked(paths: Paths) -> dict[str, NDArray[np.float64]]:
    """Ways (T, 4, 4) by name; raises `OptionError` where they are none."""
    checked = {}
    for name, values in paths.items():
        poses = np.asarray(values, np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
            raise OptionError(
                f"camera_paths: {name!r} has shape {poses.shape}; poses (T, 4, 4) belong."
            )
        if not np.isfinite(poses).all():
            raise OptionError(f"camera_paths: {name!r} holds a pose that is not finite.")
        checked[str(name)] = poses
    return checked
