"""A Milvus server as the stores need it: typed errors, one place for time limits, no chatter."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import MissingExtraError, OptionError, ServiceError

if TYPE_CHECKING:
    from pymilvus import MilvusClient


Floats = NDArray[np.float32]


SCHEMES = ("http", "https", "tcp")
PATIENCE = 600.0
"""Longest wait for what grows with the number of rows (flush, index, load) [s]."""
RECOVERY = 60.0
"""Time given to a server that has just been restarted [s]."""

_ours: ContextVar[bool] = ContextVar("placegraph_milvus_call", default=False)


class Server:
    """A connection to Milvus: every call ends within its time, or with a `ServiceError`."""

    def __init__(self, client: MilvusClient, uri: str, timeout: float = 10.0) -> None:
        self._client = client
        self.address = shown(uri)
        """URI without a password, for messages."""
        self._timeout = timeout

    @classmethod
    def connect(cls, uri: str, timeout: float = 10.0) -> Server:
        """Connect to ``http://[user:password@]host:port[/database]`` within `timeout` [s].

        Raises
        ------
        MissingExtraError
            pymilvus is not installed.
        OptionError
            The URI or the time is none.
        ServiceError
            Nobody answers there.

        """
        check_uri(uri)
        if not 0.0 < timeout <= PATIENCE:
            raise OptionError(f"timeout is {timeout}; give seconds up to {PATIENCE:.0f}.")
        try:
            from pymilvus import MilvusClient
        except ImportError as error:
            raise MissingExtraError(
                "A Milvus server is reached through pymilvus; install it with "
                "`pip install 'placegraph[milvus]'`, or keep the vectors in a file."
            ) from error
        with _speaking(shown(uri), "connect"):
            client = MilvusClient(uri=uri, timeout=timeout, dedicated=True)
        return cls(client, uri, timeout)

    def collections(self) -> list[str]:
        """Names of all collections, sorted."""
        return sorted(self._call("list_collections"))

    def describe(self, collection: str) -> dict[str, Any]:
        """Schema and description of a collection."""
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
        """Rows there now, written a moment ago included; the collection has to be loaded."""
        answer = self._call(
            "query", collection, filter=condition, output_fields=["count(*)"],
            consistency_level="Strong", limit=6 * self._timeout,
        )  # fmt: skip
        return int(answer[0]["count(*)"])

    def search(
        self, collection: str, queries: Floats, n: int, condition: str, parameters: dict[str, int]
    ) -> list[list[tuple[int, float]]]:
        """Ids and cosines of the nearest `n` rows of each query."""
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
                self._call(method, *arguments, limit=PATIENCE)
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
        with _speaking(self.address, method):
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
            f"{shown(uri)!r} is no address of a Milvus server; give one such as http://host:19530."
        )


def shown(uri: str) -> str:
    """URI as it may stand in a message: without a password."""
    head, at, tail = uri.rpartition("@")
    scheme, found, _ = head.partition("://")
    return f"{scheme if found else ''}{found}…@{tail}" if at else uri


class _OursIsQuiet(logging.Filter):
    """pymilvus logs every failure with its traceback; ours become one sentence."""

    def filter(self, record: logging.LogRecord) -> bool:  # noqa: ARG002 -- all records alike
        return not _ours.get()


_QUIET = _OursIsQuiet()


@contextmanager
def _speaking(address: str, method: str) -> Iterator[None]:
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
            f"The Milvus server at {address} failed to {method.replace('_', ' ')}: {reason}. "
            "See that it runs and can be reached; then try again."
        ) from error
    finally:
        _ours.reset(token)
