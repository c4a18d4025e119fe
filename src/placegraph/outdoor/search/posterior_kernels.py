# mypy: allow-untyped-defs, allow-incomplete-defs
"""Peaks of a posterior over points."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel


@kernel(finite=True)
def peaks(positions, probabilities, heavy, most, apart, within):
    """Up to `most` peaks, those first around which most lies: where, covariance, and how much it holds.

    A peak is the mean of what is not more than `apart` [m] from one of the `heavy` points, since peaks
    are broad, not sharp; it holds what lies `within` [m] of it, and that belongs to no other.
    """
    left = probabilities.copy()
    smooth = np.empty(len(heavy))
    for h in range(len(heavy)):
        smooth[h] = 1e-3 * left[heavy[h]]
        for i in range(len(left)):
            if _near(positions[i], positions[heavy[h]], apart):
                smooth[h] += left[i]
    place, covariance, mass = np.empty((most, 2)), np.zeros((most, 2, 2)), np.zeros(most)
    n = 0
    while n < most and len(heavy):
        best = np.argmax(smooth)
        if smooth[best] <= 1e-9:
            break
        middle = positions[heavy[best]]
        total = east = north = 0.0
        for i in range(len(left)):
            if _near(positions[i], middle, apart):
                total += left[i]
                east += left[i] * positions[i, 0]
                north += left[i] * positions[i, 1]
        for h in range(len(heavy)):
            if _near(positions[heavy[h]], middle, apart):
                smooth[h] = 0.0
        if total <= 0.0:
            continue
        place[n] = east / total, north / total
        for i in range(len(left)):
            if _near(positions[i], middle, apart):
                x, y = positions[i, 0] - place[n, 0], positions[i, 1] - place[n, 1]
                share = left[i] / total
                covariance[n, 0, 0] += share * x * x
                covariance[n, 0, 1] += share * x * y
                covariance[n, 1, 1] += share * y * y
        covariance[n, 1, 0] = covariance[n, 0, 1]
        for i in range(len(left)):
            if _near(positions[i], place[n], within):
                mass[n] += left[i]
                left[i] = 0.0
        for h in range(len(heavy)):
            if _near(positions[heavy[h]], place[n], within):
                smooth[h] = 0.0
        n += 1
    return place[:n], covariance[:n], mass[:n]


@kernel(inline="always")
def _near(a, b, reach):
    """Whether two points (2,) lie within a distance."""
    east, north = a[0] - b[0], a[1] - b[1]
    return east * east + north * north <= reach * reach
