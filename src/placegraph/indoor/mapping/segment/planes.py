"""Floor, ceiling and walls: the large planes of a mesh whose gravity is -z."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.mapping.segment.walls import find_walls, peak, quantiles

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.mapping.segment.faces import Faces
    from placegraph.indoor.mapping.segment.segments import SegmentOptions

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Mask = NDArray[np.bool_]

LEVEL = 0.9
"""|z| of the normal of a level face, from here on."""
_STOREY = 1.8  # a ceiling is at least this far above the floor [m]


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
