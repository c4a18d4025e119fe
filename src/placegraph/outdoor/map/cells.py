"""Cells and their scene graphs (GOTLoc, Eq. 5 and 7-8): a grid, and objects where they are nearest.

A road passes through many cells and stands, in each, where it is nearest to the cell's centre; an
area that holds the centre stands at the centre itself (distance 0). Eq. 5-6 are in `directions_kernels`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from math import floor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import LocalPlane
from placegraph.core.graph import SceneGraph
from placegraph.core.pickling import PickleFields
from placegraph.errors import MapError, OptionError
from placegraph.outdoor.map.directions_kernels import WINDS, relate_pairs
from placegraph.outdoor.map.geometry_kernels import _collect, nearest_on_parts
from placegraph.outdoor.map.objects import CityObjects
from placegraph.outdoor.options import LARGEST, SMALLEST

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


class VisibleObjects(NamedTuple):
    """Objects near grid points, in CSR form over the grid points that have any, row-major."""

    points: NDArray[np.int64]
    """(W,) grid point, ``row * columns + column``, ascending."""
    starts: NDArray[np.int64]
    """(W + 1,)"""
    objects: NDArray[np.int32]
    """(E,) row of the object."""
    offsets: NDArray[np.float32]
    """(E, 2) object's nearest point minus the grid point, east and north [m]."""


def find_visible(
    kind: NDArray[np.uint8],
    part_starts: NDArray[np.int32],
    point_starts: NDArray[np.int32],
    points: NDArray[np.float32],
    *,
    grid: Grid,
    radius: float,
    rows: NDArray[np.int64] | None = None,
) -> VisibleObjects:
    """Find the nearest points of objects within `radius` [m] of each grid point.

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
        raise make_extent_error(len(rows), grid.stride)
    order = _sorted(at)
    at, who, where = at[order], who[order], where[order]
    first = np.flatnonzero(np.diff(at, prepend=-1))
    return VisibleObjects(at[first], np.append(first, len(at)).astype(np.int64), who, where)


def make_extent_error(count: int, stride: float) -> MapError:
    """Return the error of a map whose things reach so far that a search would exhaust memory."""
    return MapError(
        f"The map's {count:,} objects cover too large an area for cells every {stride:g} m. "
        "Use a smaller extract, or larger cells further apart."
    )


def _sorted(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the stable order of numbers; by 16 bits at a time where they fit, which NumPy sorts fast."""
    if numbers.max(initial=0) >= 1 << 32:
        return np.argsort(numbers, kind="stable")
    order = np.argsort(numbers.astype(np.uint16), kind="stable")
    return order[np.argsort((numbers >> 16).astype(np.uint16)[order], kind="stable")]


LINE, AREA = 1, 2
NEAR = 10.0
"""Objects of a cell closer than this are "near" each other [m]."""
BESIDE = 15.0
"""Points and areas closer than this to a line stand "along" it [m]."""
_NAMED = re.compile(r"c(0|[1-9][0-9]{,8})r(0|[1-9][0-9]{,8})")


class UnknownCellError(OptionError, KeyError):
    """There is no such cell; a `KeyError` too, so that `in` and `get` work as of any mapping."""

    __str__ = Exception.__str__


@dataclass(frozen=True)
class Cell:
    """A square of the grid that holds at least two objects."""

    id: str
    longitude: float
    """Centre [deg]."""
    latitude: float
    """Centre [deg]."""


