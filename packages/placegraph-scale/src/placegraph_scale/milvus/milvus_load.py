"""Rows on their way to a Milvus server: sent, counted, sent again, and only then given their name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from placegraph.errors import IncompleteStoreError, StoreError
from placegraph.vectors.content import GRAIN, Origin, Vectors
from placegraph_scale.milvus.milvus import (
    LARGE,
    LOADING,
    MilvusStore,
    StoreInfo,
    collection_name,
    described,
)
from placegraph_scale.milvus.server import Server

BATCH = 10_000
"""Rows sent, and counted, at once: 2.7 MB of 64 numbers; a server takes up to 64 MB."""


def load_milvus(
    server: Server,
    content: Vectors,
    *,
    name: str,
    origin: Origin,
    resume: bool = False,
    progress: Callable[[str, int, int], None] | None = None,
) -> MilvusStore:
    """Bring rows to a server and open the store; a complete one of this origin is opened at once.

    After a crash, of this process or the server, the rows that are there are counted by ranges of
    ids, and only what is missing is sent.

    Raises
    ------
    ServiceError
        The server died meanwhile; load again with `resume`.
    IncompleteStoreError
        An earlier load was not finished, and this one shall not resume.
    StoreError
        The unfinished load, or the store, is of other rows.

    """
    tell = progress or _silent
    final = collection_name(name, origin)
    wanted = StoreInfo(final, name, origin, len(content), content.dimension, complete=True)
    there = set(server.collections())
    if final in there:
        _refuse_other_rows(server, wanted)
        return MilvusStore.on(server, name=name, origin=origin)
    load = _Load(server, content, final + LOADING, tell)
    if load.collection not in there:
        server.create(load.collection, content.dimension, wanted.description())
        load.send(load.batches(), replace=False)
    elif resume:
        _refuse_other_rows(server, wanted, LOADING)
    else:
        raise IncompleteStoreError(
            f"An earlier load into {final} on {server.address} was not finished; go on with --resume "
            f"(`resume=True`), or drop {load.collection} with `placegraph city stores`."
        )
    load.complete()
    server.rename(load.collection, final)
    return MilvusStore.on(server, name=name, origin=origin)


class _Load:
    """Rows on their way into a collection that is not searched yet."""

    def __init__(
        self,
        server: Server,
        content: Vectors,
        collection: str,
        tell: Callable[[str, int, int], None],
    ) -> None:
        self.server, self.content, self.collection, self.tell = server, content, collection, tell

    def complete(self) -> None:
        """Send what is missing until nothing is."""
        kind, parameters = "FLAT", {}
        if len(self.content) >= LARGE:
            kind, parameters = "HNSW", {"M": 16, "efConstruction": 200}
        for _ in range(3):
            self.tell("indexing", 0, len(self.content))
            self.server.index(self.collection, kind, parameters)
            self.server.load(self.collection)
            absent = self.missing()
            if not absent:
                return
            self.send(absent, replace=True)
        raise IncompleteStoreError(
            f"{self.server.address} does not keep all rows of {self.collection}; see its log and "
            "disk, then go on with --resume."
        )

    def batches(self) -> list[tuple[int, int]]:
        """First and last (excluded) row of each batch."""
        count = len(self.content)
        return [(start, min(start + BATCH, count)) for start in range(0, count, BATCH)]

    def missing(self) -> list[tuple[int, int]]:
        """Batches that are not there, there in part, or there twice.

        Each is counted: a row sent twice by a client that lost the answer must not make up for one
        that a dying server lost.
        """
        ids, found = self.content.ids, []
        for start, end in self.batches():
            self.tell("counting", start, len(self.content))
            condition = f"id >= {ids[start]} and id <= {ids[end - 1]}"
            if self.server.count(self.collection, condition) != end - start:
                found.append((start, end))
        return found

    def send(self, batches: list[tuple[int, int]], *, replace: bool) -> None:
        """Send batches; with `replace`, what is there of their ids goes away."""
        for start, end in batches:
            self.tell("loading", start, len(self.content))
            self.server.insert(self.collection, self._rows(start, end), replace=replace)

    def _rows(self, start: int, end: int) -> list[dict[str, Any]]:
        c = self.content
        lonlat = (c.positions[start:end] * GRAIN).tolist()
        columns = zip(c.ids[start:end].tolist(), c.vectors[start:end], lonlat, strict=True)
        return [
            {"id": i, "vector": vector, "longitude": place[0], "latitude": place[1]}
            for i, vector, place in columns
        ]


def _silent(_step: str, _done: int, _total: int) -> None:
    """Progress that nobody asked for."""


def _refuse_other_rows(server: Server, wanted: StoreInfo, ending: str = "") -> None:
    """Raise `StoreError` where a collection of the wanted name does not hold the wanted rows."""
    collection = wanted.collection + ending
    found = described(server, collection)
    same = found is not None and (found.origin, found.rows, found.dimension) == (
        wanted.origin,
        wanted.rows,
        wanted.dimension,
    )
    if not same:
        holds = (
            "what is not placegraph's"
            if found is None
            else (f"{found.rows:,} rows of {found.dimension} numbers")
        )
        raise StoreError(
            f"{collection} on {server.address} holds {holds}, not {wanted.rows:,} of "
            f"{wanted.dimension}; drop it, or choose another --name."
        )
