"""The embedded vector store: one file, no server; exact at city size, inverted lists beyond.

Figures and the choice: `docs/benchmarks/vector-stores.md`; the file: `docs/formats.md`.
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.mapfile import MapFile, read_map, sound, write_map
from placegraph.errors import OptionError, StoreError
from placegraph.vectors.content import (
    GRAIN,
    Neighbours,
    Origin,
    Region,
    Vectors,
    checked_queries,
)
from placegraph.vectors.lists import BLOCK, Lists, make_lists
from placegraph.vectors.scan_kernels import search_all, search_lists

KIND = "vectors"
VERSION = 1
LARGE = 500_000
"""From here on rows are kept in lists: reading all of them takes more than 4 ms."""
PROBES = 256
"""Lists that a query opens: recall of the exact top 10 is .998, of the top 50 .993 at a million."""
BITS = (8, 16, 32)
_STEPS = 127
"""Steps of an 8-bit column on either side of zero."""


@dataclass(frozen=True, slots=True, eq=False)
class EmbeddedStore:
    """Vectors in memory, of a city's cells or of scenes, searched by compiled code (Eq. 12-13).

    Made by `EmbeddedStore.of`, kept by `save`, opened by `open_store`.
    """

    origin: Origin
    """What the vectors were made from."""
    bits: int
    """Of a number as stored: 8, 16 or 32."""
    ids: NDArray[np.int64]
    """(C,)"""
    positions: NDArray[np.int32]
    """(C, 2) longitude and latitude in steps of `GRAIN`."""
    rows: NDArray[Any]
    """(C, D) float32, or int8 in steps of `steps`."""
    steps: NDArray[np.float32]
    """(D,) value of one step of a column; ones where rows are float32."""
    lists: Lists | None
    """Where rows are kept in lists, their bounds and centres."""

    @classmethod
    def of(
        cls,
        ids: ArrayLike,
        vectors: ArrayLike,
        positions: ArrayLike | None = None,
        *,
        origin: Origin | None = None,
        bits: int = 16,
        lists: bool | None = None,
    ) -> Self:
        """Store of ids, vectors and positions as of `Vectors.of`; the rest as of `of_rows`."""
        content = Vectors.of(ids, vectors, positions)
        return cls.of_rows(content, origin=origin, bits=bits, lists=lists)

    @classmethod
    def of_rows(
        cls,
        content: Vectors,
        *,
        origin: Origin | None = None,
        bits: int = 16,
        lists: bool | None = None,
    ) -> Self:
        """Store of rows that have been checked.

        Parameters
        ----------
        content
            What to store.
        origin
            What the vectors were made from.
        bits
            Of a number: 32 keeps float32 as they are, 16 rounds them without a change in ranking,
            8 changes about one in fifty of the best ten and halves the memory of a search again.
        lists
            Whether rows are kept in lists; where they are many if not given.

        Raises
        ------
        OptionError
            There is no such number of bits.

        """
        if bits not in BITS:
            raise OptionError(f"bits is {bits}; choose one of {', '.join(map(str, BITS))}.")
        inverted = make_lists(content.vectors) if _in_lists(len(content), lists) else None
        order = np.arange(len(content)) if inverted is None else inverted.order
        rows, steps = _coded(content.vectors, order, bits)
        return cls(
            origin or Origin(), bits, content.ids[order], content.positions[order], rows, steps,
            inverted,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def dimension(self) -> int:
        """D."""
        return self.rows.shape[1]

    def search(
        self, queries: NDArray[np.float32], n: int, region: Region | None = None
    ) -> Neighbours:
        """Nearest `n` rows of each query, best first, equal ones by id (Eq. 12-13).

        Exact where there are no lists, and within a region. With lists, recall of the exact fifty
        is about .993 at a million rows, where queries are as near to rows as texts to their places.

        Parameters
        ----------
        queries
            (Q, D) of any length but zero.
        n
            How many; what is not there is -1 with similarity -inf.
        region
            Only cells whose centre lies in it.

        Raises
        ------
        OptionError
            Queries, `n` or the region are out of range.

        """
        asked = checked_queries(queries, n, self.dimension)
        scaled = asked * self.steps
        found = np.full((len(asked), n), -1, np.int64)
        similarity = np.full((len(asked), n), -np.inf, np.float32)
        if self.lists is not None and region is None:
            search_lists(
                self.rows, self.ids, self.lists.starts, self.lists.centers, asked, PROBES, scaled,
                found, similarity,
            )  # fmt: skip
        else:
            box = np.zeros(0) if region is None else np.round(np.array(region.checked()) / GRAIN)
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
        if self.lists is not None:
            arrays |= {"starts": self.lists.starts, "centers": self.lists.centers}
        # noise cannot be squeezed: of many rows, opening would take a minute to unpack them
        as_they_are = () if self.lists is None else ("vectors",)
        write_map(path, KIND, VERSION, meta, arrays, as_they_are)

    @classmethod
    def open(cls, path: str | PathLike[str], origin: Origin | None = None) -> Self:
        """Open a file; with `origin`, only one that was made from that map by that model.

        Raises
        ------
        InputError, MapError
            It is no sound file of vectors.
        StoreError
            It was made from another map, or by another model.

        """
        file = read_map(path, KIND, VERSION)
        with sound(path, "Make it again with `placegraph city embed`."):
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
        lists = None
        if "starts" in file.arrays:
            starts, centers = file.array("starts", "<i8"), file.array("centers", "<f4", 2)
            lists = Lists(np.zeros(0, np.int64), np.array(starts), np.array(centers))
        origin = Origin(str(meta["map"]), str(meta["model"]))
        store = cls(origin, bits, ids, positions, rows, steps, lists)
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
        if self.lists is None:
            return
        starts, centers = self.lists.starts, self.lists.centers
        if (
            centers.shape != (len(starts) - 1, dimension)
            or not np.isfinite(centers).all()
            or (starts[0], starts[-1]) != (0, count)
            or (np.diff(starts) < 0).any()
        ):
            raise ValueError("lists do not hold every vector once")

    def close(self) -> None:
        """Nothing to let go of: memory goes with the last reference."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def refuse_other(what: str, found: Origin, wanted: Origin | None) -> None:
    """Raise `StoreError` where a store was not made from the wanted map by the wanted model."""
    difference = wanted.differs(found) if wanted is not None else ""
    if difference:
        raise StoreError(
            f"{what} holds vectors of another {difference}; make them again with `placegraph city "
            "embed`, or name the store that belongs to this map and model."
        )


def _in_lists(count: int, wanted: bool | None) -> bool:
    return count >= LARGE if wanted is None else wanted


def _coded(
    vectors: NDArray[np.float32], order: NDArray[np.int64], bits: int
) -> tuple[NDArray[Any], NDArray[np.float32]]:
    """Rows in an order as they are stored and searched, and the steps (D,) of their columns.

    Block by block: of ten million rows there are 2.6 GB, and no second copy of these.
    """
    steps = np.ones(vectors.shape[1], np.float32)
    if bits == 8:
        largest = np.maximum(vectors.max(axis=0), -vectors.min(axis=0)) / _STEPS
        steps = np.where(largest > 0.0, largest, steps).astype(np.float32)
    rows = np.empty(vectors.shape, np.int8 if bits == 8 else np.float32)
    for first in range(0, len(rows), BLOCK):
        some = vectors[order[first : first + BLOCK]]
        if bits == 8:
            some = np.round(some / steps)
        elif bits == 16:
            some = some.astype(np.float16).astype(np.float32)
        rows[first : first + BLOCK] = some
    return rows, steps
