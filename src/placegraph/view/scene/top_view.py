"""A mesh seen from above: which triangle is uppermost in each pixel, and how high it lies there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.view.scene.top_view_kernels import _draw

if TYPE_CHECKING:
    from placegraph.view.draw.canvas import Frame


@dataclass(frozen=True, eq=False)
class TopView:
    """Uppermost surface in each pixel of a frame."""

    triangle: NDArray[np.int32]
    """(rows, columns), row of the triangle, -1 where there is none."""
    height: NDArray[np.float32]
    """(rows, columns) [m], of the surface there; -inf where there is none."""


def render_top_view(
    vertices: NDArray[np.float32],
    triangles: NDArray[np.int32],
    lift: NDArray[np.float32],
    frame: Frame,
) -> TopView:
    """Draw triangles from above, the highest on top, one sample at each pixel's centre.

    Vertical triangles, which have no footprint, are drawn as lines: the walls of a scan are nothing
    else.

    Parameters
    ----------
    vertices
        (V, 3) float32, x, y, z [m].
    triangles
        (T, 3) int32, rows of vertices.
    lift
        (T,) float32 [m], added to a triangle's height when it is decided what is on top (paper
        before furniture before walls); -inf leaves it out.
    frame
        What is looked at, and how many pixels show it.

    """
    corners = np.empty(vertices.shape, np.float32)
    corners[:, :2] = frame.to_px(vertices[:, :2].astype(np.float64))
    corners[:, 2] = vertices[:, 2]
    shape = (frame.height, frame.width)
    triangle, level = np.full(shape, -1, np.int32), np.full(shape, -np.inf, np.float32)
    _draw(corners, triangles, lift, triangle, level)
    seen = triangle >= 0
    height = np.full(shape, -np.inf, np.float32)
    height[seen] = level[seen] - lift[triangle[seen]]
    return TopView(triangle, height)


def cut_section(
    vertices: NDArray[np.float32], triangles: NDArray[np.int32], height: float
) -> Floats:
    """Cut triangles by a horizontal plane, as on an architect's plan.

    Returns segments (S, 2, 2), x, y [m]; what is solid lies to the left of a segment where the
    triangles face outwards.
    """
    corners = vertices[triangles].astype(np.float64)
    above = corners[..., 2] > height
    count = above.sum(axis=1)
    corners, above, count = (part[(count == 1) | (count == 2)] for part in (corners, above, count))
    # the corner that stands alone on its side of the plane comes first
    first = np.where(count == 1, above.argmax(axis=1), above.argmin(axis=1))
    order = (first[:, None] + np.arange(3)) % 3
    corners = np.take_along_axis(corners, order[..., None], axis=1)
    apex, others = corners[:, :1], corners[:, 1:]
    share = (height - apex[..., 2:]) / (others[..., 2:] - apex[..., 2:])
    segments: Floats = (apex + share * (others - apex))[..., :2]
    # seen from outside corners turn counter-clockwise: below a lone top they run left to right
    segments[count == 2] = segments[count == 2, ::-1]
    return segments


def fill_section(segments: Floats, frame: Frame) -> NDArray[np.bool_]:
    """Return the pixels (rows, columns) inside segments (S, 2, 2), x, y [m], of `cut_section`.

    Enclosed by the winding number along both axes where these end at zero, so that a gap in an
    outline smears nothing; a wall that stands in another leaves no hole, and a room whose walls
    face inwards is not filled.
    """
    px = frame.to_px(segments)
    along = _winding_numbers(px, frame.height, frame.width)
    across = _winding_numbers(px[..., ::-1], frame.width, frame.height).T
    return (along > 0) & (across < 0)


def _winding_numbers(px: Floats, lines: int, length: int) -> NDArray[np.int32]:
    """Return winding numbers (lines, length) of pixel centres, along lines of constant px[1].

    0 all along a line that some outline crosses in one direction only.
    """
    start, end = px[:, 0], px[:, 1]
    low, high = np.minimum(start[:, 1], end[:, 1]), np.maximum(start[:, 1], end[:, 1])
    first = np.clip(np.ceil(low - 0.5), 0, lines).astype(np.int64)
    last = np.clip(np.ceil(high - 0.5), 0, lines).astype(np.int64)
    which = np.repeat(np.arange(len(px)), last - first)
    line = np.arange(len(which)) - np.repeat(np.cumsum(last - first) - last + first, last - first)
    line += first[which]
    share = (line + 0.5 - start[which, 1]) / (end[which, 1] - start[which, 1])
    at = start[which, 0] + share * (end[which, 0] - start[which, 0])
    step = np.clip(np.ceil(at - 0.5), 0, length).astype(np.int64)
    turns = np.zeros((lines, length + 1), np.int32)
    np.add.at(turns, (line, step), np.where(end[which, 1] > start[which, 1], 1, -1))
    winding: NDArray[np.int32] = np.cumsum(turns, axis=1, dtype=np.int32)
    winding[winding[:, -1] != 0] = 0
    return winding[:, :-1]
