"""Which vector store? Build time, query time, memory and recall against map size.

    python benchmarks/outdoor_vectors.py --sizes 447,1616,3409,5225,50000,1000000

Clustered random unit vectors of 64 numbers; a query is a stored vector that noise has turned away,
as a text is near its cell but never on it. One thread. faiss and usearch are measured where they
are installed; placegraph needs neither. Prints Markdown, writes JSON.
"""

from __future__ import annotations

import json
import sys
import time
from dataclasses import asdict, dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from placegraph.vectors import EmbeddedStore
from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.tables import markdown, number

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float32]
    Search = Callable[[Floats, int], NDArray[np.int64]]
    """One query (D,) and n to ids (n,)."""
    Build = Callable[[Floats], tuple[Search, int]]
    """Vectors (C, D) to the search and its memory in bytes."""

ROOT = Path(__file__).parents[1]
DIMENSION = 64
NEIGHBOURS = (10, 50)
SEVERAL = 100_000
"""Up to this size every kind of graph is built, beyond it one: it takes ten minutes."""


def clustered(rng: np.random.Generator, count: int, queries: int) -> tuple[Floats, Floats]:
    """Vectors in clusters of about 100, most of their variance in a third of the directions."""
    spread = np.exp(-np.arange(DIMENSION) / 20).astype(np.float32)

    def noise(n: int) -> Floats:
        return rng.standard_normal((n, DIMENSION), np.float32) * spread / np.linalg.norm(spread)

    def unit(rows: Floats) -> Floats:
        return np.asarray(rows / np.linalg.norm(rows, axis=1, keepdims=True), np.float32)

    centers = unit(noise(max(8, count // 100)))
    vectors = unit(centers[rng.integers(len(centers), size=count)] + 0.6 * noise(count))
    asked = unit(vectors[rng.integers(count, size=queries)] + 0.6 * noise(queries))
    return vectors, asked


def of_city(map_file: Path, osm: Path, queries: int, seed: int) -> tuple[Floats, Floats]:
    """Cells of a real map, and texts spoken in it, as the shipped network embeds them."""
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.language import describe
    from placegraph.outdoor.network.graphs import TextGraphs
    from placegraph.outdoor.network.network import GraphTransformer
    from placegraph_lab.tables.outdoor.queries import make_queries

    texts = [describe(q.text) for q in make_queries(osm, n=queries, seed=seed)]
    asked = GraphTransformer.default().embed_texts(TextGraphs.of(texts))
    return CityMap.open(map_file).embeddings, asked


def plain_numpy(vectors: Floats) -> tuple[Search, int]:
    """Product with all rows, then the best of them."""

    def search(query: Floats, n: int) -> NDArray[np.int64]:
        cosines = vectors @ query
        best = np.argpartition(cosines, -n)[-n:]
        return best[np.argsort(-cosines[best])]

    return search, vectors.nbytes


def ours(bits: int, *, lists: bool) -> Build:
    """`EmbeddedStore` of so many bits, exact or in lists."""

    def build(vectors: Floats) -> tuple[Search, int]:
        positions = np.zeros((len(vectors), 2))
        store = EmbeddedStore.of(
            np.arange(len(vectors)), vectors, positions, bits=bits, lists=lists
        )
        held = [store.rows, store.ids, store.positions, *(store.lists or ())]
        return lambda query, n: store.search(query[None], n).ids[0], sum(a.nbytes for a in held)

    return build


def usearch_graph(dtype: str) -> Build:
    """HNSW of usearch."""

    def build(vectors: Floats) -> tuple[Search, int]:
        from usearch.index import Index

        index = Index(
            ndim=DIMENSION, metric="cos", dtype=dtype, connectivity=16, expansion_add=128,
            expansion_search=128,
        )  # fmt: skip
        index.add(np.arange(len(vectors)), vectors, threads=1)
        return lambda query, n: index.search(query, n, threads=1).keys, index.memory_usage

    return build


def faiss_index(kind: str) -> Build:
    """faiss: every row, HNSW, or inverted lists as ours."""

    def build(vectors: Floats) -> tuple[Search, int]:
        import faiss

        faiss.omp_set_num_threads(1)
        if kind == "HNSW":
            index = faiss.IndexHNSWFlat(DIMENSION, 16, faiss.METRIC_INNER_PRODUCT)
            index.hnsw.efConstruction = index.hnsw.efSearch = 128
        elif kind == "lists":
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


def contenders(count: int, graphs: int) -> Iterator[tuple[str, Build]]:
    """Name and builder of what is measured on so many vectors."""
    yield "numpy, float32", plain_numpy
    yield "ours, exact, float32", ours(32, lists=False)
    yield "ours, exact, 16 bits", ours(16, lists=False)
    yield "ours, exact, 8 bits", ours(8, lists=False)
    large = count >= 50_000
    if large:
        yield "ours, lists, 16 bits", ours(16, lists=True)
        yield "ours, lists, 8 bits", ours(8, lists=True)
    if find_spec("faiss"):
        yield "faiss, exact", faiss_index("exact")
        if large:
            yield "faiss, lists", faiss_index("lists")
        if large and count <= min(graphs, SEVERAL):
            yield "faiss, HNSW", faiss_index("HNSW")
    if find_spec("usearch") and count <= graphs:
        yield "usearch, HNSW, float16", usearch_graph("f16")
        if count <= SEVERAL:
            yield "usearch, HNSW, 8 bits", usearch_graph("i8")


@dataclass(frozen=True)
class Row:
    """What one contender did on one size."""

    count: int
    name: str
    build_s: float
    bytes: int
    ms: dict[int, float]
    """Median of a query, by n."""
    recall: dict[int, float]
    """Share of the exact neighbours found, by n."""


def race(
    name: str, build: Build, vectors: Floats, queries: Floats, wanted: NDArray[np.int64]
) -> Row:
    """Build and ask, after both have been tried on a few vectors (compilation)."""
    warm, _ = build(vectors[:400])
    warm(queries[0], 10)
    start = time.perf_counter()
    search, size = build(vectors)
    build_s = time.perf_counter() - start
    ms, recall = {}, {}
    for n in NEIGHBOURS:
        times, hits = [], 0
        for query, best in zip(queries, wanted[:, :n], strict=True):
            start = time.perf_counter()
            found = search(query, n)
            times.append(time.perf_counter() - start)
            hits += len(np.intersect1d(found, best))
        ms[n], recall[n] = 1e3 * float(np.median(times)), hits / (n * len(queries))
    return Row(len(vectors), name, build_s, size, ms, recall)


def table(rows: list[Row]) -> str:
    """Markdown of one size."""
    header = ["store", "build", "MB", "top 10", "recall", "top 50", "recall"]
    lines = []
    for row in rows:
        line = [row.name, number(row.build_s, 2, "s"), number(row.bytes / 1e6, 1)]
        for n in NEIGHBOURS:
            line += [number(row.ms[n], 3, "ms"), f"{row.recall[n]:.3f}"]
        lines.append(line)
    return markdown(header, lines)


def main(
    sizes: Annotated[str, typer.Option(help="Numbers of vectors with commas.")] = (
        "447,1616,3409,5225,50000,1000000"
    ),
    queries: Annotated[int, typer.Option(help="Queries of each size.")] = 200,
    graphs: Annotated[
        int, typer.Option(help="Largest size that graphs (HNSW) are built for: minutes.")
    ] = 1_000_000,
    city: Annotated[
        Path | None, typer.Option(help="City map whose cells are measured too, with --osm.")
    ] = None,
    osm: Annotated[Path | None, typer.Option(help="Extract that the map was built from.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the vectors and the queries.")] = 0,
    out: Annotated[Path, typer.Option(help="JSON file.")] = (
        ROOT / "benchmarks/results/outdoor_vectors.json"
    ),
) -> None:
    """Measure every store at several sizes."""
    rows: list[Row] = []
    worlds: list[Callable[[], tuple[Floats, Floats]]] = [
        partial(clustered, np.random.default_rng(seed), int(s), queries)
        for s in sizes.split(",")
        if s
    ]
    if city and osm:
        worlds.append(partial(of_city, city, osm, queries, seed))
    for world in worlds:
        vectors, asked = world()
        count = len(vectors)
        wanted = np.stack(
            [np.argsort(-(vectors @ q), kind="stable")[: max(NEIGHBOURS)] for q in asked]
        )
        done: list[Row] = []
        for name, build in contenders(count, graphs):
            print(f"{count:,}: {name}", file=sys.stderr)
            done.append(race(name, build, vectors, asked, wanted))
        print(f"### {count:,} vectors\n\n{table(done)}\n", flush=True)
        rows += done
    out.parent.mkdir(parents=True, exist_ok=True)
    record = {"machine": machine(), "seed": seed, "queries": queries}
    record |= {"dimension": DIMENSION, "rows": [asdict(row) for row in rows]}
    out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
