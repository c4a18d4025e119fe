"""How many pairs of a text and a cell are judged in a second? Table III of the paper.

    python benchmarks/outdoor_pairs.py

Every row runs in a fresh process on one core, then on two. Prints Markdown, writes JSON.
"""

from __future__ import annotations

import importlib.util
import json
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from placegraph_lab.tables.machine import machine
from placegraph_lab.tables.outdoor.extracts import EXTRACTS, open_city, unseen_queries
from placegraph_lab.tables.outdoor.pairs import Pairs, rate
from placegraph_lab.tables.tables import markdown, number

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared/data/osm"
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


def measure(
    kind: str, city: str, data: Path, maps: Path, texts: int, cells: int, seed: int, *, quick: bool
) -> dict[str, Any]:
    """Pairs a second of one row."""
    opened = open_city(city, data, maps)
    asked = unseen_queries(city, opened, data / EXTRACTS[city], n=texts, seed=seed)
    pairs = Pairs.of(opened, asked, cells, np.random.default_rng(seed))
    seconds = 1.0 if quick else 8.0
    return {"pairs_per_s": rate(work_of(kind, pairs, quick=quick), seconds=seconds)}


def apart(
    cores: int, work: Callable[..., dict[str, Any]], *given: object, **options: object
) -> Any:  # noqa: ANN401
    """Run a function in a fresh process that has seen only some cores from its start."""
    mine = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(mine)[:cores])
    try:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            return pool.submit(work, *given, **options).result()
    finally:
        os.sched_setaffinity(0, mine)


def can_run(kind: str) -> bool:
    """Whether this machine has what a row needs."""
    if kind not in ("torch", "cuda"):
        return True
    if importlib.util.find_spec("torch") is None:
        return False
    import torch

    return kind == "torch" or torch.cuda.is_available()


def main(
    city: Annotated[str, typer.Option(help="Name of the city.")] = "vancouver",
    texts: Annotated[int, typer.Option(help="Texts.")] = 20,
    cells: Annotated[int, typer.Option(help="Cells a text.")] = 1000,
    seed: Annotated[int, typer.Option(help="Seed of the texts and the cells.")] = 0,
    *,
    quick: Annotated[bool, typer.Option(help="3 texts, 200 cells, a second a row.")] = False,
    data: Annotated[Path, typer.Option(help="Folder with the extracts.")] = DATA,
    maps: Annotated[Path, typer.Option(help="Folder for maps.")] = ROOT / ".benchmark-cache",
    out: Annotated[Path, typer.Option(help="JSON file.")] = (
        ROOT / "benchmarks/results/outdoor_pairs.json"
    ),
) -> None:
    """Measure pairs a second and print Markdown."""
    if quick:
        texts, cells = 3, 200
    given = (city, data, maps, texts, cells, seed)
    counts = [n for n in (1, 2) if n <= len(os.sched_getaffinity(0))]
    open_city(city, data, maps)  # built once, not in every process
    rows: list[dict[str, Any]] = []
    for kind, name in WORKS.items():
        for n in counts if kind != "cuda" else counts[-1:]:
            if can_run(kind) and not (kind.startswith("edits") and n > 1):
                found = apart(n, measure, kind, *given, quick=quick)
                rows.append({"kind": kind, "name": name, "cores": n} | found)
    header = ["pairs/s", "one core", "two cores", "two cores, times the paper's"]
    lines = []
    for kind, name in WORKS.items():
        by_cores = {r["cores"]: r["pairs_per_s"] for r in rows if r["kind"] == kind}
        theirs = PAPER["network-based, GPU" if kind == "cuda" else "network-based, CPU"]
        theirs = PAPER["rule-based"] if kind.startswith("edits") else theirs
        best = by_cores.get(2, by_cores.get(1))
        figures = [number(by_cores.get(1)), number(by_cores.get(2))]
        lines.append([name, *figures, number(best / theirs) if best else "–"])
    lines += [[f"*paper: {name}*", number(value, 2), "–", "–"] for name, value in PAPER.items()]
    print(markdown(header, lines))
    out.parent.mkdir(parents=True, exist_ok=True)
    record = {
        "machine": machine(),
        "city": city,
        "texts": texts,
        "cells": cells,
        "seed": seed,
        "paper": PAPER,
        "rows": rows,
    }
    out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
