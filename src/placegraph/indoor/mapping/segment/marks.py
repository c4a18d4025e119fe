"""What hangs flat on a wall or lies flat on a floor: patches of another colour in a plane."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.mapping.segment.segment_kernels import connect

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.mapping.segment.options import SegmentOptions
    from placegraph.indoor.mapping.segment.patches import Patches
    from placegraph.indoor.mapping.segment.planes import Structure

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_MOST = 0.35  # of its plane: a larger patch is the plane's own colour, or its shade
_CARPET = 8.0  # no carpet is larger [m2]: it is floor of another colour


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
        most = min(_MOST * whole[row], _CARPET if on_floor else np.inf)
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
