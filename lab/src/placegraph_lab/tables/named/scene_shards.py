"""100,000 scenes in shards: which one it is, how fast that is told, and how often the right one is.

Homes are drawn (`worlds.home`); 100,000 would take days, so that all but the first are drawn homes
perturbed as scene graphs, without meshes: turned, half of their objects others. A query of frames is
what panoramas of a scene show, with a share of the patches called wrongly; a text is six facts about a
room.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder, encoder
from placegraph.indoor.language import read
from placegraph.indoor.library.library import Entry, SceneLibrary
from placegraph.indoor.library.search import (
    PatchWords,
    Query,
    SearchOptions,
    cluster_vectors,
    infer_from_query,
)
from placegraph.indoor.library.search_kernels import count_agreeing
from placegraph.indoor.library.signature import BANDS, TURNS, Signature, compute_signature
from placegraph_lab.tables import runner as lab
from placegraph_lab.tables.runner import Column as Col
from placegraph_lab.tables.scene.search import Stock
from placegraph_lab.tables.scene.sentences import Scene, describe
from placegraph_lab.tables.statistics import peak, run_apart
from placegraph_lab.worlds.home.home import STYLES, home, scene_of
from placegraph_scale.library.shards import HEAD, SceneShards
from placegraph_scale.library.write import SIZE, NamedEntry, write_shards

WRONG = (0.0, 0.1, 0.3)
FRAMES, FACTS = 5, 6
DRAWN = 60  # homes that are drawn
SIDE = 2  # patches of a bin of a panorama: this by this
VIEW = 6  # bins of azimuth in sight: 90 degrees
NOISE = (
    0.3  # length of the noise in what patches look like, against that of what the object looks like
)
LOOKED, WIDELY = SearchOptions().shortlist, 4_000
"""Scenes compared closely, half by labels and half by looks, and so many to see what is lost."""
READ = 5_000  # scenes of a library that is read, for comparison


def draw_signatures(run: lab.Run, encoders: Sequence[Encoder], seed: int) -> list[Signature]:
    """Signatures of drawn homes."""
    names, found = list(STYLES), []
    for i in run.track(range(DRAWN), "homes", total=DRAWN):
        rng = np.random.default_rng(seed + i)
        made = scene_of(home(rng, style=names[i % len(names)]).furnish(rng))
        found.append(compute_signature(made, encoders))
    return found


def scene(signatures: Sequence[Signature], stock: Stock, row: int, seed: int) -> Signature:
    if row < len(signatures):
        return signatures[row]
    return stock.variation(signatures[row % len(signatures)], np.random.default_rng((seed, row)))


def draw_scenes(signatures: Sequence[Signature], count: int, seed: int) -> Iterator[NamedEntry]:
    stock = Stock.of(signatures)
    for i in range(count):
        yield NamedEntry(f"home {i}", Entry(scene(signatures, stock, i, seed), None))


def frames_query(
    signature: Signature,
    encoders: Sequence[Encoder],
    stock: Stock,
    wrong: float,
    rng: np.random.Generator,
) -> Query:
    """Make a query of some panoramas of a scene, a share of its patches mislabelled."""
    places = np.sort(
        rng.choice(len(signature.places), min(FRAMES, len(signature.places)), replace=False)
    )
    heading = rng.integers(TURNS, size=len(places))
    turns = (heading[:, None] + np.arange(VIEW) - VIEW // 2) % TURNS
    bins = signature.panoramas[places[:, None], :, turns].swapaxes(1, 2)  # (T, BANDS, VIEW)
    objects = bins.repeat(SIDE, axis=1).repeat(SIDE, axis=2)
    shown = (objects < len(signature)).reshape(-1)
    shape = objects.shape[1:]
    frame = np.repeat(np.arange(len(places), dtype=np.int32), np.prod(shape))
    band = np.broadcast_to(np.arange(BANDS).repeat(SIDE)[:, None], shape)
    turn = np.broadcast_to(((np.arange(VIEW) - VIEW // 2) % TURNS).repeat(SIDE), shape)
    flat = np.minimum(objects, len(signature) - 1).reshape(-1)
    mistaken = rng.random(len(flat)) < wrong
    others = rng.integers(len(stock.labels), size=len(flat))
    said = []
    for e in encoders:
        own: NDArray[Any] = signature.vectors[e.key][flat]
        if e.name == "labels":
            own = np.where(mistaken[:, None], stock.vectors[e.key][others], own)
        else:
            own = own + rng.normal(0.0, NOISE / np.sqrt(own.shape[1]), own.shape)
            own = own / np.maximum(np.linalg.norm(own, axis=1, keepdims=True), 1e-9)
        use = shown & own.any(axis=1)
        words, word = cluster_vectors(own[use].astype(np.float32))
        every = np.full(len(flat), -1, np.int32)
        every[use] = word
        around = count_agreeing(every, np.array([shape] * len(places)))
        said.append(
            PatchWords(
                e.key, e.temperature, words, word, frame[use],
                np.tile(turn.reshape(-1), len(places))[use].astype(np.int32),
                np.tile(band.reshape(-1), len(places))[use].astype(np.int32), around[use],
            )
        )  # fmt: skip
    at = signature.places[places]
    yaw = heading * (2.0 * np.pi / TURNS)
    return Query(
        tuple(said), np.column_stack([at, np.full(len(places), 1.6), yaw]).astype(np.float64)
    )


def describe_room(
    signatures: Sequence[Signature], stock: Stock, row: int, seed: int, wrong: float
) -> str:
    """Facts about a room of a scene, each of another scene with probability `wrong`."""
    rng = np.random.default_rng((seed, row, 1))
    rows = [row, *rng.integers(len(signatures), size=9).tolist()]
    own = [scene(signatures, stock, int(r), seed) for r in rows]
    told = [Scene(f"home {r}", s.graph, tuple(a.get("room", "") for a in s.attributes))
            for r, s in zip(rows, own, strict=True)]  # fmt: skip
    return describe(told, 0, rng, facts=FACTS, wrong=wrong)


def ask(folder: Path, signatures: Sequence[Signature], queries: int, seed: int) -> dict[str, Any]:
    """Open the shards in this fresh process and ask; times [ms], memory and recall."""
    before, start = peak(), time.perf_counter()
    shards = SceneShards.open(folder)
    opened = time.perf_counter() - start
    both = shards.encoders
    stock = Stock.of(signatures)
    rng = np.random.default_rng((seed, 2))
    targets = rng.choice(len(shards), queries, replace=False)
    start = time.perf_counter()
    shards.search("a bed next to a wardrobe")
    first = time.perf_counter() - start
    rows = []
    for way in ("labels", "labels and looks", "text"):
        for wrong in WRONG:
            times, spent, ranks, same = [], [], [], []
            for row in targets.tolist():
                own = scene(signatures, stock, row, seed)
                find: Callable[..., Any]
                if way == "text":
                    text = describe_room(signatures, stock, row, seed, wrong)
                    find = _text(shards, text)
                else:
                    used = both if way == "labels and looks" else both[:1]
                    query = frames_query(
                        own, used, stock, wrong, np.random.default_rng((seed, row, 3))
                    )
                    find = _frames(shards, query)
                start, cpu = time.perf_counter(), time.process_time()
                found = find(LOOKED)
                times.append(1e3 * (time.perf_counter() - start))
                spent.append(1e3 * (time.process_time() - cpu))
                names = [m.scene for m in found.modes]
                ranks.append(names.index(f"home {row}") if f"home {row}" in names else len(names))
                if way != "text":
                    same.append(find(WIDELY).best.scene == names[0])
            p50, p95 = np.percentile(times, (50, 95))
            rows.append({
                "way": way, "wrong": wrong, "p50_ms": p50, "p95_ms": p95,
                "cpu_ms": float(np.median(spent)), "recall_1": float(np.mean(np.array(ranks) < 1)),
                "recall_10": float(np.mean(np.array(ranks) < 10)),
                "same_as_widely": float(np.mean(same)) if same else 1.0,
            })  # fmt: skip
    return {
        "opened_ms": 1e3 * opened,
        "first_ms": 1e3 * first,
        "rows": rows,
        "peak": peak(),
        "before": before,
    }


def ask_read(
    signatures: Sequence[Signature], count: int, queries: int, seed: int
) -> dict[str, Any]:
    """Ask a library of some of the scenes that is read, in this fresh process: medians [ms]."""
    library, stock = SceneLibrary(), Stock.of(signatures)
    for name, entry, _ in draw_scenes(signatures, count, seed):
        library.insert(name, entry)
    rng = np.random.default_rng((seed, 2))
    out = {}
    for way in ("labels", "labels and looks", "text"):
        times = []
        for row in [0, *rng.choice(count, queries, replace=False).tolist()]:
            used = library.encoders[: 1 + (way == "labels and looks")]
            own = scene(signatures, stock, row, seed)
            query = frames_query(own, used, stock, 0.1, np.random.default_rng((seed, row, 3)))
            text = describe_room(signatures, stock, row, seed, 0.1)
            start = time.perf_counter()
            if way == "text":
                library.score_text(read(text))
            else:
                infer_from_query(library, query, SearchOptions())
            times.append(1e3 * (time.perf_counter() - start))
        out[way] = float(np.median(times[1:]))  # the first compiles, and makes the index
    return out | {"peak": peak()}


def _frames(shards: SceneShards, query: Query) -> Callable[[int], Any]:
    return lambda looked: infer_from_query(shards, query, SearchOptions(shortlist=looked)).estimate(
        shards, 10
    )


def _text(shards: SceneShards, text: str) -> Callable[[int], Any]:
    def find(_: int) -> Any:
        try:
            return shards.search(text, most=10)
        except OptionError:  # nothing of it was understood
            return shards.search("a room", most=10)

    return find


@lab.table()
def scene_shards(
    run: lab.Run,
    scenes: Annotated[int, lab.option("Scenes.")] = 100_000,
    queries: Annotated[int, lab.option("Queries of each kind.")] = 50,
    size: Annotated[int, lab.option("Scenes of a shard.")] = SIZE,
    seed: lab.Seed = 1000,
    *,
    fresh: lab.Fresh = False,
    quick: lab.Quick = False,
) -> None:
    """100,000 scenes in shards: which one it is, how fast that is told, and how often rightly."""
    scenes, queries = (2_000, 5) if quick else (scenes, queries)
    encoders = [encoder("labels"), encoder("appearance")]
    signatures = draw_signatures(run, encoders, seed)
    folder = run.cache / f"scene_shards_{scenes}_{seed}"
    made = None
    if fresh or not (folder / HEAD).exists():
        start, cpu = time.perf_counter(), time.process_time()
        every = run.track(draw_scenes(signatures, scenes, seed), "scenes", total=scenes)
        write_shards(folder, every, encoders, size)
        made = {"s": time.perf_counter() - start, "cpu_s": time.process_time() - cpu}
    told = run_apart(ask, folder, signatures, queries, seed)
    read_ = run_apart(ask_read, signatures, min(READ, scenes), min(queries, 20), seed)
    size_ = sum(f.stat().st_size for f in folder.rglob("*.shard"))
    objects = float(np.mean([len(s) for s in signatures]))
    print(
        f"{scenes:,} scenes of {objects:.0f} objects in {-(-scenes // size)} shards, "
        f"{size_ / scenes:,.0f} bytes a scene; opened in {told['opened_ms']:.0f} ms, "
        f"first text in {told['first_ms']:.0f} ms; "
        f"{told['peak'] / 1e6:.0f} MB at most, {told['before'] / 1e6:.0f} MB of them before; "
        f"made in {made['cpu_s'] if made else 0:.0f} s of processor.\n"
    )

    columns = (
        Col("asked by", "way"), Col("wrong", "wrong", lab.share), Col("p50", "p50_ms", 0, "ms"),
        Col("p95", "p95_ms", 0, "ms"), Col("processor", "cpu_ms", 0, "ms"),
        Col("right", "recall_1", lab.share), Col("among ten", "recall_10", lab.share),
        Col(f"as of {WIDELY:,}", "same_as_widely", lab.share),
        Col(f"times {min(READ, scenes):,} read", lambda r: r["p50_ms"] / read_[r["way"]], 1),
    )  # fmt: skip
    print(lab.render(columns, told["rows"]))
    run.save(
        {"scenes": scenes, "objects": objects, "bytes": size_, "made": made, "read": read_, **told}
    )
