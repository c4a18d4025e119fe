"""Landmarks: points of a map's surfaces that are known again by what they look like."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.mapfile import MapFile
from placegraph.core.pickling import Portable
from placegraph.errors import OptionError

MOST = 20_000
"""Landmarks of a scene."""
WIDTH = 32
"""Numbers of a descriptor."""
GRAIN = 0.0005
"""Step of a map file's coordinates [m]."""
_UNIT = 127.0
_CELL = 0.5  # neighbours in the file are neighbours in space [m]: differences compress


@dataclass(frozen=True, eq=False)
class Landmarks(Portable):
    """L points with compact descriptors, as `placegraph.indoor.refine.landmarks` makes them."""

    points: NDArray[np.float32]
    """(L, 3) [m, map], in whole steps of `GRAIN`."""
    vectors: NDArray[np.int8]
    """(L, WIDTH) unit vectors times 127."""

    def __post_init__(self) -> None:
        shapes, count = (self.points.shape, self.vectors.shape), len(self.points)
        if shapes != ((count, 3), (count, WIDTH)) or not np.isfinite(self.points).all():
            raise OptionError(f"landmarks: shapes {shapes}; finite (L, 3) and (L, {WIDTH}) belong.")

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def of(cls, points: ArrayLike, vectors: ArrayLike) -> Landmarks:
        """Landmarks at points (L, 3) [m] with unit vectors (L, WIDTH), brought into the file's order."""
        points = np.asarray(points, np.float64).reshape(-1, 3)
        steps = np.rint(points / GRAIN)
        order = np.lexsort((*steps.T, *np.floor(points / _CELL).T))
        rounded = np.rint(np.asarray(vectors, np.float64).reshape(-1, WIDTH) * _UNIT)
        return cls((steps[order] * GRAIN).astype(np.float32), rounded[order].astype(np.int8))

    @cached_property
    def unit_vectors(self) -> NDArray[np.float32]:
        """(L, WIDTH) float32."""
        numbers = self.vectors.astype(np.float32)
        return numbers / np.maximum(np.linalg.norm(numbers, axis=1, keepdims=True), 1.0)

    def moved(self, shift: ArrayLike) -> Landmarks:
        """The same, shifted by (3,) [m]."""
        points = self.points.astype(np.float64) + np.asarray(shift, np.float64)
        return Landmarks(points.astype(np.float32), self.vectors)

    @staticmethod
    def joined(parts: Sequence[Landmarks | None]) -> Landmarks | None:
        """Those of several scenes; None where none has any."""
        known = [part for part in parts if part is not None]
        if not known:
            return None
        return Landmarks(
            np.concatenate([part.points for part in known]),
            np.concatenate([part.vectors for part in known]),
        )

    def columns(self) -> dict[str, NDArray[Any]]:
        """Columns of a map file."""
        steps = np.rint(self.points.astype(np.float64) / GRAIN).astype(np.int32)
        return {"landmark_points": steps, "landmark_vectors": self.vectors}

    @classmethod
    def read(cls, file: MapFile) -> Landmarks | None:
        """Landmarks of a map file's columns; None of a file that has none."""
        if not {"landmark_points", "landmark_vectors"} & set(file.arrays):
            return None
        steps = file.array("landmark_points", "<i4", 2).astype(np.float64)
        return cls((steps * GRAIN).astype(np.float32), file.array("landmark_vectors", "|i1", 2))
