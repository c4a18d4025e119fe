"""A city as data: objects stored once; cells, graphs, viewpoints, checks and GeoJSON derived from them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Self

import numpy as np

from placegraph.core.geojson import (
    line_geometry,
    make_collection,
    make_feature,
    point_geometry,
    polygon_geometry,
)
from placegraph.core.geometry import LocalPlane
from placegraph.core.mapfile import check_contents, offsets_of, pack_strings, read_map, write_map
from placegraph.core.pickling import PickleFields
from placegraph.errors import OptionError
from placegraph.outdoor.language.vocabulary import Vocabulary
from placegraph.outdoor.map.cells import Cells, Grid, VisibleObjects, cell_graph, find_occupied
from placegraph.outdoor.map.index import (
    DTYPES,
    LARGE,
    MAPPED,
    PREFIX,
    WORTH,
    Core,
    SightTotals,
    ViewIndex,
    index_in,
    name_columns,
    tokens_of,
)
from placegraph.outdoor.map.index_kernels import list_visible_each
from placegraph.outdoor.map.names import NameIndex
from placegraph.outdoor.map.objects import (
    AREA,
    GRAIN,
    LINE,
    CityColumns,
    CityObjects,
    columns_of,
    ends_of,
    find_hidden,
    index_of,
    of_name,
)
from placegraph.outdoor.map.street_graph import Blocks, StreetGraph
from placegraph.outdoor.map.streets import Streets

if TYPE_CHECKING:
    from os import PathLike

    from numpy.typing import NDArray

    from placegraph.core.graph import SceneGraph

KIND = "city"
VERSION = 3


@dataclass(frozen=True, eq=False)
class City(PickleFields):
    """A city: its objects, its cells, and what is derived from them to be searched.

    Every stage takes one; `CityMap` adds what a user asks of it. Nothing changes it.
    """

    plane: LocalPlane
    """East-north plane of all coordinates."""
    objects: CityObjects
    cells: Cells
    source: str
    """Name of the file the map was built from."""
    left_out: dict[str, int]
    """Number of elements of the source that could not be used, by reason."""
    index: ViewIndex | None = field(default=None, init=False, repr=False)
    """Index of the viewpoints, as the map file stores it, or as given; see `views`. `replace` drops it."""

    @classmethod
    def create(
        cls,
        plane: LocalPlane,
        objects: CityObjects,
        *,
        cell_size: float,
        stride: float,
        edge_distance: float,
        source: str,
        left_out: dict[str, int],
    ) -> Self:
        """Create a city of objects; cells are laid over their bounding box."""
        low, high = ends_of(objects.points)
        columns, rows = (int(n) for n in np.ceil((high - low) / stride) + 1)
        grid = Grid(float(low[0]), float(low[1]), stride, columns, rows)
        occupied = find_occupied(objects, grid, cell_size)
        cells = Cells(plane, grid, cell_size, edge_distance, occupied)
        return cls(plane, objects, cells, source, left_out)

    def save(self, path: str | PathLike[str], *, index: bool | None = None) -> None:
        """Write the map file (atomically, with checksums).

        `index`: with the index of its viewpoints, which makes the first question quick; None: where
        the map is large.
        """
        objects, cells = self.objects, self.cells
        meta = {
            "origin": [self.plane.longitude, self.plane.latitude],
            "grain": GRAIN,
            "cell_size": cells.size,
            "edge_distance": cells.edge_distance,
            "grid": list(cells.grid),
            "source": self.source,
            "left_out": self.left_out,
        }
        arrays: dict[str, NDArray[Any]] = {
            "osm_type": objects.osm_type,
            "osm_id": objects.osm_id,
            "kind": objects.kind,
            "label_counts": np.diff(objects.label_starts).astype(np.uint8),
            "label_values": objects.label_values,
            "name_counts": np.diff(objects.name_starts).astype(np.uint16),
            "name_values": objects.name_values,
            "part_counts": np.diff(objects.part_starts).astype(np.uint16),
            "point_counts": np.diff(objects.point_starts).astype(np.uint32),
            "points": np.round(objects.points / GRAIN).astype(np.int32),
            "labels": pack_strings(objects.labels),
            "names": pack_strings(objects.names),
            "cells": cells.points,
        }
        if len(objects) >= WORTH if index is None else index:
            meta["viewpoints"] = list(self.views.grid)
            arrays |= name_columns(self.views.arrays())
        large = sum(arrays[name].nbytes for name in MAPPED & arrays.keys()) >= LARGE
        write_map(path, KIND, VERSION, meta, arrays, MAPPED if large else ())

    @classmethod
    def open(cls, path: str | PathLike[str], views: ViewIndex | None = None) -> Self:
        """Open a map file; raises `InputError` or `MapError` where it is not a sound city map.

        `views`: index of its viewpoints, of which the file is then not read. A large one is read where
        it lies.
        """
        skipped = () if views is None else {PREFIX + name for name in DTYPES}
        file = read_map(path, KIND, VERSION, MAPPED, LARGE, skipped)
        with check_contents(path, "Build it again."):
            meta = file.meta
            (longitude, latitude), grain = map(float, meta["origin"]), float(meta["grain"])
            plane = LocalPlane(longitude, latitude)
            if not (0.0 < grain <= 1e3 and abs(longitude) <= 180.0 and abs(latitude) <= 90.0):
                raise ValueError(f"grain {grain}, {plane}")
            kind = file.array("kind", "u1")
            label_values = file.array("label_values", "<i4")
            name_values = file.array("name_values", "<i4")
            part_starts = _starts(file.array("part_counts", "<u2"))
            point_starts = _starts(file.array("point_counts", "<u4"))
            steps = file.array("points", "<i4", 2)
            points = np.multiply(
                steps, grain, out=np.empty(steps.shape, np.float32), casting="unsafe"
            )
            objects = CityObjects(
                osm_type=file.array("osm_type", "u1"),
                osm_id=file.array("osm_id", "<i8"),
                kind=kind,
                label_starts=_starts(file.array("label_counts", "u1")),
                label_values=label_values,
                name_starts=_starts(file.array("name_counts", "<u2")),
                name_values=name_values,
                part_starts=part_starts,
                point_starts=point_starts,
                points=points,
                labels=file.strings("labels", max_count=len(label_values)),
                names=file.strings("names", max_count=len(name_values)),
            )
            objects.check()
            east, north, grid_stride, columns, rows = meta["grid"]
            grid = Grid(float(east), float(north), float(grid_stride), int(columns), int(rows))
            sizes = float(meta["cell_size"]), float(meta["edge_distance"])
            cells = Cells(plane, grid, *sizes, file.array("cells", "<i8"))
            cells.check()
            source = str(meta["source"])
            left_out = {str(k): int(v) for k, v in dict(meta["left_out"]).items()}
            words = len(objects.labels) + len(objects.names)
            index = index_in(file, words) if views is None else views
        city = cls(plane, objects, cells, source, left_out)
        object.__setattr__(city, "index", index)
        return city

    def graph(self, cell: str) -> SceneGraph:
        """Build the scene graph of a cell (Eq. 1-8); raises `OptionError` for an unknown cell."""
        return cell_graph(self.objects, self.cells, cell)

    @property
    def views(self) -> ViewIndex:
        """Index of viewpoints: from the map file, or derived on first use.

        Raises `MapError` where the file was written to since it was opened, instead of replaced.
        """
        if self.index is not None and self.index.watch is not None:
            self.index.watch.check()
        return self._views

    @cached_property
    def _views(self) -> ViewIndex:
        return self.index or ViewIndex.build(self.objects)[0]

    def look_around(self, core: Core) -> SightTotals:
        """Derive and cache `views` around a core; return what they see."""
        self.__dict__["_views"], seen = ViewIndex.build(self.objects, core)
        return seen

    def in_sight(self, rows: NDArray[np.integer[Any]]) -> VisibleObjects:
        """Return the objects in sight of viewpoints `rows` (K,) of `views`."""
        points = np.asarray(rows, np.int64)
        starts, objects, offsets, _ = list_visible_each(self.columns, self.views.columns, points)
        return VisibleObjects(points, starts, objects, offsets)

    @cached_property
    def hidden(self) -> NDArray[np.bool_]:
        """(N,) whether nobody sees an object (`find_hidden`); derived on first use."""
        return np.isin(np.arange(len(self.objects)), find_hidden(self.objects))

    @cached_property
    def name_index(self) -> NameIndex:
        """Proper names of the map; derived on first use."""
        return replace(NameIndex.build(self.objects), streets=Streets(self.objects))

    @cached_property
    def blocks(self) -> Blocks:
        """Length of a block; derived on first use."""
        return Blocks.measure(self.street_graph)

    @cached_property
    def street_graph(self) -> StreetGraph:
        """Graph of the streets; derived on first use."""
        return StreetGraph.of_objects(self.objects)

    def block_length(self, bearing: float | None) -> float:
        """Return the length of a block [m] in a direction [rad], or in any where that is None."""
        return self.blocks.length(bearing)

    @cached_property
    def vocabulary(self) -> Vocabulary:
        """Vocabulary of the map: the shipped one, and every tag value of the map."""
        return Vocabulary.default().of_map(self.objects.labels)

    @cached_property
    def label_index(self) -> dict[str, list[int]]:
        """Rows of `objects.labels` by label and by ``key=*``."""
        return index_of(self.objects.labels)

    @cached_property
    def tokens(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
        """Tokens of every object as CSR (starts, values, weights); values are rows of `words`."""
        return tokens_of(self.objects)

    @cached_property
    def words(self) -> tuple[str, ...]:
        """Texts of the tokens: labels, then names (`of_name`)."""
        return (*self.objects.labels, *map(of_name, self.objects.names))

    @cached_property
    def word_counts(self) -> tuple[NDArray[np.int64], int]:
        """Number of objects that bear each of `words`, (T,), and number of all objects."""
        return np.bincount(self.tokens[1], minlength=len(self.words)), len(self.objects)

    @cached_property
    def token_objects(self) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Objects by token (label, then name), as CSR: starts and rows, ascending within a token."""
        token_starts, values, _ = self.tokens
        owner = np.repeat(np.arange(len(self.objects), dtype=np.int32), np.diff(token_starts))
        order = np.argsort(values, kind="stable")
        return offsets_of(np.bincount(values, minlength=len(self.words))), owner[order]

    def frequency(self, tokens: NDArray[np.int32], weights: NDArray[np.float32]) -> float:
        """Return the share of tokens in all objects in sight, over all viewpoints."""
        return float(weights @ self.views.share[tokens])

    def count_bearers(self, tokens: NDArray[np.int32]) -> NDArray[np.int64]:
        """Return the number of objects (K,) that bear each token."""
        starts, _ = self.token_objects
        return np.asarray(starts[tokens + 1] - starts[tokens])

    def bearers(self, tokens: NDArray[np.int32]) -> list[NDArray[np.int64]]:
        """List the rows of the objects that bear each of these tokens, ascending."""
        starts, rows = self.token_objects
        return [rows[starts[t] : starts[t + 1]].astype(np.int64) for t in tokens]

    @cached_property
    def columns(self) -> CityColumns:
        """Columns that compiled code reads."""
        return columns_of(self.objects, self.tokens)

    @cached_property
    def digest(self) -> str:
        """Digest of objects and cells; equal for a map built and the map opened."""
        o, cells = self.objects, self.cells
        # Points as the map file has them, so that rounding does not make another map of it.
        points = np.round(o.points / GRAIN).astype(np.int32)
        columns = (
            o.osm_type, o.osm_id, o.kind, o.label_starts, o.label_values, o.name_starts, o.name_values,
            o.part_starts, o.point_starts, points, pack_strings(o.labels), pack_strings(o.names),
            cells.points,
            np.array([*cells.grid, cells.size, cells.edge_distance], np.float64),
            np.array([self.plane.longitude, self.plane.latitude], np.float64),
        )  # fmt: skip
        digest = hashlib.sha256()
        for column in columns:
            digest.update(f"{column.dtype.str}{column.shape}".encode())
            digest.update(np.ascontiguousarray(column).data)
        return digest.hexdigest()[:32]

    def __repr__(self) -> str:
        name, objects, cells = type(self).__name__, len(self.objects), len(self.cells)
        return f"{name}({self.source!r}, {objects:,} objects, {cells:,} cells)"


