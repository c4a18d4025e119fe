"""The surface of a sparse volume as a mesh: dual marching cubes.

Nielson, "Dual marching cubes", 2004: where marching cubes has a polygon in a cell, one vertex; where
the surface crosses an edge of the grid, a quad of the four cells around it. Two sheets within a
cell stay apart, so that edges have two triangles but for rare configurations, and at borders.
"""

from __future__ import annotations

from collections import Counter
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.mapping.fuse import surface_kernels as kernels

if TYPE_CHECKING:
    from placegraph.indoor.mapping.fuse.volume import Volume


Ints = NDArray[np.int64]
Colours = NDArray[np.uint8]


STEEPEST = 1.0
"""Neighbouring voxels differ by one voxel at most, and by noise; not by this much [truncations]."""
NOTHING = 1e-12
"""Triangles of no more than this are none [m^2]."""


def surface_of(
    volume: Volume, *, least: float, speck: float, left_out: Counter[str]
) -> tuple[Floats, Ints, Colours]:
    """Vertices (V, 3) [m], triangles (T, 3) that face free space, and colours (V, 3).

    `least` and `speck` as of `FuseOptions`. All are empty where the volume shows no surface.
    """
    loop_of, loops = loop_tables()
    count = volume.count
    around = kernels.neighbours(volume.keys, volume.rows, volume.places, count)
    cases, crossed, sizes = kernels.cells_of(
        around, volume.distance, volume.weight, least, STEEPEST * volume.truncation, loops
    )
    starts = _starts(sizes)
    points, colours, first = kernels.vertices_of(
        around, volume.places, volume.distance, volume.colour, volume.paint, cases, crossed,
        starts, loop_of, loops, volume.voxel,
    )  # fmt: skip
    none = np.zeros((0, 4), np.int32)
    grid = around, volume.distance, cases, crossed, first, loop_of
    ends = _starts(kernels.quads_of(*grid, np.zeros(count, np.int64), none))
    quads = np.empty((ends[-1], 4), np.int32)
    kernels.quads_of(*grid, ends, quads)
    del around, cases, crossed, first, grid
    triangles = kernels.split(points, quads)
    del quads
    return without_specks(points, triangles, colours, speck, left_out)


def without_specks(
    points: Floats, triangles: Ints, colours: Colours, least: float, left_out: Counter[str]
) -> tuple[Floats, Ints, Colours]:
    """Drop connected parts of less than `least` [m^2], and vertices that nothing uses."""
    root = kernels.roots_of(len(points), triangles)[triangles[:, 0]]
    area = kernels.areas_of(points, triangles)
    size = np.bincount(root, area, minlength=len(points))
    dropped = np.unique(root[size[root] < least])
    if len(dropped):
        left_out["parts of the surface that are too small"] += len(dropped)
    # where knowledge ends in one line, both triangles of a quad may have no area
    kept = triangles[(size[root] >= least) & (area > NOTHING)]
    used = np.zeros(len(points), np.bool_)
    used[kept.ravel()] = True
    place = np.cumsum(used) - 1
    return points[used], place[kept], colours[used]


@lru_cache(maxsize=1)
def loop_tables() -> tuple[NDArray[np.int8], NDArray[np.int8]]:
    """Loop of every edge by case (256, 12), -1: the surface does not cross it; number of loops (256,).

    On each face of a cell the surface joins crossed edges in pairs. Where all four are crossed, the
    two corners behind the surface are cut off one by one; the cell beyond the face does the same.
    Case 0 stands for cells that are known in part: all their crossed edges share one vertex.
    """
    loop_of = np.full((256, 12), -1, np.int8)
    loops = np.zeros(256, np.int8)
    loop_of[0], loops[0] = 0, 1
    edges = {}
    for edge in range(12):
        low = int(kernels.low_corner(edge))
        edges[frozenset((low, low | 1 << (edge >> 2)))] = edge
    faces = [
        (side, side | one, side | one | two, side | two)
        for one, two, axis in ((2, 4, 1), (4, 1, 2), (1, 2, 4))
        for side in (0, axis)
    ]
    for case in range(1, 256):
        group = {e: e for pair, e in edges.items() if len({case >> c & 1 for c in pair}) == 2}
        for face in faces:
            round_ = [edges[frozenset((face[n], face[(n + 1) % 4]))] for n in range(4)]
            crossed = [e for e in round_ if e in group]
            pairs = [tuple(crossed)] if len(crossed) == 2 else []
            if len(crossed) == 4:
                pairs = [(round_[n - 1], round_[n]) for n in range(4) if case >> face[n] & 1]
            for a, b in pairs:
                old, new = group[a], group[b]
                group = {e: new if g == old else g for e, g in group.items()}
        names = sorted(set(group.values()))
        loops[case] = len(names)
        for edge, name in group.items():
            loop_of[case, edge] = names.index(name)
    return loop_of, loops


def _starts(sizes: Ints) -> Ints:
    """Where each part begins, and the end (B + 1,)."""
    return np.concatenate([[0], np.cumsum(sizes)])
