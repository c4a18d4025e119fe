"""Baking: the colours of a mesh, seen at every texel, become a small texture atlas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.atlas.baking_kernels import (
    DARK,
    FLAT,
    SEEN,
    UNSEEN,
    choose,
    cover,
    draw,
)
from placegraph.indoor.mapping.atlas.chart_kernels import spread
from placegraph.indoor.mapping.atlas.charts import Charts, charts_of, neighbours_of
from placegraph.indoor.mapping.atlas.pack import filled, pack
from placegraph.threads import share

if TYPE_CHECKING:
    from numpy.typing import NDArray

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
SHADES = 4
"""Charts of one colour share a texel with those that differ by less than this [of 255]."""
_BATCH = 1 << 19  # texels a call of `colour_of`
_PATCH = 4  # texels a side of one shared colour: a block of chroma and its surrounding
_SHEET = 16  # patches a side of a sheet of shared colours
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
    return _assembled(mesh, charts, sheets, margin, largest)


@dataclass(eq=False)
class _Sheets:
    """Images of C charts."""

    step: Floats
    """(C,) width of a texel of level 0 [m]."""
    levels: NDArray[np.int32]
    """(C,) halvings of the resolution; FLAT: one colour; DARK: nothing seen."""
    means: Floats
    """(C, 3) mean colours."""
    sizes: Ints
    """(C, 2) width and height of the images, margins included; 0 of charts of one colour."""
    texels: list[Bytes]
    """(h * w, 3) of each batch of charts."""
    known: list[NDArray[np.bool_]]
    sums: Floats
    """(T, 3) of the colours seen on each triangle."""
    counts: Floats
    """(T,)"""

    def light_up(self, charts: Charts, neighbours: Ints, object_of: NDArray[np.int32]) -> None:
        """Give charts of which nothing is known their neighbours' colour, or their object's."""
        dark = self.levels == DARK
        if not dark.any():
            return
        known = self.counts > 0
        colours = self.sums / np.maximum(self.counts, 1)[:, None]
        of_object = _means(object_of, colours, known)
        spread(neighbours, colours, known)
        colours = np.where(known[:, None], colours, of_object[object_of])
        every = np.ones(len(colours), bool)
        self.means[dark] = _means(charts.of, colours, every, len(self.levels))[dark]
        self.levels[dark] = FLAT


def _painted(
    mesh: Mesh, charts: Charts, colour_of: ColourOf, step: Floats, margin: int, tolerance: float
) -> _Sheets:
    """Ask for the colours of all texels, batch by batch, and keep what each chart needs."""
    extents = charts.sizes / step[:, None]
    grids = np.maximum(np.ceil(extents - 1e-6), 1).astype(np.int64) + 2 * margin
    rows, starts = charts.grouped()
    corners = charts.corners / step[charts.of][:, None, None]
    count, ends = len(grids), np.cumsum(grids.prod(axis=1))
    sheets = _Sheets(
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


def _keep(sheets: _Sheets, part: slice, grids: tuple[Any, ...], tolerance: float) -> None:
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


def _means(
    of: NDArray[Any], colours: Floats, known: NDArray[np.bool_], count: int | None = None
) -> Floats:
    """Mean colours (N, 3) of what is known of each group; of everything where nothing is."""
    count = int(of.max()) + 1 if count is None else count
    number = np.bincount(of[known], minlength=count)
    sums = np.stack([np.bincount(of[known], colours[known, k], count) for k in range(3)], axis=1)
    overall = colours[known].mean(axis=0) if known.any() else np.full(3, 128.0)
    return np.where(number[:, None] > 0, sums / np.maximum(number, 1)[:, None], overall)


# -------------------------------------------------------------------------------------- pages


def _assembled(mesh: Mesh, charts: Charts, sheets: _Sheets, margin: int, largest: int) -> Mesh:
    """Mesh with all images on pages."""
    flat = sheets.levels < 0
    drawn = np.flatnonzero(~flat)
    shades, shade_of = _shades(sheets.means[flat])
    across = max(min(_SHEET, int(np.ceil(np.sqrt(len(shades))))), 1)  # patches side by side
    each = across**2
    cards = -(-len(shades) // each)
    page, places, pages = pack(
        np.concatenate([sheets.sizes[drawn], np.full((cards, 2), across * _PATCH, np.int64)]),
        largest,
        np.append(sheets.means[drawn].sum(axis=1), np.zeros(cards)),
    )
    canvases = [np.zeros((h, w, 3), np.uint8) for w, h in pages.tolist()]
    masks = [np.zeros((h, w), bool) for w, h in pages.tolist()]
    _paste(sheets, drawn, page, places, canvases, masks)
    for card in range(cards):
        k, (x, y) = int(page[len(drawn) + card]), places[len(drawn) + card]
        for i, shade in enumerate(shades[card * each : (card + 1) * each]):
            row, column = divmod(i, across)
            area = np.s_[y + row * _PATCH :, x + column * _PATCH :]
            canvases[k][area][:_PATCH, :_PATCH] = shade
            masks[k][area][:_PATCH, :_PATCH] = True
    # where each chart lies: its corner on the page, or the middle of its shade
    count = len(sheets.levels)
    page_of, origin = np.zeros(count, np.int64), np.zeros((count, 2))
    page_of[drawn] = page[: len(drawn)]
    card_of, at = np.divmod(shade_of, each)
    page_of[flat] = page[len(drawn) + card_of]
    cell = np.stack([at % across, at // across], axis=1)
    origin[flat] = places[len(drawn) + card_of] + (cell + 0.5) * _PATCH
    scale = np.where(flat, 0.0, 1.0 / (sheets.step * np.exp2(np.maximum(sheets.levels, 0))))
    inner = sheets.sizes[drawn] - 2 * margin
    centring = 0.5 * (inner - charts.sizes[drawn] * scale[drawn, None])
    origin[drawn] = places[: len(drawn)] + margin + centring
    key = np.arange(count)
    key[flat] = count + shade_of  # charts of one shade share their vertices
    uv = origin[charts.of][:, None] + charts.corners * scale[charts.of][:, None, None]
    uv /= pages[page_of][charts.of][:, None]
    return _split(mesh, key[charts.of], uv, page_of[charts.of], [
        filled(canvas, mask) for canvas, mask in zip(canvases, masks, strict=True)
    ])  # fmt: skip


def _shades(means: Floats) -> tuple[Bytes, Ints]:
    """Shared colours (S, 3), dark ones first, and which of them each mean colour (N, 3) is."""
    cells, of = np.unique(np.rint(means / SHADES), axis=0, return_inverse=True)
    of = of.reshape(-1)
    number = np.maximum(np.bincount(of, minlength=len(cells)), 1)
    sums = [np.bincount(of, means[:, k], len(cells)) for k in range(3)]
    shades = np.rint(np.stack(sums, axis=1) / number[:, None]).astype(np.uint8)
    order = np.argsort(shades.astype(np.int64).sum(axis=1), kind="stable")
    rank = np.empty(len(order), np.int64)
    rank[order] = np.arange(len(order))
    return shades[order], rank[of]


def _paste(
    sheets: _Sheets,
    drawn: Ints,
    page: Ints,
    places: Ints,
    canvases: list[Bytes],
    masks: list[NDArray[np.bool_]],
) -> None:
    """Copy the images of the charts `drawn` to their places."""
    texels, known = np.concatenate(sheets.texels), np.concatenate(sheets.known)
    start = 0
    for i, (w, h) in enumerate(sheets.sizes[drawn].tolist()):
        x, y = places[i].tolist()
        area, part = np.s_[y : y + h, x : x + w], np.s_[start : start + w * h]
        canvases[int(page[i])][area] = texels[part].reshape(h, w, 3)
        masks[int(page[i])][area] = known[part].reshape(h, w)
        start += w * h


def _split(mesh: Mesh, key: Ints, uv: Floats, page: Ints, pages: list[Bytes]) -> Mesh:
    """Mesh whose vertices are doubled where triangles of different `key` (T,) meet."""
    span = int(key.max()) + 1
    corner = mesh.triangles.astype(np.int64) * span + key[:, None]
    used, first, rows = np.unique(corner, return_index=True, return_inverse=True)
    return Mesh(
        vertices=mesh.vertices[used // span],
        triangles=rows.reshape(-1, 3).astype(np.int32),
        object_of=mesh.object_of,
        colours=np.full((len(used), 3), 255, np.uint8),
        uv=uv.reshape(-1, 2)[first].astype(np.float32),
        texture_of=page.astype(np.int32),
        textures=tuple(pages),
    )


def _check(texel: float, margin: int, largest: int, tolerance: float) -> None:
    if not (np.isfinite(texel) and texel > 0):
        raise OptionError(f"texel is {texel}; it must be a width in metres, as 0.01.")
    if not 1 <= margin <= 16:
        raise OptionError(f"margin is {margin}; it must be 1 to 16 texels.")
    if not 64 <= largest <= _LARGEST:
        raise OptionError(f"largest is {largest}; it must be 64 to {_LARGEST} texels.")
    if not (np.isfinite(tolerance) and tolerance >= 0):
        raise OptionError(f"tolerance is {tolerance}; it must be a number from 0 on.")
