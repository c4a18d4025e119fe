"""Stores by their address: a file, or the URI of a Milvus server."""

from __future__ import annotations

import os
from collections.abc import Callable

from placegraph.vectors.content import Origin, Vectors, VectorStore
from placegraph.vectors.embedded import EmbeddedStore
from placegraph_scale.milvus import milvus
from placegraph_scale.milvus.milvus_load import load_milvus
from placegraph_scale.milvus.server import SCHEMES, Server

Address = str | os.PathLike[str]


def is_uri(where: Address) -> bool:
    """Whether this is the address of a server, not of a file."""
    return (
        isinstance(where, str) and where.partition("://")[0].lower() in SCHEMES and "://" in where
    )


def open_store(
    where: Address,
    *,
    name: str | None = None,
    origin: Origin | None = None,
    timeout: float = 10.0,
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
        return milvus.MilvusStore.open(str(where), name=name, origin=origin, timeout=timeout)
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

    Parameters
    ----------
    where
        As for `open_store`. A file is replaced in one step.
    content
        What to store.
    name
        Of the store on a server, such as ``monaco``; a file has none.
    origin
        What the vectors were made from.
    bits
        Of a number in a file; a server keeps float32.
    resume
        Go on with a load into a server that was not finished.
    progress
        Is told the step, how many rows are done, and of how many.
    timeout
        Longest wait for a server's answer to a short question [s].

    Raises
    ------
    Errors of `EmbeddedStore.of_rows` and `save`, or of `load_milvus`.

    """
    if not is_uri(where):
        store = EmbeddedStore.of_rows(content, origin=origin, bits=bits)
        store.save(where)
        return store
    server = Server.connect(str(where), timeout)
    try:
        return load_milvus(
            server, content, name=name, origin=origin, resume=resume, progress=progress
        )
    except BaseException:
        server.close()
        raise


def list_stores(uri: str, *, timeout: float = 10.0) -> tuple[milvus.StoreInfo, ...]:
    """Stores of placegraph on a Milvus server, half loaded ones included."""
    server = Server.connect(uri, timeout)
    try:
        return milvus.list_stores(server)
    finally:
        server.close()


def drop_store(uri: str, collection: str, *, timeout: float = 10.0) -> milvus.StoreInfo:
    """Remove a store, whole or half loaded, by the name of its collection."""
    server = Server.connect(uri, timeout)
    try:
        return milvus.drop_store(server, collection)
    finally:
        server.close()
