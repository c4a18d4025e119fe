"""Rectangles on pages, and what lies between them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int64]

GRAIN = 2
"""Rectangles lie on multiples of this: chroma of 2 x 2 texels is never that of two charts."""
SIDE = 16
"""A page's sides are multiples of this: its first four halves are exact, and JPEG's blocks whole."""


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
