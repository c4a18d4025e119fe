# mypy: allow-untyped-defs, allow-incomplete-defs
"""Direction of the difference of two positions (GOTLoc, Eq. 5-6): named, shared, or compared.

`name_direction` is Eq. 6 as published, for scene graphs of cells; `share_winds` softens it for the
network, `direction_table` and `direction_fit` for the likelihood of statements at viewpoints.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel

TABLE = 256
"""Entries of a direction table, over the cosine from -1 to 1."""
SOFT = 0.1
"""Width of a wind's edge, as a share of its half sector."""


def name_direction(delta: NDArray[np.float64]) -> str:
    """Return the relation of Eq. 6 for the vector (2,) east, north from a target to a source.

    The equation leaves |dx| = |dy| open; here north and south win.
    """
    east, north = delta
    if abs(east) > abs(north):
        return "east" if east > 0 else "west"
    return "north" if north > 0 else "south"


@kernel
def share_winds(x, y):
    """Return the shares of north, south, east and west in a vector (x, y) (Eq. 6, softened); sum 1."""
    out = np.zeros(4, np.float32)
    x2, y2 = x * x, y * y
    total = x2 * x2 + y2 * y2
    if total > 1e-12:
        out[0 if y > 0.0 else 1] = y2 * y2 / total
        out[2 if x > 0.0 else 3] = x2 * x2 / total
    return out


@lru_cache(maxsize=64)
def direction_table(sigma: float, slip: float) -> NDArray[np.float32]:
    """Return P(direction said | cosine of the angle between truth and direction said), (TABLE,) float32.

    Eq. 6, softened: near 1 within the word's sector, falling around its edge; `slip` is the share of
    directions that are simply wrong. `sigma` [rad] is 0.5 for the four winds, whose sectors are 45
    degrees to either side.
    """
    angle = np.arccos(np.linspace(-1.0, 1.0, TABLE))
    half = np.pi / 4 * sigma / 0.5
    inside = 1.0 / (1.0 + np.exp((angle - half) / (SOFT * half)))
    return ((1.0 - slip) * inside + slip * 0.25).astype(np.float32)


@kernel(finite=True, inline="always")
def direction_fit(table, ux, uy, dx, dy, blurred):
    """Return P(direction said) for a vector [m]; within `blurred` [m^2] it points nowhere."""
    d2 = dx * dx + dy * dy
    if d2 < 0.25:
        return np.float32(0.25)
    d = np.sqrt(d2)
    index = int(((dx * ux + dy * uy) / d + 1.0) * (0.5 * (TABLE - 1)) + 0.5)
    blur = d2 / (d2 + blurred)
    return blur * table[min(TABLE - 1, max(0, index))] + (1.0 - blur) * np.float32(0.25)
