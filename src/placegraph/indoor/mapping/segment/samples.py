"""Points spread over faces: how large faces and separate parts are compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.mapping.segment import segment_kernels as kernels

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.mapping.segment.faces import Faces

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_MOST = 6_000_000
"""More points than this are not spread: their distance grows instead."""


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """S points, each in one face."""

    spots: Floats
    """(S, 3) [m]"""
    face: Ints
    """(S,) rows of faces."""
    step: float
    """About their distance [m]."""

    @classmethod
    def of(cls, faces: Faces, rows: Ints, step: float) -> Samples:
        """Points about `step` [m] apart on the faces `rows` (R,); at least one on each."""
        corners = faces.corners[rows]
        parts = kernels.sample_counts(faces.points, corners, step)
        while (parts.astype(np.float64) ** 2).sum() > _MOST + len(rows):
            step *= 1.5
            parts = kernels.sample_counts(faces.points, corners, step)
        spots, row = kernels.samples(faces.points, corners, parts)
        return cls(spots, rows[row], step)

    def touching(self, group: Ints, reach: float) -> Ints:
        """Rows (K, 2) of points of different groups (F,) of faces that are within `reach` [m]."""
        if not len(self.spots):
            return np.zeros((0, 2), np.int64)
        reach = max(reach, self.step)
        low = self.spots.min(axis=0) - reach
        kept = self._thinned(group, low)
        spots, own = self.spots[kept], group[self.face[kept]]
        shape = ((self.spots.max(axis=0) - low) / reach).astype(np.int64) + 3
        keys = kernels.cell_keys(spots, low, reach, shape)
        order = np.argsort(keys, kind="stable")
        return kept[kernels.touching(spots, own, order, keys[order], shape, reach)]

    def _thinned(self, group: Ints, low: Floats) -> Ints:
        """One point (N,) of each group in a cube of side `step`, the first of them."""
        shape = ((self.spots.max(axis=0) - low) / self.step).astype(np.int64) + 3
        keys = kernels.cell_keys(self.spots, low, self.step, shape)
        order = np.lexsort((group[self.face], keys))
        where, whose = keys[order], group[self.face[order]]
        fresh = np.ones(len(order), np.bool_)
        fresh[1:] = (np.diff(where) != 0) | (np.diff(whose) != 0)
        return np.sort(order[fresh])
