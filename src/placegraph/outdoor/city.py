"""The city map: objects stored once; cells, cell graphs and viewpoints derived from them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from placegraph.errors import MapError
from placegraph.geometry import LocalPlane
from placegraph.outdoor.map.cells import Cells, cell_graph, occupied_cells
from placegraph.outdoor.map.objects import CityObjects
from placegraph.outdoor.map.raster import Grid
from placegraph.outdoor.map.simplify import centers
from placegraph.store import pack_strings, read_map, write_map

if TYPE_CHECKING:
    from collections.abc import Sequence
    from os import PathLike

    from numpy.typing import NDArray

    from placegraph.estimate import CityEstimate
    from placegraph.graph import SceneGraph
    from placegraph.outdoor.language.description import Description
    from placegraph.outdoor.likelihood.match import Scene
    from placegraph.outdoor.map.index import ViewIndex
    from placegraph.outdoor.map.names import NameIndex
    from placegraph.outdoor.network.encoded import EncodedCity
    from placegraph.outdoor.search.ask import Answer
    from placegraph.outdoor.search.cells import By, Matcher
    from placegraph.outdoor.track.tracker import CityTracker
    from placegraph.vectors import Region, VectorStore

KIND = "city"
VERSION = 1
GRAIN = 0.5
"""Coordinates are stored in these steps [m]."""


@dataclass(frozen=True, eq=False)
class CityMap:
    """A city: its objects, its cells, and what is derived from them to be searched.

    Made by `build_city`, opened by `open_map`; never changed by localizing in it.
    """

    plane: LocalPlane
    """East-north plane of all coordinates."""
    objects: CityObjects
    cells: Cells
    source: str
    """Name of the file the map was built from."""
    left_out: dict[str, int]
    """What of that file could not be used, by reason."""

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
    ) -> CityMap:
        """City map over these objects; cells are laid over their bounding box."""
        low, high = objects.points.min(axis=0), objects.points.max(axis=0)
        columns, rows = (int(n) for n in np.ceil((high - low) / stride) + 1)
        grid = Grid(float(low[0]), float(low[1]), stride, columns, rows)
        occupied = occupied_cells(objects, grid, cell_size)
        cells = Cells(plane, grid, cell_size, edge_distance, occupied)
        return cls(plane, objects, cells, source, left_out)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the map file (atomically, with checksums)."""
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
        write_map(path, KIND, VERSION, meta, arrays)

    @classmethod
    def open(cls, path: str | PathLike[str]) -> CityMap:
        """Open a map file; raises `InputError` or `MapError` where it is not a sound city map."""
        file = read_map(path, KIND, VERSION)
        try:
            meta = file.meta
            plane = LocalPlane(*map(float, meta["origin"]))
            grain = float(meta["grain"])
            _check_frame(plane, grain)
            kind = file.array("kind", "u1")
            part_starts = _starts(file.array("part_counts", "<u2"))
            point_starts = _starts(file.array("point_counts", "<u4"))
            points = (file.array("points", "<i4", 2) * grain).astype(np.float32)
            objects = CityObjects(
                osm_type=file.array("osm_type", "u1"),
                osm_id=file.array("osm_id", "<i8"),
                kind=kind,
                label_starts=_starts(file.array("label_counts", "u1")),
                label_values=file.array("label_values", "<i4"),
                name_starts=_starts(file.array("name_counts", "<u2")),
                name_values=file.array("name_values", "<i4"),
                part_starts=part_starts,
                point_starts=point_starts,
                points=points,
                center=np.zeros((0, 2), np.float32),
                labels=file.strings("labels"),
                names=file.strings("names"),
            )
            objects.check()
            center = centers(kind, part_starts, point_starts, points)
            east, north, grid_stride, columns, rows = meta["grid"]
            grid = Grid(float(east), float(north), float(grid_stride), int(columns), int(rows))
            size, edge = float(meta["cell_size"]), float(meta["edge_distance"])
            cells = Cells(plane, grid, size, edge, file.array("cells", "<i8"))
            cells.check()
            left_out = {str(k): int(v) for k, v in dict(meta["left_out"]).items()}
            source = str(meta["source"])
        except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
            raise MapError(
                f"{path}: its columns contradict each other ({error}). Build it again."
            ) from error
        return cls(plane, replace(objects, center=center), cells, source, left_out)

    def graph(self, cell: str) -> SceneGraph:
        """Scene graph of a cell (Eq. 1-8); raises `OptionError` where there is no such cell."""
        return cell_graph(self.objects, self.cells, cell)

    @cached_property
    def views(self) -> ViewIndex:
        """What is seen from where; derived on first use."""
        from placegraph.outdoor.map.index import ViewIndex

        return ViewIndex.build(self.objects)

    @cached_property
    def name_index(self) -> NameIndex:
        """Proper names of the map; derived on first use."""
        from placegraph.outdoor.map.names import NameIndex

        return NameIndex.build(self.objects)

    @cached_property
    def label_index(self) -> dict[str, list[int]]:
        """Rows of `objects.labels` by label and by ``key=*``."""
        index: dict[str, list[int]] = {}
        for row, label in enumerate(self.objects.labels):
            index.setdefault(label, []).append(row)
            wildcard = label.partition("=")[0] + "=*"
            if wildcard != label:
                index.setdefault(wildcard, []).append(row)
        return index

    @cached_property
    def tokens(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
        """Tokens of every object as CSR (starts, values, weights); values are rows of `words`."""
        from placegraph.outdoor.map.index import tokens_of

        return tokens_of(self.objects)

    @cached_property
    def words(self) -> tuple[str, ...]:
        """What tokens read: labels, then names (`learn.labels.of_name`)."""
        from placegraph.outdoor.network.labels import of_name

        return (*self.objects.labels, *map(of_name, self.objects.names))

    @cached_property
    def word_counts(self) -> tuple[NDArray[np.int64], int]:
        """How many objects bear each of `words`, (T,), and how many objects there are."""
        counts = np.bincount(self.tokens[1], minlength=len(self.words))
        return counts, len(self.objects)

    @cached_property
    def token_objects(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Objects by token (label, then name), as CSR: starts and rows, ascending within a token."""
        views = self.views
        owner = np.repeat(np.arange(len(self.objects)), np.diff(views.token_starts))
        order = np.argsort(views.token_values, kind="stable")
        counts = np.bincount(views.token_values, minlength=len(views.posting_starts) - 1)
        return np.concatenate(([0], np.cumsum(counts))), owner[order]

    @cached_property
    def encoded(self) -> EncodedCity:
        """The city as the shipped network reads it; derived on first use."""
        from placegraph.outdoor.network.encoded import EncodedCity
        from placegraph.outdoor.network.network import GraphTransformer

        return EncodedCity(self, GraphTransformer.default())

    @property
    def embeddings(self) -> NDArray[np.float32]:
        """Embeddings (C, D) of all cells by the shipped network (Eq. 10)."""
        return self.encoded.embeddings

    @cached_property
    def scene(self) -> Scene:
        """Columns that the matching kernels read."""
        from placegraph.outdoor.likelihood.match import Scene

        o, v = self.objects, self.views
        return Scene(
            o.kind, o.part_starts, o.point_starts, o.points, o.center,
            v.token_starts, v.token_values, v.token_weights,
        )  # fmt: skip

    def locate(
        self,
        text: str | Description,
        *,
        top: int = 5,
        near: Sequence[float] | None = None,
        radius: float = 1000.0,
        heading: float | None = None,
        listener: Sequence[float] | None = None,
        answers: Sequence[Answer] = (),
        matcher: Matcher = "relational",
        by: By | Literal["auto"] = "auto",
        candidates: int = 50,
        store: VectorStore | None = None,
        region: Region | None = None,
        encoded: EncodedCity | None = None,
    ) -> CityEstimate:
        """Where a description was spoken.

        Parameters
        ----------
        text
            What stands around the speaker, in words (or an already parsed description).
        top
            How many modes at most.
        near
            Longitude and latitude [deg] the speaker is known to be near; a third number is the
            radius [m].
        radius
            Radius of `near` [m]: a Gaussian prior of which half lies within.
        heading
            Where the speaker looks [rad], clockwise from north: gives "left of me" a meaning.
        listener
            Longitude and latitude [deg] of "you", where that is known.
        answers
            Answers to earlier questions of `CityEstimate.next_question`.
        matcher
            ``relational`` measures best at the price; ``fused`` lets the network judge its best places
            as well. ``transformer`` (Eq. 14-17), ``edit-distance`` or ``embedding`` (Eq. 11) alone,
            on cells.
        by
            Candidates by the inverted index (``sparse``), by embeddings (``dense``), ``both``, or
            ``all`` places; ``auto`` takes both where a store is given, else the inverted index.
            Embeddings alone are fast in maps of any size, find less, and are never sure (`OK`).
        candidates
            How many cells embeddings propose.
        store
            Where embeddings are searched, such as a Milvus server (`open_store`); the map's own if
            not given.
        region
            The place is known to lie in it.
        encoded
            The map as another network reads it (`EncodedCity`).

        Returns
        -------
        CityEstimate
            Ranked modes with probability over the whole city, and the evidence.

        Raises
        ------
        DescriptionError
            The text is empty, too long, or not text.
        OptionError
            An option is out of range.
        StoreError
            The store is of another map or another network.

        """
        from placegraph.outdoor.locate import Matching, locate

        return locate(
            self,
            text,
            top=top,
            near=near,
            radius=radius,
            heading=heading,
            listener=listener,
            answers=answers,
            matching=Matching(matcher, by, candidates, store, region, encoded),
        )

    def track(
        self,
        *,
        near: Sequence[float] | None = None,
        radius: float = 1000.0,
        heading: float | None = None,
        top: int = 5,
    ) -> CityTracker:
        """Follow somebody who speaks and walks; see `CityTracker`, arguments as for `locate`."""
        from placegraph.outdoor.track.tracker import CityTracker

        return CityTracker(self, near=near, radius=radius, heading=heading, top=top)

    def __repr__(self) -> str:
        return f"CityMap({self.source!r}, {len(self.objects):,} objects, {len(self.cells):,} cells)"


def _check_frame(plane: LocalPlane, grain: float) -> None:
    if not (0.0 < grain <= 1e3 and abs(plane.longitude) <= 180.0 and abs(plane.latitude) <= 90.0):
        raise ValueError(f"grain {grain}, {plane}")


def _starts(counts: NDArray[Any]) -> NDArray[np.int32]:
    """Bounds of counted entries; `ValueError` where they do not fit, which compiled code believes."""
    starts = np.concatenate(([0], np.cumsum(counts, dtype=np.int64)))
    if starts[-1] > np.iinfo(np.int32).max:
        raise ValueError("counts are too large")
    return starts.astype(np.int32)