def _starts(counts: NDArray[Any]) -> NDArray[np.int32]:
    """Return the bounds of counted entries; raises `ValueError` where they do not fit into 32 bits."""
    bounds = offsets_of(counts)
    if bounds[-1] > np.iinfo(np.int32).max:
        raise ValueError("counts are too large")
    return bounds.astype(np.int32)


def make_geojson(city: City, what: Literal["objects", "cells"]) -> dict[str, Any]:
    """Make the FeatureCollection of a city. See also `CityMap.to_geojson`."""
    if what not in ("objects", "cells"):
        raise OptionError(f"what is {what!r}; it must be 'objects' or 'cells'.")
    return make_collection(_objects(city) if what == "objects" else _cells(city))


def _objects(city: City) -> Iterator[dict[str, Any]]:
    objects = city.objects
    for row in range(len(objects)):
        start, end = objects.label_starts[row : row + 2]
        tags = [objects.labels[k].partition("=") for k in objects.label_values[start:end]]
        said = {
            "osm": objects.osm(row),
            "label": objects.label(row),
            "name": objects.name(row),
            "tags": {key: value for key, _, value in reversed(tags)},
        }
        parts = [city.plane.to_lonlat(part) for part in objects.parts(row)]
        kind = objects.kind[row]
        if kind == AREA:
            parts = [part for part in parts if len(part) > 3] or parts
        shape = point_geometry(parts[0][0])
        if kind == AREA and len(parts[0]) > 3:
            shape = polygon_geometry(parts)
        elif kind in (LINE, AREA) and len(parts[0]) > 1:
            shape = line_geometry(parts)
        yield make_feature(shape, said)