@dataclass(frozen=True, eq=False)
class Cells(PickleFields, Mapping[str, Cell]):
    """Cells of a city by id (``c<column>r<row>``), the keys of Eq. 8; only those with two objects exist."""

    plane: LocalPlane
    grid: Grid
    size: float
    """Edge of a cell [m]."""
    edge_distance: float
    """Objects nearer than this are joined by an edge [m]."""
    points: NDArray[np.int64]
    """(C,) grid points that are cells, ``row * columns + column``, ascending."""

    def check(self) -> None:
        """Raise `ValueError` where this is no grid (a damaged or hand-made map)."""
        sizes = (self.grid.stride, self.size, self.edge_distance)
        if not all(SMALLEST <= size <= LARGEST for size in sizes):
            raise ValueError(f"sizes {sizes}")
        if min(self.grid.columns, self.grid.rows) < 1:
            raise ValueError(f"grid {self.grid}")
        if not np.isfinite(self.grid).all() or (np.abs(self.grid[:2]) > 1e9).any():
            raise ValueError(f"grid {self.grid}")
        last = self.grid.columns * self.grid.rows
        if (np.diff(self.points, prepend=-1, append=last) < 1).any():
            raise ValueError("cells are not in order")

    def __len__(self) -> int:
        return len(self.points)

    def __iter__(self) -> Iterator[str]:
        return map(self._id, self.points.tolist())

    def __contains__(self, cell: object) -> bool:
        return self._find_point(cell) is not None

    def __getitem__(self, cell: str) -> Cell:
        lonlat = self.plane.to_lonlat(self.center(cell))
        return Cell(cell, float(lonlat[0]), float(lonlat[1]))

    def at(self, longitude: float, latitude: float) -> str | None:
        """Return the id of the cell whose centre is nearest to a position, None where no cell covers it."""
        return self.at_plane(self.plane.to_plane((longitude, latitude)))

    def at_plane(self, east_north: NDArray[np.float64]) -> str | None:
        """Return the id of the cell at east and north (2,) [m]; see `at`."""
        grid, (east, north) = self.grid, east_north.tolist()
        across, up = (east - grid.east) / grid.stride, (north - grid.north) / grid.stride
        column, row = floor(across + 0.5), floor(up + 0.5)
        reach = max(abs(across - column), abs(up - row)) * grid.stride
        if not (0 <= column < grid.columns and 0 <= row < grid.rows) or reach > self.size / 2:
            return None
        cell = self._id(row * grid.columns + column)
        return cell if cell in self else None

    def nearest(self, east_north: NDArray[np.float64]) -> str:
        """Return the id of the cell that covers a position, else of the cell whose centre is nearest."""
        covering = self.at_plane(east_north)
        if covering is not None:
            return covering
        if not len(self.points):  # one lone object makes no cell
            return self._id(0)
        row, reach = int((east_north[1] - self.grid.north) // self.grid.stride), 2
        while True:  # rows of the grid around it, and more where none is near enough
            ends = self.grid.columns * np.array([row - reach, row + reach + 1])
            first, last = np.searchsorted(self.points, ends)
            delta = self.centers(slice(first, last)) - east_north
            squares = (delta**2).sum(axis=1)
            every = last - first == len(self.points)
            if every or squares.min(initial=np.inf) < (self.grid.stride * reach) ** 2:
                return self.id_of(first + int(np.argmin(squares)))
            reach *= 4

    def center(self, cell: str) -> NDArray[np.float64]:
        """Return the centre (2,) of a cell, east and north [m]; raises `OptionError` for an unknown cell."""
        row, column = divmod(self.point(cell), self.grid.columns)
        return np.array([self.grid.east, self.grid.north]) + self.grid.stride * np.array(
            [column, row]
        )

    @property
    def lonlat(self) -> NDArray[np.float64]:
        """Centres (C, 2) of all cells, longitude and latitude [deg], rows as `points`."""
        return self.plane.to_lonlat(self.centers(np.arange(len(self.points))))

    def centers(self, rows: NDArray[np.int64] | slice) -> NDArray[np.float64]:
        """Return the centres (K, 2) of the cells in `rows` of `points`, east and north [m]."""
        row, column = np.divmod(self.points[rows], self.grid.columns)
        return np.stack([column, row], 1) * self.grid.stride + (self.grid.east, self.grid.north)

    def rows_at(self, east_north: NDArray[np.float64]) -> NDArray[np.int64]:
        """Find the rows (K,) in `points` of the cells that cover positions (K, 2) [m]; -1 where none does."""
        step = (east_north - (self.grid.east, self.grid.north)) / self.grid.stride
        column, row = np.floor(step + 0.5).astype(np.int64).T
        reach = np.abs(step - np.stack([column, row], 1)).max(axis=1) * self.grid.stride
        on_grid = (column >= 0) & (column < self.grid.columns) & (row >= 0)
        points = row * self.grid.columns + column
        at = np.minimum(np.searchsorted(self.points, points), len(self.points) - 1)
        there = on_grid & (reach <= self.size / 2) & (self.points[at] == points)
        return np.where(there, at, -1)

    def id_of(self, row: int) -> str:
        """Return the id of the cell in a row of `points`."""
        return self._id(int(self.points[row]))

    def bounds(self, cell: str) -> tuple[float, float, float, float]:
        """Return the west, south, east and north edge of a cell [m]."""
        east, north = self.center(cell)
        half = self.size / 2
        return float(east - half), float(north - half), float(east + half), float(north + half)

    def point(self, cell: str) -> int:
        """Return the grid point of a cell; raises `OptionError` for an unknown cell."""
        point = self._find_point(cell)
        if point is None:
            raise UnknownCellError(
                f"{cell!r} is not a cell of this map; cell names look like "
                f"{next(iter(self), '-')!r}."
            )
        return point

    def _find_point(self, cell: object) -> int | None:
        named = _NAMED.fullmatch(cell) if isinstance(cell, str) else None
        if named is None:
            return None
        column, row = map(int, named.groups())
        point = row * self.grid.columns + column
        at = int(np.searchsorted(self.points, point))
        there = column < self.grid.columns and at < len(self.points) and self.points[at] == point
        return point if there else None

    def _id(self, point: int) -> str:
        row, column = divmod(point, self.grid.columns)
        return f"c{column}r{row}"


def find_in_cells(objects: CityObjects, grid: Grid, size: float) -> VisibleObjects:
    """Find the objects of each square of edge `size` [m] around grid points, where they are nearest."""
    around = find_visible(
        objects.kind,
        objects.part_starts,
        objects.point_starts,
        objects.points,
        grid=grid,
        radius=size * np.sqrt(0.5),
    )
    inside = np.abs(around.offsets).max(axis=1, initial=0.0) <= size / 2
    counts = np.concatenate(([0], np.cumsum(inside)))
    return VisibleObjects(
        around.points, counts[around.starts], around.objects[inside], around.offsets[inside]
    )


def find_occupied(objects: CityObjects, grid: Grid, size: float) -> NDArray[np.int64]:
    """Find grid points (C,) whose square holds at least two objects, so that an edge can exist."""
    seen = find_in_cells(objects, grid, size)
    return seen.points[np.diff(seen.starts) >= 2]


def cell_graph(objects: CityObjects, cells: Cells, cell: str) -> SceneGraph:
    """Build the scene graph of a cell (Eq. 7): objects at their nearest points, relations of Eq. 5-6.

    Every ordered pair nearer than the edge distance is an edge "source is <relation> of target";
    pairs closer than 10 m are also `near`, what stands in an area is `inside` it, and what stands
    at a line is `along` it.
    """
    from placegraph.core.graph import SceneGraph

    center = cells.center(cell)
    grid = Grid(float(center[0]), float(center[1]), cells.grid.stride, 1, 1)
    seen = find_in_cells(objects, grid, cells.size)
    rows, at = seen.objects, center + seen.offsets
    _, ends, winds = relate_pairs(np.array([0, len(rows)]), at, cells.edge_distance)
    direction = {(i, j): WINDS[wind] for (i, j), wind in zip(ends.tolist(), winds, strict=True)}
    edges = [
        (source, target, relation)
        for source in range(len(rows))
        for target in range(len(rows))
        if source != target
        for relation in (
            direction.get((source, target)),
            *_relations(objects, rows, at, source, target),
        )
        if relation
    ]
    sources, targets, relations = zip(*edges, strict=True) if edges else ((), (), ())
    return SceneGraph(
        ids=tuple(objects.osm(i) for i in rows),
        labels=tuple(objects.label(i) for i in rows),
        names=tuple(objects.name(i) for i in rows),
        positions=at,
        sources=np.array(sources, np.int64),
        targets=np.array(targets, np.int64),
        relations=tuple(relations),
    )


def _relations(
    objects: CityObjects,
    rows: NDArray[np.int32],
    at: NDArray[np.float64],
    source: int,
    target: int,
) -> Iterator[str]:
    """Yield the relations of a source to a target that the paper lacks: near, inside, along."""
    if np.hypot(*(at[source] - at[target])) <= NEAR:
        yield "near"
    kind = objects.kind[rows[target]]
    if kind in (LINE, AREA):
        areas = kind == AREA == objects.kind[rows[source]]  # neighbours touch at their wall
        _, _, d2 = nearest_on_parts(
            objects.part_starts,
            objects.point_starts,
            objects.points,
            kind,
            int(rows[target]),
            *(objects.center[rows[source]] if areas else at[source]),
        )
        if kind == AREA and d2 == 0.0 and not _holds(objects, rows[source], rows[target]):
            yield "inside"
        elif kind == LINE and d2 <= BESIDE**2 and objects.kind[rows[source]] != LINE:
            yield "along"


def _holds(objects: CityObjects, outer: int, inner: int) -> bool:
    """Tell whether area `outer` is the larger one, so that "inside" would be the wrong way round."""
    if objects.kind[outer] != AREA:
        return False
    spans = [
        np.ptp(np.concatenate(objects.parts(i)), axis=0).prod() for i in (int(outer), int(inner))
    ]
    return bool(spans[0] > spans[1])
