"""What compiled code knows of a map's mesh: object and colour of the point where a ray hits.

Textures are kept with their mip levels, so that a ray that stands for a whole patch of the image
sees the colour of a whole patch of the wall.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.mesh import Mesh, portions
from placegraph.indoor.map.surface_kernels import chart_of

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
