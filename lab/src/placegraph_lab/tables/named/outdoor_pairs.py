"""Pairs of a text and a cell that each matcher compares in a second (Table III)."""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.random import Generator

from placegraph.outdoor.city import CityMap
from placegraph.outdoor.language.description import Description
from placegraph.outdoor.likelihood.match_kernels import score_views
from placegraph.outdoor.likelihood.query import compile_query
from placegraph.outdoor.network.graphs import (
    PlaceGraphs,
    TextGraphs,
    WordFits,
    find_word_weights,
    make_word_fits,
)
from placegraph.outdoor.network.label_graphs import LabelGraphs
from placegraph.outdoor.network.network import GraphTransformer
from placegraph.outdoor.search.edit_distance import rank
from placegraph.outdoor.search.posterior import PRIOR_COHERENT
from placegraph.outdoor.search.request import parse
from placegraph_lab.tables.outdoor.extracts import CITY, Extract, extract_of, unseen_queries
from placegraph_lab.tables.outdoor.queries import Query
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, number, option, table
from placegraph_lab.tables.statistics import run_apart

EVERYTHING = 1e9  # margin [nat] that leaves nothing out: every pair is scored in full
TOGETHER_IN_TORCH = 250  # pairs a batch in PyTorch


def rate(work: Callable[[], int], *, seconds: float, least: int = 3) -> float:
    """Pairs a second: the median of runs that together take `seconds`, after one that warms up.

    `work`: compares some pairs and returns how many they are; `least`: runs at the least.
    """
    work()
    rates: list[float] = []
    end = time.perf_counter() + seconds
    while len(rates) < least or time.perf_counter() < end:
        start = time.perf_counter()
        pairs = work()
        rates.append(pairs / (time.perf_counter() - start))
    return float(np.median(rates))


@dataclass(frozen=True)
class Pairs:
    """Texts, and cells drawn at random for each of them."""

    city: CityMap
    descriptions: tuple[Description, ...]
    rows: tuple[np.ndarray, ...]  # for each text (K,) rows of `city.cells.points`

    @classmethod
    def of(cls, city: CityMap, queries: Sequence[Query], cells: int, rng: Generator) -> Pairs:
        return cls(
            city,
            tuple(parse(city, q.text) for q in queries),
            tuple(rng.choice(len(city.cells), cells, replace=False) for _ in queries),
        )

    def by_edits(self, *, plain: bool, texts: int, cells: int, timeout: float) -> Callable[[], int]:
        """Edit distance of some of the pairs; the graphs of the cells are made before."""
        names = tuple(self.city.cells)
        chosen = [
            (d, [names[i] for i in r[:cells]])
            for d, r in zip(self.descriptions[:texts], self.rows, strict=False)
        ]
        graphs = [[self.city.graph(cell) for cell in cells] for _, cells in chosen]
        centers = [[self.city.cells.center(cell) for cell in cells] for _, cells in chosen]

        def work() -> int:
            for (description, _), given, at in zip(chosen, graphs, centers, strict=True):
                rank(description, given, centers=at, timeout=timeout, plain=plain)
            return sum(map(len, graphs))

        return work

    @cached_property
    def views(self) -> tuple[np.ndarray, ...]:
        """For each text (K,) viewpoints drawn at random: what relational matching scores."""
        rng = np.random.default_rng(0)
        count = len(self.city.views)
        return tuple(rng.choice(count, len(r)).astype(np.int32) for r in self.rows)

    def by_relations(self) -> Callable[[], int]:
        """Relational matching of all pairs in full, texts compiled anew."""
        city, columns, scene = self.city, self.city.views.columns, self.city.columns
        tokens = len(city.views.share)

        def work() -> int:
            for description, chosen in zip(self.descriptions, self.views, strict=True):
                query = compile_query(description, city)
                statements = query.statements
                score_views(
                    statements,
                    scene,
                    columns,
                    query.token_weights(tokens),
                    chosen,
                    np.ones(len(chosen)),
                    np.zeros(len(chosen)),
                    np.zeros((len(chosen), len(statements.op)), np.float32),
                    PRIOR_COHERENT,
                    EVERYTHING,
                )
            return sum(map(len, self.views))

        return work

    def by_network(self, network: GraphTransformer, *, encoded: bool = False) -> Callable[[], int]:
        """Joint embedding of all pairs (Eq. 14-17), a text's cells at once, a thread a core.

        The graphs of the cells are encoded anew for every pair, or were before (`encoded`).
        """
        texts, places, words = self._graphs(printed=network.shape.printed)
        vectors = network.word_vectors(places.vocabulary)
        before = [network.encode_places(places, r, vectors) if encoded else None for r in self.rows]
        threads = len(os.sched_getaffinity(0))

        def match(text: int) -> int:
            rows = self.rows[text]
            network.match(texts, text, places, rows, words, vectors, before[text])
            return len(rows)

        def work() -> int:
            with ThreadPoolExecutor(threads) as pool:
                return sum(pool.map(match, range(len(self.rows))))

        return work

    def by_torch(self, network: GraphTransformer, device: str) -> Callable[[], int]:
        """The same in PyTorch, by the network as printed: batches are laid out, moved, and judged."""
        import torch

        from placegraph_learn.city.batches import Batch, PairBatch, forward
        from placegraph_learn.city.network import Network

        texts, places, _ = self._graphs(printed=True)
        module = Network(
            network.shape, network.word_table.vectors.shape[1] if network.word_table else 0
        )
        module.load_state_dict({k: torch.from_numpy(v.copy()) for k, v in network.arrays.items()})
        module.to(device).eval()
        bags = SimpleNamespace(
            text_bags=network.bags(texts.vocabulary), place_bags=network.bags(places.vocabulary)
        )

        def work() -> int:
            for text, chosen in enumerate(self.rows):
                for at in range(0, len(chosen), TOGETHER_IN_TORCH):
                    rows, one = chosen[at : at + TOGETHER_IN_TORCH], np.array([text])
                    every = np.arange(len(rows))
                    none: Any = (np.zeros((len(rows), 0), np.float32),) * (
                        len(PairBatch._fields) - 2
                    )
                    batch = Batch(
                        texts.batch(one),
                        places.batch(rows),
                        PairBatch(np.zeros(len(rows), np.int64), every, *none),
                        slots=every,
                        right=np.zeros(len(rows), np.int8),
                        everywhere=np.zeros((1, len(rows)), np.int64),
                        relational=np.zeros(len(rows), np.float32),
                    )
                    with torch.no_grad():
                        forward(module, bags, batch, device).logit.cpu()  # type: ignore[arg-type]  # only bags are read
            return sum(map(len, self.rows))

        return work

    def _graphs(
        self, *, printed: bool
    ) -> tuple[TextGraphs | LabelGraphs, PlaceGraphs | LabelGraphs, WordFits | None]:
        """Graphs of texts and cells; with `printed` those of the paper, which need no weights of words."""
        if printed:
            return LabelGraphs.of_texts(self.descriptions), LabelGraphs.of_cells(self.city), None
        texts = TextGraphs.of(self.descriptions)
        fits = find_word_weights(texts, [compile_query(d, self.city) for d in self.descriptions])
        words = make_word_fits(fits, *self.city.word_counts)
        return texts, PlaceGraphs.of_cells(self.city), words


