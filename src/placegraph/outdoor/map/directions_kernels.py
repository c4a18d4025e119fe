# mypy: allow-untyped-defs, allow-incomplete-defs
"""Direction of the difference of two positions (GOTLoc, Eq. 5-6): named, shared, or compared.

`relate_pairs` and `find_wind` are Eq. 5 and 6 as printed, for the graphs of cells; `share_winds` softens
Eq. 6 for our network, `direction_table` and `direction_fit` for the likelihood of statements at viewpoints.
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


WINDS = ("north", "south", "east", "west")
"""The four directions of Eq. 6."""


@kernel
def find_wind(east, north):
    """Return the row of `WINDS` for a vector [m] from a target to a source (Eq. 6).

    The equation leaves |dx| = |dy| open; here north and south win.
    """
    if abs(east) > abs(north):
        return 2 if east > 0 else 3
    return 0 if north > 0 else 1


@kernel
def relate_pairs(starts, positions, edge_distance):
    """Relate the nodes of K graphs by the differences of their positions (Eq. 5).

    `starts` (K + 1,) delimit the nodes of a graph, `positions` (N, 2) are east and north [m]. Every
    ordered pair at most `edge_distance` [m] apart is an edge, unless both stand at one point. Returns
    the edges as CSR: starts (K + 1,), ends (E, 2) int32 counted within the graph, and the row of
    `WINDS` (E,) uint8: end 0 is <wind> of end 1.
    """
    most = 0
    for k in range(len(starts) - 1):
        most += (starts[k + 1] - starts[k]) * (starts[k + 1] - starts[k] - 1)
    edge_starts = np.zeros(len(starts), np.int64)
    ends, winds = np.empty((most, 2), np.int32), np.empty(most, np.uint8)
    n = 0
    for k in range(len(starts) - 1):
        first, last = starts[k], starts[k + 1]
        for i in range(first, last):
            for j in range(first, last):
                east = positions[i, 0] - positions[j, 0]
                north = positions[i, 1] - positions[j, 1]
                if 0.0 < np.hypot(east, north) <= edge_distance:
                    ends[n, 0], ends[n, 1] = i - first, j - first
                    winds[n] = find_wind(east, north)
                    n += 1
        edge_starts[k + 1] = n
    return edge_starts, ends[:n], winds[:n]


def name_direction(delta: NDArray[np.float64]) -> str:
    """Return the name of the direction of Eq. 6 of a vector (2,) east, north from a target to a source."""
    return WINDS[find_wind(float(delta[0]), float(delta[1]))]


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


@kernel(finite=True, inline=True)
def direction_fit(table, ux, uy, dx, dy, blurred):
    """Return P(direction said) for a vector [m]; within `blurred` [m^2] it points nowhere."""
    d2 = dx * dx + dy * dy
    if d2 < 0.25:
        return np.float32(0.25)
    d = np.sqrt(d2)
    index = int(((dx * ux + dy * uy) / d + 1.0) * (0.5 * (TABLE - 1)) + 0.5)
    blur = d2 / (d2 + blurred)
    return blur * table[min(TABLE - 1, max(0, index))] + (1.0 - blur) * np.float32(0.25)
