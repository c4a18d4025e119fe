"""Vector stores: rows whose vectors are nearest to a query's (GOTLoc, Eq. 9-13; SG2Loc, Sec. 4).

`EmbeddedStore` needs no server, `MilvusStore` asks one (extra `milvus`); `open_store` and
`load_store` take the one that the address belongs to. How to: `docs/howto-milvus.md`.
"""

from placegraph.vectors.content import (
    Neighbours,
    Origin,
    Region,
    Vectors,
    VectorStore,
)
from placegraph.vectors.embedded import EmbeddedStore
from placegraph.vectors.stores import (
    drop_store,
    list_stores,
    load_store,
    open_store,
)
from placegraph_scale.milvus.milvus import MilvusStore, StoreInfo

__all__ = [
    "EmbeddedStore",
    "MilvusStore",
    "Neighbours",
    "Origin",
    "Region",
    "StoreInfo",
    "VectorStore",
    "Vectors",
    "drop_store",
    "list_stores",
    "load_store",
    "open_store",
]
