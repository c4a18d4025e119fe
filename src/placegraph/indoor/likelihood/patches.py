"""Patches of one image, compared with the objects of a map: what encoders hand to the likelihood."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.io.capture.frame import Frame

TEMPERATURE = 0.05
"""Cosine that counts one nat, of encoders whose vectors agree or do not."""


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Cosines of the patches of one image with the N objects of a map.

    Several patches may share a row of the table (two patches that both say "chair"); a learned
    encoder gives every patch a row of its own.
    """

    camera: Camera
    """Camera whose image the grid divides."""
    grid: tuple[int, int]
    """Rows and columns of patches; a property of the encoder."""
    rows: NDArray[np.int32]
    """(rows * columns,) int32, row of `table` of each patch, row by row; -1: says nothing."""
    table: NDArray[np.float32]
    """(L, N) float32, cosine similarity in [-1, 1] of each row with each object."""
    temperature: float = TEMPERATURE
    """Cosine that counts one nat."""
    named: bool = True
    """Whether patches say what a thing is, not what it looks like: looks alone make no pose `OK`."""


@runtime_checkable
class MapEncoder(Protocol):
    """Anything that encodes frames for one map."""

    def encode(self, frame: Frame) -> Patches | None:
        """Return patches of a frame; None where it has nothing to encode."""
