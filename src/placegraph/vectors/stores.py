"""Vector stores: rows of unit vectors, the embedded store that scans one file, stores by address.

Figures and the choice: `docs/benchmarks/outdoor.md#vector-stores`; the file: `docs/formats.md`.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.mapfile import MapFile, check_contents, read_map, write_map
from placegraph.core.plugins import load_module
from placegraph.errors import OptionError, StoreError
from placegraph.vectors.scan_kernels import search_all

GRAIN = 1e-7
"""Positions are stored in these steps [deg], as OpenStreetMap does: 1 cm."""


class Region(NamedTuple):
    """A box on the ground, its edges included; west of a larger east it crosses the date line."""

    west: float
    """Longitude [deg]."""
    south: float
    """Latitude [deg]."""
    east: float
    """Longitude [deg]."""
    north: float
    """Latitude [deg]."""

    def validate(self) -> Self:
        """Return the region itself; raise `OptionError` where it is none."""
        longitudes, latitudes = (self.west, self.east), (self.south, self.north)
        if not (
            all(-180.0 <= x <= 180.0 for x in longitudes)
            and all(-90.0 <= x <= 90.0 for x in latitudes)
            and self.south <= self.north
        ):
            raise OptionError(
                f"{tuple(self)} is not a region; give west, south, east and north in "
                "degrees, such as 7.41,43.72,7.44,43.75."
            )
        return self

    @property
    def crosses_date_line(self) -> bool:
        """Whether it reaches from the eastern to the western hemisphere over 180 degrees."""
        return self.west > self.east


class Neighbours(NamedTuple):
    """Rows of a store nearest to each query, best first; equal ones by ascending id."""

    ids: NDArray[np.int64]
    """(Q, n) ids, -1 where there are fewer."""
    similarity: NDArray[np.float32]
    """(Q, n) cosine, -inf where there are fewer."""


class VectorStore(Protocol):
    """Vectors of a map's cells, by cosine similarity (Eq. 12-13); a context manager."""

    @property
    def dimension(self) -> int:
        """D."""

    @property
    def origin(self) -> Origin:
        """Map and model that the vectors were made from."""

    def __len__(self) -> int: ...

    def search(
        self, queries: NDArray[np.float32], n: int, region: Region | None = None
    ) -> Neighbours:
        """Find the nearest `n` rows of each of the queries (Q, D), within a region where one is given."""

    def close(self) -> None:
        """Let go of connections and memory; a closed store is not searched again."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


@dataclass(frozen=True, slots=True)
class Origin:
    """Map and model that vectors were made from; vectors of others cannot be compared."""

    map: str = ""
    """Digest of the map; empty if unknown."""
    model: str = ""
    """Digest of the network that embeds; empty if unknown."""

    @property
    def version(self) -> str:
        """Twelve hexadecimal digits that stand for both."""
        return hashlib.sha256(f"{self.map}\n{self.model}".encode()).hexdigest()[:12]

    def differs(self, other: Origin) -> str:
        """Say what is another in `other`: "map", "model", "map and model", or nothing."""
        pairs = (("map", self.map, other.map), ("model", self.model, other.model))
        return " and ".join(name for name, mine, yours in pairs if mine != yours)


@dataclass(frozen=True, slots=True, eq=False)
class Vectors:
    """Rows to be stored, checked: unit vectors of cells and where the cells are."""

    ids: NDArray[np.int64]
    """(C,) ascending."""
    vectors: NDArray[np.float32]
    """(C, D) of unit length."""
    positions: NDArray[np.int32]
    """(C, 2) longitude and latitude in steps of `GRAIN`."""

    @classmethod
    def of(cls, ids: ArrayLike, vectors: ArrayLike, positions: ArrayLike | None = None) -> Self:
        """Check and sort rows in any order, of any length; raises `OptionError` for malformed ones.

        `ids`: (C,) integers from 0, each once.
        `vectors`: (C, D), finite, none of them zero.
        `positions`: (C, 2) longitude and latitude [deg]; None: what the rows stand for has none.
        """
        names = np.asarray(ids)
        rows = unit(vectors, "Vectors")
        places = np.zeros((len(rows), 2)) if positions is None else np.asarray(positions, float)
        if names.dtype.kind not in "iu" or names.shape != (len(rows),) or not len(rows):
            raise OptionError(
                f"{len(rows)} vectors have ids of {names.dtype} {names.shape}; give one integer a "
                "vector, and at least one vector."
            )
        order = np.argsort(names, kind="stable")
        names = names[order].astype(np.int64)
        if (names < 0).any() or (np.diff(names) == 0).any():
            raise OptionError(
                "Ids of vectors are negative or not unique; give each id from 0 once."
            )
        if places.shape != (len(rows), 2) or not (np.abs(places) <= (180.0, 90.0)).all():
            raise OptionError(
                f"Positions of {len(rows)} vectors are {places.shape}; give longitude and latitude "
                "of each in degrees."
            )
        steps = np.round(places[order] / GRAIN).astype(np.int32)
        return cls(names, rows[order], steps)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def dimension(self) -> int:
        """D."""
        return self.vectors.shape[1]

    @property
    def lonlat(self) -> NDArray[np.float64]:
        """Longitude and latitude (C, 2) [deg]."""
        return np.asarray(self.positions * GRAIN, np.float64)


def unit(vectors: ArrayLike, what: str) -> NDArray[np.float32]:
    """Normalize vectors (N, D) to unit length as float32; raises `OptionError` for zero or infinite ones."""
    rows = np.asarray(vectors)
    if rows.ndim != 2 or not rows.shape[1] or rows.dtype.kind not in "fiu":
        raise OptionError(f"{what} are {rows.dtype} {rows.shape}; give numbers (rows, dimension).")
    rows = rows.astype(np.float64 if rows.dtype.kind != "f" else rows.dtype, copy=False)
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float64))
    if not (np.isfinite(lengths) & (lengths > 0.0)).all():
        raise OptionError(f"{what} are zero or not finite; give vectors with a direction.")
    return np.ascontiguousarray(rows / lengths[:, None], np.float32)


def checked_queries(queries: ArrayLike, n: int, dimension: int) -> NDArray[np.float32]:
    """Normalize queries (Q, D); raises `OptionError` where they, or `n`, do not fit a store."""
    if n < 1:
        raise OptionError(f"n is {n}; give at least 1.")
    found = np.asarray(queries)
    if found.ndim == 2 and found.shape[1] != dimension:
        raise OptionError(
            f"Queries have {found.shape[1]} numbers, the store's vectors {dimension}; embed both with "
            "one model."
        )
    return unit(found, "Queries")


KIND = "vectors"
VERSION = 1
LARGE = 500_000
"""Files of at least so many rows hold them uncompressed: opening a million takes 1.3 s instead of 6.9 s."""
SCHEMES = ("http", "https", "tcp")
"""Schemes of the URI of a server."""
BLOCK = 1 << 14
"""Rows coded at once."""
BITS = (8, 16, 32)
_STEPS = 127
"""Steps of an 8-bit column on either side of zero."""


@dataclass(frozen=True, slots=True, eq=False)
class EmbeddedStore:
    """Vectors in memory, of a city's cells or of scenes, searched by compiled code (Eq. 12-13).

    Made by `EmbeddedStore.of`, kept by `save`, opened by `open_store`.
    """

    origin: Origin
    """Map and model of the vectors."""
    bits: int
    """Bits of a stored number: 8, 16 or 32."""
    ids: NDArray[np.int64]
    """(C,)"""
    positions: NDArray[np.int32]
    """(C, 2) longitude and latitude in steps of `GRAIN`."""
    rows: NDArray[Any]
    """(C, D) float32, or int8 in steps of `steps`."""
    steps: NDArray[np.float32]
    """(D,) value of one step of a column; ones where rows are float32."""

    @classmethod
    def of(
        cls,
        ids: ArrayLike,
        vectors: ArrayLike,
        positions: ArrayLike | None = None,
        *,
        origin: Origin | None = None,
        bits: int = 16,
    ) -> Self:
        """Make a store of ids, vectors and positions (`Vectors.of`); `of_rows` has the other options."""
        return cls.of_rows(Vectors.of(ids, vectors, positions), origin=origin, bits=bits)

    @classmethod
    def of_rows(cls, content: Vectors, *, origin: Origin | None = None, bits: int = 16) -> Self:
        """Make a store of checked rows.

        Raises `OptionError`: there is no such number of bits.

        `content`: what to store.
        `origin`: what the vectors were made from.
        `bits`: of a number: 32 keeps float32 as they are, 16 rounds them without a change in
            ranking, 8 changes about one in fifty of the best ten and halves the memory of a search
            again.
        """
        if bits not in BITS:
            raise OptionError(f"bits is {bits}; choose one of {', '.join(map(str, BITS))}.")
        steps = np.ones(content.dimension, np.float32)
        if bits == 8:
            largest = np.maximum(content.vectors.max(axis=0), -content.vectors.min(axis=0)) / _STEPS
            steps = np.where(largest > 0.0, largest, steps).astype(np.float32)
        rows = np.empty(content.vectors.shape, np.int8 if bits == 8 else np.float32)
        for first in range(0, len(rows), BLOCK):  # no second copy of millions of rows
            some = content.vectors[first : first + BLOCK]
            if bits == 8:
                some = np.round(some / steps)
            elif bits == 16:
                some = some.astype(np.float16).astype(np.float32)
            rows[first : first + BLOCK] = some
        return cls(origin or Origin(), bits, content.ids, content.positions, rows, steps)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def dimension(self) -> int:
        """D."""
        return self.rows.shape[1]

    def search(
        self, queries: NDArray[np.float32], n: int, region: Region | None = None
    ) -> Neighbours:
        """Return the nearest `n` rows of each query, best first, equal ones by id (Eq. 12-13).

        Raises `OptionError`: Queries, `n` or the region are out of range.

        `queries`: (Q, D) of any length but zero.
        `n`: how many; what is not there is -1 with similarity -inf.
        `region`: only cells whose centre lies in it.
        """
        asked = checked_queries(queries, n, self.dimension)
        scaled = asked * self.steps
        found = np.full((len(asked), n), -1, np.int64)
        similarity = np.full((len(asked), n), -np.inf, np.float32)
        box = np.zeros(0) if region is None else np.round(np.array(region.validate()) / GRAIN)
        search_all(self.rows, self.ids, self.positions, box, scaled, found, similarity)
        return Neighbours(found, similarity)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the file (atomically, with checksums); raises `MapError` where it cannot."""
        meta = {
            "map": self.origin.map,
            "model": self.origin.model,
            "bits": self.bits,
            "grain": GRAIN,
        }
        rows = self.rows.astype(np.float16) if self.bits == 16 else self.rows
        arrays: dict[str, NDArray[Any]] = {
            "ids": self.ids,
            "positions": self.positions,
            "vectors": rows,
        }
        if self.bits == 8:
            arrays["steps"] = self.steps
        as_they_are = ("vectors",) if len(self) >= LARGE else ()
        write_map(path, KIND, VERSION, meta, arrays, as_they_are)

    @classmethod
    def open(cls, path: str | PathLike[str], origin: Origin | None = None) -> Self:
        """Open a file; with `origin`, only one that was made from that map by that model.

        Raises `InputError` or `MapError`: it is no sound file of vectors; `StoreError`: it was made
        from another map, or by another model.
        """
        file = read_map(path, KIND, VERSION)
        with check_contents(path, "Make it again with `placegraph city embed`."):
            store = cls._read(file)
        refuse_other(str(path), store.origin, origin)
        return store

    @classmethod
    def _read(cls, file: MapFile) -> Self:
        """Raise any of KeyError, TypeError, ValueError where columns are not what they should be."""
        meta = file.meta
        bits = int(meta["bits"])
        if bits not in BITS or float(meta["grain"]) != GRAIN:
            raise ValueError(f"bits {bits}, grain {meta['grain']}")
        ids, positions = file.array("ids", "<i8"), file.array("positions", "<i4", 2)
        rows = file.array("vectors", {8: "|i1", 16: "<f2", 32: "<f4"}[bits], 2)
        rows = rows if bits == 8 else rows.astype(np.float32)
        steps = file.array("steps", "<f4") if bits == 8 else np.ones(rows.shape[1], np.float32)
        # Copies: for arrays that must not be written, the kernels would be compiled once more.
        ids, positions, rows, steps = (np.array(a) for a in (ids, positions, rows, steps))
        origin = Origin(str(meta["map"]), str(meta["model"]))
        store = cls(origin, bits, ids, positions, rows, steps)
        store._check()
        return store

    def _check(self) -> None:
        """Raise `ValueError` where columns do not fit: compiled code believes them."""
        count, dimension = self.rows.shape
        sizes = (len(self.ids), len(self.positions), self.positions.shape[1], len(self.steps))
        if not count or not dimension or sizes != (count, count, 2, dimension):
            raise ValueError(f"{self.rows.shape} vectors with columns of {sizes}")
        if not all(np.isfinite(a).all() for a in (self.rows, self.steps)):
            raise ValueError("a number is not finite")
        if self.ids.min() < 0 or len(np.unique(self.ids)) != count:
            raise ValueError("ids are negative or not unique")

    def close(self) -> None:
        """Do nothing: memory goes with the last reference."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def refuse_other(what: str, origin: Origin, wanted: Origin | None) -> None:
    """Raise `StoreError` where a store was not made from the wanted map by the wanted model."""
    difference = wanted.differs(origin) if wanted is not None else ""
    if difference:
        raise StoreError(
            f"{what} contains vectors of another {difference}; create them again with `placegraph "
            "city embed`, or name the store that belongs to this map and model."
        )


Address = str | os.PathLike[str]


def is_uri(where: Address) -> bool:
    """Tell whether this is the address of a server, not of a file."""
    return (
        isinstance(where, str) and where.partition("://")[0].lower() in SCHEMES and "://" in where
    )


def open_store(
    where: Address, *, name: str | None = None, origin: Origin | None = None, timeout: float = 10.0
) -> VectorStore:
    """Open a store.

    Parameters
    ----------
    where
        A file of vectors, or ``http://[user:password@]host:port[/database]`` of a Milvus server.
    name
        Which store of the server; a file has none.
    origin
        The map and the model it has to be made from; anything if not given. A server's store is
        found by it too.
    timeout
        Longest wait for a server's answer to a short question [s].

    Raises
    ------
    InputError, MapError
        It is no sound file of vectors.
    StoreError
        The store is of another map or model, or not there; `IncompleteStoreError` where its load
        was not finished.
    ServiceError, MissingExtraError
        The server cannot be reached; pymilvus is not installed.

    """
    if is_uri(where):
        milvus = load_module("placegraph_scale.milvus", "scale")
        opened: VectorStore = milvus.MilvusStore.open(
            str(where), name=name, origin=origin, timeout=timeout
        )
        return opened
    return EmbeddedStore.open(where, origin)


def load_store(
    where: Address,
    content: Vectors,
    *,
    name: str,
    origin: Origin,
    bits: int = 16,
    resume: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
    timeout: float = 10.0,
) -> VectorStore:
    """Write vectors to a file, or bring them to a server, and open the store.

    Raises the errors of `EmbeddedStore.of_rows` and `save`, or those of `load_milvus`.

    `where`: as for `open_store`. A file is replaced in one step.
    `content`: what to store.
    `name`: of the store on a server, such as ``monaco``; a file has none.
    `origin`: what the vectors were made from.
    `bits`: of a number in a file; a server keeps float32.
    `resume`: go on with a load into a server that was not finished.
    `progress`: is told the step, how many rows are done, and of how many.
    `timeout`: longest wait for a server's answer to a short question [s].
    """
    if not is_uri(where):
        store = EmbeddedStore.of_rows(content, origin=origin, bits=bits)
        store.save(where)
        return store
    server = load_module("placegraph_scale.milvus", "scale").Server.connect(str(where), timeout)
    load = load_module("placegraph_scale.milvus", "scale").load_milvus
    try:
        loaded: VectorStore = load(
            server, content, name=name, origin=origin, resume=resume, progress=progress
        )
    except BaseException:
        server.close()
        raise
    return loaded


def list_stores(uri: str, *, timeout: float = 10.0) -> tuple[Any, ...]:
    """Return `StoreInfo` of all stores of placegraph on a Milvus server, half loaded ones included."""
    return tuple(_ask_server(uri, timeout, "list_stores"))


def drop_store(uri: str, collection: str, *, timeout: float = 10.0) -> Any:  # noqa: ANN401  # StoreInfo
    """Remove a store, complete or half loaded, by the name of its collection; return its `StoreInfo`."""
    return _ask_server(uri, timeout, "drop_store", collection)


def _ask_server(uri: str, timeout: float, what: str, *arguments: str) -> Any:  # noqa: ANN401
    server = load_module("placegraph_scale.milvus", "scale").Server.connect(uri, timeout)
    try:
        return getattr(load_module("placegraph_scale.milvus", "scale"), what)(server, *arguments)
    finally:
        server.close()
