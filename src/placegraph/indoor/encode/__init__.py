"""Encoders say, patch by patch, which objects of the map an image may show (Sec. 3.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from placegraph.formats.frame import Frame
    from placegraph.geometry import Camera

__all__ = ["Encoder", "Patches"]


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """What the patches of one image say of the N objects of a map.

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


@runtime_checkable
class Encoder(Protocol):
    """Anything that encodes frames for one map."""

    def encode(self, frame: Frame) -> Patches | None:
        """Patches of a frame; None where it has nothing to encode."""