def _cells(city: City) -> Iterator[dict[str, Any]]:
    for cell in city.cells:
        west, south, east, north = city.cells.bounds(cell)
        corners = [(west, south), (east, south), (east, north), (west, north), (west, south)]
        yield make_feature(polygon_geometry([city.plane.to_lonlat(corners)]), {"cell": cell})


WIDEST = 60_000.0
"""Cities wider than this are distorted by their plane [m]."""


def find_oddities(city: City) -> list[str]:
    """List what is odd in a map whose bytes and columns are sound, a sentence each."""
    objects, found = city.objects, []
    span = np.ptp(objects.points, axis=0)
    if span.max() > WIDEST:
        found.append(
            f"The map spans {span.max() / 1000.0:.0f} km, so directions near its edge are "
            "distorted by the map projection. Split the extract into cities."
        )
    if not len(city.cells):
        found.append(
            "No cell contains two objects, so there are no relations. Use a larger extract."
        )
    named = float((np.diff(objects.name_starts) > 0).mean())
    if named < 0.02:
        found.append(
            f"Only {named:.1%} of the objects have a name, so few names in descriptions can "
            "be matched."
        )
    first = objects.label_values[objects.label_starts[:-1]]
    share = np.bincount(first, minlength=len(objects.labels)) / len(objects)
    top = int(np.argmax(share))
    if share[top] > 0.8:
        found.append(
            f"{share[top]:.0%} of the objects are {objects.labels[top]}, so places are hard "
            "to distinguish. Use an extract with more kinds of objects, or extend the "
            "vocabulary."
        )
    ids = np.stack([objects.osm_type.astype(np.int64), objects.osm_id], 1)
    twice = len(ids) - len(np.unique(ids, axis=0))
    if twice:
        found.append(
            f"{twice} objects occur twice, probably because overlapping extracts were "
            "merged. Export the extract again."
        )
    missing = sum(n for why, n in city.left_out.items() if "missing" in why or "without" in why)
    if missing > 0.05 * len(objects):
        found.append(
            f"{missing:,} elements of the extract lack members, because it was clipped. "
            "Clip it with complete ways."
        )
    return found
