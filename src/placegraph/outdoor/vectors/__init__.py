"""Vector stores: the cells of a map whose embeddings are nearest to a text's (GOTLoc, Eq. 9-13).

`EmbeddedStore` needs no server, `MilvusStore` asks one (extra `milvus`); `open_store` and
`load_store` take the one that the address belongs to. How to: `docs/howto-milvus.md`.
"""

from placegraph.outdoor.vectors.content import (
    Neighbours,
    Origin,
    Region,
    Vectors,
    VectorStore,
    map_fingerprint,
)
from placegraph.outdoor.vectors.embedded import EmbeddedStore
from placegraph.outdoor.vectors.milvus import MilvusStore, StoreInfo
from placegraph.outdoor.vectors.stores import (
    cell_positions,
    drop_store,
    embed_city,
    list_stores,
    load_store,
    open_store,
)

__all__ = [
    "EmbeddedStore",
    "MilvusStore",
    "Neighbours",
    "Origin",
    "Region",
    "StoreInfo",
    "VectorStore",
    "Vectors",
    "cell_positions",
    "drop_store",
    "embed_city",
    "list_stores",
    "load_store",
    "map_fingerprint",
    "open_store",
]
