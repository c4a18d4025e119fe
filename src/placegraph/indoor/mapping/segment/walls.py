"""Walls: upright planes that are large and high enough, and no fronts of furniture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.floor import quantiles
from placegraph.indoor.mapping.segment.faces import Faces, Samples
from placegraph.indoor.mapping.segment.segment_kernels import connect

if TYPE_CHECKING:
    from placegraph.indoor.mapping.segment.segments import SegmentOptions


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


UPRIGHT = 0.35
"""|z| of the normal of an upright face is below this."""
_FACING = 0.85  # cosine between the normals of a face and of its plane
_TURNS = 60  # directions of walls in half a turn
_CELL = 0.1  # [m] of the grid in which parts of a plane are connected
_DEEP = 0.9  # furniture is at most this deep: what stands this far before a wall [m]
_PLANES = 400  # walls that are looked for at most
_BIN = 0.04  # [m] of the heights and distances that planes are looked for in
_REACH = 25_000  # of them on either side of the median: 1 km


def find_walls(
    faces: Faces, normals: Floats, free: Mask, floor: float | None, options: SegmentOptions
) -> list[Mask]:
    """Upright planes that are large and high enough, one mask (F,) a connected region."""
    free = free & (np.abs(normals[:, 2]) < UPRIGHT)
    angle = np.arctan2(normals[:, 1], normals[:, 0])
    found: list[_Wall] = []
    rows = np.flatnonzero(free)
    for _ in range(_PLANES):
        if not rows.size:
            break
        turn, distance = _upright_peak(faces, angle, rows, options.wall_area)
        if distance is None:
            break
        way = np.array([np.cos(turn), np.sin(turn)])
        for _ in range(2):
            off, facing = _off(faces, normals, rows, way, distance)
            near = rows[(off < options.flatness) & facing]
            if near.size:
                way, distance = _line(faces.centres[near, :2], faces.areas[near], way, distance)
        off, facing = _off(faces, normals, rows, way, distance)
        inside = (off < options.flatness) & facing
        own = rows[inside]
        if not own.size:  # a peak of faces that do not lie on its plane: they are left alone
            off, _ = _off(faces, normals, rows, way, distance)
            rows = rows[off >= _BIN] if (off < _BIN).any() else rows[:0]
            continue
        found += _regions(faces, own, way, distance, options)
        rows = rows[~inside]
    return _kept(faces, found, floor)


@dataclass(frozen=True, slots=True, eq=False)
class _Wall:
    """A region of an upright plane."""

    rows: Ints
    way: Floats
    distance: float
    low: float
    high: float
    span: tuple[float, float]
    """From where to where it reaches along the plane [m]."""
    area: float


def _off(
    faces: Faces, normals: Floats, rows: Ints, way: Floats, distance: float
) -> tuple[Floats, Mask]:
    """How far each face lies from an upright plane (R,) [m], and whether it runs along it (R,)."""
    corners = faces.points[faces.corners[rows]]
    off = np.abs(corners[:, :, 0] * way[0] + corners[:, :, 1] * way[1] - distance).max(axis=1)
    facing = np.abs(normals[rows, 0] * way[0] + normals[rows, 1] * way[1]) > _FACING
    return off, facing


def _upright_peak(
    faces: Faces, angle: Floats, rows: Ints, least: float
) -> tuple[float, float | None]:
    """Direction [rad] and distance [m] of the upright plane with most area; None: below `least`."""
    turn = np.floor(angle[rows] / np.pi * _TURNS + 0.5).astype(np.int64) % _TURNS
    turns = np.arange(_TURNS) / _TURNS * np.pi
    spots = faces.centres[rows]
    distance = spots[:, 0] * np.cos(turns[turn]) + spots[:, 1] * np.sin(turns[turn])
    bins = bins_of(distance)
    low = int(bins.min())
    wide = int(bins.max()) - low + 3
    counts = np.bincount(turn * wide + bins - low + 1, faces.areas[rows], _TURNS * wide)
    table = counts.reshape(_TURNS, wide)
    around = table.copy()
    around[:, 1:-1] += table[:, :-2] + table[:, 2:]
    best = int(np.argmax(around))
    if around.flat[best] < least * 0.5:
        return 0.0, None
    return float(turns[best // wide]), (best % wide - 1 + low + 0.5) * _BIN


def _line(spots: Floats, weights: Floats, way: Floats, distance: float) -> tuple[Floats, float]:
    """Normal (2,) and distance of the line of least squares through points (N, 2)."""
    whole = weights.sum()
    middle = (spots * weights[:, None]).sum(axis=0) / whole
    x, y = (spots - middle).T
    xx, xy, yy = (weights * x * x).sum(), (weights * x * y).sum(), (weights * y * y).sum()
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    fresh = np.array([-np.sin(along), np.cos(along)])
    if abs(float(fresh @ way)) < 0.98 or max(xx, yy) < 0.01 * whole:
        return way, distance
    fresh *= np.sign(float(fresh @ way))
    return fresh, float(fresh @ middle)


def _regions(
    faces: Faces, own: Ints, way: Floats, distance: float, options: SegmentOptions
) -> list[_Wall]:
    """Parts of a plane that a grid connects, where they are large and high enough for a wall."""
    spread = Samples.of(faces, own, _CELL)
    along = spread.spots[:, 1] * way[0] - spread.spots[:, 0] * way[1]
    z = spread.spots[:, 2]
    column = np.floor(along / _CELL).astype(np.int64)
    row = np.floor(z / _CELL).astype(np.int64)
    column -= column.min() - 1
    row -= row.min() - 1
    tall = int(row.max()) + 3
    cells, cell = np.unique(column * tall + row, return_inverse=True)
    links = [np.stack([cell, cell], axis=1)[:0]]
    for step in (1, tall, tall + 1, tall - 1, 2, 2 * tall):  # across gaps of one cell too
        at = np.minimum(np.searchsorted(cells, cells + step), len(cells) - 1)
        there = np.flatnonzero(cells[at] == cells + step)
        links.append(np.stack([there, at[there]], axis=1))
    # cells of one face hang together
    first = np.flatnonzero(np.diff(spread.face, prepend=-1))
    lead = np.repeat(cell[first], np.diff([*first, len(cell)]))
    links.append(np.stack([lead, cell], axis=1))
    part = connect(len(cells), np.concatenate(links))[cell[first]]
    areas = np.bincount(part, faces.areas[own], len(cells))
    out = []
    big = [p for p in np.unique(part).tolist() if areas[p] >= options.wall_area]
    face_part = part[np.searchsorted(first, np.arange(len(cell)), side="right") - 1]
    for p in big:
        mine = face_part == p
        low, high = float(z[mine].min()), float(z[mine].max())
        if high - low >= options.wall_height:
            ends = float(along[mine].min()), float(along[mine].max())
            wall = _Wall(own[part == p], way, distance, low, high, ends, float(areas[p]))
            out.append(wall)
    return out


def _kept(faces: Faces, found: list[_Wall], floor: float | None) -> list[Mask]:
    """Masks (F,) of the walls, without fronts of furniture: what stands before a higher wall."""
    kept = []
    for wall in found:
        reach = wall.high - (floor if floor is not None else wall.low)
        front = any(_stands_before(wall, other) for other in found if other is not wall)
        if reach < 1.5 or front:
            continue
        mask = np.zeros(len(faces), np.bool_)
        mask[wall.rows] = True
        kept.append(mask)
    return kept


def _stands_before(wall: _Wall, other: _Wall) -> bool:
    """Whether a plane is the front or the side of furniture at another one that is higher."""
    if wall.high > other.high - 0.15 or other.area < 1.5 * wall.area:
        return False
    cosine = float(wall.way @ other.way)
    if abs(cosine) > 0.95:
        apart = abs(wall.distance - np.sign(cosine) * other.distance)
        low, high = wall.span if cosine > 0 else (-wall.span[1], -wall.span[0])
        shared = min(high, other.span[1]) - max(low, other.span[0])
        return bool(apart < _DEEP and shared > 0.5 * (high - low))
    # across: a side that starts at the wall and ends before the depth of furniture
    return bool(wall.span[1] - wall.span[0] < _DEEP and abs(cosine) < 0.3)


def peak(heights: Floats, areas: Floats) -> tuple[float, float]:
    """Height and area of the level with most area: the median of what lies near its bin."""
    bins = bins_of(heights)
    low = int(bins.min())
    table = np.bincount(bins - low + 1, areas, int(bins.max()) - low + 3)
    around = table.copy()
    around[1:-1] += table[:-2] + table[2:]
    best = int(np.argmax(around)) - 1 + low
    own = np.abs(bins - best) <= 1
    (height,) = quantiles(heights[own], areas[own], (0.5,))
    return height, float(areas[own].sum())


def bins_of(values: Floats) -> Ints:
    """Bin (N,) of each value; what is far from most shares the outermost."""
    bins = np.floor(values / _BIN).astype(np.int64)
    middle = int(np.median(bins))
    return np.clip(bins, middle - _REACH, middle + _REACH)
