# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `surface`."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel


@kernel
def chart_of(triangles, vertices):
    """Lowest vertex (V,) of the connected part, joined by triangles (T, 3), of each vertex."""
    root = np.arange(vertices)
    for t in range(len(triangles)):
        for k in range(2):
            a, b = triangles[t, k], triangles[t, k + 1]
            while root[a] != a:
                root[a] = root[root[a]]
                a = root[a]
            while root[b] != b:
                root[b] = root[root[b]]
                b = root[b]
            root[max(a, b)] = min(a, b)
    for v in range(vertices):
        root[v] = root[root[v]]  # lower vertices are done
    return root


@kernel(inline="always")
def colour_at(surface, triangle, u, v, footprint):
    """Colour in sRGB (3 floats, 0 to 1) at barycentrics u, v of a triangle.

    `footprint`: width of what the ray stands for at the hit [m].
    """
    a = surface.triangles[triangle, 0]
    b = surface.triangles[triangle, 1]
    c = surface.triangles[triangle, 2]
    w = np.float32(1.0) - u - v
    red = w * surface.colours[a, 0] + u * surface.colours[b, 0] + v * surface.colours[c, 0]
    green = w * surface.colours[a, 1] + u * surface.colours[b, 1] + v * surface.colours[c, 1]
    blue = w * surface.colours[a, 2] + u * surface.colours[b, 2] + v * surface.colours[c, 2]
    texture = surface.texture_of[triangle]
    level = 0
    texels = surface.texels_per_metre[triangle] * footprint
    while texels > np.float32(1.5) and level < surface.levels.shape[1] - 1:
        texels *= np.float32(0.5)
        level += 1
    width = surface.levels[texture, level, 1]
    height = surface.levels[texture, level, 2]
    x = w * surface.uv[a, 0] + u * surface.uv[b, 0] + v * surface.uv[c, 0]
    y = w * surface.uv[a, 1] + u * surface.uv[b, 1] + v * surface.uv[c, 1]
    column = min(int((x - np.floor(x)) * width), width - 1)
    row = min(int((y - np.floor(y)) * height), height - 1)
    texel = surface.levels[texture, level, 0] + row * width + column
    scale = np.float32(1.0 / (255.0 * 255.0))
    return (
        red * surface.texels[texel, 0] * scale,
        green * surface.texels[texel, 1] * scale,
        blue * surface.texels[texel, 2] * scale,
    )


@kernel(inline="always")
def opponent(red, green, blue):
    """Lightness and two chromaticities (3 floats) that a lamp's brightness leaves alone."""
    total = red + green + blue
    shade = np.float32(1.0) / (total + np.float32(0.06))
    return total, (red - blue) * shade, (np.float32(2.0) * green - red - blue) * shade
