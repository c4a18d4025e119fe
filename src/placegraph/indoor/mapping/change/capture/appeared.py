"""What is new in a place: readings before the map that nothing explains, gathered over all frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.indoor.mapping.change.capture.capture_kernels import BITS, connected
from placegraph.indoor.mapping.change.capture.looks import project
from placegraph.indoor.mapping.change.capture.tally import Rest, tolerance
from placegraph.indoor.mapping.change.changes import Change, Piece
from placegraph.indoor.mapping.change.register import moved
from placegraph.indoor.mapping.fuse import Fused
from placegraph.io.capture.frame import Frame

_MARGIN = 0.12
"""What lies this near to a thing that moved belongs to it [m]."""
_SEEN_THROUGH = 0.5
"""A cell that this share of the frames that look at it see through is not there (any more)."""
_LEAST_TRIANGLES = 12  # of a surface that is one; a box has as many
_FINE = 0.02
"""Voxel of the surface of what appeared [m]."""
_EMPTY = 2  # cells around all, so that a neighbour's number never wraps around


@dataclass(frozen=True, slots=True, eq=False)
class Clump:
    """Cells (V, 3) that touch, with a point and a colour each."""

    points: Floats
    """(V, 3) mean of the readings in each cell [m]."""
    colours: NDArray[np.uint8]
    """(V, 3)"""
    cells: NDArray[np.int64]
    """(V, 3)"""
    frames: int
    """That show some of it."""
    pixels: int

    @property
    def low(self) -> Floats:
        """(3,) of its box [m]."""
        return np.asarray(self.points.min(axis=0))

    @property
    def high(self) -> Floats:
        """(3,) of its box [m]."""
        return np.asarray(self.points.max(axis=0))


def gather(rest: Rest) -> list[Clump]:
    """Clumps of unexplained readings, the largest first."""
    points, colours = [np.zeros((0, 3))], [np.zeros((0, 3))]
    frame = [np.zeros(0, np.int64)]
    for t, (look, new) in enumerate(zip(rest.looks, rest.new, strict=True)):
        points.append(look.points(new))
        colours.append(np.nan_to_num(look.rgb[new]).astype(np.float64))
        frame.append(np.full(len(points[-1]), t))
    every, tints, frames = np.concatenate(points), np.concatenate(colours), np.concatenate(frame)
    if not len(every):
        return []
    cells, at = np.unique(
        np.floor(every / rest.options.voxel).astype(np.int64), axis=0, return_inverse=True
    )
    at = at.ravel()
    count = np.bincount(at)
    middle = np.stack([np.bincount(at, every[:, k]) for k in range(3)], axis=1) / count[:, None]
    tint = np.stack([np.bincount(at, tints[:, k]) for k in range(3)], axis=1) / count[:, None]
    views = np.bincount(np.unique(at * len(rest.looks) + frames) // len(rest.looks))
    standing = (count >= 3) & ~_carved(rest, middle, views)
    number = np.full(len(cells), -1)
    number[standing] = clumps(cells[standing])
    found = []
    for k in range(number.max() + 1):
        own = number == k
        mine = own[at]
        shown = len(np.unique(frames[mine]))
        paint = np.rint(255.0 * tint[own]).astype(np.uint8)
        found.append(Clump(middle[own], paint, cells[own], shown, int(mine.sum())))
    return sorted(found, key=lambda c: -c.pixels)


def clumps(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number (N,) of the clump of each cell (N, 3): cells that touch, also by a corner, share one.

    Raises `OptionError` where cells are a million apart.
    """
    if not len(cells):
        return np.zeros(0, np.int64)
    at = cells - cells.min(axis=0) + _EMPTY
    if int(at.max()) >= (1 << BITS) - _EMPTY:
        raise OptionError(f"Points are {int(at.max()):,} cells apart; make the cells larger.")
    keys = (at[:, 0] << 2 * BITS) + (at[:, 1] << BITS) + at[:, 2]
    unique, rows = np.unique(keys, return_inverse=True)
    return np.unique(connected(unique), return_inverse=True)[1][rows]


