"""Vectors on a Milvus server (extra `milvus`): the same interface as the embedded store.

A store is a collection ``placegraph_<name>_<version>``; the version stands for the map and the
model. Its description says what it holds. A load goes into ``..._loading``, which takes its final
name only when every row is there: nothing else is ever searched.
"""

from __future__ import annotations

import json
import re
import unicodedata
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import IncompleteStoreError, OptionError, StoreError
from placegraph.vectors.content import (
    GRAIN,
    Neighbours,
    Origin,
    Region,
    checked_queries,
)
from placegraph_scale.milvus.server import Server

PREFIX = "placegraph_"
LOADING = "_loading"
LARGE = 200_000
"""From here on a graph of neighbours (HNSW) is searched, below it every row."""
MOST = 16_384
"""Neighbours that Milvus gives at once."""
TOGETHER = 1_000
"""Queries sent at once."""


@dataclass(frozen=True, slots=True)
class StoreInfo:
    """A collection of placegraph on a server."""

    collection: str
    name: str
    origin: Origin
    rows: int
    """That it has when complete."""
    dimension: int
    complete: bool
    """Whether it may be searched; else its load was begun and not finished."""

    def is_named(self, name: str) -> bool:
        """Whether `name` leads to this collection."""
        return self.collection.removesuffix(LOADING) == collection_name(name, self.origin)

    def description(self) -> str:
        """JSON that the collection carries."""
        said = {"placegraph": 1, "name": self.name, "map": self.origin.map}
        said |= {"model": self.origin.model, "rows": self.rows, "dimension": self.dimension}
        return json.dumps(said, ensure_ascii=True, sort_keys=True)


class MilvusStore:
    """Vectors of a map's cells on a Milvus server (Eq. 12-13); opened by `open_store`."""

    def __init__(self, server: Server, info: StoreInfo) -> None:
        self._server = server
        self.info = info

    @classmethod
    def open(
        cls,
        uri: str,
        *,
        name: str | None = None,
        origin: Origin | None = None,
        timeout: float = 10.0,
    ) -> Self:
        """Open the store of that name, or made from that map by that model, or both.

        Raises
        ------
        ServiceError
            The server is down, or answers nonsense.
        StoreError
            There is none, or only of another map or model, or several fit.
        IncompleteStoreError
            Its load was begun and not finished, or rows are missing.

        """
        server = Server.connect(uri, timeout)
        try:
            return cls.on(server, name=name, origin=origin)
        except BaseException:
            server.close()
            raise

    @classmethod
    def on(cls, server: Server, *, name: str | None = None, origin: Origin | None = None) -> Self:
        """As `open`, on a connection that is there."""
        info = _chosen(server, name, origin)
        server.load(info.collection)
        there = server.count(info.collection)
        if there != info.rows:
            raise IncompleteStoreError(
                f"{info.collection} on {server.address} has {there:,} of {info.rows:,} rows; drop it "
                "with `placegraph city stores URI --drop NAME` and embed the map again."
            )
        return cls(server, info)

    def __len__(self) -> int:
        return self.info.rows

    @property
    def dimension(self) -> int:
        """D."""
        return self.info.dimension

    @property
    def origin(self) -> Origin:
        """What the vectors were made from."""
        return self.info.origin

    def search(
        self, queries: NDArray[np.float32], n: int, region: Region | None = None
    ) -> Neighbours:
        """Nearest `n` rows of each query; see `EmbeddedStore.search`.

        Exact below 200,000 rows; recall from there on .99, within a region .98. Raises
        `ServiceError` where the server has gone.
        """
        if n > MOST:
            raise OptionError(f"n is {n}; Milvus gives at most {MOST} neighbours at once.")
        asked = checked_queries(queries, n, self.dimension)
        found = np.full((len(asked), n), -1, np.int64)
        similarity = np.full((len(asked), n), -np.inf, np.float32)
        condition = "" if region is None else _condition(region.checked())
        # Rows outside a region take up places in the search: with 128, a tenth of the best is lost.
        effort = max(2 * n, 128 if region is None else 1024)
        parameters = {"ef": effort} if self.info.rows >= LARGE else {}
        for start in range(0, len(asked), TOGETHER):
            some = asked[start : start + TOGETHER]
            answers = self._server.search(self.info.collection, some, n, condition, parameters)
            for row, hits in enumerate(answers, start):
                best = sorted(hits, key=lambda hit: (-hit[1], hit[0]))
                found[row, : len(best)] = [i for i, _ in best]
                similarity[row, : len(best)] = [s for _, s in best]
        return Neighbours(found, similarity)

    def close(self) -> None:
        """Close the connection."""
        self._server.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def list_stores(server: Server) -> tuple[StoreInfo, ...]:
    """Stores of placegraph on a server, by name of the collection; others' collections are not."""
    names = [c for c in server.collections() if c.startswith(PREFIX)]
    found = (described(server, name) for name in names)
    return tuple(info for info in found if info is not None)


