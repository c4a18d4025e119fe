"""Cutting by geometry: planes of floor, walls and ceilings, and patches joined into objects."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.indoor.map.floor import weighted_quantiles
from placegraph.indoor.mapping.segment.faces import (
    Faces,
    PatchGraph,
    Samples,
    cut_patches,
    describe_patches,
)
from placegraph.indoor.mapping.segment.segment_kernels import connect, nearest

if TYPE_CHECKING:
    from placegraph.indoor.mapping.segment import SegmentOptions

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

UPRIGHT = 0.35  # |z| of the normal of an upright face is below this
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
    """Find upright planes that are large and high enough, one mask (F,) a connected region."""
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
            off, facing = _plane_distances(faces, normals, rows, way, distance)
            near = rows[(off < options.flatness) & facing]
            if near.size:
                way, distance = _fit_line(faces.centres[near, :2], faces.areas[near], way, distance)
        off, facing = _plane_distances(faces, normals, rows, way, distance)
        inside = (off < options.flatness) & facing
        own = rows[inside]
        if not own.size:  # a peak of faces that do not lie on its plane: they are left alone
            off, _ = _plane_distances(faces, normals, rows, way, distance)
            rows = rows[off >= _BIN] if (off < _BIN).any() else rows[:0]
            continue
        found += _find_regions(faces, own, way, distance, options)
        rows = rows[~inside]
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


@dataclass(frozen=True, slots=True, eq=False)
class _Wall:
    """A region of an upright plane."""

    rows: Ints
    way: Floats
    distance: float
    low: float
    high: float
    span: tuple[float, float]  # From where to where it reaches along the plane [m]
    area: float


def _plane_distances(
    faces: Faces, normals: Floats, rows: Ints, way: Floats, distance: float
) -> tuple[Floats, Mask]:
    """Return distances (R,) of faces from an upright plane [m], and whether they run along it (R,)."""
    corners = faces.points[faces.corners[rows]]
    off = np.abs(corners[:, :, 0] * way[0] + corners[:, :, 1] * way[1] - distance).max(axis=1)
    facing = np.abs(normals[rows, 0] * way[0] + normals[rows, 1] * way[1]) > _FACING
    return off, facing


def _upright_peak(
    faces: Faces, angle: Floats, rows: Ints, least: float
) -> tuple[float, float | None]:
    """Return direction [rad] and distance [m] of the upright plane with most area; None: below `least`."""
    turn = np.floor(angle[rows] / np.pi * _TURNS + 0.5).astype(np.int64) % _TURNS
    turns = np.arange(_TURNS) / _TURNS * np.pi
    spots = faces.centres[rows]
    distance = spots[:, 0] * np.cos(turns[turn]) + spots[:, 1] * np.sin(turns[turn])
    bins = bin_heights(distance)
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


def _fit_line(spots: Floats, weights: Floats, way: Floats, distance: float) -> tuple[Floats, float]:
    """Fit a line to points (N, 2) by least squares: normal (2,) and distance."""
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


def _find_regions(
    faces: Faces, own: Ints, way: Floats, distance: float, options: SegmentOptions
) -> list[_Wall]:
    """Find parts of a plane that a grid connects, where they are large and high enough for a wall."""
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


def _stands_before(wall: _Wall, other: _Wall) -> bool:
    """Return whether a plane is the front or the side of furniture at another one that is higher."""
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


def find_peak(heights: Floats, areas: Floats) -> tuple[float, float]:
    """Find height and area of the level with most area: the median of what lies near its bin."""
    bins = bin_heights(heights)
    low = int(bins.min())
    table = np.bincount(bins - low + 1, areas, int(bins.max()) - low + 3)
    around = table.copy()
    around[1:-1] += table[:-2] + table[2:]
    best = int(np.argmax(around)) - 1 + low
    own = np.abs(bins - best) <= 1
    (height,) = weighted_quantiles(heights[own], areas[own], (0.5,))
    return height, float(areas[own].sum())


def bin_heights(values: Floats) -> Ints:
    """Return bin (N,) of each value; what is far from most shares the outermost."""
    bins = np.floor(values / _BIN).astype(np.int64)
    middle = int(np.median(bins))
    return np.clip(bins, middle - _REACH, middle + _REACH)


_LEVEL = 0.9
_LOW = 0.2  # a surface that carries things is this far above the floor [m]
_RESTS = 0.7  # share of a contact that is concave where something only stands on a surface
_ALONE = 0.25  # area [m2] of what could stand alone, and
_WIDE = 0.3  # its second largest extent [m]: it is no post and no rail


def join_patches(patches: PatchGraph, floor: float | None, options: SegmentOptions) -> Ints:
    """Join patches (N,) to objects, named by their lowest; planes of the structure stay alone."""
    free = patches.plane < 0
    ends, kept = patches.ends, free[patches.ends].all(axis=1)
    carried = _find_carried(patches, free, floor, options)
    kept &= ~carried
    return join_parts(patches, ends[kept], patches.lengths[kept], patches.concave[kept], options)


def _find_carried(
    patches: PatchGraph, free: Mask, floor: float | None, options: SegmentOptions
) -> Mask:
    """Find contacts (E,) of things with the level surfaces they stand on."""
    ends, lengths = patches.ends, patches.lengths
    base = patches.low[:, 2].min(initial=0.0) if floor is None else floor
    level = free & (patches.normals[:, 2] > _LEVEL) & (patches.low[:, 2] > base + _LOW)
    flat = level[ends].all(axis=1) & (patches.concave < 0.5)
    surface = connect(len(patches), ends[flat])
    wide = np.bincount(surface, patches.areas * level, len(patches))
    tops = level & (wide[surface] >= options.support)
    inner = free[ends].all(axis=1)
    apart = inner & ~tops[ends].any(axis=1)
    thing = connect(len(patches), ends[apart])
    meets = np.flatnonzero(inner & tops[ends[:, 0]] & ~tops[ends[:, 1]])
    key = surface[ends[meets, 0]] * (len(patches) + 1) + thing[ends[meets, 1]]
    _, row = np.unique(key, return_inverse=True)
    total = np.bincount(row, lengths[meets])
    over = np.bincount(row, (lengths * patches.concave)[meets])
    # what joins any surface from the side or from below is no thing on a surface
    part = np.zeros(len(patches), np.bool_)
    tied = over < _RESTS * total
    part[thing[ends[meets[tied[row]], 1]]] = True
    out = np.zeros(len(ends), np.bool_)
    rests = meets[~part[thing[ends[meets, 1]]]]
    pair = np.sort(ends, axis=1)
    code = pair[:, 0] * (len(patches) + 1) + pair[:, 1]
    out[np.isin(code, code[rests])] = True
    return out


@dataclass(slots=True)
class _Part:
    """Patches joined so far."""

    area: float
    low: Floats
    high: Floats
    contacts: dict[int, tuple[float, float]]
    """Length and concave length of contact with each other part [m]."""

    def is_standalone(self) -> bool:
        """Return whether a segment is large enough to be an object by itself."""
        return self.area >= _ALONE and bool(np.partition(self.high - self.low, 1)[1] >= _WIDE)


def join_parts(
    patches: PatchGraph, ends: Ints, lengths: Floats, concave: Floats, options: SegmentOptions
) -> Ints:
    """Join parts (N,) over their contacts (E,), but for the thin ones; named by the lowest."""
    parts = [
        _Part(float(a), low, high, {})
        for a, low, high in zip(patches.areas, patches.low, patches.high, strict=True)
    ]
    for (a, b), length, share in zip(
        ends.tolist(), lengths.tolist(), concave.tolist(), strict=True
    ):
        for one, two in ((a, b), (b, a)):  # both directions halve into one contact
            total, inward = parts[one].contacts.get(two, (0.0, 0.0))
            half = 0.5 * length
            parts[one].contacts[two] = (total + half, inward + half * share)
    root = np.arange(len(parts))
    queue = [
        (-_contact_strength(parts, a, b), a, b)
        for a, part in enumerate(parts)
        for b in part.contacts
        if a < b
    ]
    heapq.heapify(queue)
    while queue:
        value, a, b = heapq.heappop(queue)
        if root[a] != a or root[b] != b or value != -_contact_strength(parts, a, b):
            continue  # an older state of one of them
        if _is_thin(parts, a, b, options):
            continue
        root[b] = a
        for other in _merge_parts(parts, a, b):
            low, high = min(a, other), max(a, other)
            heapq.heappush(queue, (-_contact_strength(parts, low, high), low, high))
    for i in range(len(root)):
        root[i] = root[root[i]]  # roots are lower, so theirs are settled
    return root


def _contact_strength(parts: list[_Part], a: int, b: int) -> float:
    """Return length of a contact, the concave part of it at a third, over the size of the smaller part."""
    length, inward = parts[a].contacts[b]
    return (length - 0.67 * inward) / min(parts[a].area, parts[b].area) ** 0.5


def _is_thin(parts: list[_Part], a: int, b: int, options: SegmentOptions) -> bool:
    one, two = parts[a], parts[b]
    length, inward = one.contacts[b]
    if inward < 0.5 * length or not (one.is_standalone() and two.is_standalone()):
        return False
    return bool(length < options.thin * min(one.area, two.area) ** 0.5)


def _merge_parts(parts: list[_Part], a: int, b: int) -> list[int]:
    """Put part b into part a; returns all that touch it now."""
    one, two = parts[a], parts[b]
    one.area += two.area
    one.low, one.high = np.minimum(one.low, two.low), np.maximum(one.high, two.high)
    del one.contacts[b]
    for other, (length, inward) in two.contacts.items():
        if other == a:
            continue
        total, before = one.contacts.get(other, (0.0, 0.0))
        one.contacts[other] = parts[other].contacts[a] = (total + length, before + inward)
        del parts[other].contacts[b]
    two.contacts = {}
    return list(one.contacts)


def absorb_small(
    group: Ints, patches: PatchGraph, fixed: NDArray[np.bool_], options: SegmentOptions
) -> Ints:
    """Absorb small groups (N,) of patches into what they touch most.

    A group is named by one of its patches; those whose patch is `fixed` (N,) stay. So does what
    touches nothing.
    """
    areas = np.bincount(group, patches.areas, len(patches))
    contacts = _measure_contacts(group, patches)
    root = np.arange(len(patches))
    queue = [(float(areas[g]), int(g)) for g in np.unique(group) if not fixed[g]]
    heapq.heapify(queue)
    while queue:
        area, g = heapq.heappop(queue)
        if area >= options.least:
            break
        if root[g] != g or area != areas[g] or not contacts[g]:
            continue
        to = max(contacts[g].items(), key=lambda item: (item[1], -item[0]))[0]
        root[g] = to
        areas[to] += area
        for other, length in contacts[g].items():
            del contacts[other][g]
            if other != to:
                contacts[to][other] = contacts[to].get(other, 0.0) + length
                contacts[other][to] = contacts[other].get(to, 0.0) + length
        contacts[g] = {}
        if not fixed[to]:
            heapq.heappush(queue, (float(areas[to]), to))
    while (root != root[root]).any():
        root = root[root]
    return root[group]


def _measure_contacts(group: Ints, patches: PatchGraph) -> list[dict[int, float]]:
    """Measure length of contact [m] of each group with others."""
    contacts: list[dict[int, float]] = [{} for _ in range(len(patches))]
    ends = group[patches.ends].tolist()
    for (a, b), length in zip(ends, patches.lengths.tolist(), strict=True):
        if a != b:
            for one, two in ((a, b), (b, a)):
                contacts[one][two] = contacts[one].get(two, 0.0) + 0.5 * length
    return contacts


ROUNDS = 3  # How often normals and colours are levelled
_OWN_SHADE = 0.35  # of its plane: a larger patch is the plane's own colour, or its shade
_CARPET = 8.0  # no carpet is larger [m2]: it is floor of another colour
LEVEL = 0.9  # |z| of the normal of a level face, from here on
_STOREY = 1.8  # a ceiling is at least this far above the floor [m]


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """Faces put into patches, and patches into objects."""

    structure: Structure
    patches: PatchGraph
    groups: Ints  # (N,) object of each patch, named by one of its patches


def cut_by_geometry(faces: Faces, options: SegmentOptions, tell: Callable[[str], None]) -> Cut:
    """Cut faces, at least one, into floor, ceiling, walls and objects."""
    normals, lab = faces.smooth(ROUNDS)
    tell("planes")
    structure = find_structure(faces, normals, options)
    tell("patches")
    patch = cut_patches(faces, normals, lab, structure.of_face, structure.outward, options)
    patches = describe_patches(faces, normals, patch, structure.of_face, structure.outward, options)
    patches, structure = lift_marks(patches, structure, options)
    tell("objects")
    group = join_patches(patches, structure.floor, options)
    bound = patches.plane >= 0
    first: dict[int, int] = {}
    for row in np.flatnonzero(bound).tolist():
        group[row] = first.setdefault(int(patches.plane[row]), row)
    group = absorb_small(group, patches, bound, options)
    return Cut(structure, patches, absorb_lost(group, patches, bound, faces, options.least))


def absorb_lost(
    group: Ints, patches: PatchGraph, fixed: NDArray[np.bool_], faces: Faces, least: float
) -> Ints:
    """Absorb small groups (N,) that touch nothing into the nearest other one."""
    areas = np.bincount(group, patches.areas, len(patches))
    small = areas[group] < least
    small &= ~fixed[group]
    if small.all() or not small.any():
        return group
    large = np.flatnonzero(~small[patches.of_face])
    lost = np.unique(group[small])
    lead = np.array([int(np.flatnonzero(patches.of_face == g)[0]) for g in lost])
    near = large[nearest(faces.centres[lead], faces.centres[large])]
    to = np.arange(len(patches))
    to[lost] = group[patches.of_face[near]]
    return to[group]


def lift_marks(
    patches: PatchGraph, structure: Structure, options: SegmentOptions
) -> tuple[PatchGraph, Structure]:
    """Lift pictures, boards and carpets out of the planes of the structure.

    What hangs on a wall becomes a patch among others, so that its frame joins it. What lies on the
    floor becomes a plane of its own, a floor too: it joins none of the things that stand on it.
    """
    plane, labels = patches.plane.copy(), list(structure.labels)
    usual = _plane_colours(patches, len(labels))
    shade = np.sqrt(((patches.lab - usual[np.maximum(patches.plane, 0)]) ** 2).sum(axis=1))
    odd = (patches.plane >= 0) & (shade > options.contrast)
    a, b = patches.ends.T
    same = odd[a] & odd[b] & (patches.plane[a] == patches.plane[b])
    mark = connect(len(patches), patches.ends[same])
    area = np.bincount(mark, patches.areas * odd, len(patches))
    whole = np.bincount(np.maximum(plane, 0), patches.areas * (plane >= 0), len(labels) or 1)
    for m in np.unique(mark[odd]).tolist():
        own = odd & (mark == m)
        row = int(patches.plane[m])
        on_floor = structure.labels[row] == "floor"
        least = options.carpet if on_floor else options.mark
        most = min(_OWN_SHADE * whole[row], _CARPET if on_floor else np.inf)
        if not least <= area[m] <= most:
            continue
        plane[own] = len(labels) if on_floor else -1
        if on_floor:
            labels.append("floor")
    return replace(patches, plane=plane), replace(structure, labels=tuple(labels))


def _plane_colours(patches: PatchGraph, count: int) -> Floats:
    """Return colour (P, 3) CIELAB of each plane: the median of its patches by area."""
    out = np.zeros((max(count, 1), 3))
    for row in range(count):
        own = np.flatnonzero(patches.plane == row)
        for k in range(3):
            if len(own):
                (out[row, k],) = weighted_quantiles(patches.lab[own, k], patches.areas[own], (0.5,))
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """Planes of a building, in order: floor, ceilings, walls."""

    of_face: Ints  # (F,) row of the plane, -1: none
    labels: tuple[str, ...]  # "floor", "ceiling" or "wall" of each
    floor: float | None  # Height of the floor [m]
    outward: bool
    """Whether the mesh faces free space, as far as its floor tells; else it is inside out."""


def find_structure(faces: Faces, normals: Floats, options: SegmentOptions) -> Structure:
    """Find the large planes of a mesh; `normals` (F, 3) are smoothed."""
    of_face = np.full(len(faces), -1, np.int64)
    labels: list[str] = []
    level = np.abs(normals[:, 2]) > LEVEL
    height, floor_plane = _find_floor(faces, normals, level, options)
    outward = True
    if height is not None:
        below = level & (np.abs(_height_above(faces.centres, floor_plane)) < options.flatness)
        of_face[below] = 0
        labels.append("floor")
        outward = float((faces.areas * normals[:, 2])[below].sum()) >= 0
        for part in _find_ceilings(faces, normals, level & (of_face < 0), height, outward, options):
            of_face[part] = len(labels)
            labels.append("ceiling")
    for part in find_walls(faces, normals, of_face < 0, height, options):
        of_face[part] = len(labels)
        labels.append("wall")
    return Structure(of_face, tuple(labels), height, outward)


def _height_above(points: Floats, plane: Floats) -> Floats:
    """Return height (N,) of points over a plane z = p0 x + p1 y + p2."""
    out: Floats = points[:, 2] - points[:, 0] * plane[0] - points[:, 1] * plane[1] - plane[2]
    return out


def _find_floor(
    faces: Faces, normals: Floats, level: Mask, options: SegmentOptions
) -> tuple[float | None, Floats]:
    """Find height and plane of the floor: the largest level surface in the lowest part of the mesh."""
    nothing = np.zeros(3)
    if not level.any():
        return None, nothing
    z = faces.centres[:, 2]
    low, high = weighted_quantiles(z, faces.areas, (0.005, 0.98))
    near = level & (z <= low + max(0.25 * (high - low), 0.4))
    up = near & (normals[:, 2] > 0)
    down = near & (normals[:, 2] < 0)
    chosen = up if faces.areas[up].sum() >= 0.5 * faces.areas[down].sum() else down
    if not chosen.any():
        return None, nothing
    height, area = find_peak(z[chosen], faces.areas[chosen])
    span = np.ptp(faces.points[:, :2], axis=0)
    if area < max(0.5, 0.05 * float(span[0] * span[1])):
        return None, nothing
    plane = np.array([0.0, 0.0, height])
    for _ in range(3):  # a scan's floor may lean by a degree
        inside = chosen & (np.abs(_height_above(faces.centres, plane)) < 1.5 * options.flatness)
        plane = _fit_plane(faces.centres[inside], faces.areas[inside], plane)
    inside = chosen & (np.abs(_height_above(faces.centres, plane)) < options.flatness)
    if not inside.any():
        return None, nothing
    (height,) = weighted_quantiles(z[inside], faces.areas[inside], (0.5,))
    return height, plane


def _fit_plane(points: Floats, weights: Floats, before: Floats) -> Floats:
    """Fit a plane z = p0 x + p1 y + p2; `before` where it leans over 3 degrees."""
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


def _find_ceilings(
    faces: Faces, normals: Floats, free: Mask, floor: float, outward: bool, options: SegmentOptions
) -> list[Mask]:
    """Level planes far above the floor that face it, the largest first."""
    facing = normals[:, 2] * (1.0 if outward else -1.0) < 0
    free = free & (faces.centres[:, 2] > floor + _STOREY) & facing
    found = []
    while free.any():
        z = faces.centres[:, 2]
        height, area = find_peak(z[free], faces.areas[free])
        own = free & (np.abs(z - height) < options.flatness)
        if area < options.wall_area:
            break
        found.append(own)
        free = free & ~own
    return found
