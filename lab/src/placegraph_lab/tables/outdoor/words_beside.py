"""Words beside vectors in one store: dense, sparse and hybrid search in Milvus Lite, beside our index."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.city import CityMap
from placegraph.outdoor.map.objects import of_name
from placegraph_lab.tables.outdoor.queries import Query

BATCH = 10_000
HIT = 50.0
"""A cell whose centre is no farther from the place than this is right [m]."""
AMONG = (1, 10, 50)


def sparse_cells(city: CityMap) -> list[dict[int, float]]:
    """Of each cell its words, the rarer the heavier, as a sparse vector of length one."""
    cells = city.encoded.cells
    heavy = _rarity(city)
    out = []
    for first, last in pairwise(cells.starts.tolist()):
        own: dict[int, float] = {}
        for k in range(cells.word_starts[first], cells.word_starts[last]):
            word = int(cells.words[k])
            own[word] = max(own.get(word, 0.0), float(cells.weights[k] * heavy[word]))
        out.append(_unit(own))
    return out


def sparse_text(city: CityMap, text: str) -> dict[int, float]:
    """The words of a text, as the map's vocabulary understands them."""
    from placegraph.outdoor.language import describe

    own: dict[int, float] = {}
    heavy = _rarity(city)
    rows = {word: i for i, word in enumerate(city.encoded.cells.vocabulary)}
    for mention in describe(text).mentions:
        for sense in mention.senses:
            word = rows.get(sense.label)
            if word is not None:
                own[word] = max(own.get(word, 0.0), float(sense.weight * heavy[word]))
        named = rows.get(of_name(mention.name)) if mention.name else None
        if named is not None:
            own[named] = float(heavy[named])
    return _unit(own)


def _rarity(city: CityMap) -> NDArray[np.float64]:
    """Of each word, by how many things of cells bear it."""
    cells = city.encoded.cells
    counts = np.bincount(cells.words, minlength=len(cells.vocabulary))
    return np.asarray(np.log((len(cells.offsets) + 1.0) / (counts + 0.5)))


def _unit(own: dict[int, float]) -> dict[int, float]:
    length = float(np.sqrt(sum(v * v for v in own.values()))) or 1.0
    return {k: v / length for k, v in own.items()}


def hybrid(city: CityMap, queries: Sequence[Query], folder: Path) -> list[dict[str, Any]]:
    """Dense, sparse and both, in Milvus Lite, beside our index: share of places among the first."""
    from pymilvus import AnnSearchRequest, DataType, MilvusClient, RRFRanker

    from placegraph.outdoor.language import describe
    from placegraph.outdoor.network.graphs import TextGraphs

    client = MilvusClient(str(folder / "hybrid.db"))
    schema = client.create_schema(auto_id=False)
    schema.add_field("id", DataType.INT64, is_primary=True)
    schema.add_field("dense", DataType.FLOAT_VECTOR, dim=city.embeddings.shape[1])
    schema.add_field("words", DataType.SPARSE_FLOAT_VECTOR)
    index = client.prepare_index_params()
    index.add_index("dense", index_type="FLAT", metric_type="IP")
    index.add_index("words", index_type="SPARSE_INVERTED_INDEX", metric_type="IP")
    client.create_collection("cells", schema=schema, index_params=index)
    rows = [
        {"id": i, "dense": dense, "words": words or {0: 1e-9}}
        for i, (dense, words) in enumerate(zip(city.embeddings, sparse_cells(city), strict=True))
    ]
    for first in range(0, len(rows), BATCH):
        client.insert("cells", rows[first : first + BATCH])
    client.flush("cells")
    client.load_collection("cells")
    dense = city.encoded.network.embed_texts(TextGraphs.of([describe(q.text) for q in queries]))
    words = [sparse_text(city, q.text) or {0: 1e-9} for q in queries]
    centers = city.cells.centers(np.arange(len(city.cells)))

    def one(field: str, vector: Any) -> list[int]:  # noqa: ANN401
        return [
            h["id"] for h in client.search("cells", [vector], anns_field=field, limit=max(AMONG))[0]
        ]

    def both(d: Any, w: Any) -> list[int]:  # noqa: ANN401
        asks = [AnnSearchRequest([d], "dense", {}, 50), AnnSearchRequest([w], "words", {}, 50)]
        return [h["id"] for h in client.hybrid_search("cells", asks, RRFRanker(), max(AMONG))[0]]

    def ours(query: Query) -> list[NDArray[np.float64]]:
        modes = city.locate(query.text, top=max(AMONG)).modes
        return [city.plane.to_plane((m.longitude, m.latitude)) for m in modes]

    ways: dict[str, Callable[[int], Any]] = {
        "dense": lambda i: centers[one("dense", dense[i].tolist())],
        "words": lambda i: centers[one("words", words[i])],
        "both (reciprocal ranks)": lambda i: centers[both(dense[i].tolist(), words[i])],
        "our index and matching": lambda i: ours(queries[i]),
    }
    out = []
    for name, way in ways.items():
        way(0)
        times, ranks = [], []
        for i, query in enumerate(queries):
            start = time.perf_counter()
            places = np.reshape(way(i), (-1, 2))
            times.append(1e3 * (time.perf_counter() - start))
            there = city.plane.to_plane((query.longitude, query.latitude))
            off = np.linalg.norm(places - there, axis=1)
            ranks.append(int(np.argmax(off <= HIT)) if (off <= HIT).any() else max(AMONG))
        p50, p95 = np.percentile(times, (50, 95))
        found = {str(n): float(np.mean(np.array(ranks) < n)) for n in AMONG}
        out.append({"way": name, "p50_ms": p50, "p95_ms": p95, "among": found})
    client.close()
    return out
