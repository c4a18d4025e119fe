"""Covariance of a fitted pose, and its least certain direction."""

from __future__ import annotations

import numpy as np

from placegraph.core.geometry import Floats

WIDENED = 3.0
"""Factor on the covariance of samples that brings normalised errors to what they should be (benchmark)."""
TILT = 0.006
"""Standard deviation of the tilt that gravity gives [rad]: a third of a degree, as of a phone."""
FITTED = [0, 1, 2, 5]
"""What is fitted of x, y, z, and a turn about the map's axes."""


def pose_covariance(fitted: Floats) -> Floats:
    """Return the covariance (6, 6) of x, y, z and a turn about the map's axes from that of a fit (4, 4)."""
    whole = np.diag([0.0, 0.0, 0.0, WIDENED * TILT**2, WIDENED * TILT**2, 0.0])
    whole[np.ix_(FITTED, FITTED)] = fitted
    return whole


def least_certain(covariance: Floats) -> tuple[float, Floats]:
    """Return the largest standard deviation [m] of a position and its direction, a unit vector (3,)."""
    variances, axes = np.linalg.eigh(covariance[:3, :3])
    return float(np.sqrt(variances[-1])), axes[:, -1]
