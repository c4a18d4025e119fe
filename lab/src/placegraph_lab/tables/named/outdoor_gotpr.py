"""GOTPR's released network on its released graphs: the transformer's rows on OSM of Table II.

    placegraph-lab table outdoor_gotpr data

RELEASE is the folder `data` of github.com/donghwijung/GOTLoc with `scene_graphs` and
`model_checkpoints`. `docs/howto-kitti360pose.md` says what is read of them.
"""

from __future__ import annotations

from pathlib import Path  # Typer reads the annotations
from typing import Annotated

import typer

from placegraph_lab.datasets.gotpr import file_of, read_graphs
from placegraph_lab.tables.kitti.gotpr import CANDIDATES, BigGNN, recalls
from placegraph_lab.tables.kitti.kitti360pose import PAPER, RANKS
from placegraph_lab.tables.run import Quick, Run, option, table
from placegraph_lab.tables.tables import markdown, share

SPLITS = ("val", "test")
TITLE = "GOTPR's released weights on its released graphs (Table II)"


@table("GOTLoc, Table II")
def outdoor_gotpr(
    run: Run,
    release: Annotated[
        Path, typer.Argument(help="Released folder, with scene_graphs and weights.")
    ],
    weights: Annotated[
        Path | None, option("Of the network; model_checkpoints/*.pt if not given.")
    ] = None,
    candidates: Annotated[int, option("Cells that are compared closely.")] = CANDIDATES,
    *,
    quick: Quick = False,
) -> None:
    """GOTPR's released weights on its released graphs, with candidates and without."""
    network = BigGNN.open(weights or file_of(release, "model_checkpoints/*.pt"))
    cells = read_graphs(file_of(release, "scene_graphs/osm_cell_graphs_*.pkl"))
    asked: dict[str, int | None] = {f"{candidates} candidates": candidates, "all cells": None}
    found: dict[str, list[dict[int, float]]] = {name: [] for name in asked}
    texts: dict[str, int] = {}
    for split in run.track(SPLITS[:1] if quick else SPLITS, "splits"):
        graphs = read_graphs(file_of(release, f"scene_graphs/osm_{split}_text_graphs_*.pkl"))
        texts[split] = len(graphs.graphs)
        for name, most in asked.items():
            found[name].append(recalls(network, graphs, cells, candidates=most, ranks=RANKS))
    published = zip(SPLITS, PAPER["GOTLoc on OSM, transformer"], strict=True)
    header = ["", *(f"{split} k = {k}" for split in texts for k in RANKS)]
    rows = [["published", *(share(x) for split, r in published if split in texts for x in r or ())]]
    rows += [[name, *(share(r[k]) for r in found[name] for k in RANKS)] for name in asked]
    print(f"### {TITLE}\n\n{markdown(header, rows)}")
    run.save({"texts": texts, "cells": len(cells.graphs), "rows": found})
