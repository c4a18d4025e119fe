"""Vectors of a map's cells on a Milvus server: connection, store, and load."""

from __future__ import annotations

import json
import logging
import re
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, Self
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import (
    IncompleteStoreError,
    MissingExtraError,
    OptionError,
    ServiceError,
    StoreError,
)
from placegraph.vectors.stores import GRAIN, Neighbours, Origin, Region, Vectors, checked_queries

if TYPE_CHECKING:
    from pymilvus import MilvusClient

Floats = NDArray[np.float32]


SCHEMES = ("http", "https", "tcp")
LONGEST = 600.0
"""Longest wait for what grows with the number of rows (flush, index, load) [s]."""
RECOVERY = 60.0
"""Time given to a server that has just been restarted [s]."""

PREFIX = "placegraph_"
LOADING = "_loading"
LARGE = 200_000
"""From here on a graph of neighbours (HNSW) is searched, below it every row."""
MOST = 16_384
"""Neighbours that Milvus gives at once."""
TOGETHER = 1_000
"""Queries sent at once."""
BATCH = 10_000
"""Rows sent, and counted, at once: 2.7 MB of 64 numbers; a server takes up to 64 MB."""

_ours: ContextVar[bool] = ContextVar("placegraph_milvus_call", default=False)


class Server:
    """A connection to Milvus: every call ends within its time, or with a `ServiceError`."""

    def __init__(self, client: MilvusClient, uri: str, timeout: float = 10.0) -> None:
        self._client = client
        self.address = hide_password(uri)
        """URI without a password, for messages."""
        self._timeout = timeout

    @classmethod
    def connect(cls, uri: str, timeout: float = 10.0) -> Server:
        """Connect to ``http://[user:password@]host:port[/database]`` within `timeout` [s].

        Raises `MissingExtraError`: pymilvus is not installed; `OptionError`: the URI or the time is
        none; `ServiceError`: nobody answers there.
        """
        check_uri(uri)
        if not 0.0 < timeout <= LONGEST:
            raise OptionError(f"timeout is {timeout}; give at most {LONGEST:.0f} seconds.")
        try:
            from pymilvus import MilvusClient
        except ImportError as error:
            raise MissingExtraError(
                "Milvus needs pymilvus; run `pip install 'placegraph[milvus]'`, or store the "
                "vectors in a file."
            ) from error
        with _typed_errors(hide_password(uri), "connect"):
            client = MilvusClient(uri=uri, timeout=timeout, dedicated=True)
        return cls(client, uri, timeout)

    def collections(self) -> list[str]:
        """Return names of all collections, sorted."""
        return sorted(self._call("list_collections"))

    def describe(self, collection: str) -> dict[str, Any]:
        """Return schema and description of a collection."""
        return dict(self._call("describe_collection", collection))

    def create(self, collection: str, dimension: int, description: str) -> None:
        """Create an empty collection of id, vector, longitude and latitude."""
        from pymilvus import DataType

        schema = self._client.create_schema(
            auto_id=False, enable_dynamic_field=False, description=description
        )
        schema.add_field("id", DataType.INT64, is_primary=True)
        schema.add_field("vector", DataType.FLOAT_VECTOR, dim=dimension)
        schema.add_field("longitude", DataType.DOUBLE)
        schema.add_field("latitude", DataType.DOUBLE)
        self._call("create_collection", collection, schema=schema)

    def insert(self, collection: str, rows: list[dict[str, Any]], *, replace: bool) -> None:
        """Add rows; with `replace`, rows of the same ids go away, however many there are."""
        self._call("upsert" if replace else "insert", collection, rows, limit=6 * self._timeout)

    def index(self, collection: str, kind: str, parameters: dict[str, int]) -> None:
        """Bring rows to disk and wait for the index over them; may be asked again."""
        self._wait("flush", collection)
        index = self._client.prepare_index_params()
        index.add_index("vector", index_type=kind, metric_type="COSINE", params=parameters)
        self._wait("create_index", collection, index)

    def load(self, collection: str) -> None:
        """Make a collection searchable; waits for it."""
        self._wait("load_collection", collection)

    def count(self, collection: str, condition: str = "") -> int:
        """Count rows, those just written included; the collection has to be loaded."""
        answer = self._call(
            "query", collection, filter=condition, output_fields=["count(*)"],
            consistency_level="Strong", limit=6 * self._timeout,
        )  # fmt: skip
        return int(answer[0]["count(*)"])

    def search(
        self, collection: str, queries: Floats, n: int, condition: str, parameters: dict[str, int]
    ) -> list[list[tuple[int, float]]]:
        """Return ids and cosines of the nearest `n` rows of each query."""
        answers = self._call(
            "search", collection, data=list(queries), limit_rows=n, filter=condition,
            search_params={"params": parameters}, consistency_level="Bounded",
        )  # fmt: skip
        return [[(int(hit["id"]), float(hit["distance"])) for hit in hits] for hits in answers]

    def rename(self, collection: str, name: str) -> None:
        """Give a collection another name, in one step."""
        self._call("rename_collection", collection, name)

    def drop(self, collection: str) -> None:
        """Remove a collection and all that is in it."""
        self._call("drop_collection", collection)

    def close(self) -> None:
        """Close the connection."""
        self._call("close", timed=False)

    def _wait(self, method: str, *arguments: object) -> None:
        """Call what may take long; one that has just been restarted may need a minute for it.

        Until the leases of its dead parts run out, such a server answers, but refuses these calls.
        """
        last = monotonic() + RECOVERY
        while True:
            try:
                self._call(method, *arguments, limit=LONGEST)
            except ServiceError:
                self._call("list_collections")  # raises where the server is gone altogether
                if monotonic() > last:
                    raise
                sleep(1.0)
            else:
                return

    def _call(
        self,
        method: str,
        *arguments: object,
        limit: float | None = None,
        limit_rows: int | None = None,
        timed: bool = True,
        **options: object,
    ) -> Any:  # noqa: ANN401 -- pymilvus is untyped
        """Call the client; `limit` is the time limit [s], `limit_rows` what pymilvus calls limit."""
        if limit_rows is not None:
            options["limit"] = limit_rows
        if timed:
            options["timeout"] = limit or self._timeout
        with _typed_errors(self.address, method):
            return getattr(self._client, method)(*arguments, **options)


