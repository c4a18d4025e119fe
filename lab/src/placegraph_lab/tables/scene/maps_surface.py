"""How far two surfaces lie apart: exact distances from points spread over one to the other."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.map.mesh import Mesh

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

SAMPLES = 50_000
"""Points on either surface."""
REACH = 1.0
"""What lies farther away counts as this far [m]."""
_CELL = 0.1  # [m]


@dataclass(frozen=True)
class Apart:
    """Distances of two surfaces [m], of samples of the one and of the other."""

    mean: float
    most: float
    """95 % are nearer than this."""
    maximum: float
    there: list[float]
    """The same three of samples of the first alone ..."""
    back: list[float]
    """... and of the second."""


class Grid(NamedTuple):
    """Triangles by the cells that they may touch."""

    corners: Floats
    """(T, 3, 3) [m]"""
    low: Floats
    """(3,) lowest corner of cell 0 [m]."""
    shape: Ints
    """(3,) cells an axis."""
    cells: Ints
    """(C,) numbers of those that hold a triangle, ascending."""
    starts: Ints
    """(C + 1,) first row of each in `rows`."""
    rows: Ints
    """Triangles."""


def compare(one: Mesh, other: Mesh, rng: np.random.Generator, samples: int = SAMPLES) -> Apart:
    """Distances of samples, spread evenly over either surface, from the other surface."""
    there = distances(spread(one, rng, samples), other)
    back = distances(spread(other, rng, samples), one)
    (mean, most, maximum), *each = (_three(d) for d in (np.concatenate([there, back]), there, back))
    return Apart(mean, most, maximum, *each)


def spread(mesh: Mesh, rng: np.random.Generator, samples: int) -> Floats:
    """Points (N, 3) [m], even over the surface."""
    area = np.linalg.norm(mesh.normals().astype(np.float64), axis=1)
    rows = rng.choice(len(mesh), samples, p=area / area.sum())
    root, split = np.sqrt(rng.random(samples)), rng.random(samples)
    shares = np.stack([1.0 - root, root * (1.0 - split), root * split], axis=1)
    points: Floats = np.einsum("nkd,nk->nd", mesh.vertices[mesh.triangles[rows]], shares)
    return points


def distances(points: Floats, mesh: Mesh) -> Floats:
    """Distances (N,) [m] of points (N, 3) from a surface, at most `REACH`."""
    out = np.empty(len(points))
    _distances(points, _grid(mesh), int(np.ceil(REACH / _CELL)), out)
    return np.minimum(out, REACH)


def _three(found: Floats) -> list[float]:
    return [float(found.mean()), float(np.quantile(found, 0.95)), float(found.max())]


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


@njit(cache=True, nogil=True)
def _distances(points: Floats, grid: Grid, rings: int, out: Floats) -> None:
    """Fill distances (N,): cells are looked at from the point's own outwards, ring by ring."""
    for i in range(len(points)):
        own = np.floor((points[i] - grid.low) / _CELL).astype(np.int64)
        best = np.inf
        for ring in range(rings + 1):
            for x in range(own[0] - ring, own[0] + ring + 1):
                for y in range(own[1] - ring, own[1] + ring + 1):
                    side = abs(x - own[0]) == ring or abs(y - own[1]) == ring
                    for z in range(own[2] - ring, own[2] + ring + 1, 1 if side else 2 * ring):
                        best = min(best, _squared_in(points[i], grid, x, y, z))
            if best <= (ring * _CELL) ** 2:  # all else is farther
                break
        out[i] = np.sqrt(best)


@njit(cache=True, nogil=True)
def _squared_in(point: Floats, grid: Grid, x: int, y: int, z: int) -> float:
    """Squared distance of a point from what a cell holds; infinite if nothing."""
    best = np.inf
    shape = grid.shape
    if 0 <= x < shape[0] and 0 <= y < shape[1] and 0 <= z < shape[2]:
        number = (x * shape[1] + y) * shape[2] + z
        k = np.searchsorted(grid.cells, number)
        if k < len(grid.cells) and grid.cells[k] == number:
            for row in grid.rows[grid.starts[k] : grid.starts[k + 1]]:
                best = min(best, _squared(point, grid.corners[row]))
    return best


@njit(cache=True, nogil=True)
def _squared(point: Floats, corners: Floats) -> float:
    """Squared distance of a point from a triangle: from its plane if above it, else its edges."""
    ax, ay, az = corners[1] - corners[0]
    bx, by, bz = corners[2] - corners[0]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    inside = nx * nx + ny * ny + nz * nz > 0.0
    best = np.inf
    for k in range(3):
        a, b = corners[k], corners[(k + 1) % 3]
        ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        px, py, pz = point[0] - a[0], point[1] - a[1], point[2] - a[2]
        length = ex * ex + ey * ey + ez * ez
        along = (ex * px + ey * py + ez * pz) / length if length > 0.0 else 0.0
        along = min(max(along, 0.0), 1.0)
        dx, dy, dz = px - along * ex, py - along * ey, pz - along * ez
        best = min(best, dx * dx + dy * dy + dz * dz)
        turn = nx * (ey * pz - ez * py) + ny * (ez * px - ex * pz) + nz * (ex * py - ey * px)
        inside = inside and turn >= 0.0
    if inside:
        px, py, pz = point[0] - corners[0, 0], point[1] - corners[0, 1], point[2] - corners[0, 2]
        return (nx * px + ny * py + nz * pz) ** 2 / (nx * nx + ny * ny + nz * nz)
    return best
