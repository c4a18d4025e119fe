"""The cells of a city in a vector store: embedded by a model, found again by map and model."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Protocol

import numpy as np

from placegraph.outdoor.city import GRAIN as METRES
from placegraph.store import pack_strings
from placegraph.vectors import Origin, load_store

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.map.cells import Cells
    from placegraph.outdoor.network.graphs import PlaceGraphs
    from placegraph.vectors import VectorStore
    from placegraph.vectors.stores import Address


class Model(Protocol):
    """Whatever embeds; a store is of one model."""

    @property
    def fingerprint(self) -> str:
        """Stands for its weights and all else that a vector depends on."""

    def embed_places(self, places: PlaceGraphs, /) -> NDArray[np.float32]:
        """Embeddings (K, D) of place graphs."""


def embed_city(
    city: CityMap,
    where: Address,
    *,
    name: str,
    model: Model | None = None,
    embeddings: NDArray[np.float32] | None = None,
    bits: int = 16,
    resume: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
    timeout: float = 10.0,
) -> VectorStore:
    """Embed the cells of a city and keep the vectors in a store; see `load_store`.

    Parameters
    ----------
    city
        The map.
    where, name, bits, resume, progress, timeout
        As for `load_store`.
    model
        What embeds; the model that ships with placegraph if not given.
    embeddings
        (C, D) rows as `city.cells.points`, where they have been made by `model` already.

    """
    if progress is not None:
        progress("embedding", 0, len(city.cells))
    if model is None:
        from placegraph.outdoor.network.network import GraphTransformer

        model = GraphTransformer.default()
    if embeddings is None:
        from placegraph.outdoor.network.graphs import PlaceGraphs

        embeddings = model.embed_places(PlaceGraphs.of_cells(city))
    return load_store(
        where,
        city.cells.points,
        embeddings,
        cell_positions(city.cells),
        name=name,
        origin=Origin(map_fingerprint(city), model.fingerprint),
        bits=bits,
        resume=resume,
        progress=progress,
        timeout=timeout,
    )


def cell_positions(cells: Cells) -> NDArray[np.float64]:
    """Centres (C, 2) of all cells, longitude and latitude [deg], rows as `cells.points`."""
    row, column = np.divmod(cells.points, cells.grid.columns)
    first = np.array([cells.grid.east, cells.grid.north])
    return cells.plane.to_lonlat(first + cells.grid.stride * np.stack([column, row], 1))


def map_fingerprint(city: CityMap) -> str:
    """Fingerprint of a city's objects and cells; the same for a map built and the map opened."""
    o, cells = city.objects, city.cells
    # Points as the map file has them, so that rounding does not make another map of it.
    points = np.round(o.points / METRES).astype(np.int32)
    columns = (
        o.osm_type, o.osm_id, o.kind, o.label_starts, o.label_values, o.name_starts, o.name_values,
        o.part_starts, o.point_starts, points, pack_strings(o.labels), pack_strings(o.names),
        cells.points,
        np.array([*cells.grid, cells.size, cells.edge_distance], np.float64),
        np.array([city.plane.longitude, city.plane.latitude], np.float64),
    )  # fmt: skip
    digest = hashlib.sha256()
    for column in columns:
        digest.update(f"{column.dtype.str}{column.shape}".encode())
        digest.update(np.ascontiguousarray(column).data)
    return digest.hexdigest()[:32]
