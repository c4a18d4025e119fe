"""Where objects stand, seen from the points of a grid: nearest points of their geometry.

A road passes through many cells and stands, in each, where it is nearest to the cell's centre; an
area that holds the centre stands at the centre itself (distance 0).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from placegraph.errors import MapError
from placegraph.outdoor.map.raster_kernels import _collect

if TYPE_CHECKING:
    from numpy.typing import NDArray


MOST, EACH = 1 << 24, 1024
"""Comparisons of grid points with boxes and segments: so many, and so many more an object. Cities take
100 to 300 an object, and ten square kilometres of park 25,000."""


class Grid(NamedTuple):
    """Square grid of points in the plane: origin + stride * (column, row)."""

    east: float
    """East of point (0, 0) [m]."""
    north: float
    """North of point (0, 0) [m]."""
    stride: float
    """Distance of neighbours [m]."""
    columns: int
    rows: int


class Sightings(NamedTuple):
    """Objects near grid points, in CSR form over the grid points that have any, row-major."""

    points: NDArray[np.int64]
    """(W,) grid point, ``row * columns + column``, ascending."""
    starts: NDArray[np.int64]
    """(W + 1,)"""
    objects: NDArray[np.int32]
    """(E,) row of the object."""
    offsets: NDArray[np.float32]
    """(E, 2) object's nearest point minus the grid point, east and north [m]."""


def sightings(
    kind: NDArray[np.uint8],
    part_starts: NDArray[np.int32],
    point_starts: NDArray[np.int32],
    points: NDArray[np.float32],
    *,
    grid: Grid,
    radius: float,
    rows: NDArray[np.int64] | None = None,
) -> Sightings:
    """Nearest points of objects within `radius` [m] of each grid point.

    `kind`, `part_starts`, `point_starts` and `points` are the columns of `CityObjects`; `rows`
    restricts to these objects. Cost grows with segments times grid points near them, and with the
    rows of the grid that areas span, not with the area's bounding box times its points.

    Raises `MapError` where that is out of proportion: a few bytes can draw a park as large as a continent.
    """
    if rows is None:
        rows = np.arange(len(kind))
    at, who, where, done = _collect(
        kind,
        part_starts,
        point_starts,
        points,
        rows,
        tuple(grid),
        radius,
        max(1024, 32 * len(rows)),
        MOST + EACH * len(rows),
    )
    if not done:
        raise out_of_proportion(len(rows), grid.stride)
    order = _sorted(at)
    at, who, where = at[order], who[order], where[order]
    first = np.flatnonzero(np.diff(at, prepend=-1))
    return Sightings(at[first], np.append(first, len(at)).astype(np.int64), who, where)


def out_of_proportion(things: int, stride: float) -> MapError:
    """What is raised where things reach so far that looking around would take memory and time."""
    return MapError(
        f"The map's {things:,} things reach over more ground than a map of so many is looked "
        f"through for, every {stride:g} m. Build it of a smaller extract, or of larger cells "
        "further apart."
    )


def _sorted(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Stable order: where they fit by 16 bits at a time, for which NumPy counts."""
    if numbers.max(initial=0) >= 1 << 32:
        return np.argsort(numbers, kind="stable")
    order = np.argsort(numbers.astype(np.uint16), kind="stable")
    return order[np.argsort((numbers >> 16).astype(np.uint16)[order], kind="stable")]