def appeared(
    rest: Rest,
    found: Sequence[Clump],
    used: Sequence[tuple[Floats, Floats, Floats]],
    frames: Sequence[Frame],
    poses: Sequence[Floats],
) -> list[Change]:
    """Changes for what of the clumps no moved object explains.

    `used`: of each moved object its box before, and the motion back.
    """
    options = rest.options
    least = min(options.least_frames, len(rest.looks))
    kept: list[tuple[Clump, int]] = []
    for clump in found:
        part = _unused(clump, used)
        pixels = clump.pixels * len(part.points) // len(clump.points)
        if len(part.points) < max(4, 0.3 * len(clump.points)) or clump.frames < least:
            continue
        if pixels >= options.least_pixels and np.max(part.high - part.low) >= options.least_box:
            kept.append((part, pixels))
    fused = _fused(frames, poses) if kept else None
    return [_change(part, pixels, _piece(part, fused, options.voxel)) for part, pixels in kept]


def _unused(clump: Clump, used: Sequence[tuple[Floats, Floats, Floats]]) -> Clump:
    """What of a clump does not belong to a thing that moved."""
    free = np.ones(len(clump.points), np.bool_)
    for low, high, back in used:
        before = moved(back, clump.points)
        free &= ~np.all((before > low - _MARGIN) & (before < high + _MARGIN), axis=1)
    return replace(
        clump, points=clump.points[free], colours=clump.colours[free], cells=clump.cells[free]
    )


def _change(clump: Clump, pixels: int, piece: Piece) -> Change:
    box = np.stack([piece.vertices.min(axis=0), piece.vertices.max(axis=0)])
    size = " x ".join(f"{v:.2f}" for v in np.ptp(box, axis=0))
    shown = clump.frames
    return Change(
        kind="appeared",
        label="unknown",
        box=box,
        piece=piece,
        confidence=(shown + 0.5) / (shown + 1.0) * min(1.0, pixels / 400.0),
        reason=f"{pixels:,} readings in {shown} frames end before the map, in a box of {size} m.",
    )


def _carved(rest: Rest, points: Floats, views: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which points (V, 3) are seen through so often that nothing stands there."""
    through = np.zeros(len(points), np.int64)
    for look in rest.looks:
        if look.depth is None:
            continue
        rows, columns, depth = project(look, points)
        reading = look.depth[np.maximum(rows, 0), np.maximum(columns, 0)]
        with np.errstate(invalid="ignore"):
            slack = tolerance(reading, rest.options) + rest.options.voxel
            through += (rows >= 0) & (reading > depth + slack)
    return np.asarray(through > _SEEN_THROUGH * (through + views))


def _piece(clump: Clump, fused: Fused | None, voxel: float) -> Piece:
    """What was fused in a clump's cells; a box where that is nothing."""
    if fused is not None:
        centres = np.floor(fused.vertices[fused.triangles].mean(axis=1) / voxel).astype(np.int64)
        inside = _touching(centres, clump.cells)
        if np.count_nonzero(inside) >= _LEAST_TRIANGLES:
            rows, triangles = np.unique(fused.triangles[inside], return_inverse=True)
            return Piece(fused.vertices[rows], triangles.reshape(-1, 3), fused.colours[rows])
    points, half = clump.points, voxel / 4
    colour = np.median(clump.colours, axis=0).astype(np.uint8)
    return Piece.box(points.min(axis=0) - half, points.max(axis=0) + half, colour)


def _fused(frames: Sequence[Frame], poses: Sequence[Floats]) -> Fused | None:
    """Surface of all that the frames show; None where they show none."""
    from placegraph.indoor.mapping.fuse import fuse

    try:
        return fuse(frames, np.array(poses), voxel=_FINE)
    except InputError:
        return None


def _touching(cells: NDArray[np.int64], others: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which cells (N, 3) are one of others (M, 3), or touch one."""
    steps = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    grown = np.unique((others[:, None] + steps).reshape(-1, 3), axis=0)
    low, high = grown.min(axis=0), grown.max(axis=0)
    near = np.flatnonzero(((cells >= low) & (cells <= high)).all(axis=1))
    mask = np.zeros(high - low + 1, np.bool_)
    mask[tuple((grown - low).T)] = True
    out = np.zeros(len(cells), np.bool_)
    out[near] = mask[tuple((cells[near] - low).T)]
    return out
