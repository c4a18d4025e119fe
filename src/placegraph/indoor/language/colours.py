"""What colours people would say that the objects of a map have: shares of the basic colours.

Points on an object's triangles, spread evenly over their area, are named by the nearest colours that
`looks.toml` shows, in CIE L*a*b*. A map says them of its objects as an attribute, "brown 7 beige 3" in
tenths, so that libraries know them without a mesh.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.language.looks import COLOURS, looks
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.map.textures import linear_from_srgb

Floats = NDArray[np.float64]


KEY = "colours"
"""The attribute."""
POINTS = 64
"""On each object."""
_SOFT = 9.0
"""Difference of colours (CIE76) at which a name is given up for the next."""
_LEAST = 0.08
"""A colour that covers less is not spoken of."""
_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_D65 = np.array([0.9505, 1.0, 1.089])


def with_colours(scene: Scene) -> tuple[dict[str, str], ...]:
    """Attributes (N,) of a map's objects, with their colours where its surfaces have some."""
    if not scene.coloured:
        return scene.attributes
    shares = scene.derived("colours", colours_of)
    return tuple(
        {**own, KEY: said} if (said := in_words(share)) and KEY not in own else own
        for own, share in zip(scene.attributes, shares, strict=True)
    )


def colours_of(scene: Scene) -> Floats:
    """Shares (N, 12) of the basic colours on the surface of each object."""
    mesh = scene.mesh
    areas = np.linalg.norm(mesh.normals(), axis=1) + 1e-12
    order = np.argsort(mesh.object_of, kind="stable")
    total = np.cumsum(areas[order])
    starts = np.searchsorted(mesh.object_of[order], np.arange(len(scene) + 1))
    ends = np.append(0.0, total)[starts]
    steps = (np.arange(POINTS) + 0.5) / POINTS
    at = ends[:-1, None] + steps * np.diff(ends)[:, None]
    rows = np.searchsorted(total, at.ravel()).clip(max=len(order) - 1)
    # a sequence of low discrepancy, folded into the triangle
    k = np.arange(at.size)
    u, v = (k * 0.7548776662) % 1.0, (k * 0.5698402910) % 1.0
    over = u + v > 1.0
    u, v = np.where(over, 1.0 - u, u).astype("f4"), np.where(over, 1.0 - v, v).astype("f4")
    colours = mesh.colour_at(order[rows].astype(np.int32), u, v)
    return np.asarray(named(colours).reshape(len(scene), POINTS, -1).mean(axis=1))


def named(colours: NDArray[np.uint8]) -> Floats:
    """How readily (n, 12) colours (n, 3) uint8 sRGB are called by each basic name; rows sum to 1."""
    shown, names = _shown()
    distance = np.linalg.norm(_lab(colours)[:, None] - shown, axis=2)
    nearest = np.stack([distance[:, names == i].min(axis=1) for i in range(len(COLOURS))], axis=1)
    share = np.exp(-(nearest - nearest.min(axis=1, keepdims=True)) / _SOFT)
    return np.asarray(share / share.sum(axis=1, keepdims=True))


@cache
def _shown() -> tuple[Floats, NDArray[np.int64]]:
    entries = [(i, code) for i, name in enumerate(COLOURS) for code in looks().shown[name]]
    rgb = np.array([list(bytes.fromhex(code[1:])) for _, code in entries], np.uint8)
    return _lab(rgb), np.array([i for i, _ in entries])


def _lab(colours: NDArray[np.uint8]) -> Floats:
    """CIE L*a*b* (n, 3) of colours (n, 3) uint8 sRGB, under D65."""
    xyz = linear_from_srgb(colours / 255.0) @ _XYZ.T / _D65
    f = np.where(xyz > 0.008856, np.cbrt(xyz), 7.787 * xyz + 16.0 / 116.0)
    x, y, z = f.T
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=1)


def in_words(share: Floats) -> str:
    """Shares (12,) as "brown 7 beige 3", the largest first."""
    order = [i for i in np.argsort(-share, kind="stable").tolist() if share[i] >= _LEAST]
    return " ".join(f"{COLOURS[i]} {max(round(10 * share[i]), 1)}" for i in order)


def from_words(attributes: Mapping[str, str]) -> Floats:
    """Shares (12,) that attributes say: what `in_words` wrote, or words of people ("white, grey").

    NaN where they say none.
    """
    out = np.zeros(len(COLOURS))
    words = attributes.get(KEY, "").split()
    for name, tenths in zip(words[::2], words[1::2], strict=False):
        if name in COLOURS and tenths.isdecimal() and len(tenths) < 4:
            out[COLOURS.index(name)] += int(tenths)
    for word in attributes.get("color", "").lower().replace(",", " ").split():
        for name in looks().colours.get(word, ()):
            out[COLOURS.index(name)] += 10.0
    return out / out.sum() if out.any() else np.full(len(COLOURS), np.nan)
