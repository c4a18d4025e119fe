# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops of the guided matcher: corners of a rendering, and their places in a query."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

_TENSOR = 2  # half the side of the window of the structure tensor [px]
_FLAT = np.float32(1e-5)  # variance per pixel below which a window shows nothing
_LEAST = 1e-4  # least eigenvalue of the structure tensor of a corner


@kernel(fastmath=True, error_model="numpy")
def corners(image, seen, margin, cell):
    """Best corner (K, 2) row, column of each cell of an image (H, W) float32 in [0, 1].

    A corner is where the lesser eigenvalue of the structure tensor is largest (Shi and Tomasi
    1994). Only pixels in `seen` (H, W), at least `margin` from the border.
    """
    h, w = image.shape
    xx, xy, yy = np.zeros((h, w)), np.zeros((h, w)), np.zeros((h, w))
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            gx = image[y, x + 1] - image[y, x - 1]
            gy = image[y + 1, x] - image[y - 1, x]
            if not (seen[y, x + 1] and seen[y, x - 1] and seen[y + 1, x] and seen[y - 1, x]):
                gx = gy = np.float32(0.0)  # where the map ends is no corner of anything
            xx[y, x], xy[y, x], yy[y, x] = gx * gx, gx * gy, gy * gy
    margin = max(margin, _TENSOR + 1)
    out = np.empty((((h // cell) + 1) * ((w // cell) + 1), 2), np.float64)
    count = 0
    for top in range(margin, h - margin, cell):
        for left in range(margin, w - margin, cell):
            best, row, column = _LEAST, -1, -1
            for y in range(top, min(top + cell, h - margin)):
                for x in range(left, min(left + cell, w - margin)):
                    if not seen[y, x]:
                        continue
                    a = b = c = 0.0
                    for j in range(-_TENSOR, _TENSOR + 1):
                        for i in range(-_TENSOR, _TENSOR + 1):
                            a += xx[y + j, x + i]
                            b += xy[y + j, x + i]
                            c += yy[y + j, x + i]
                    least = 0.5 * (a + c) - np.sqrt(0.25 * (a - c) * (a - c) + b * b)
                    if least > best:
                        best, row, column = least, y, x
            if row >= 0:
                out[count, 0], out[count, 1] = row, column
                count += 1
    return out[:count]


@kernel(fastmath=True, error_model="numpy")
def search(view, seen, query, at, half, radius, peak):
    """Places in a query (H, W) of patches of a view (H, W) around `at` (K, 2) row, column.

    Only pixels of a patch in `seen` (H, W) count; a patch of which less than half is seen is none.

    Returns (K, 4): row, column (to a fraction of a pixel), zero-mean normalised correlation there,
    and the best one farther than `peak` from it; correlation -1 where nothing was found. A best place
    on the rim of the window is none: the true one may lie beyond.
    """
    h, w = query.shape
    side, reach = 2 * half + 1, 2 * radius + 1
    patch = np.empty((side, side), np.float32)
    shown = np.empty((side, side), np.float32)
    scores = np.empty((reach, reach), np.float32)
    rows = np.empty((3, reach), np.float32)
    out = np.empty((len(at), 4))
    for k in range(len(at)):
        row, column = int(at[k, 0]), int(at[k, 1])
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = row, column, -1.0, -1.0
        area, energy = _template(view, seen, row, column, half, patch, shown)
        if 2.0 * area < side * side or energy < area * _FLAT:
            continue
        scores[:] = -1.0
        left = max(-radius, half - column)
        width = min(radius, w - 1 - half - column) + 1 - left
        for j in range(max(-radius, half - row), min(radius, h - 1 - half - row) + 1):
            _slide(query, row + j - half, column + left - half, patch, shown, area, rows, width)
            for i in range(width):
                spread = rows[1, i] - rows[0, i] * rows[0, i] / area
                if spread > area * _FLAT:
                    scores[j + radius, left + i + radius] = rows[2, i] / np.sqrt(spread * energy)
        best, rival, j, i = _peaks(scores, peak)
        if best <= -1.0 or not (0 < j < 2 * radius and 0 < i < 2 * radius):
            continue
        out[k, 0] = row + j - radius + _vertex(scores[j - 1, i], best, scores[j + 1, i])
        out[k, 1] = column + i - radius + _vertex(scores[j, i - 1], best, scores[j, i + 1])
        out[k, 2], out[k, 3] = best, rival
    return out


@kernel(inline="always", fastmath=True)
def _slide(query, top, left, patch, shown, area, rows, width):
    """Sums, sums of squares and products with a patch (3, width) at `width` places in a row.

    The innermost loop runs along the row of places, which is what processors are quick at.
    """
    side = len(patch)
    rows[:, :width] = 0.0
    whole = area == side * side
    for y in range(side):
        for x in range(side):
            p, m = patch[y, x], shown[y, x]
            if whole or m > 0.0:
                for i in range(width):
                    q = query[top + y, left + x + i]
                    rows[0, i] += q
                    rows[1, i] += q * q
                    rows[2, i] += q * p


@kernel(inline="always", fastmath=True)
def _peaks(scores, peak):
    """Best score, the best farther than `peak` from it, and the row and column of the first."""
    best, rival, row, column = np.float32(-1.0), np.float32(-1.0), 0, 0
    for y in range(scores.shape[0]):
        for x in range(scores.shape[1]):
            if scores[y, x] > best:
                best, row, column = scores[y, x], y, x
    for y in range(scores.shape[0]):
        for x in range(scores.shape[1]):
            if (abs(y - row) > peak or abs(x - column) > peak) and scores[y, x] > rival:
                rival = scores[y, x]
    return best, rival, row, column


@kernel(inline="always", fastmath=True)
def _template(view, seen, row, column, half, patch, shown):
    """Copy a patch less its mean, and which of it is seen; its number of pixels, and its energy."""
    side = 2 * half + 1
    total = area = energy = np.float32(0.0)
    for y in range(side):
        for x in range(side):
            j, i = row - half + y, column - half + x
            shown[y, x] = np.float32(1.0) if seen[j, i] else np.float32(0.0)
            patch[y, x] = view[j, i] * shown[y, x]
            total += patch[y, x]
            area += shown[y, x]
    mean = total / max(area, np.float32(1.0))
    for y in range(side):
        for x in range(side):
            patch[y, x] -= mean * shown[y, x]
            energy += patch[y, x] * patch[y, x]
    return area, energy


@kernel(inline="always")
def _vertex(before, at, after):
    """Place of a parabola's top through three scores, from the middle one [-0.5 to 0.5]."""
    bend = before - np.float32(2.0) * at + after
    if before <= -1.0 or after <= -1.0 or bend >= 0.0:
        return np.float32(0.0)
    return np.float32(0.5) * (before - after) / bend
