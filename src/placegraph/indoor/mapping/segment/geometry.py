"""A mesh cut by its geometry and colour alone: planes of the building, and the things between."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.mapping.segment.marks import lift_marks
from placegraph.indoor.mapping.segment.objects import join_patches, settle
from placegraph.indoor.mapping.segment.patches import Patches, cut_patches, describe
from placegraph.indoor.mapping.segment.planes import Structure, find_structure
from placegraph.indoor.mapping.segment.segment_kernels import nearest

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from placegraph.indoor.mapping.segment.faces import Faces
    from placegraph.indoor.mapping.segment.options import SegmentOptions

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

ROUNDS = 3
"""How often normals and colours are levelled."""


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
