"""Which vector store? Build time, query time, memory and recall against map size.

Clustered random unit vectors of 64 numbers; a query is a stored vector that noise has turned away,
as a text is near its cell but never on it. One thread. faiss and usearch are measured where they
are installed; placegraph needs neither.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.vectors import EmbeddedStore
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.runner import Quick, Run, Seed, option, parts, show, table

Floats = NDArray[np.float32]
Search = Callable[[Floats, int], NDArray[np.int64]]  # one query (D,) and n to ids (n,)
Build = Callable[
    [Floats], tuple[Search, int]
]  # vectors (C, D) to the search and its memory in bytes


DIMENSION = 64
BLOCK = 1_000_000  # rows that are drawn at once
NEIGHBOURS = (10, 50)


def draw_clusters(rng: np.random.Generator, count: int, queries: int) -> tuple[Floats, Floats]:
    """Vectors in clusters of about 100, most of their variance in a third of the directions."""
    spread = np.exp(-np.arange(DIMENSION) / 20).astype(np.float32)

    def noise(n: int) -> Floats:
        return rng.standard_normal((n, DIMENSION), np.float32) * spread / np.linalg.norm(spread)

    def unit(rows: Floats) -> Floats:
        return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)

    centers = unit(noise(max(8, count // 100)))
    vectors = np.empty((count, DIMENSION), np.float32)
    for first in range(0, count, BLOCK):  # ten million at once would take 10 GB
        some = vectors[first : first + BLOCK]
        some[:] = unit(centers[rng.integers(len(centers), size=len(some))] + 0.6 * noise(len(some)))
    asked = unit(vectors[rng.integers(count, size=queries)] + 0.6 * noise(queries))
    return vectors, asked


def plain_numpy(vectors: Floats) -> tuple[Search, int]:
    """Product with all rows, then the best of them."""

    def search(query: Floats, n: int) -> NDArray[np.int64]:
        cosines = vectors @ query
        best = np.argpartition(cosines, -n)[-n:]
        return best[np.argsort(-cosines[best])]

    return search, vectors.nbytes


def build_store(bits: int) -> Build:
    """Build an `EmbeddedStore` of so many bits."""

    def build(vectors: Floats) -> tuple[Search, int]:
        positions = np.zeros((len(vectors), 2))
        store = EmbeddedStore.of(np.arange(len(vectors)), vectors, positions, bits=bits)
        held = [store.rows, store.ids, store.positions]
        return lambda query, n: store.search(query[None], n).ids[0], sum(a.nbytes for a in held)

    return build


def usearch_graph(vectors: Floats) -> tuple[Search, int]:
    """HNSW of usearch, in 16 bits a number."""
    from usearch.index import Index

    index = Index(
        ndim=DIMENSION, metric="cos", dtype="f16", connectivity=16, expansion_add=128,
        expansion_search=128,
    )  # fmt: skip
    index.add(np.arange(len(vectors)), vectors, threads=1)
    return lambda query, n: index.search(query, n, threads=1).keys, index.memory_usage


def faiss_index(kind: str) -> Build:
    """faiss: every row, or inverted lists."""

    def build(vectors: Floats) -> tuple[Search, int]:
        import faiss

        faiss.omp_set_num_threads(1)
        if kind == "lists":
            count = int(2 * len(vectors) ** 0.5)
            flat = faiss.IndexFlatIP(DIMENSION)
            index = faiss.IndexIVFFlat(flat, DIMENSION, count, faiss.METRIC_INNER_PRODUCT)
            index.train(vectors[:: max(1, len(vectors) // (40 * count))])
            index.nprobe = 256
        else:
            index = faiss.IndexFlatIP(DIMENSION)
        index.add(vectors)
        return lambda query, n: index.search(query[None], n)[1][0], faiss.serialize_index(
            index
        ).nbytes

    return build


def contenders(count: int) -> Iterator[tuple[str, Build]]:
    """Name and builder of what is measured on so many vectors."""
    yield "numpy, float32", plain_numpy
    yield "ours, exact, float32", build_store(32)
    yield "ours, exact, 16 bits", build_store(16)
    yield "ours, exact, 8 bits", build_store(8)
    if find_spec("faiss"):
        yield "faiss, exact", faiss_index("exact")
        if count >= 50_000:
            yield "faiss, lists", faiss_index("lists")
    if find_spec("usearch") and count <= 1_000_000:  # more take long
        yield "usearch, HNSW, float16", usearch_graph


COLUMNS = (
    Col("store", "name"), Col("build", "build_s", 2, "s"), Col("MB", "bytes", 1, "", 1e-6),
    *(column for n in NEIGHBOURS
      for column in (Col(f"top {n}", f"ms.{n}", 3, "ms"), Col("recall", f"recall.{n}", 3))),
)  # fmt: skip


def time_store(name: str, build: Build, vectors: Floats, queries: Floats) -> dict[str, Any]:
    """Time building and asking one store; share of the exact neighbours that are found."""
    warm, _ = build(vectors[:400])
    warm(queries[0], 10)
    start = time.perf_counter()
    search, size = build(vectors)
    row = {
        "count": len(vectors),
        "name": name,
        "build_s": time.perf_counter() - start,
        "bytes": size,
    }
    ms, recall = {}, {}
    for n in NEIGHBOURS:
        times, hits = [], 0
        for query in queries:
            start = time.perf_counter()
            found = search(query, n)
            times.append(time.perf_counter() - start)
            hits += len(np.intersect1d(found, np.argsort(-(vectors @ query), kind="stable")[:n]))
        ms[str(n)], recall[str(n)] = 1e3 * float(np.median(times)), hits / (n * len(queries))
    return row | {"ms": ms, "recall": recall}


@table()
def outdoor_vectors(
    run: Run,
    sizes: Annotated[str, option("Numbers of vectors with commas.")] = (
        "447,1616,3409,5225,50000,1000000"
    ),
    queries: Annotated[int, option("Queries of each size.")] = 200,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Vector stores: build time, query time, memory and recall against the size of the map."""
    if quick:
        sizes, queries = "447", 20
    rows: list[dict[str, Any]] = []
    for size in parts(sizes):
        vectors, asked = draw_clusters(np.random.default_rng(seed), int(size), queries)
        first, count = len(rows), len(vectors)
        for name, build in contenders(count):
            run.log(f"{count:,}: {name}")
            rows.append(time_store(name, build, vectors, asked))
        show(f"{count:,} vectors", COLUMNS, rows[first:])
    run.save({"dimension": DIMENSION, "rows": rows})
