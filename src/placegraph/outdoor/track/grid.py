"""A belief over places on the grid of the viewpoints, and how motion spreads it.

The grid covers the map's viewpoints and a margin; cells without a viewpoint (nothing is in sight
there) hold probability only where motion brought it. What leaves the grid is elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.outdoor.map.index import STRIDE, ViewIndex
from placegraph.outdoor.search.posterior import ELSEWHERE
from placegraph.outdoor.track.grid_kernels import background, scatter

MARGIN = 15
"""Cells around the viewpoints: whoever leaves the map by 300 m is still followed."""
BACKGROUND = 0.03
"""Of a belief in more cells than `MOST_SPREAD`, the lightest are shifted whole: so much of the
probability ..."""
MOST_SPREAD = 40_000
"""... or all but so many. What is that broad is no broader for being spread."""
FINE = 8.0
"""A motion is sampled at least this finely [m] ..."""
MOST_SAMPLES = 400_000
"""... by no more samples than this."""
WIDE = 4e8
"""Cells times cells of the kernel from which motion goes through the Fourier transform."""
FARTHEST = 5000.0
"""After a way longer than this nothing is left of what was known [m]."""
ODOMETRY = 0.03
"""Deviation of measured motion, as a share of it ..."""
STEP = 1.0
"""... plus this [m]."""
COMPASS = 0.1
"""Deviation of a measured bearing [rad]."""
KIDNAPPED = 0.01
"""Probability that the speaker is somewhere else altogether after a motion."""
RETURNED = 0.2
"""Probability that who was elsewhere is on the map again after a motion."""


@dataclass(frozen=True, eq=False)
class TrackGrid:
    """Square cells around the viewpoints of a map, as wide as these stand apart."""

    low: Floats
    """(2,) centre of the first cell, east and north [m]."""
    rows: int
    columns: int
    cells: NDArray[np.int64]
    """(W,) cell of every viewpoint, ``row * columns + column``."""

    @classmethod
    def of(cls, views: ViewIndex) -> TrackGrid:
        """Grid of a map's viewpoints."""
        positions = views.positions.astype(np.float64)
        low = positions.min(axis=0) - MARGIN * STRIDE
        column, row = np.rint((positions - low) / STRIDE).astype(np.int64).T
        rows, columns = int(row.max()) + MARGIN + 1, int(column.max()) + MARGIN + 1
        return cls(low, rows, columns, row * columns + column)

    def positions(self, cells: NDArray[np.int64]) -> Floats:
        """Centres (n, 2) of cells (n,), east and north [m]."""
        row, column = np.divmod(cells, self.columns)
        return np.asarray(self.low + STRIDE * np.stack([column, row], axis=1))


@dataclass(frozen=True, eq=False)
class Belief:
    """Where the speaker may be; masses and `elsewhere` sum to 1."""

    mass: NDArray[np.float32]
    """(rows, columns) probability of every cell."""
    elsewhere: float
    """Probability of being on no place of the grid."""

    @classmethod
    def start(cls, grid: TrackGrid, shares: Floats | None = None) -> Belief:
        """Belief before a word is heard: `shares` (W,) of the viewpoints, or all alike.

        Shares sum to 1, or to less where the speaker may have been off the map from the start.
        """
        mass = np.zeros(grid.rows * grid.columns, np.float32)
        mass[grid.cells] = (1.0 - ELSEWHERE) * (1.0 / len(grid.cells) if shares is None else shares)
        return cls(mass.reshape(grid.rows, grid.columns), 1.0 - float(mass.sum(dtype=np.float64)))


class Kernel(NamedTuple):
    """What a motion does to probability."""

    row: int
    column: int
    """Displacement of the first entry, in cells."""
    weights: NDArray[np.float32]
    """(K, L), sums to 1."""
    mean: Floats
    """(2,) expected displacement [m]."""
    covariance: Floats
    """(2, 2) of the displacement [m^2]."""


def straight(east: float, north: float, sigma: float) -> Kernel:
    """Kernel of a measured displacement [m], with its standard deviation along each axis [m]."""
    along = _normal(sigma)
    shift, share = _grid_of(along, along)
    return _kernel(shift + np.array([east, north]), share)


def odometry_sigma(length: float) -> float:
    """Deviation of a measured motion of this length [m]."""
    return ODOMETRY * length + STEP


def way(distance: float, sigma: float, bearing: float | None, bearing_sigma: float) -> Kernel:
    """Kernel of a distance [m] in a direction [rad], each with its deviation; None: in any direction.

    A negative distance that the deviation allows counts as its amount: who hardly moved may have
    gone to any side.
    """
    lengths, share = _normal(sigma, distance)
    reach = distance + 2.5 * sigma
    if bearing is None:
        n = max(16, min(1024, int(2.0 * np.pi * reach / FINE)))
        turns, odds = 2.0 * np.pi * (np.arange(n) + 0.5) / n, np.full(n, 1.0 / n)
    else:
        turns, odds = _normal(bearing_sigma, bearing, fine=FINE / max(reach, FINE))
    if len(lengths) * len(turns) > MOST_SAMPLES:
        lengths, share = lengths[::4], share[::4] / share[::4].sum()
    d, b = np.meshgrid(np.abs(lengths), turns, indexing="ij")
    shift = np.stack([d * np.sin(b), d * np.cos(b)], axis=-1).reshape(-1, 2)
    return _kernel(shift, np.outer(share, odds).ravel())


