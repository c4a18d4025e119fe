"""Words beside vectors in one store: dense, sparse and hybrid search in Milvus Lite, beside our index."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from subprocess import TimeoutExpired
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.outdoor.city import CityMap
from placegraph.outdoor.language import describe
from placegraph.outdoor.map.objects import of_name
from placegraph.outdoor.network.graphs import PlaceGraphs, TextGraphs
from placegraph.vectors import Origin
from placegraph.vectors.stores import Vectors, load_store
from placegraph_lab.tables.named.outdoor_vectors import draw_clusters
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, open_city
from placegraph_lab.tables.outdoor.queries import Query, make_queries
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, number, option, table
from placegraph_lab.tables.statistics import peak, run_apart

WORD_BATCH = 10_000
HIT = 50.0  # A cell whose centre is no farther from the place than this is right [m]
AMONG = (1, 10, 50)


@cache
def _graphs(city: CityMap) -> PlaceGraphs:
    return PlaceGraphs.of_cells(city)


def sparse_cells(city: CityMap) -> list[dict[int, float]]:
    cells = _graphs(city)
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
    own: dict[int, float] = {}
    heavy = _rarity(city)
    rows = {word: i for i, word in enumerate(_graphs(city).vocabulary)}
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
    cells = _graphs(city)
    counts = np.bincount(cells.words, minlength=len(cells.vocabulary))
    return np.asarray(np.log((len(cells.offsets) + 1.0) / (counts + 0.5)))


def _unit(own: dict[int, float]) -> dict[int, float]:
    length = float(np.sqrt(sum(v * v for v in own.values()))) or 1.0
    return {k: v / length for k, v in own.items()}


def hybrid(city: CityMap, queries: Sequence[Query], folder: Path) -> list[dict[str, Any]]:
    """Dense, sparse and both, in Milvus Lite, beside our index: share of places among the first."""
    from pymilvus import AnnSearchRequest, DataType, MilvusClient, RRFRanker

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
    for first in range(0, len(rows), WORD_BATCH):
        client.insert("cells", rows[first : first + WORD_BATCH])
    client.flush("cells")
    client.load_collection("cells")
    dense = city.encoded.network.embed_texts(TextGraphs.of([describe(q.text) for q in queries]))
    words = [sparse_text(city, q.text) or {0: 1e-9} for q in queries]
    centers = city.cells.centers(np.arange(len(city.cells)))

    def one(field: str, vector: Any) -> list[int]:
        return [
            h["id"] for h in client.search("cells", [vector], anns_field=field, limit=max(AMONG))[0]
        ]

    def both(d: Any, w: Any) -> list[int]:
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


Floats = NDArray[np.float32]
Search = Callable[[Floats, int], Sequence[int]]  # one query (D,) and n to ids (n,)
NEIGHBOURS = 10
BATCH = 10_000
ORIGIN = Origin("vector_scale", "clustered")


@dataclass(frozen=True)
class Row:
    store: str
    count: int
    rows_a_second: float  # sent, indexed and ready to be asked
    p50_ms: float
    p95_ms: float
    recall: float  # share of the exact ten that are found
    cpu_ms: float  # of all threads of this process, a query
    bytes_a_row: float  # on disk
    peak: int = 0  # largest memory of this process so far [bytes]


def time_queries(
    search: Search, queries: Floats, wanted: NDArray[np.int64]
) -> tuple[float, float, float, float]:
    """Median and 95th percentile of a query [ms], recall, and time of the processor [ms]."""
    for query in queries[:5]:
        search(query, NEIGHBOURS)
    times, hits, cpu = [], 0, time.process_time()
    for query, best in zip(queries, wanted, strict=True):
        start = time.perf_counter()
        found = search(query, NEIGHBOURS)
        times.append(1e3 * (time.perf_counter() - start))
        hits += len(np.intersect1d(found, best))
    p50, p95 = np.percentile(times, (50, 95))
    spent = 1e3 * (time.process_time() - cpu) / len(queries)
    return float(p50), float(p95), hits / wanted.size, spent


def on_disk(folder: Path) -> int:
    return sum(f.stat().st_size for f in folder.rglob("*") if f.is_file())


def on_server(vectors: Floats, queries: Floats, wanted: NDArray[np.int64], folder: Path) -> Row:
    """A Milvus server of its own, by the way that placegraph loads and asks it."""
    from milvus import MilvusServer

    server = MilvusServer()
    server.set_base_dir(str(folder))
    server.start()
    try:
        uri = f"http://127.0.0.1:{server.listen_port}"
        start = time.perf_counter()
        content = Vectors.of(np.arange(len(vectors)), vectors)
        store = load_store(uri, content, name="scale", origin=ORIGIN, timeout=60.0)
        spent = time.perf_counter() - start
        with store:
            told = time_queries(
                lambda q, n: store.search(q[None], n).ids[0].tolist(), queries, wanted
            )
        size = on_disk(folder) / len(vectors)
        return Row("Milvus 2.3.5, HNSW", len(vectors), len(vectors) / spent, *told, size)
    finally:
        with suppress(TimeoutExpired):  # it takes longer to end than its package waits
            server.stop()


def on_lite(vectors: Floats, queries: Floats, wanted: NDArray[np.int64], folder: Path) -> Row:
    """Milvus Lite 3, in this process."""
    from pymilvus import DataType, MilvusClient

    client = MilvusClient(str(folder / "lite.db"))
    schema = client.create_schema(auto_id=False)
    schema.add_field("id", DataType.INT64, is_primary=True)
    schema.add_field("vector", DataType.FLOAT_VECTOR, dim=vectors.shape[1])
    index = client.prepare_index_params()
    hnsw = {"M": 16, "efConstruction": 200}
    index.add_index("vector", index_type="HNSW", metric_type="IP", params=hnsw)
    start = time.perf_counter()
    client.create_collection("scale", schema=schema, index_params=index)
    for first in range(0, len(vectors), BATCH):
        batch = enumerate(vectors[first : first + BATCH], first)
        client.insert("scale", [{"id": i, "vector": row} for i, row in batch])
    client.flush("scale")
    client.load_collection("scale")
    ready = False
    parameters = {"metric_type": "IP", "params": {"ef": 128}}

    def search(query: Floats, n: int) -> list[int]:
        found = client.search("scale", [query.tolist()], limit=n, search_params=parameters)
        return [hit["id"] for hit in found[0]]

    while not ready:  # its first answer waits for the index
        ready = bool(search(queries[0], 1))
    spent = time.perf_counter() - start
    told = time_queries(search, queries, wanted)
    client.close()
    size = on_disk(folder) / len(vectors)
    return Row("Milvus Lite 3, HNSW", len(vectors), len(vectors) / spent, *told, size)


MEASURES = {"milvus_lite": on_lite, "milvus": on_server}  # by the module that each needs


def measure_store(module: str, size: int, queries: int, seed: int, cache: Path) -> Row:
    """One store of so many vectors, in this fresh process."""
    vectors, queried = draw_clusters(np.random.default_rng(seed), size, queries)
    with TemporaryDirectory(dir=cache, ignore_cleanup_errors=True) as folder:
        best = np.full((len(queried), NEIGHBOURS), -np.inf, np.float32)
        rows = np.zeros((len(queried), NEIGHBOURS), np.int64)
        for start in range(0, len(vectors), 250_000):
            cosines = queried @ vectors[start : start + 250_000].T
            top = np.argpartition(-cosines, NEIGHBOURS, axis=1)[:, :NEIGHBOURS]
            both = np.concatenate([best, np.take_along_axis(cosines, top, 1)], axis=1)
            numbers = np.concatenate([rows, start + top], axis=1)
            order = np.argsort(-both, axis=1)[:, :NEIGHBOURS]
            best, rows = np.take_along_axis(both, order, 1), np.take_along_axis(numbers, order, 1)
        wanted = rows
        row = MEASURES[module](vectors, queried, wanted, Path(folder))
    return replace(row, peak=peak())


def format_rows(rows: Sequence[Row]) -> str:
    header = ["store", "vectors", "rows/s", "p50", "p95", "processor", "recall of ten",
              "bytes a row", "at most"]  # fmt: skip
    lines = [
        [r.store, number(r.count), number(r.rows_a_second, 0), number(r.p50_ms, 2, "ms"),
         number(r.p95_ms, 2, "ms"), number(r.cpu_ms, 2, "ms"), f"{r.recall:.3f}",
         number(r.bytes_a_row, 0), number(r.peak / 1e9, 1, "GB")]
        for r in rows
    ]  # fmt: skip
    return markdown(header, lines)


@table()
def vector_scale(
    run: Run,
    city: Annotated[
        str, option("City whose words and vectors are searched together.")
    ] = "vancouver",
    queries: Annotated[int, option("Queries of each.")] = 100,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Vectors by the million, and words beside them: rows a second, times, recall, bytes."""
    # Sizes in Milvus Lite, and on a Milvus server; `outdoor_vectors` has those of our file
    stores = ([250_000], [1_000_000])
    if quick:
        stores, city = ([10_000], []), "monaco"
    rows: list[Row] = []
    for module, sizes in zip(MEASURES, stores, strict=True):
        for size in sizes:
            if not find_spec(module):
                run.log(f"{module} is not installed")
                continue
            rows.append(run_apart(measure_store, module, size, queries, seed, run.cache))
            run.log(str(rows[-1]))
            run.save({"rows": rows})  # a server may never answer
    print(format_rows(rows))
    words: list[dict[str, Any]] = []
    if city and not find_spec("milvus_lite"):
        run.log("milvus-lite is not installed: words beside vectors are left out")
    elif city:
        told = make_queries(run.osm / EXTRACTS[city], n=queries, seed=seed)
        with TemporaryDirectory(dir=run.cache, ignore_cleanup_errors=True) as folder:
            words = hybrid(open_city(city, run.osm, run.cache), told, Path(folder))
        header = ["way", "p50", "p95", *(f"@{n}" for n in AMONG)]
        lines = [
            [w["way"], number(w["p50_ms"], 1, "ms"), number(w["p95_ms"], 1, "ms"),
             *(f"{w['among'][str(n)]:.2f}" for n in AMONG)]
            for w in words
        ]  # fmt: skip
        print(f"\n{markdown(header, lines)}")
    run.save({"rows": rows, "city": city, "words": words})