def drop_store(server: Server, collection: str) -> StoreInfo:
    """Remove a store, whole or half; raises `StoreError` where there is no such store."""
    info = next((s for s in list_stores(server) if s.collection == collection), None)
    if info is None:
        raise StoreError(
            f"{server.address} has no store {collection!r} of placegraph's; `placegraph city stores` "
            "lists them."
        )
    server.drop(collection)
    return info


def collection_name(name: str, origin: Origin) -> str:
    """Name of the collection of a store: what Milvus allows of `name`, then the version."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    plain = re.sub(r"[^0-9A-Za-z]+", "_", plain).strip("_")[:100]
    return f"{PREFIX}{plain or 'map'}_{origin.version}"


def described(server: Server, collection: str) -> StoreInfo | None:
    """What a collection holds by its own description, None where it is not placegraph's."""
    about = server.describe(collection)
    try:
        said = json.loads(about["description"])
        dimension = next(f for f in about["fields"] if f["name"] == "vector")["params"]["dim"]
        if said["placegraph"] != 1 or said["dimension"] != int(dimension):
            return None
        origin = Origin(str(said["map"]), str(said["model"]))
        complete = not collection.endswith(LOADING)
        return StoreInfo(
            collection, str(said["name"]), origin, int(said["rows"]), int(dimension), complete
        )
    except (KeyError, TypeError, ValueError, StopIteration):
        return None


def _chosen(server: Server, name: str | None, origin: Origin | None) -> StoreInfo:
    """The one complete store of that name and origin."""
    if name is None and origin is None:
        raise OptionError("Say which store of the server: its name, or the map and the model.")
    named = [s for s in list_stores(server) if name is None or s.is_named(name)]
    fitting = [s for s in named if origin is None or s.origin == origin]
    complete = [s for s in fitting if s.complete]
    if len(complete) == 1:
        return complete[0]
    what = f"store {name!r}" if name is not None else "store of this map and model"
    if complete:
        raise StoreError(
            f"{server.address} has {', '.join(s.collection for s in complete)}; give name, map and "
            "model so that one of them is meant."
        )
    if fitting:
        raise IncompleteStoreError(
            f"The {what} on {server.address} is not loaded completely; finish it with `placegraph "
            "city embed --resume`."
        )
    if named and name is not None:
        raise StoreError(
            f"The {what} on {server.address} was made from another map or model; make one for this "
            "with `placegraph city embed`."
        )
    raise StoreError(
        f"{server.address} has no {what}; make one with `placegraph city embed --store`."
    )


def _condition(region: Region) -> str:
    """Filter of a region, half a step wider: positions are multiples of a step, as its edges are."""
    west, south, east, north = (round(x / GRAIN) * GRAIN for x in region)
    half = 0.5 * GRAIN
    either = "or" if region.crosses_date_line else "and"
    return (
        f"(longitude >= {west - half:.9f} {either} longitude <= {east + half:.9f}) "
        f"and latitude >= {south - half:.9f} and latitude <= {north + half:.9f}"
    )