def _normal(sigma: float, mean: float = 0.0, fine: float = FINE) -> tuple[Floats, Floats]:
    """Nodes and shares of a normal distribution, `fine` apart at the most, out to 2.5 sigma."""
    if sigma <= 0.0:
        return np.array([mean]), np.ones(1)
    n = 2 * int(np.clip(2.5 * sigma / fine, 5, 400)) + 1
    z = np.linspace(-2.5, 2.5, n)
    share = np.exp(-0.5 * z * z)
    return mean + sigma * z, share / share.sum()


def _grid_of(x: tuple[Floats, Floats], y: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    east, north = np.meshgrid(x[0], y[0], indexing="ij")
    return np.stack([east, north], axis=-1).reshape(-1, 2), np.outer(x[1], y[1]).ravel()


def _kernel(shift: Floats, share: Floats) -> Kernel:
    """Kernel of displacements (n, 2) [m] with shares (n,), each split between its four cells.

    So the mean is kept exactly; the variance grows by a quarter of a cell's square at the most.
    """
    at, part = _split(shift / STRIDE, share)
    first = at.min(axis=0)
    columns, rows = at.max(axis=0) - first + 1
    flat = (at[:, 1] - first[1]) * columns + at[:, 0] - first[0]
    weights = np.bincount(flat, part, rows * columns).reshape(rows, columns)
    mean = share @ shift
    off = shift - mean
    return Kernel(
        int(first[1]),
        int(first[0]),
        weights.astype(np.float32),
        mean,
        (share[:, None] * off).T @ off,
    )


def _split(at: Floats, mass: Floats) -> tuple[NDArray[np.int64], Floats]:
    """Cells (4 n, 2) column and row, and parts (4 n,) of masses (n,) at positions (n, 2) in cells."""
    base = np.floor(at)
    rest = at - base
    corners, parts = [], []
    for x in (0, 1):
        for y in (0, 1):
            corners.append(base + np.array([x, y]))
            parts.append(mass * np.abs(1 - x - rest[:, 0]) * np.abs(1 - y - rest[:, 1]))
    return np.concatenate(corners).astype(np.int64), np.concatenate(parts)


def laid(mass: NDArray[np.float32], grid: TrackGrid, positions: Floats, shares: Floats) -> None:
    """Add shares (n,) at positions (n, 2) [m] on the grid to the masses of its cells."""
    at, part = _split((positions - grid.low) / STRIDE, shares)
    np.add.at(mass, (at[:, 1], at[:, 0]), part.astype(np.float32))


def moved(belief: Belief, kernel: Kernel) -> Belief:
    """Belief after a motion; what leaves the grid is elsewhere."""
    mass, weights = belief.mass, kernel.weights
    broad = np.count_nonzero(mass) > MOST_SPREAD
    light = background(mass.ravel(), BACKGROUND, MOST_SPREAD) if broad else 0.0
    if np.count_nonzero(mass > light) * float(np.count_nonzero(weights)) > WIDE:
        out = _by_fourier(mass, kernel)
    else:
        out = np.zeros_like(mass)
        used = weights > 0.0
        ends = weights.shape[1] - used[:, ::-1].argmax(axis=1)
        bounds = np.stack([used.argmax(axis=1), np.where(used.any(axis=1), ends, 0)], axis=1)
        column, row = np.rint(kernel.mean / STRIDE).astype(int).tolist()
        scatter(
            mass, weights, bounds.astype(np.int64), kernel.row, kernel.column,
            light, (row, column), out,
        )  # fmt: skip
    return Belief(out, max(0.0, 1.0 - float(out.sum(dtype=np.float64))))


def _by_fourier(mass: NDArray[np.float32], kernel: Kernel) -> NDArray[np.float32]:
    """Convolution of a large kernel; the same as `scatter` but for rounding."""
    shape = [m + k - 1 for m, k in zip(mass.shape, kernel.weights.shape, strict=True)]
    product = np.fft.rfft2(mass, shape) * np.fft.rfft2(kernel.weights, shape)
    full = np.fft.irfft2(product, shape)
    out = np.zeros(mass.shape, np.float32)
    to, of = [], []
    for shift, size, n in zip((kernel.row, kernel.column), mass.shape, shape, strict=True):
        first, last = max(0, shift), min(size, n + shift)
        to.append(slice(first, max(first, last)))
        of.append(slice(first - shift, max(first, last) - shift))
    out[tuple(to)] = np.maximum(full[tuple(of)], 0.0)
    return out


def reborn(belief: Belief, grid: TrackGrid) -> Belief:
    """Belief that allows for having been lost on the way, as in augmented Monte Carlo localization.

    A small share of what is on the map, and a larger one of what is elsewhere, starts anew anywhere.
    """
    fresh = KIDNAPPED * (1.0 - belief.elsewhere) + RETURNED * belief.elsewhere
    return mixed(belief, grid, 1.0 - KIDNAPPED, 1.0 - RETURNED, fresh)


def mixed(belief: Belief, grid: TrackGrid, kept: float, stays: float, fresh: float) -> Belief:
    """Keep a share of the map's mass, and of what is elsewhere; `fresh` mass starts anew."""
    mass = belief.mass * np.float32(kept)
    mass.ravel()[grid.cells] += np.float32(fresh * (1.0 - ELSEWHERE) / len(grid.cells))
    return Belief(mass, stays * belief.elsewhere + fresh * ELSEWHERE)
