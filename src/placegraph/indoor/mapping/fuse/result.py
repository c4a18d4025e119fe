"""Options of fusion, and what comes of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from placegraph.errors import OptionError
from placegraph.indoor.options import check_numbers, check_positive

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class FuseOptions:
    """How frames are fused; defaults are what measured best (`docs/benchmarks/maps.md`)."""

    least: float = 0.0003
    """Weight that a surface needs [1 / m^4]: one view weighs cos(angle of incidence) / depth^4, since
    the noise of depth grows with its square. One frontal view from 7.6 m is enough."""
    speck: float = 0.02
    """Connected parts of less surface than this are dropped [m^2]."""
    edges: bool = True
    """Drop readings at depth edges, where cameras often read a mean of both sides."""
    gains: bool = True
    """Bring every image to the brightness of the model fused so far: exposure changes vanish."""
    memory: float = 1.5
    """What the volume may take [GB]; making the mesh of it takes up to as much again."""
    coarsen: bool = True
    """Beyond that begin again with coarser voxels, and say so; else raise `OptionError`."""

    def __post_init__(self) -> None:
        check_numbers(self)
        check_positive(self, "memory")
        if self.memory > 2.0:
            raise OptionError(f"memory is {self.memory} GB; a volume takes 2 GB at most.")


@dataclass(frozen=True, slots=True, eq=False)
class FuseStats:
    """What fusion did, and how well the frames agree."""

    seconds: float
    frames: int
    """That were used."""
    voxel: float
    """Edge [m]; larger than asked for where `coarser` says so."""
    voxels: int
    """In blocks that hold anything."""
    memory: int
    """Of the volume [bytes]."""
    agreement: float
    """Median distance of the used readings from the fused surface [m]. Poses that drift show here:
    it should not be much above the depth's own noise."""
    apart: float
    """Share of the readings that are farther from it than half the truncation."""
    residuals: NDArray[np.float64]
    """(T,) the same median by frame [m], NaN where it was not used: bad poses stand out."""
    gains: NDArray[np.float64]
    """(T,) what each image was multiplied by, NaN where it was not used."""
    coarser: str = ""
    """Why the voxels are coarser than asked for, or empty."""


@dataclass(frozen=True, slots=True, eq=False)
class Fused:
    """Coloured surface; triangles face free space and share their vertices."""

    vertices: NDArray[np.float64]
    """(V, 3) [m, map]"""
    triangles: NDArray[np.int64]
    """(T, 3) rows of vertices, counter-clockwise seen from free space."""
    colours: NDArray[np.uint8]
    """(V, 3) sRGB"""
    stats: FuseStats
