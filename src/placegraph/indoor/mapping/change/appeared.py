"""Clusters of readings that no object of a map explains, and what appeared there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.indoor.mapping.change import observe
from placegraph.indoor.mapping.change.align import (
    transform_points,
)
from placegraph.indoor.mapping.change.change_kernels import BITS, label_connected
from placegraph.indoor.mapping.change.changes import Change, Piece
from placegraph.indoor.mapping.fuse import FusedSurface
from placegraph.io.capture.frame import Frame

_MARGIN = 0.12  # What lies this near to a thing that moved belongs to it [m]
_SEEN_THROUGH = 0.5
"""A cell that this share of the frames that look at it see through is not there (any more)."""
_LEAST_TRIANGLES = 12  # of a surface that is one; a box has as many
_VOXEL = 0.02  # Voxel of the surface of what appeared [m]
_EMPTY = 2  # cells around all, so that a neighbour's number never wraps around


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """Cells (V, 3) that touch, with a point and a colour each."""

    points: Floats  # (V, 3) mean of the readings in each cell [m]
    colours: NDArray[np.uint8]  # (V, 3)
    cells: NDArray[np.int64]  # (V, 3)
    frames: int  # That show some of it
    pixels: int

    @property
    def low(self) -> Floats:
        """(3,) of its box [m]."""
        return np.asarray(self.points.min(axis=0))

    @property
    def high(self) -> Floats:
        """(3,) of its box [m]."""
        return np.asarray(self.points.max(axis=0))


def gather_clusters(unexplained: observe.UnexplainedReadings) -> list[Cluster]:
    """Gather clusters of unexplained readings, the largest first."""
    points, colours = [np.zeros((0, 3))], [np.zeros((0, 3))]
    frame = [np.zeros(0, np.int64)]
    for t, (observation, new) in enumerate(
        zip(unexplained.observations, unexplained.new, strict=True)
    ):
        points.append(observation.points(new))
        colours.append(np.nan_to_num(observation.rgb[new]).astype(np.float64))
        frame.append(np.full(len(points[-1]), t))
    every, tints, frames = np.concatenate(points), np.concatenate(colours), np.concatenate(frame)
    if not len(every):
        return []
    cells, at = np.unique(
        np.floor(every / unexplained.options.voxel).astype(np.int64), axis=0, return_inverse=True
    )
    at = at.ravel()
    count = np.bincount(at)
    middle = np.stack([np.bincount(at, every[:, k]) for k in range(3)], axis=1) / count[:, None]
    tint = np.stack([np.bincount(at, tints[:, k]) for k in range(3)], axis=1) / count[:, None]
    views = np.bincount(
        np.unique(at * len(unexplained.observations) + frames) // len(unexplained.observations)
    )
    standing = (count >= 3) & ~_find_carved(unexplained, middle, views)
    number = np.full(len(cells), -1)
    number[standing] = label_clusters(cells[standing])
    found = []
    for k in range(number.max() + 1):
        own = number == k
        mine = own[at]
        observed = len(np.unique(frames[mine]))
        paint = np.rint(255.0 * tint[own]).astype(np.uint8)
        found.append(Cluster(middle[own], paint, cells[own], observed, int(mine.sum())))
    return sorted(found, key=lambda c: -c.pixels)


def label_clusters(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number the cluster (N,) of each cell (N, 3): cells that touch, also by a corner, share one."""
    if not len(cells):
        return np.zeros(0, np.int64)
    at = cells - cells.min(axis=0) + _EMPTY
    if int(at.max()) >= (1 << BITS) - _EMPTY:
        raise OptionError(
            f"The points are {int(at.max()):,} cells apart, which is too far; use larger cells."
        )
    keys = (at[:, 0] << 2 * BITS) + (at[:, 1] << BITS) + at[:, 2]
    unique, rows = np.unique(keys, return_inverse=True)
    return np.unique(label_connected(unique), return_inverse=True)[1][rows]