PAPER = {"rule-based": 11.05, "network-based, CPU": 80.44, "network-based, GPU": 152.96}
"""Table III: pairs a second on a Xeon Gold 6140 and a TITAN Xp."""
WORKS = {
    "edits, plain": "edit distance, plain, 0.1 s a pair",
    "edits": "edit distance, 0.1 s a pair",
    "relations": "relational matching",
    "network": "our network",
    "network, encoded": "our network, cells encoded before",
    "printed": "GOTLoc as printed",
    "printed, encoded": "GOTLoc as printed, cells encoded before",
    "torch": "GOTLoc as printed in PyTorch, CPU",
    "cuda": "GOTLoc as printed in PyTorch, GPU",
}


def work_of(kind: str, pairs: Pairs, *, quick: bool) -> Callable[[], int]:
    if kind.startswith("edits"):
        texts, cells = (1, 5) if quick else (5, 20)
        return pairs.by_edits(plain=kind != "edits", texts=texts, cells=cells, timeout=0.1)
    if kind == "relations":
        return pairs.by_relations()
    network = GraphTransformer.default(printed=not kind.startswith("network"))
    if kind in ("torch", "cuda"):
        return pairs.by_torch(network, "cuda" if kind == "cuda" else "cpu")
    return pairs.by_network(network, encoded=kind.endswith("encoded"))


class Question(NamedTuple):
    extract: Extract
    cache: Path
    texts: int
    cells: int
    seed: int
    quick: bool


def measure(kind: str, question: Question) -> dict[str, Any]:
    """Pairs a second of one row."""
    city, path = question.extract.open(question.cache), question.extract.osm(question.cache)
    told = unseen_queries(question.extract, city, path, n=question.texts, seed=question.seed)
    pairs = Pairs.of(city, told, question.cells, np.random.default_rng(question.seed))
    work = work_of(kind, pairs, quick=question.quick)
    return {"pairs_per_s": rate(work, seconds=1.0 if question.quick else 8.0)}


def can_run(kind: str) -> bool:
    """Whether this machine has what a row needs."""
    if kind not in ("torch", "cuda"):
        return True
    if importlib.util.find_spec("torch") is None:
        return False
    import torch

    return kind == "torch" or torch.cuda.is_available()


@table("GOTLoc, Table III")
def outdoor_pairs(
    run: Run,
    city: Annotated[str, option(CITY)] = "vancouver",
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """Pairs of a text and a cell matched in a second, on one core and on two."""
    texts, cells = (3, 200) if quick else (20, 1000)
    extract = extract_of(city, run.osm)
    built = extract.open(run.cache)  # once, not in every process
    asked = Question(extract, run.cache, texts, min(cells, len(built.cells)), seed, quick)
    counts = [n for n in (1, 2) if n <= len(os.sched_getaffinity(0))]
    rows: list[dict[str, Any]] = []
    for kind, name in WORKS.items():
        for n in counts if kind != "cuda" else counts[-1:]:
            if can_run(kind) and not (kind.startswith("edits") and n > 1):
                found = run_apart(measure, kind, asked, cores=n)
                rows.append({"kind": kind, "name": name, "cores": n} | found)
    header = ["pairs/s", "one core", "two cores", "two cores, times the paper's"]
    lines = [line(kind, rows) for kind in WORKS]
    lines += [[f"*paper: {name}*", number(value, 2), "–", "–"] for name, value in PAPER.items()]
    print(markdown(header, lines))
    run.save({"texts": texts, "cells": cells, "paper": PAPER, "rows": rows})


def line(kind: str, rows: list[dict[str, Any]]) -> list[str]:
    by_cores = {r["cores"]: r["pairs_per_s"] for r in rows if r["kind"] == kind}
    theirs = PAPER["network-based, GPU" if kind == "cuda" else "network-based, CPU"]
    theirs = PAPER["rule-based"] if kind.startswith("edits") else theirs
    best = by_cores.get(2, by_cores.get(1))
    figures = [number(by_cores.get(1)), number(by_cores.get(2))]
    return [WORKS[kind], *figures, number(best / theirs) if best else "–"]
