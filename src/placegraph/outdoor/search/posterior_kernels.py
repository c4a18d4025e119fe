# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops over posteriors: peaks of points, and motion on a grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

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


@kernel
def background(mass: NDArray[np.float32], share: float, most: int) -> float:
    """Mass below which cells (n,) are background: `share` of the total at most, or all but `most`.

    Buckets by the leading bits of the numbers: found in one pass, and a sixteenth too high at most.
    """
    bits = mass.view(np.int32)
    counts = np.zeros(1 << 12, np.int64)
    sums = np.zeros(1 << 12)
    for i in range(len(mass)):
        if mass[i] > 0.0:
            bucket = bits[i] >> 19
            counts[bucket] += 1
            sums[bucket] += mass[i]
    wanted = (1.0 - share) * sums.sum()
    kept, n = 0.0, 0
    for bucket in range(len(counts) - 1, -1, -1):
        n += counts[bucket]
        if n > most or kept >= wanted:
            edge = np.array([(bucket + 1) << 19], np.int32).view(np.float32)
            return float(edge[0])
        kept += sums[bucket]
    return 0.0


@kernel(finite=True)
def scatter(
    mass: NDArray[np.float32],
    weights: NDArray[np.float32],
    bounds: NDArray[np.int64],
    row: int,
    column: int,
    light: float,
    shift: tuple[int, int],
    out: NDArray[np.float32],
) -> None:
    """Move every cell of `mass` (R, C) by a kernel; what falls off the grid is lost.

    Cell (i, j) of the kernel `weights` (K, L) stands for a displacement of (row + i, column + j)
    cells; in its row i only columns from `bounds[i, 0]` to `bounds[i, 1]` matter. Cells that hold less
    than `light` are shifted whole, by `shift` rows and columns. Adds to `out` (R, C).
    """
    rows, columns = mass.shape
    for r in range(rows):
        for c in range(columns):
            here = mass[r, c]
            if here < light or here == 0.0:
                if here > 0.0 and 0 <= r + shift[0] < rows and 0 <= c + shift[1] < columns:
                    out[r + shift[0], c + shift[1]] += here
                continue
            for i in range(max(0, -r - row), min(weights.shape[0], rows - r - row)):
                first = max(bounds[i, 0], -c - column)
                last = min(bounds[i, 1], columns - c - column)
                for j in range(first, last):
                    out[r + row + i, c + column + j] += here * weights[i, j]
