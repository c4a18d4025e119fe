"""Baking: the colours of a mesh, seen at every texel, become a small texture atlas."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from placegraph.core.threads import share
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.atlas.baking_kernels import SEEN, UNSEEN, choose, cover, draw
from placegraph.indoor.mapping.atlas.charts import Charts, charts_of, neighbours_of
from placegraph.indoor.mapping.atlas.pages import Sheets, assembled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]


ColourOf: TypeAlias = Callable[[Any, Any, Any], Any]
"""`colour_of(points, normals, triangles)`: what colour the surface has.

points (N, 3) float64 [m, map], their unit normals (N, 3) float64 and their triangles (N,) int64 to
colours (N, 3) uint8 sRGB, or to a pair of them and (N,) bool: whether a colour is known.
"""

TOLERANCE = 5.0
"""Of 255: what a smaller chart may differ from its samples (root mean square of 8 x 8 texels)."""
LONGEST = 256
"""Charts longer than this [texels] are cut, so that the dull part of a wall can be smaller."""
_BATCH = 1 << 19  # texels a call of `colour_of`
_LARGEST = 1 << 13


def bake(
    mesh: Mesh,
    colour_of: ColourOf,
    *,
    texel: float = 0.01,
    margin: int = 1,
    largest: int = 2048,
    tolerance: float = TOLERANCE,
) -> Mesh:
    """The same triangles with a texture atlas.

    Charts of similar normal are laid flat, coloured by `colour_of` at every texel, made as coarse as
    their content allows, and packed on pages. Charts of one colour take a few texels that many
    share, so that blank walls cost nothing. What nobody saw looks like what is next to it.

    Parameters
    ----------
    mesh
        Triangles with shared vertices; its own colours and textures are not looked at. Triangles,
        their order and their objects stay; vertices are doubled where charts meet.
    colour_of
        `surface_colours`, `mesh_colours`, `frame_colours`, or any function like them.
    texel
        Width of a texel [m].
    margin
        Texels around each chart, which bilinear looks touch.
    largest
        Longest side of a page [texels].
    tolerance
        What coarser charts may differ from the samples [of 255]; 0 keeps every texel.

    Raises
    ------
    OptionError
        An option is out of range, or `colour_of` returns something else.

    """
    _check(texel, margin, largest, tolerance)
    if not len(mesh):
        return mesh
    neighbours = neighbours_of(mesh)
    room = largest - 2 * margin - 2
    charts = charts_of(mesh, neighbours, texel, min(room, LONGEST))
    step = np.maximum(texel, charts.sizes.max(axis=1) / room)  # one triangle may be a whole hall
    sheets = _painted(mesh, charts, colour_of, step, margin, tolerance)
    sheets.light_up(charts, neighbours, mesh.object_of)
    return assembled(mesh, charts, sheets, margin, largest)


def _painted(
    mesh: Mesh, charts: Charts, colour_of: ColourOf, step: Floats, margin: int, tolerance: float
) -> Sheets:
    """Ask for the colours of all texels, batch by batch, and keep what each chart needs."""
    extents = charts.sizes / step[:, None]
    grids = np.maximum(np.ceil(extents - 1e-6), 1).astype(np.int64) + 2 * margin
    rows, starts = charts.grouped()
    corners = charts.corners / step[charts.of][:, None, None]
    count, ends = len(grids), np.cumsum(grids.prod(axis=1))
    sheets = Sheets(
        step, np.zeros(count, np.int32), np.zeros((count, 3)), np.zeros((count, 2), np.int64), [],
        [], np.zeros((len(mesh), 3)), np.zeros(len(mesh)),
    )  # fmt: skip
    points, normals = mesh.vertices[mesh.triangles].astype(np.float64), mesh.normals()
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    first = 0
    while first < count:
        done = int(ends[first - 1]) if first else 0
        last = max(int(np.searchsorted(ends, done + _BATCH, "right")), first + 1)
        part = slice(first, last)
        firsts = ends[part] - grids[part].prod(axis=1) - done
        total = int(ends[last - 1]) - done
        owner, shares = np.full(total, -1, np.int32), np.zeros((total, 2), np.float32)
        share(
            cover, last - first, corners, rows, starts[first : last + 1], grids[part],
            extents[part], firsts, margin, owner, shares,
        )  # fmt: skip
        at = np.flatnonzero(owner >= 0)
        own = owner[at].astype(np.int64)
        u, v = (shares[at, k, None].astype(np.float64) for k in (0, 1))
        a, b, c = np.moveaxis(points[own], 1, 0)
        found, seen = asked(colour_of, a + u * (b - a) + v * (c - a), normals[own], own)
        colours, state = np.zeros((total, 3), np.uint8), np.zeros(total, np.uint8)
        colours[at], state[at] = found, np.where(seen, SEEN, UNSEEN)
        np.add.at(sheets.counts, own[seen], 1)
        for k in range(3):
            sheets.sums[:, k] += np.bincount(own[seen], found[seen, k], len(mesh))
        _keep(sheets, part, (colours, state, grids[part], extents[part], firsts, margin), tolerance)
        first = last
    return sheets


def asked(
    colour_of: ColourOf, points: Floats, normals: Floats, triangles: Ints
) -> tuple[Bytes, NDArray[np.bool_]]:
    """Colours (N, 3) uint8 and whether they are known (N,); `OptionError` where they are neither."""
    answer = colour_of(points, normals, triangles)
    colours, known = answer if isinstance(answer, tuple) else (answer, np.ones(len(points), bool))
    if colours.dtype != np.uint8 or colours.shape != points.shape or known.shape != (len(points),):
        raise OptionError(
            f"colour_of returned {colours.dtype} {colours.shape} for {len(points)} points; it must "
            "return colours (N, 3) uint8, or these and whether they are known, (N,) bool."
        )
    return colours, known.astype(bool, copy=False)


def _keep(sheets: Sheets, part: slice, grids: tuple[Any, ...], tolerance: float) -> None:
    """Take over a batch of charts at the coarsest levels that will do."""
    extents, margin = grids[3], grids[5]
    levels, means = sheets.levels[part], sheets.means[part]  # views
    share(choose, len(levels), *grids, tolerance, levels, means)
    scale = np.exp2(np.maximum(levels, 0))[:, None]
    sizes = np.maximum(np.ceil(extents / scale - 1e-6), 1).astype(np.int64) + 2 * margin
    sizes[levels < 0] = 0
    sheets.sizes[part] = sizes
    counts = sizes.prod(axis=1)
    texels = np.zeros((int(counts.sum()), 3), np.uint8)
    known = np.zeros(len(texels), bool)
    share(draw, len(levels), *grids, levels, np.cumsum(counts) - counts, texels, known)
    sheets.texels.append(texels)
    sheets.known.append(known)


def _check(texel: float, margin: int, largest: int, tolerance: float) -> None:
    if not (np.isfinite(texel) and texel > 0):
        raise OptionError(f"texel is {texel}; it must be a width in metres, as 0.01.")
    if not 1 <= margin <= 16:
        raise OptionError(f"margin is {margin}; it must be 1 to 16 texels.")
    if not 64 <= largest <= _LARGEST:
        raise OptionError(f"largest is {largest}; it must be 64 to {_LARGEST} texels.")
    if not (np.isfinite(tolerance) and tolerance >= 0):
        raise OptionError(f"tolerance is {tolerance}; it must be a number from 0 on.")