def check_uri(uri: str) -> None:
    """Raise `OptionError` where this is no URI of a server."""
    try:
        parts = urlsplit(uri)
        sound = parts.scheme in SCHEMES and bool(parts.hostname) and parts.port != 0
    except ValueError:
        sound = False
    if not sound:
        raise OptionError(
            f"{hide_password(uri)!r} is not an address of a Milvus server; give one such as "
            "http://host:19530."
        )


def hide_password(uri: str) -> str:
    """Return a URI for messages: without a password."""
    head, at, tail = uri.rpartition("@")
    scheme, found, _ = head.partition("://")
    return f"{scheme if found else ''}{found}…@{tail}" if at else uri


class _QuietFilter(logging.Filter):
    """Filter of pymilvus's log: failures of our calls become one sentence instead of a traceback."""

    def filter(self, record: logging.LogRecord) -> bool:  # noqa: ARG002 -- all records alike
        return not _ours.get()


_QUIET = _QuietFilter()


@contextmanager
def _typed_errors(address: str, method: str) -> Iterator[None]:
    """Turn whatever pymilvus raises into a `ServiceError`."""
    import grpc
    from pymilvus.exceptions import MilvusException

    for handler in logging.getLogger("pymilvus").handlers:
        handler.addFilter(_QUIET)
    token = _ours.set(True)
    try:
        yield
    except (MilvusException, grpc.RpcError, grpc.FutureTimeoutError, OSError) as error:
        reason = " ".join(str(getattr(error, "message", "") or error).split())[:300]
        raise ServiceError(
            f"The Milvus server at {address} failed to {method.replace('_', ' ')}: {reason}. Check "
            "that it runs and can be reached, and try again."
        ) from error
    finally:
        _ours.reset(token)


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
        """Return whether `name` leads to this collection."""
        return self.collection.removesuffix(LOADING) == collection_name(name, self.origin)

    def description(self) -> str:
        """Return the JSON that the collection carries."""
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

        Raises `ServiceError`: the server is down, or answers nonsense; `StoreError`: there is none,
        or only of another map or model, or several fit; `IncompleteStoreError`: its load was begun
        and not finished, or rows are missing.
        """
        server = Server.connect(uri, timeout)
        try:
            return cls.on(server, name=name, origin=origin)
        except BaseException:
            server.close()
            raise

    @classmethod
    def on(cls, server: Server, *, name: str | None = None, origin: Origin | None = None) -> Self:
        """Open a store on a server that is connected; arguments and errors as of `open`."""
        info = _choose_store(server, name, origin)
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
        """Map and model that the vectors were made from."""
        return self.info.origin

    def search(
        self, queries: NDArray[np.float32], n: int, region: Region | None = None
    ) -> Neighbours:
        """Return the nearest `n` rows of each query; see `EmbeddedStore.search`.

        Exact below 200,000 rows; recall from there on .99, within a region .98. Raises
        `ServiceError` where the server has gone.
        """
        if n > MOST:
            raise OptionError(
                f"n is {n}, but Milvus returns at most {MOST} neighbours at once; choose fewer."
            )
        asked = checked_queries(queries, n, self.dimension)
        found = np.full((len(asked), n), -1, np.int64)
        similarity = np.full((len(asked), n), -np.inf, np.float32)
        condition = "" if region is None else _region_filter(region.validate())
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
    """Return placegraph's stores on a server, by name of the collection."""
    names = [c for c in server.collections() if c.startswith(PREFIX)]
    found = (describe_store(server, name) for name in names)
    return tuple(info for info in found if info is not None)


