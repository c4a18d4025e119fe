# mypy: allow-untyped-defs, allow-incomplete-defs
"""The part of the network that is no matrix product: every channel's own small convolution."""

from __future__ import annotations

import numpy as np

from placegraph.compiled import kernel
from placegraph.indoor.map.surface_kernels import colour_at


@kernel(fastmath=True, error_model="numpy")
def mixed(x, weight, bias, gain, shift):
    """Neighbours of each cell mixed, each channel for itself, and its channels normalized.

    x: (H, W, C) float32, zero beyond its edges; weight: (K, K, C), K odd; bias, gain, shift: (C,).
    Returns (H * W, C) float32 of mean 0 and deviation 1, times gain, plus shift.
    """
    h, w, c = x.shape
    size = weight.shape[0]
    reach = size // 2
    out = np.empty((h * w, c), np.float32)
    for row in range(h):
        for column in range(w):
            total = out[row * w + column]
            total[:] = bias
            for i in range(max(0, reach - row), min(size, h + reach - row)):
                for j in range(max(0, reach - column), min(size, w + reach - column)):
                    near = x[row + i - reach, column + j - reach]
                    share = weight[i, j]
                    for k in range(c):
                        total[k] += near[k] * share[k]
            normalize(total, gain, shift)
    return out


@kernel(fastmath=True, error_model="numpy")
def normalize(values, gain, shift):
    """Bring values (C,) to mean 0 and deviation 1, in place, times gain, plus shift."""
    count = np.float32(len(values))
    mean = np.float32(0.0)
    for k in range(len(values)):
        mean += values[k]
    mean /= count
    square = np.float32(0.0)
    for k in range(len(values)):
        values[k] -= mean
        square += values[k] * values[k]
    scale = np.float32(1.0) / np.sqrt(square / count + np.float32(1e-5))
    for k in range(len(values)):
        values[k] = values[k] * scale * gain[k] + shift[k]


@kernel(fastmath=True, error_model="numpy")
def normalized(x, gain, shift):
    """Rows of x (N, C) float32 normalized, as a new array."""
    out = x.copy()
    for row in range(len(out)):
        normalize(out[row], gain, shift)
    return out


@kernel
def colours_at(surface, triangle, u, v, footprint):
    """Colours (M, 3) float32, sRGB 0 to 1, of points: triangles and barycentrics (M,).

    `surface`: of the map; `footprint`: width of what a point stands for [m].
    """
    out = np.empty((len(triangle), 3), np.float32)
    for m in range(len(triangle)):
        out[m] = colour_at(surface, triangle[m], u[m], v[m], footprint)
    return out