def find_appeared(
    unexplained: observe.UnexplainedReadings,
    clusters: Sequence[Cluster],
    used: Sequence[tuple[Floats, Floats, Floats]],
    frames: Sequence[Frame],
    poses: Sequence[Floats],
) -> list[Change]:
    """Find what appeared: the clusters that no moved object explains.

    `used`: of each moved object its box before, and the motion back.
    """
    options = unexplained.options
    least = min(options.least_frames, len(unexplained.observations))
    kept: list[tuple[Cluster, int]] = []
    for cluster in clusters:
        free = np.ones(len(cluster.points), np.bool_)
        for low, high, back in used:
            before = transform_points(back, cluster.points)
            free &= ~np.all((before > low - _MARGIN) & (before < high + _MARGIN), axis=1)
        part = replace(
            cluster,
            points=cluster.points[free],
            colours=cluster.colours[free],
            cells=cluster.cells[free],
        )
        pixels = cluster.pixels * len(part.points) // len(cluster.points)
        if len(part.points) < max(4, 0.3 * len(cluster.points)) or cluster.frames < least:
            continue
        if pixels >= options.least_pixels and np.max(part.high - part.low) >= options.least_box:
            kept.append((part, pixels))
    fused = _fuse_frames(frames, poses) if kept else None
    return [
        _describe_cluster(part, pixels, _cut_piece(part, fused, options.voxel))
        for part, pixels in kept
    ]


def _describe_cluster(cluster: Cluster, pixels: int, piece: Piece) -> Change:
    box = np.stack([piece.vertices.min(axis=0), piece.vertices.max(axis=0)])
    size = " x ".join(f"{v:.2f}" for v in np.ptp(box, axis=0))
    observed = cluster.frames
    return Change(
        kind="appeared",
        label="unknown",
        box=box,
        piece=piece,
        confidence=(observed + 0.5) / (observed + 1.0) * min(1.0, pixels / 400.0),
        reason=f"{pixels:,} readings in {observed} frames lie in front of the map's surfaces, in a "
        f"box of {size} m.",
    )


def _find_carved(
    unexplained: observe.UnexplainedReadings, points: Floats, views: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Find points (V, 3) that are seen through so often that nothing stands there."""
    through = np.zeros(len(points), np.int64)
    for observation in unexplained.observations:
        if observation.depth is None:
            continue
        rows, columns, depth = observe.project(observation, points)
        reading = observation.depth[rows, columns]
        with np.errstate(invalid="ignore"):
            slack = observe.tolerance(reading, unexplained.options) + unexplained.options.voxel
            through += (rows >= 0) & (reading > depth + slack)
    return np.asarray(through > _SEEN_THROUGH * (through + views))


def _cut_piece(cluster: Cluster, fused: FusedSurface | None, voxel: float) -> Piece:
    """Cut the fused surface in a cluster's cells; a box where there is none."""
    if fused is not None:
        centres = np.floor(fused.vertices[fused.triangles].mean(axis=1) / voxel).astype(np.int64)
        steps = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        grown = np.unique((cluster.cells[:, None] + steps).reshape(-1, 3), axis=0)
        low, high = grown.min(axis=0), grown.max(axis=0)
        near = np.flatnonzero(((centres >= low) & (centres <= high)).all(axis=1))
        mask = np.zeros(high - low + 1, np.bool_)
        mask[tuple((grown - low).T)] = True
        inside = near[mask[tuple((centres[near] - low).T)]]
        if len(inside) >= _LEAST_TRIANGLES:
            rows, triangles = np.unique(fused.triangles[inside], return_inverse=True)
            return Piece(fused.vertices[rows], triangles.reshape(-1, 3), fused.colours[rows])
    points, half = cluster.points, voxel / 4
    colour = np.median(cluster.colours, axis=0).astype(np.uint8)
    return Piece.box(points.min(axis=0) - half, points.max(axis=0) + half, colour)


def _fuse_frames(frames: Sequence[Frame], poses: Sequence[Floats]) -> FusedSurface | None:
    from placegraph.indoor.mapping.fuse import fuse

    try:
        return fuse(frames, np.array(poses), voxel=_VOXEL)
    except InputError:
        return None
