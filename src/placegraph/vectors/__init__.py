"""Vector stores: rows whose vectors are nearest to a query's (GOTLoc, Eq. 9-13; SG2Loc, Sec. 4).

`EmbeddedStore` scans one file and needs no server; `MilvusStore` of placegraph-scale asks a server.
`open_store` and `load_store` take the one that the address belongs to. How to: `docs/howto-milvus.md`.
"""

from placegraph.vectors.stores import (
    EmbeddedStore,
    Neighbours,
    Origin,
    Region,
    Vectors,
    VectorStore,
    drop_store,
    list_stores,
    load_store,
    open_store,
)

__all__ = [
    "EmbeddedStore",
    "Neighbours",
    "Origin",
    "Region",
    "VectorStore",
    "Vectors",
    "drop_store",
    "list_stores",
    "load_store",
    "open_store",
]
