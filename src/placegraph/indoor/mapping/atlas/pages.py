"""Pages of a texture atlas: images of charts put in their places, and the mesh that looks at them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.atlas.baking_kernels import DARK, FLAT
from placegraph.indoor.mapping.atlas.chart_kernels import spread

if TYPE_CHECKING:
    from placegraph.indoor.mapping.atlas.charts import Charts


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bytes = NDArray[np.uint8]


SHADES = 4
"""Charts of one colour share a texel with those that differ by less than this [of 255]."""
_PATCH = 4  # texels a side of one shared colour: a block of chroma and its surrounding
_SHEET = 16  # patches a side of a sheet of shared colours
GRAIN = 2
"""Rectangles lie on multiples of this: chroma of 2 x 2 texels is never that of two charts."""
SIDE = 16
"""A page's sides are multiples of this: its first four halves are exact, and JPEG's blocks whole."""


@dataclass(eq=False)
class Sheets:
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


def assembled(mesh: Mesh, charts: Charts, sheets: Sheets, margin: int, largest: int) -> Mesh:
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


def _means(
    of: NDArray[Any], colours: Floats, known: NDArray[np.bool_], count: int | None = None
) -> Floats:
    """Mean colours (N, 3) of what is known of each group; of everything where nothing is."""
    count = int(of.max()) + 1 if count is None else count
    number = np.bincount(of[known], minlength=count)
    sums = np.stack([np.bincount(of[known], colours[known, k], count) for k in range(3)], axis=1)
    overall = colours[known].mean(axis=0) if known.any() else np.full(3, 128.0)
    return np.where(number[:, None] > 0, sums / np.maximum(number, 1)[:, None], overall)


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
    sheets: Sheets,
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


def pack(sizes: Ints, largest: int, shade: NDArray[Any]) -> tuple[Ints, Ints, Ints]:
    """Places of rectangles (R, 2) width, height on pages no longer than `largest`.

    Of one height, those of like `shade` (R,) lie side by side: in a coarse copy of the page, whose
    texels are wider than gutters, a chart then mixes with its like.

    Returns
    -------
    page
        (R,) page of each.
    places
        (R, 2) x, y of its first corner.
    pages
        (K, 2) width and height of the pages.

    """
    room = -(-sizes // GRAIN) * GRAIN
    order = np.lexsort((shade, -room[:, 1]))
    width = max(int(np.sqrt(1.05 * room.prod(axis=1).sum())), int(room[:, 0].max(initial=1)))
    width = min(-(-width // SIDE) * SIDE, largest)
    page, places = np.zeros(len(sizes), np.int64), np.zeros((len(sizes), 2), np.int64)
    x = y = shelf = k = 0
    heights = []
    for row, (wide, high) in zip(order.tolist(), room[order].tolist(), strict=True):
        if x + wide > width:  # a new shelf, as high as its first rectangle
            x, y, shelf = 0, y + shelf, 0
        if x == 0 and y + high > largest:
            heights.append(y)
            y, k = 0, k + 1
        shelf = max(shelf, high)
        page[row], places[row] = k, (x, y)
        x += wide
    heights.append(y + shelf)
    pages = [(width, min(-(-max(h, 1) // SIDE) * SIDE, largest)) for h in heights]
    return page, places, np.array(pages, np.int64)


def filled(texels: NDArray[np.uint8], known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Page (h, w, 3) whose unknown texels are smooth between those that are known (h, w).

    Means of known texels are taken over squares that double, then handed down: what lies next to a
    chart has its colour, what is far from all costs next to nothing.
    """
    weights = [known.astype(np.float32)]
    means = [texels * weights[0][:, :, None]]
    while max(weights[-1].shape) > 1:
        weight, mean = (_halved(a) for a in (weights[-1], means[-1]))
        mean /= np.maximum(weight, 1e-6)[:, :, None]
        weight = np.minimum(weight, 1.0)
        weights.append(weight)
        means.append(mean * weight[:, :, None])
    below: NDArray[Any] = means[-1] / np.maximum(weights[-1], 1e-6)[:, :, None]
    for weight, mean in zip(weights[-2::-1], means[-2::-1], strict=True):
        wide = _doubled(below, weight.shape)
        below = mean + (1.0 - weight[:, :, None]) * wide
    out = np.clip(np.rint(below), 0, 255).astype(np.uint8)
    out[known] = texels[known]
    return out


def _halved(array: NDArray[Any]) -> NDArray[Any]:
    """Sums over squares of 2 x 2; what is missing at the edge is 0."""
    h, w = array.shape[:2]
    padded = np.pad(array, [(0, h % 2), (0, w % 2), *[(0, 0)] * (array.ndim - 2)])
    rows = padded[::2] + padded[1::2]
    out: NDArray[Any] = rows[:, ::2] + rows[:, 1::2]
    return out


def _doubled(array: NDArray[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Array twice as large, cut to `shape`, smooth between the texels' centres."""
    for axis in (0, 1):
        before, after = (np.roll(array, s, axis) for s in (1, -1))
        index: list[Any] = [slice(None)] * 3
        index[axis] = slice(0, 1)
        before[tuple(index)] = array[tuple(index)]
        index[axis] = slice(-1, None)
        after[tuple(index)] = array[tuple(index)]
        pair = np.stack([0.75 * array + 0.25 * before, 0.75 * array + 0.25 * after], axis + 1)
        new = list(array.shape)
        new[axis] *= 2
        array = pair.reshape(new)
    return array[: shape[0], : shape[1]]
