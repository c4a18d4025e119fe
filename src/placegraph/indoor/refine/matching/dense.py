"""From a dense warp of two images to matches: what the RoMa family answers, thinned out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.refine.matching.matches import Matches, inside


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Where each pixel of a grid lies in both images.

    Normalised coordinates run from -1 to 1 between the images' edges, so that pixel i of n has
    its centre at (2 i + 1) / n - 1.
    """

    query: NDArray[np.float32]
    """(h, w, 2) normalised x y in the query."""
    view: NDArray[np.float32]
    """(h, w, 2) normalised x y in the rendered view."""
    certainty: NDArray[np.float32]
    """(h, w) in [0, 1]."""


def to_pixels(normalised: NDArray[np.floating], size: tuple[int, int]) -> Floats:
    """Pixels (..., 2), centres at +0.5, of normalised coordinates (..., 2); size: height, width."""
    height, width = size
    return (np.asarray(normalised, np.float64) + 1.0) / 2.0 * (width, height)


def to_normalised(pixels: Floats, size: tuple[int, int]) -> Floats:
    """Normalised coordinates (..., 2) of pixels (..., 2); inverse of `to_pixels`."""
    height, width = size
    return np.asarray(pixels, np.float64) * 2.0 / (width, height) - 1.0


def thinned(
    warps: Sequence[Warp],
    query: tuple[int, int],
    view: tuple[int, int],
    *,
    count: int,
    least: float,
    mask: NDArray[np.bool_] | None = None,
    margin: int = 0,
) -> Matches:
    """About `count` matches, spread over the images: the surest of each block of pixels.

    The authors draw theirs at random by certainty and density; this gives the same ones again.

    Parameters
    ----------
    warps
        One, or one for each direction.
    query, view
        Height and width of the images [px].
    count
        Most matches.
    least
        Smallest certainty of a match.
    mask
        (H, W) bool of the view; matches lie in it, and `margin` px from its edge.
    margin
        [px]

    """
    parts = [_blocks(warp, max(1, count // len(warps)), least) for warp in warps]
    ours = to_pixels(np.concatenate([p[0] for p in parts]), query)
    theirs = to_pixels(np.concatenate([p[1] for p in parts]), view)
    sure = np.concatenate([p[2] for p in parts])
    keep = _in_image(ours, query) & _in_image(theirs, view)
    keep[keep] = inside(mask, theirs[keep], margin)
    return Matches.of(ours[keep], theirs[keep], sure[keep])


def _blocks(
    warp: Warp, count: int, least: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The surest pixel of each of at most `count` blocks: in the query, in the view, certainty."""
    height, width = warp.certainty.shape
    side = int(np.ceil(np.sqrt(height * width / count)))
    while -(-height // side) * -(-width // side) > count and side < max(height, width):
        side += 1
    rows, columns = -(-height // side), -(-width // side)
    sure = np.full((rows * side, columns * side), -1.0, np.float32)
    sure[:height, :width] = np.nan_to_num(warp.certainty, nan=-1.0)
    tiles = sure.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows * columns, -1)
    best = tiles.argmax(axis=1)
    block = np.arange(rows * columns)
    keep = tiles[block, best] >= max(least, 0.0)
    y = (block // columns * side + best // side)[keep]
    x = (block % columns * side + best % side)[keep]
    return warp.query[y, x], warp.view[y, x], warp.certainty[y, x]


def _in_image(points: Floats, size: tuple[int, int]) -> NDArray[np.bool_]:
    height, width = size
    x, y = points.T
    found: NDArray[np.bool_] = (x > 0) & (x < width) & (y > 0) & (y < height)
    return found
