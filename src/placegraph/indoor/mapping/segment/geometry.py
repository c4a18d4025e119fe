"""A mesh cut by its geometry and colour alone: planes of the building, and the things between."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.mapping.segment.objects import join_patches, settle
from placegraph.indoor.mapping.segment.patches import Patches, cut_patches, describe
from placegraph.indoor.mapping.segment.planes import Structure, find_structure
from placegraph.indoor.mapping.segment.segment_kernels import connect, nearest

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from placegraph.indoor.mapping.segment.faces import Faces
    from placegraph.indoor.mapping.segment.patches import Patches
    from placegraph.indoor.mapping.segment.planes import Structure
    from placegraph.indoor.mapping.segment.segments import SegmentOptions

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

ROUNDS = 3
"""How often normals and colours are levelled."""
_OWN_SHADE = 0.35  # of its plane: a larger patch is the plane's own colour, or its shade
_CARPET = 8.0  # no carpet is larger [m2]: it is floor of another colour


@dataclass(frozen=True, slots=True, eq=False)
class Cut:
    """Faces put into patches, and patches into objects."""

    structure: Structure
    patches: Patches
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
    group: Ints, patches: Patches, fixed: NDArray[np.bool_], faces: Faces, least: float
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
    patches: Patches, structure: Structure, options: SegmentOptions
) -> tuple[Patches, Structure]:
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


def _usual_colours(patches: Patches, count: int) -> Floats:
    """Colour (P, 3) CIELAB of each plane: the median of its patches by area."""
    out = np.zeros((max(count, 1), 3))
    for row in range(count):
        own = np.flatnonzero(patches.plane == row)
        for k in range(3):
            order = own[np.argsort(patches.lab[own, k], kind="stable")]
            total = np.cumsum(patches.areas[order])
            if len(order):
                at = int(np.searchsorted(total, 0.5 * total[-1]))
                out[row, k] = patches.lab[order[min(at, len(order) - 1)], k]
    return out