def drop_store(server: Server, collection: str) -> StoreInfo:
    """Remove a store, whole or half; raises `StoreError` where there is no such store."""
    info = next((s for s in list_stores(server) if s.collection == collection), None)
    if info is None:
        raise StoreError(
            f"{server.address} has no placegraph store {collection!r}; list the stores with "
            "`placegraph city stores`."
        )
    server.drop(collection)
    return info


def collection_name(name: str, origin: Origin) -> str:
    """Return the name of a store's collection: what Milvus allows of `name`, then the version."""
    plain = unicodedata.normalize("NFKD", name).encode("ascii", "ignore").decode()
    plain = re.sub(r"[^0-9A-Za-z]+", "_", plain).strip("_")[:100]
    return f"{PREFIX}{plain or 'map'}_{origin.version}"


def describe_store(server: Server, collection: str) -> StoreInfo | None:
    """Return the store of a collection by its own description; None where it is not placegraph's."""
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


def _choose_store(server: Server, name: str | None, origin: Origin | None) -> StoreInfo:
    """Return the one complete store of that name and origin."""
    if name is None and origin is None:
        raise OptionError("Choose a store of the server: give its name, or the map and the model.")
    named = [s for s in list_stores(server) if name is None or s.is_named(name)]
    fitting = [s for s in named if origin is None or s.origin == origin]
    complete = [s for s in fitting if s.complete]
    if len(complete) == 1:
        return complete[0]
    what = f"store {name!r}" if name is not None else "store of this map and model"
    if complete:
        raise StoreError(
            f"{server.address} has {', '.join(s.collection for s in complete)}; give name, map and "
            "model to choose one."
        )
    if fitting:
        raise IncompleteStoreError(
            f"The {what} on {server.address} is not loaded completely; finish it with `placegraph "
            "city embed --resume`."
        )
    if named and name is not None:
        raise StoreError(
            f"The {what} on {server.address} was made from another map or model; create one for "
            "this map with `placegraph city embed`."
        )
    raise StoreError(
        f"{server.address} has no {what}; create one with `placegraph city embed --store`."
    )


def _region_filter(region: Region) -> str:
    """Return the filter of a region, half a step wider: positions and edges are multiples of a step."""
    west, south, east, north = (round(x / GRAIN) * GRAIN for x in region)
    half = 0.5 * GRAIN
    either = "or" if region.crosses_date_line else "and"
    return (
        f"(longitude >= {west - half:.9f} {either} longitude <= {east + half:.9f}) "
        f"and latitude >= {south - half:.9f} and latitude <= {north + half:.9f}"
    )


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

    Raises `ServiceError`: the server died meanwhile; load again with `resume`;
    `IncompleteStoreError`: an earlier load was not finished, and this one shall not resume;
    `StoreError`: the unfinished load, or the store, is of other rows.
    """
    tell = progress or (lambda _step, _done, _total: None)
    final = collection_name(name, origin)
    wanted = StoreInfo(final, name, origin, len(content), content.dimension, complete=True)
    there = set(server.collections())
    if final in there:
        _check_rows(server, wanted)
        return MilvusStore.on(server, name=name, origin=origin)
    load = _Loader(server, content, final + LOADING, tell)
    if load.collection not in there:
        server.create(load.collection, content.dimension, wanted.description())
        load.send(load.batches(), replace=False)
    elif resume:
        _check_rows(server, wanted, LOADING)
    else:
        raise IncompleteStoreError(
            f"An earlier load into {final} on {server.address} is incomplete; resume it with "
            f"--resume (`resume=True`), or drop {load.collection} with `placegraph city stores`."
        )
    load.complete()
    server.rename(load.collection, final)
    return MilvusStore.on(server, name=name, origin=origin)


class _Loader:
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
            absent = self.find_missing()
            if not absent:
                return
            self.send(absent, replace=True)
        raise IncompleteStoreError(
            f"{self.server.address} does not store all rows of {self.collection}; check its log "
            "and disk, and continue with --resume."
        )

    def batches(self) -> list[tuple[int, int]]:
        """Return first and last (excluded) row of each batch."""
        count = len(self.content)
        return [(start, min(start + BATCH, count)) for start in range(0, count, BATCH)]

    def find_missing(self) -> list[tuple[int, int]]:
        """Return batches that are not there, there in part, or there twice.

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


def _check_rows(server: Server, wanted: StoreInfo, ending: str = "") -> None:
    """Raise `StoreError` where a collection of the wanted name does not hold the wanted rows."""
    collection = wanted.collection + ending
    found = describe_store(server, collection)
    same = found is not None and (found.origin, found.rows, found.dimension) == (
        wanted.origin,
        wanted.rows,
        wanted.dimension,
    )
    if not same:
        holds = (
            "a collection not made by placegraph"
            if found is None
            else (f"{found.rows:,} rows of {found.dimension} numbers")
        )
        raise StoreError(
            f"{collection} on {server.address} contains {holds}, not {wanted.rows:,} of "
            f"{wanted.dimension}; drop it, or choose another --name."
        )
