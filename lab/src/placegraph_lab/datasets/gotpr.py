"""The scene graphs of GOTPR (GOTLoc) as its authors released them.

Layout after `config.py`, `scene_graph.py` and `eval.py` of github.com/donghwijung/GOTLoc (2025): a
folder `data` with ``scene_graphs/osm_cell_graphs_<n>.pkl``, ``osm_train_text_graphs_<n>.pkl``,
``osm_val_text_graphs_<n>.pkl``, ``osm_test_text_graphs_<n>.pkl`` and
``model_checkpoints/model_osm.pt``. Each pickle is a dict of `scene_graph.SceneGraph` by id: a cell's
as KITTI360Pose has it (``0003_00012``), a text's with its number behind it (``0003_00012_00004``).
Nodes and relations come with their word vectors, so that no word file is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.errors import InputError
from placegraph_lab.datasets.pickles import Record, Release, finished, read_pickle

RELEASE = Release("GOTPR", "scene_graph", ("SceneGraph", "Node"))  # the published classes
LONGEST = 4096  # numbers of a word vector at most


@dataclass(frozen=True, eq=False)
class Graph:
    """A scene graph of n nodes and e edges."""

    labels: tuple[str, ...]
    nodes: NDArray[np.int64]  # (n,) rows of `Graphs.vectors`
    ends: NDArray[np.int64]  # (2, e) source and target of each edge, rows of nodes
    edges: NDArray[np.int64]  # (e,) rows of `Graphs.vectors`: what the relation is called


@dataclass(frozen=True, eq=False)
class Graphs:
    """The graphs of one file."""

    graphs: dict[str, Graph]  # by their ids
    vectors: NDArray[np.float32]  # (V, d) word vectors, each once


def read_graphs(path: str | PathLike[str]) -> Graphs:
    """Read a file of scene graphs; nothing in it is run.

    Raises `InputError`: the file is missing, damaged, or no such pickle; or a graph is not what it
    should be: the message names its id and the field.
    """
    value = read_pickle(path, RELEASE)
    if type(value) is not dict or not value:
        raise InputError(f"{path} holds no graphs by id; download it again.")
    vectors = _Vectors()
    found = {str(key): _graph(graph, f"{path}, {key}", vectors) for key, graph in value.items()}
    return Graphs(found, np.stack(vectors.rows))


def file_of(folder: str | PathLike[str], pattern: str) -> Path:
    """The one file of a released folder that fits a pattern; `InputError` where there is not one."""
    found = sorted(Path(folder).glob(pattern))
    if len(found) != 1:
        what = f"{len(found)} files" if found else "no file"
        raise InputError(
            f"{folder} holds {what} {pattern}; name the folder `data` of GOTPR with one of them."
        )
    return found[0]


class _Vectors:
    """Word vectors, each kept once: released graphs repeat those of four relations by the million."""

    def __init__(self) -> None:
        self.rows: list[NDArray[np.float32]] = []
        self.known: dict[bytes, int] = {}
        self.seen: dict[int, int] = {}

    def row(self, value: Any, where: str) -> int:  # noqa: ANN401  # whatever the file holds
        if id(value) not in self.seen:  # the whole file stays in memory: ids do not change hands
            vector = _vector(finished(value), where)
            if self.rows and len(vector) != len(self.rows[0]):
                raise InputError(
                    f"{where} has {len(vector)} numbers, others {len(self.rows[0])}; "
                    "download the file again."
                )
            key = vector.tobytes()
            if key not in self.known:
                self.known[key] = len(self.rows)
                self.rows.append(vector)
            self.seen[id(value)] = self.known[key]
        return self.seen[id(value)]


def _vector(value: object, where: str) -> NDArray[np.float32]:
    if isinstance(value, list | tuple) and all(type(x) in (int, float) for x in value):
        value = np.array(value, np.float64)
    if not isinstance(value, np.ndarray) or value.ndim != 1 or not 1 <= len(value) <= LONGEST:
        raise InputError(f"{where} is no vector; download the file again.")
    if not (np.abs(value.astype(np.float64)) < 1e9).all():
        raise InputError(f"{where} holds what is no number; download the file again.")
    return value.astype(np.float32)


def _graph(value: object, where: str, vectors: _Vectors) -> Graph:
    nodes = _field(value, "SceneGraph", "nodes", dict, where)
    (sources, targets), features = _edges(value, where)
    rows: dict[int, int] = {}
    labels, words = [], []
    for row, (key, node) in enumerate(nodes.items()):
        at = f"{where}, node {key}"
        rows[_field(node, "Node", "idx", int, at)] = row
        labels.append(str(_field(node, "Node", "label", object, at)))
        features_of = _field(node, "Node", "features", object, at)
        words.append(vectors.row(features_of, f"{at}: features"))
    if len(rows) != len(nodes) or not nodes:
        raise InputError(f"{where}: nodes are missing or there twice; download the file again.")
    try:
        ends = [[rows[int(end)] for end in side] for side in (sources, targets)]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{where}: edge_idx names a node that is not there ({error}); download the file again."
        ) from error
    edges = [vectors.row(v, f"{where}: edge_features, {i}") for i, v in enumerate(features)]
    return Graph(
        tuple(labels),
        np.array(words, np.int64),
        np.array(ends, np.int64).reshape(2, -1),
        np.array(edges, np.int64),
    )


def _edges(value: object, where: str) -> tuple[list[list[Any]], list[Any]]:
    """Ends of the edges as the file has them, and what is said of each."""
    ends = _field(value, "SceneGraph", "edge_idx", list, where)
    features = _field(value, "SceneGraph", "edge_features", list, where)
    if len(ends) != 2 or any(type(e) is not list or len(e) != len(features) for e in ends):
        raise InputError(
            f"{where}: edge_idx does not have two ends for each of {len(features)} edge_features; "
            "download the file again."
        )
    return ends, features


def _field(value: object, kind: str, name: str, type_: type, where: str) -> Any:  # noqa: ANN401
    """Field of a record; `InputError` where it is another record, or the field of another type."""
    if not isinstance(value, Record) or value.kind != kind:
        raise InputError(f"{where} is no {kind}; download the file again.")
    if name not in value.fields:
        raise InputError(f"{where} has no {name}; is this another release of the data?")
    found = value.fields[name]
    if not isinstance(found, type_) or type(found) is bool:
        raise InputError(f"{where}: {name} is no {type_.__name__}; download the file again.")
    return found
