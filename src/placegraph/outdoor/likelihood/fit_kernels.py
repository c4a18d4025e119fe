# mypy: allow-untyped-defs, allow-incomplete-defs
"""How well geometry fits what was said: soft directions, distances, and the other relations."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel

DIRECTION, NEAR, INSIDE, ALONG, ACROSS, BETWEEN, VISIBLE, SAME = range(8)
"""Operations, one for each `Relation`, in its order."""
ME = -1
"""Stands for the viewpoint itself where a mention could stand."""
TABLE = 256
"""Entries of a direction table, over the cosine from -1 to 1."""
AREA = 2
SOFT = 0.1
"""Width of a wind's edge, as a share of its half sector."""
BLUR = 1.5
"""Square of the distance below which directions blur [m^2]."""


@lru_cache(maxsize=64)
def direction_table(sigma: float, slip: float) -> NDArray[np.float32]:
    """P(direction said | cosine of the angle between truth and what is said), (TABLE,) float32.

    Eq. 6 softened: near 1 within the word's sector, falling around its edge; `slip` is the share of
    directions that are simply wrong. `sigma` [rad] is 0.5 for the four winds, whose sectors are 45
    degrees to either side.
    """
    angle = np.arccos(np.linspace(-1.0, 1.0, TABLE))
    half = np.pi / 4 * sigma / 0.5
    inside = 1.0 / (1.0 + np.exp((angle - half) / (SOFT * half)))
    return ((1.0 - slip) * inside + slip * 0.25).astype(np.float32)


@kernel(finite=True, inline="always")
def direction_fit(table, ux, uy, dx, dy, blurred):
    """P(direction said) for a vector; one not longer than its ends are uncertain has no direction."""
    d2 = dx * dx + dy * dy
    if d2 < 0.25:
        return np.float32(0.25)
    d = np.sqrt(d2)
    index = int(((dx * ux + dy * uy) / d + 1.0) * (0.5 * (TABLE - 1)) + 0.5)
    blur = d2 / (d2 + blurred)
    return blur * table[min(TABLE - 1, max(0, index))] + (1.0 - blur) * np.float32(0.25)


@kernel(finite=True, inline="always")
def distance_fit(said, d):
    """How well a distance d fits what was said [m]; 1 where nothing was said.

    What is much nearer than was said fits by the ratio: nobody calls 5 m "about 60 m". A negative
    number is the most that it may be: "within 50 m", "on the same block".
    """
    if said == 0.0:
        return 1.0
    if said < 0.0:
        return 1.0 / (1.0 + np.exp((d + said) / (5.0 - 0.15 * said)))
    nearer = np.log((said + 5.0) / (d + 5.0)) / 0.5
    farther = (d - said) / (0.35 * said + 5.0)
    z = nearer if d < said else farther
    return np.exp(-0.5 * z * z)


@kernel(finite=True, inline="always")
def _close(said, d):
    """How well "near" fits a distance d [m]."""
    if said != 0.0:
        return distance_fit(said, d)
    return 1.0 / (1.0 + np.exp((d - 25.0) / 6.0))


@kernel(finite=True, _nrt=False)
def pair_fit(op, table, ux, uy, said, ax, ay, bx, by, kind_b):
    """P(geometry | source at a, target at b), seen from the viewpoint [m]."""
    dx, dy = ax - bx, ay - by
    d = np.sqrt(dx * dx + dy * dy)
    if op == DIRECTION:
        return direction_fit(table, ux, uy, dx, dy, BLUR) * distance_fit(said, d)
    if op == NEAR:
        return _close(said, d)
    if op == ACROSS:
        return _close(0.0, max(0.0, d - 25.0)) * min(1.0, d / 8.0)
    if op == INSIDE:
        return _close(0.0, 2.0 * d) if kind_b == AREA else 0.2 * _close(0.0, d)
    if op == ALONG:
        return _close(0.0, 1.5 * d) if kind_b != 0 else 0.3 * _close(0.0, d)
    return _close(0.0, d)


@kernel(finite=True, _nrt=False)
def me_fit(op, table, ux, uy, said, x, y, kind, forward, blurred):
    """P(geometry | the thing at (x, y) seen from v); `forward`: it is the source, v the target."""
    d = np.sqrt(x * x + y * y)
    if op == DIRECTION:
        if not forward:
            ux, uy = -ux, -uy
        return direction_fit(table, ux, uy, x, y, blurred) * distance_fit(said, d)
    if op == VISIBLE:
        return distance_fit(said, d)
    if op == NEAR:
        return _close(said, d)
    if op == SAME:
        return _close(0.0, 2.0 * d)
    if op == INSIDE:
        return (
            (1.0 if d < 1.0 else 0.3 * _close(0.0, 2.0 * d))
            if kind == AREA
            else 0.2 * _close(0.0, d)
        )
    if op == ALONG:
        return _close(0.0, 1.5 * d) if kind != 0 else 0.3 * _close(0.0, d)
    return _close(0.0, max(0.0, d - 25.0)) * min(1.0, d / 8.0)  # ACROSS
