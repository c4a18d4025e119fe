"""Floor, ceiling and walls: the large planes of a mesh whose gravity is -z."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.mapping.segment.samples import Samples
from placegraph.indoor.mapping.segment.segment_kernels import connect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.mapping.segment.faces import Faces
    from placegraph.indoor.mapping.segment.options import SegmentOptions

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Mask = NDArray[np.bool_]

LEVEL = 0.9
"""|z| of the normal of a level face, from here on; of an upright one it is below 0.35."""
UPRIGHT = 0.35
_FACING = 0.85  # cosine between the normals of a face and of its plane
_BIN = 0.04  # [m] of the heights and distances that planes are looked for in
_REACH = 25_000  # of them on either side of the median: 1 km
_TURNS = 60  # directions of walls in half a turn
_CELL = 0.1  # [m] of the grid in which parts of a plane are connected
_STOREY = 1.8  # a ceiling is at least this far above the floor [m]
_DEEP = 0.9  # furniture is at most this deep: what stands this far before a wall [m]
_PLANES = 400  # walls that are looked for at most


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """What holds a building: rows of planes, in order: floor, ceilings, walls."""

    of_face: Ints
    """(F,) row of the plane, -1: none."""
    labels: tuple[str, ...]
    """"floor", "ceiling" or "wall" of each."""
    floor: float | None
    """Height of the floor [m]."""
    outward: bool
    """Whether the mesh faces free space, as far as its floor tells; else it is inside out."""


def find_structure(faces: Faces, normals: Floats, options: SegmentOptions) -> Structure:
    """Large planes of a mesh; `normals` (F, 3) are the levelled ones."""
    of_face = np.full(len(faces), -1, np.int64)
    labels: list[str] = []
    level = np.abs(normals[:, 2]) > LEVEL
    height, floor_plane = _floor(faces, normals, level, options)
    outward = True
    if height is not None:
        below = level & (np.abs(_above(faces.centres, floor_plane)) < options.flatness)
        of_face[below] = 0
        labels.append("floor")
        outward = float((faces.areas * normals[:, 2])[below].sum()) >= 0
        for part in _ceilings(faces, normals, level & (of_face < 0), height, outward, options):
            of_face[part] = len(labels)
            labels.append("ceiling")
    for part in _walls(faces, normals, of_face < 0, height, options):
        of_face[part] = len(labels)
        labels.append("wall")
    return Structure(of_face, tuple(labels), height, outward)


def _above(points: Floats, plane: Floats) -> Floats:
    """Height (N,) of points over a plane z = p0 x + p1 y + p2."""
    out: Floats = points[:, 2] - points[:, 0] * plane[0] - points[:, 1] * plane[1] - plane[2]
    return out


def _floor(
    faces: Faces, normals: Floats, level: Mask, options: SegmentOptions
) -> tuple[float | None, Floats]:
    """Height and plane of the floor: the largest level surface in the lowest part of the mesh."""
    nothing = np.zeros(3)
    if not level.any():
        return None, nothing
    z = faces.centres[:, 2]
    low, high = _quantiles(z, faces.areas, (0.005, 0.98))
    near = level & (z <= low + max(0.25 * (high - low), 0.4))
    up = near & (normals[:, 2] > 0)
    down = near & (normals[:, 2] < 0)
    chosen = up if faces.areas[up].sum() >= 0.5 * faces.areas[down].sum() else down
    if not chosen.any():
        return None, nothing
    height, area = _peak(z[chosen], faces.areas[chosen])
    span = np.ptp(faces.points[:, :2], axis=0)
    if area < max(0.5, 0.05 * float(span[0] * span[1])):
        return None, nothing
    plane = np.array([0.0, 0.0, height])
    for _ in range(3):  # a scan's floor may lean by a degree
        inside = chosen & (np.abs(_above(faces.centres, plane)) < 1.5 * options.flatness)
        plane = _fitted(faces.centres[inside], faces.areas[inside], plane)
    inside = chosen & (np.abs(_above(faces.centres, plane)) < options.flatness)
    if not inside.any():
        return None, nothing
    (height,) = _quantiles(z[inside], faces.areas[inside], (0.5,))
    return height, plane


def _fitted(points: Floats, weights: Floats, before: Floats) -> Floats:
    """Plane z = p0 x + p1 y + p2 of least squares; the one before where it leans over 3 degrees."""
    if len(points) < 3:
        return before
    middle = (points * weights[:, None]).sum(axis=0) / weights.sum()
    x, y, z = (points - middle).T
    square = [(weights * a * b).sum() for a, b in ((x, x), (x, y), (y, y), (x, z), (y, z))]
    determinant = square[0] * square[2] - square[1] ** 2
    if determinant < 1e-3:
        return before
    lean = np.array(
        [
            (square[3] * square[2] - square[4] * square[1]) / determinant,
            (square[4] * square[0] - square[3] * square[1]) / determinant,
        ]
    )
    if np.hypot(*lean) > 0.05:
        return before
    return np.array([*lean, middle[2] - lean @ middle[:2]])


def _ceilings(
    faces: Faces, normals: Floats, free: Mask, floor: float, outward: bool, options: SegmentOptions
) -> list[Mask]:
    """Level planes far above the floor that face it, the largest first."""
    facing = normals[:, 2] * (1.0 if outward else -1.0) < 0
    free = free & (faces.centres[:, 2] > floor + _STOREY) & facing
    found = []
    while free.any():
        z = faces.centres[:, 2]
        height, area = _peak(z[free], faces.areas[free])
        own = free & (np.abs(z - height) < options.flatness)
        if area < options.wall_area:
            break
        found.append(own)
        free = free & ~own
    return found


def _walls(
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
    bins = _bins(distance)
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


def _peak(heights: Floats, areas: Floats) -> tuple[float, float]:
    """Height and area of the level with most area: the median of what lies near its bin."""
    bins = _bins(heights)
    low = int(bins.min())
    table = np.bincount(bins - low + 1, areas, int(bins.max()) - low + 3)
    around = table.copy()
    around[1:-1] += table[:-2] + table[2:]
    best = int(np.argmax(around)) - 1 + low
    own = np.abs(bins - best) <= 1
    (height,) = _quantiles(heights[own], areas[own], (0.5,))
    return height, float(areas[own].sum())


def _bins(values: Floats) -> Ints:
    """Bin (N,) of each value; what is far from most shares the outermost."""
    bins = np.floor(values / _BIN).astype(np.int64)
    middle = int(np.median(bins))
    return np.clip(bins, middle - _REACH, middle + _REACH)


def _quantiles(values: Floats, weights: Floats, shares: tuple[float, ...]) -> list[float]:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weights[order])
    rows = np.searchsorted(total, np.array(shares) * total[-1])
    return [float(v) for v in values[order[np.minimum(rows, len(order) - 1)]]]
