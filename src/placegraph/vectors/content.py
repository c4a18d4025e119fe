"""Content of any vector store: rows of unit vectors, regions, neighbours."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.errors import OptionError

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

    def checked(self) -> Self:
        """Return the region itself; raise `OptionError` where it is none."""
        longitudes, latitudes = (self.west, self.east), (self.south, self.north)
        if not (
            all(-180.0 <= x <= 180.0 for x in longitudes)
            and all(-90.0 <= x <= 90.0 for x in latitudes)
            and self.south <= self.north
        ):
            raise OptionError(
                f"{tuple(self)} is no region; give west, south, east and north in degrees, "
                "such as 7.41,43.72,7.44,43.75."
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
        """Nearest `n` rows of each of the queries (Q, D), within a region where one is given."""

    def close(self) -> None:
        """Let go of connections and memory; a closed store is not searched again."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...


@dataclass(frozen=True, slots=True)
class Origin:
    """Map and model that vectors were made from; vectors of others cannot be compared."""

    map: str = ""
    """Fingerprint of the map, as its maker tells maps apart; empty where it is not known."""
    model: str = ""
    """Fingerprint of the model that embeds; empty where it is not known."""

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
        """Rows in any order, of any length; raises `OptionError` where they are none.

        Parameters
        ----------
        ids
            (C,) integers from 0, each once.
        vectors
            (C, D), finite, none of them zero.
        positions
            (C, 2) longitude and latitude [deg]; None: what the rows stand for has none.

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
    """Vectors (N, D) float32 of unit length; `OptionError` where they are none or have none."""
    rows = np.asarray(vectors)
    if rows.ndim != 2 or not rows.shape[1] or rows.dtype.kind not in "fiu":
        raise OptionError(f"{what} are {rows.dtype} {rows.shape}; give numbers (rows, dimension).")
    rows = rows.astype(np.float64 if rows.dtype.kind != "f" else rows.dtype, copy=False)
    with np.errstate(over="ignore", invalid="ignore"):
        lengths = np.sqrt(np.einsum("ij,ij->i", rows, rows, dtype=np.float64))
    if not (np.isfinite(lengths) & (lengths > 0.0)).all():
        raise OptionError(f"{what} are zero or not finite; a direction is needed in each row.")
    return np.ascontiguousarray(rows / lengths[:, None], np.float32)


def checked_queries(queries: ArrayLike, n: int, dimension: int) -> NDArray[np.float32]:
    """Unit queries (Q, D); raise `OptionError` where they, or `n`, do not fit a store."""
    if n < 1:
        raise OptionError(f"n is {n}; ask for at least one neighbour.")
    found = np.asarray(queries)
    if found.ndim == 2 and found.shape[1] != dimension:
        raise OptionError(
            f"Queries have {found.shape[1]} numbers, the store's vectors {dimension}; embed both with "
            "one model."
        )
    return unit(found, "Queries")
