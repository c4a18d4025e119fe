"""Scene graphs of any source as places that the outdoor network reads."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from placegraph.graph import SceneGraph
from placegraph.outdoor.map.objects import of_name
from placegraph.outdoor.network.graphs import PlaceGraphs
from placegraph.outdoor.network.graphs_kernels import MOST_THINGS


def places_of_graphs(graphs: Sequence[SceneGraph], centers: NDArray[np.float64]) -> PlaceGraphs:
    """Graphs of any scene graphs with positions in a plane, around `centers` (K, 2) [m]."""
    rows: dict[str, int] = {}
    offsets, words, starts = [], [], [0]
    for graph, center in zip(graphs, centers, strict=True):
        off = graph.positions[:, :2] - center
        nearest = np.argsort(np.hypot(*off.T), kind="stable")[:MOST_THINGS]
        offsets.append(off[nearest])
        for i in nearest:
            called = [graph.labels[i]]
            called += [of_name(graph.names[i])] if graph.names[i] else []
            words.append([rows.setdefault(word, len(rows)) for word in called])
        starts.append(len(words))
    flat = [word for thing in words for word in thing]
    return PlaceGraphs(
        np.array(starts, np.int64),
        np.concatenate([np.zeros((0, 2)), *offsets]).astype(np.float32),
        np.zeros(len(words), np.uint8),
        np.concatenate(([0], np.cumsum([len(thing) for thing in words]))).astype(np.int64),
        np.array(flat, np.int32),
        np.ones(len(flat), np.float32),
        tuple(rows),
    )
