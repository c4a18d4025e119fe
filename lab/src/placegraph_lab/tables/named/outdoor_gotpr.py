"""GOTPR's released network on its released graphs: the transformer's rows on OSM of Table II.

RELEASE is the folder `data` of github.com/donghwijung/GOTLoc with `scene_graphs` and
`model_checkpoints`. `docs/howto-kitti360pose.md` says what is read of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path  # Typer reads the annotations
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph_lab.datasets.pickles import Graph, Graphs, file_of, read_graphs
from placegraph_lab.tables.kitti.kitti360pose import PAPER, RANKS
from placegraph_lab.tables.runner import Quick, Run, markdown, option, share, table
from placegraph_learn.torch_files import read_state

Floats = NDArray[np.float32]

SIDES = ("TSALayers", "GSALayers", "TCALayers", "GCALayers")  # text and graph, within and across
SLOPE = 0.01  # of the leaky rectifiers
CANDIDATES = 10  # cells that the published evaluation compares closely
_MEND = "give the released model_osm.pt"


def sizes(layers: int, heads: int, width: int) -> dict[str, tuple[int, ...]]:
    """Shape of every weight, by its published name."""
    found: dict[str, tuple[int, ...]] = {}

    def linear(name: str, to: int, of: int, *, bias: bool = True) -> None:
        found[f"{name}.weight"] = (to, of)
        if bias:
            found[f"{name}.bias"] = (to,)

    for side in SIDES:
        for i in range(layers):
            layer = f"{side}.{i}.TConv"
            for name in ("lin_key", "lin_query", "lin_value"):
                linear(f"{layer}.{name}", heads * width, width)
            linear(f"{layer}.lin_edge", heads * width, width, bias=False)
            linear(f"{layer}.lin_skip", width, width)
    for i, (to, of) in enumerate(((2 * width, 2 * width), (width, 2 * width), (1, width))):
        linear(f"SceneText_MLP.{2 * i}", to, of)
    return found


@dataclass(frozen=True, eq=False)
class BigGNN:
    """The published network; 300 wide, one layer, two heads as released."""

    layers: int
    heads: int
    width: int
    arrays: dict[str, Floats]

    @classmethod
    def open(cls, path: Path) -> BigGNN:
        """Read a released checkpoint: a state dict, of which nothing is run."""
        import torch

        state = read_state(torch, path, "GOTPR")
        return cls.of({key: np.asarray(t.float().numpy()) for key, t in state.items()}, str(path))

    @classmethod
    def of(cls, state: Mapping[str, Floats], source: str) -> BigGNN:
        """Network of arrays by published name; raises as `open` does."""
        skip, key = (f"TSALayers.0.TConv.{name}.weight" for name in ("lin_skip", "lin_key"))
        for name in (skip, key):
            if name not in state or state[name].ndim != 2:
                raise InputError(f"{source}: key {name!r} is missing or no matrix; {_MEND}.")
        width = state[skip].shape[0]
        heads = state[key].shape[0] // max(1, width)
        layers = len({name.split(".")[1] for name in state if name.startswith("TSALayers.")})
        expected = sizes(layers, heads, width)
        for what, keys in (
            ("is missing", expected.keys() - state.keys()),
            ("is unknown", state.keys() - expected.keys()),
        ):
            if keys:
                raise InputError(f"{source}: key {min(keys)!r} {what}; {_MEND}.")
        for name, wanted in expected.items():
            if state[name].shape != wanted:
                raise InputError(
                    f"{source}: key {name!r} has shape {state[name].shape}, not {wanted}; {_MEND}."
                )
            if not np.isfinite(state[name]).all():
                raise InputError(
                    f"{source}: key {name!r} contains something that is not a number; {_MEND}."
                )
        return cls(layers, heads, width, dict(state))

    def texts(self, graphs: Graphs) -> Floats:
        """Joint embeddings (G, width) of text graphs (Eq. 14)."""
        return self._embedded(graphs, "TSALayers", "TCALayers")

    def places(self, graphs: Graphs) -> Floats:
        """Joint embeddings (G, width) of map graphs (Eq. 14)."""
        return self._embedded(graphs, "GSALayers", "GCALayers")

    def first(self, graphs: Graphs) -> Floats:
        """Embeddings (G, width) by which candidates are found (Eq. 9-10): one layer for both sides."""
        found = []
        for graph in graphs.graphs.values():
            x, e = graphs.vectors[graph.nodes], graphs.vectors[graph.edges]
            found.append(self._layer("TSALayers.0", x, graph.ends, e).mean(axis=0))
        return np.stack(found)

    def probability(self, texts: Floats, places: Floats) -> Floats:
        """Matching probabilities (P,) of pairs of joint embeddings (P, width) (Eq. 17)."""
        x = np.hstack([texts, places])
        for i in (0, 2):
            x = _leaky(self._linear(f"SceneText_MLP.{i}", x))
        return np.asarray(1.0 / (1.0 + np.exp(-self._linear("SceneText_MLP.4", x)[:, 0])))

    def _embedded(self, graphs: Graphs, within: str, across: str) -> Floats:
        found = [self._joint(graphs, graph, within, across) for graph in graphs.graphs.values()]
        return np.stack(found)

    def _joint(self, graphs: Graphs, graph: Graph, within: str, across: str) -> Floats:
        x, e = graphs.vectors[graph.nodes], graphs.vectors[graph.edges]
        none = np.zeros((2, 0), np.int64)
        for i in range(self.layers):
            x = self._layer(f"{within}.{i}", x, graph.ends, e)
            x = self._layer(f"{across}.{i}", x, none, e[:0])
        return np.asarray(x.mean(axis=0))

    def _layer(self, name: str, x: Floats, ends: NDArray[np.int64], e: Floats) -> Floats:
        n, h, c = len(x), self.heads, self.width
        source, target = ends
        query, key, value = (
            self._linear(f"{name}.TConv.lin_{part}", x).reshape(n, h, c)
            for part in ("query", "key", "value")
        )
        told = (e @ self.arrays[f"{name}.TConv.lin_edge.weight"].T).reshape(-1, h, c)
        logit = (query[target] * (key[source] + told)).sum(axis=2) / np.sqrt(c)
        top = np.full((n, h), -np.inf, np.float32)
        np.maximum.at(top, target, logit)
        weight = np.exp(logit - top[target])
        total = np.zeros((n, h), np.float32)
        np.add.at(total, target, weight)
        out = np.zeros((n, h, c), np.float32)
        share = (weight / total[target])[:, :, None]
        np.add.at(out, target, share * (value[source] + told))
        return _leaky(out.mean(axis=1) + self._linear(f"{name}.TConv.lin_skip", x))

    def _linear(self, name: str, x: Floats) -> Floats:
        y: Floats = x @ self.arrays[f"{name}.weight"].T + self.arrays[f"{name}.bias"]
        return y


def _leaky(x: Floats) -> Floats:
    return np.where(x >= 0.0, x, SLOPE * x).astype(np.float32)


def recalls(
    network: BigGNN,
    texts: Graphs,
    cells: Graphs,
    *,
    candidates: int | None = CANDIDATES,
    ranks: Sequence[int] = (1, 3, 5),
) -> dict[int, float]:
    """Recall of the exact cell by rank, as `eval.py` counts it (Eq. 11-16).

    Cells are those of the texts' drives; they are ranked by the cosine of the joint embeddings,
    the `candidates` nearest by `BigGNN.first`, or all where None.
    """
    for graphs in (texts, cells):
        if graphs.vectors.shape[1] != network.width:
            raise InputError(
                f"Word vectors have {graphs.vectors.shape[1]} numbers, the network takes "
                f"{network.width}; take graphs and weights of one release."
            )
    drives = {name.split("_")[0] for name in texts.graphs}
    chosen = {name: g for name, g in cells.graphs.items() if name.split("_")[0] in drives}
    if not chosen:
        raise InputError(f"No cell is of the drives {', '.join(sorted(drives))} of the texts.")
    here = type(cells)(chosen, cells.vectors)
    names = np.array(list(chosen))
    said, there = _unit(network.texts(texts)), _unit(network.places(here))
    near = None if candidates is None else (_unit(network.first(texts)), _unit(network.first(here)))
    found = []
    for row, name in enumerate(texts.graphs):
        scores = there @ said[row]
        if near is not None:
            dropped = np.argsort(-(near[1] @ near[0][row]), kind="stable")[candidates:]
            scores[dropped] = -np.inf
        best = np.argsort(-scores, kind="stable")[: max(ranks)]
        best = best[np.isfinite(scores[best])]
        found.append(names[best] == "_".join(name.split("_")[:2]))
    return {k: float(np.mean([f[:k].any() for f in found])) for k in ranks}


def _unit(x: Floats) -> Floats:
    return np.asarray(x / np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-8))


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
