"""What compiled code knows of a map's mesh: object and colour of the point where a ray hits.

Textures are kept with their mip levels, so that a ray that stands for a whole patch of the image
sees the colour of a whole patch of the wall.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from placegraph.indoor.map.mesh import portions

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.map.mesh import Mesh

MANY = 100
"""A texture of more charts than this is an atlas; in one of fewer, neighbours look alike."""
BLEED = 0.1
"""Share of a texture's surface whose charts may be mixed with their neighbours."""


class Surface(NamedTuple):
    """T triangles of V vertices with K textures of up to L mip levels, as plain arrays."""

    triangles: NDArray[np.int32]
    """(T, 3)"""
    object_of: NDArray[np.int32]
    """(T,)"""
    colours: NDArray[np.uint8]
    """(V, 3) sRGB"""
    uv: NDArray[np.float32]
    """(V, 2)"""
    texture_of: NDArray[np.int32]
    """(T,)"""
    texels_per_metre: NDArray[np.float32]
    """(T,) at level 0."""
    levels: NDArray[np.int32]
    """(K, L, 3) first texel, width, height; the last level is repeated."""
    texels: NDArray[np.uint8]
    """(M, 3) sRGB of all levels of all textures."""

    @classmethod
    def of(cls, mesh: Mesh) -> Surface:
        """Surface of a mesh."""
        most = _useful_levels(mesh)
        pyramids = [_pyramid(t, n) for t, n in zip(mesh.textures, most.tolist(), strict=True)]
        depth = max(len(p) for p in pyramids)
        levels = np.zeros((len(pyramids), depth, 3), np.int32)
        first = 0
        for k, pyramid in enumerate(pyramids):
            for level in range(depth):
                h, w = pyramid[min(level, len(pyramid) - 1)].shape[:2]
                if level < len(pyramid):
                    start, first = first, first + w * h
                levels[k, level] = start, w, h
        return cls(
            triangles=mesh.triangles,
            object_of=mesh.object_of,
            colours=mesh.colours,
            uv=mesh.uv,
            texture_of=mesh.texture_of,
            texels_per_metre=_density(mesh, levels[:, 0, 1:]),
            levels=levels,
            texels=np.concatenate([level.reshape(-1, 3) for p in pyramids for level in p]),
        )


def _useful_levels(mesh: Mesh) -> NDArray[np.int64]:
    """Mip levels (K,) of each texture beyond the first that hold what belongs together.

    A texture of many charts mixes neighbours that have nothing to do with each other as soon as a
    texel is as wide as half a chart: the shorter side that all but `BLEED` of the surface has decides.
    """
    sizes = np.array([(a.shape[1], a.shape[0]) for a in mesh.textures], np.float64)
    most = np.ceil(np.log2(sizes.max(axis=1))).astype(np.int64)
    if not len(mesh) or (most == 0).all():
        return most
    chart = chart_of(mesh.triangles, len(mesh.vertices))[mesh.triangles[:, 0]]
    rows, chart = np.unique(chart, return_inverse=True)
    uv = mesh.uv[mesh.triangles]
    low, high = np.full((len(rows), 2), np.inf), np.full((len(rows), 2), -np.inf)
    np.minimum.at(low, chart, uv.min(axis=1))
    np.maximum.at(high, chart, uv.max(axis=1))
    texture = np.zeros(len(rows), np.int64)
    texture[chart] = mesh.texture_of
    side = np.minimum((high - low) * sizes[texture], sizes[texture]).min(axis=1)
    area = np.bincount(chart, np.linalg.norm(mesh.normals(), axis=1), len(rows))
    for k in np.flatnonzero(most > 0).tolist():
        own = np.flatnonzero((texture == k) & (side > 0))
        whole = (side[own] >= 0.5 * sizes[k].min()).any()  # one chart has it all
        if own.size > MANY and not whole:
            order = own[np.argsort(side[own])]
            total = np.cumsum(area[order])
            least = side[order[np.searchsorted(total, BLEED * total[-1])]]
            most[k] = min(most[k], max(int(np.log2(max(least, 2.0) / 2.0)), 1))
    return most


@njit(cache=True, nogil=True)
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


def _pyramid(texture: NDArray[np.uint8], most: int) -> list[NDArray[np.uint8]]:
    """Texture (h, w, 3) and its halves, quarters, ... down to one texel, or `most` of them."""
    from PIL import Image

    out = [texture]
    while max(out[-1].shape[:2]) > 1 and len(out) <= most:
        h, w = out[-1].shape[:2]
        smaller = Image.fromarray(out[-1]).resize(
            (max(1, w // 2), max(1, h // 2)), Image.Resampling.BOX
        )
        out.append(np.asarray(smaller))
    return out


def _density(mesh: Mesh, sizes: NDArray[np.int32]) -> NDArray[np.float32]:
    """Texels per metre (T,) along the denser side of each triangle's texture."""
    density = np.empty(len(mesh), np.float32)
    for part in portions(len(mesh)):
        corners, uv = mesh.vertices[mesh.triangles[part]], mesh.uv[mesh.triangles[part]]
        uv = uv * sizes[mesh.texture_of[part]][:, None, :]
        edges, spans = (np.linalg.norm(c - np.roll(c, 1, axis=1), axis=2) for c in (corners, uv))
        with np.errstate(divide="ignore", invalid="ignore"):
            density[part] = np.where(edges > 0, spans / edges, 0.0).max(axis=1)
    return density


@njit(cache=True, nogil=True, inline="always")
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


@njit(cache=True, nogil=True, inline="always")
def opponent(red, green, blue):
    """Lightness and two chromaticities (3 floats) that a lamp's brightness leaves alone."""
    total = red + green + blue
    shade = np.float32(1.0) / (total + np.float32(0.06))
    return total, (red - blue) * shade, (np.float32(2.0) * green - red - blue) * shade
