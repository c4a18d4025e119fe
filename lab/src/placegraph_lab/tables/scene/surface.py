"""Distance of two surfaces: exact distances from points spread over one to the other."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.change.align import sample_surface
from placegraph_lab.tables.scene.surface_kernels import _CELL, Grid, _distances

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
SAMPLES = 50_000  # points on either surface
REACH = 1.0  # what lies farther away counts as this far [m]


@dataclass(frozen=True)
class SurfaceDistances:
    """Distances of two surfaces [m], of samples of the one and of the other."""

    mean: float
    most: float  # 95 % are nearer than this
    maximum: float


def compare(
    one: Mesh, other: Mesh, rng: np.random.Generator, samples: int = SAMPLES
) -> SurfaceDistances:
    """Distances of samples, spread evenly over either surface, from the other surface."""
    there = distances(spread(one, rng, samples), other)
    off = np.concatenate([there, distances(spread(other, rng, samples), one)])
    return SurfaceDistances(float(off.mean()), float(np.quantile(off, 0.95)), float(off.max()))


def spread(mesh: Mesh, rng: np.random.Generator, samples: int) -> Floats:
    """Points (N, 3) [m], even over the surface."""
    return sample_surface(mesh, np.arange(len(mesh)), samples, rng).points


def distances(points: Floats, mesh: Mesh) -> Floats:
    """Distances (N,) [m] of points (N, 3) from a surface, at most `REACH`."""
    out = np.empty(len(points))
    _distances(points, _grid(mesh), int(np.ceil(REACH / _CELL)), out)
    return np.minimum(out, REACH)


def _grid(mesh: Mesh) -> Grid:
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    low = corners.min(axis=(0, 1))
    first = np.floor((corners.min(axis=1) - low) / _CELL).astype(np.int64)
    last = np.floor((corners.max(axis=1) - low) / _CELL).astype(np.int64)
    shape = last.max(axis=0) + 1
    counts = (last - first + 1).prod(axis=1)
    rows = np.repeat(np.arange(len(corners)), counts)
    nth = np.arange(len(rows)) - np.repeat(np.cumsum(counts) - counts, counts)
    wide, high = (last - first + 1)[rows, 1:].T
    at = first[rows] + np.stack([nth // (wide * high), nth // high % wide, nth % high], axis=1)
    number = (at[:, 0] * shape[1] + at[:, 1]) * shape[2] + at[:, 2]
    order = np.argsort(number, kind="stable")
    cells, starts = np.unique(number[order], return_index=True)
    return Grid(corners, low, shape, cells, np.append(starts, len(rows)), rows[order])
