"""How many pairs of a text and a cell are judged in a second? Table III of the paper.

    placegraph-lab table outdoor_pairs

Every row runs in a fresh process on one core, then on two. Prints Markdown, writes JSON.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from placegraph_lab.tables.outdoor.extracts import EXTRACTS, open_city, unseen_queries
from placegraph_lab.tables.outdoor.pairs import Pairs, rate
from placegraph_lab.tables.runner import Quick, Run, Seed, markdown, number, option, table
from placegraph_lab.tables.statistics import apart

PAPER = {"rule-based": 11.05, "network-based, CPU": 80.44, "network-based, GPU": 152.96}
"""Table III: pairs a second on a Xeon Gold 6140 and a TITAN Xp."""
WORKS = {
    "edits, plain": "edit distance, plain, 0.1 s a pair",
    "edits": "edit distance, 0.1 s a pair",
    "relations": "relational matching",
    "network": "network",
    "encoded": "network, cells encoded before",
    "torch": "network in PyTorch, CPU",
    "cuda": "network in PyTorch, GPU",
}


def work_of(kind: str, pairs: Pairs, *, quick: bool) -> Callable[[], int]:
    """What is timed."""
    if kind.startswith("edits"):
        texts, cells = (1, 5) if quick else (5, 20)
        return pairs.by_edits(plain=kind != "edits", texts=texts, cells=cells, timeout=0.1)
    if kind == "relations":
        return pairs.by_relations()
    from placegraph.outdoor.network.network import GraphTransformer

    network = GraphTransformer.default()
    if kind in ("network", "encoded"):
        return pairs.by_network(network, encoded=kind == "encoded")
    return pairs.by_torch(network, "cuda" if kind == "cuda" else "cpu")


class Asked(NamedTuple):
    """What every row is asked."""

    city: str
    osm: Path
    cache: Path
    texts: int
    cells: int
    seed: int
    quick: bool


def measure(kind: str, asked: Asked) -> dict[str, Any]:
    """Pairs a second of one row."""
    city = open_city(asked.city, asked.osm, asked.cache)
    path = asked.osm / EXTRACTS[asked.city]
    told = unseen_queries(asked.city, city, path, n=asked.texts, seed=asked.seed)
    pairs = Pairs.of(city, told, asked.cells, np.random.default_rng(asked.seed))
    work = work_of(kind, pairs, quick=asked.quick)
    return {"pairs_per_s": rate(work, seconds=1.0 if asked.quick else 8.0)}


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
    city: Annotated[str, option("Name of the city.")] = "vancouver",
    texts: Annotated[int, option("Texts.")] = 20,
    cells: Annotated[int, option("Cells a text.")] = 1000,
    seed: Seed = 0,
    *,
    quick: Quick = False,
) -> None:
    """How many pairs of a text and a cell are judged in a second? On one core, and on two."""
    if quick:
        texts, cells = 3, 200
    asked = Asked(city, run.osm, run.cache, texts, cells, seed, quick)
    counts = [n for n in (1, 2) if n <= len(os.sched_getaffinity(0))]
    open_city(city, run.osm, run.cache)  # built once, not in every process
    rows: list[dict[str, Any]] = []
    for kind, name in WORKS.items():
        for n in counts if kind != "cuda" else counts[-1:]:
            if can_run(kind) and not (kind.startswith("edits") and n > 1):
                found = apart(measure, kind, asked, cores=n)
                rows.append({"kind": kind, "name": name, "cores": n} | found)
    header = ["pairs/s", "one core", "two cores", "two cores, times the paper's"]
    lines = [line(kind, rows) for kind in WORKS]
    lines += [[f"*paper: {name}*", number(value, 2), "–", "–"] for name, value in PAPER.items()]
    print(markdown(header, lines))
    run.save({"texts": texts, "cells": cells, "paper": PAPER, "rows": rows})


def line(kind: str, rows: list[dict[str, Any]]) -> list[str]:
    """Row of the table."""
    by_cores = {r["cores"]: r["pairs_per_s"] for r in rows if r["kind"] == kind}
    theirs = PAPER["network-based, GPU" if kind == "cuda" else "network-based, CPU"]
    theirs = PAPER["rule-based"] if kind.startswith("edits") else theirs
    best = by_cores.get(2, by_cores.get(1))
    figures = [number(by_cores.get(1)), number(by_cores.get(2))]
    return [WORKS[kind], *figures, number(best / theirs) if best else "–"]
