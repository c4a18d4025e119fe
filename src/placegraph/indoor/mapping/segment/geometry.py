"""A mesh cut by its geometry and colour alone: planes of the building, and the things between."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.floor import quantiles
from placegraph.indoor.mapping.segment.objects import join_patches, settle
from placegraph.indoor.mapping.segment.patches import PatchGraph, cut_patches, describe
from placegraph.indoor.mapping.segment.segment_kernels import connect, nearest
from placegraph.indoor.mapping.segment.walls import find_walls, peak

if TYPE_CHECKING:
    from placegraph.indoor.mapping.segment.faces import Faces
    from placegraph.indoor.mapping.segment.segments import SegmentOptions


Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]


ROUNDS = 3
"""How often normals and colours are levelled."""
_OWN_SHADE = 0.35  # of its plane: a larger patch is the plane's own colour, or its shade
_CARPET = 8.0  # no carpet is larger [m2]: it is floor of another colour
LEVEL = 0.9
"""|z| of the normal of a level face, from here on."""
_STOREY = 1.8  # a ceiling is at least this far above the floor [m]


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """Faces put into patches, and patches into objects."""

    structure: Structure
    patches: PatchGraph
    groups: Ints
    """(N,) object of each patch, named by one of its patches."""


def cut_by_geometry(faces: Faces, options: SegmentOptions, tell: Callable[[str], None]) -> Cut:
    """Floor, ceiling, walls, and the rest in objects; `faces` has at least one."""
    normals, lab = faces.smoothed(ROUNDS)
    tell("planes")
    structure = find_structure(faces, normals, options)
    tell("patches")
    patch = cut_patches(faces, normals, lab, structure.of_face, structure.outward, options)
    patches = describe(faces, normals, patch, structure.of_face, structure.outward, options)
    patches, structure = lift_marks(patches, structure, options)
    tell("objects")
    group = join_patches(patches, structure.floor, options)
    bound = patches.plane >= 0
    first: dict[int, int] = {}
    for row in np.flatnonzero(bound).tolist():
        group[row] = first.setdefault(int(patches.plane[row]), row)
    group = settle(group, patches, bound, options)
    return Cut(structure, patches, adopted(group, patches, bound, faces, options.least))


def adopted(
    group: Ints, patches: PatchGraph, fixed: NDArray[np.bool_], faces: Faces, least: float
) -> Ints:
    """Groups (N,), those that are too small and touch nothing put into the nearest other one."""
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
    """Patches and structure with the pictures, boards and carpets taken out of its planes.

    What hangs on a wall becomes a patch among others, so that its frame joins it. What lies on the
    floor becomes a plane of its own, a floor too: it joins none of the things that stand on it.
    """
    plane, labels = patches.plane.copy(), list(structure.labels)
    usual = _usual_colours(patches, len(labels))
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


def _usual_colours(patches: PatchGraph, count: int) -> Floats:
    """Colour (P, 3) CIELAB of each plane: the median of its patches by area."""
    out = np.zeros((max(count, 1), 3))
    for row in range(count):
        own = np.flatnonzero(patches.plane == row)
        for k in range(3):
            if len(own):
                (out[row, k],) = quantiles(patches.lab[own, k], patches.areas[own], (0.5,))
    return out


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
    for part in find_walls(faces, normals, of_face < 0, height, options):
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
    low, high = quantiles(z, faces.areas, (0.005, 0.98))
    near = level & (z <= low + max(0.25 * (high - low), 0.4))
    up = near & (normals[:, 2] > 0)
    down = near & (normals[:, 2] < 0)
    chosen = up if faces.areas[up].sum() >= 0.5 * faces.areas[down].sum() else down
    if not chosen.any():
        return None, nothing
    height, area = peak(z[chosen], faces.areas[chosen])
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
    (height,) = quantiles(z[inside], faces.areas[inside], (0.5,))
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
        height, area = peak(z[free], faces.areas[free])
        own = free & (np.abs(z - height) < options.flatness)
        if area < options.wall_area:
            break
        found.append(own)
        free = free & ~own
    return found
